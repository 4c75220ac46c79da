# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A rig for each test, in a free ROS domain."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from loop_rig import Rig
from ros_domain import free_domain

# They take longest: begun last, each would run alone at the end.
_FIRST = tuple(
    f"test_{name}.py"
    for name in ("faults", "guide", "joint", "remote_gains_kept", "new_loop", "tune_loop")
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.name not in _FIRST)


@pytest.fixture
def rig(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Rig]:
    with free_domain() as domain:
        made = Rig(domain, tmp_path)
        request.node.rig = made
        try:
            yield made
        finally:
            made.close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    report = yield
    made = getattr(item, "rig", None)
    if report.failed and made is not None:
        report.sections.append(("logs of the processes", made.logs()))
    return report
