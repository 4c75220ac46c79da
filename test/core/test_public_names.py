# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The names for programs and notebooks, which cost nothing until they are used."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import relay_autotune
from relay_autotune.loop.sampled import ClosedLoop


def loaded_by(code: str) -> set[str]:
    """Return the top-level packages that a fresh process has loaded after some code."""
    script = f"{code}\nimport sys\nprint(*sorted(m.partition('.')[0] for m in sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60
    )
    return set(done.stdout.split())


def test_every_public_name_is_there() -> None:
    assert sorted(relay_autotune.__all__) == sorted(relay_autotune._HOME)
    # The others need what is not in every environment in which the core is tested.
    for name in set(relay_autotune.__all__) - {"read_records"}:
        assert getattr(relay_autotune, name) is not None
    assert set(relay_autotune.__all__) <= set(dir(relay_autotune))


def test_the_package_alone_loads_nothing() -> None:
    assert not loaded_by("import relay_autotune") & {"numpy", "scipy", "matplotlib", "mcap"}


@pytest.mark.long
def test_what_draws_is_loaded_when_it_draws() -> None:
    loaded = loaded_by("from relay_autotune import analyse, draw, write_report")
    assert not loaded & {"matplotlib", "jinja2", "mcap"}


def _classes_in(hint: Any) -> set[Any]:
    """Return the classes that a type hint names."""
    inside = [_classes_in(each) for each in get_args(hint) if not isinstance(each, list)]
    return {get_origin(hint) or hint}.union(*inside)


def test_what_holds_arrays_is_equal_to_itself_alone() -> None:
    """Arrays are compared number by number, so that neither == nor hash has an answer."""
    public = [getattr(relay_autotune, name) for name in relay_autotune.__all__]
    waiting = {kind for kind in public if isinstance(kind, type)} | {ClosedLoop}
    inside: dict[Any, set[Any]] = {}
    while waiting:
        kind = waiting.pop()
        if is_dataclass(kind) and kind not in inside:
            inside[kind] = set().union(*map(_classes_in, get_type_hints(kind).values()))
            waiting |= inside[kind]
    compared = {kind for kind in inside if kind.__eq__ is not object.__eq__}
    assert relay_autotune.Controller in compared
    alone = inside.keys() - compared | {np.ndarray}
    assert {relay_autotune.Record, relay_autotune.Analysis} <= alone
    assert {kind.__name__ for kind in compared if inside[kind] & alone} == set()


def test_an_unknown_name_is_an_ordinary_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'autotun'"):
        getattr(relay_autotune, "autotun")  # noqa: B009  the name is what is tested
    with pytest.raises(ImportError):
        from relay_autotune import autotun  # noqa: F401
