# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The names for programs and notebooks, which cost nothing until they are used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import relay_autotune


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


def test_an_unknown_name_is_an_ordinary_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'autotun'"):
        getattr(relay_autotune, "autotun")  # noqa: B009  the name is what is tested
    with pytest.raises(ImportError):
        from relay_autotune import autotun  # noqa: F401
