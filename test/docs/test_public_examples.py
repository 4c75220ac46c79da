# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What `help()` shows of each public name has an example, and the example is true."""

from __future__ import annotations

import doctest
import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pages import ROOT
from report_cases import only

import relay_autotune

# their help is that of a dict; that of the package shows them
TABLES = {"METHODS", "RULES", "STRUCTURES"}


def remembering(name: str) -> Callable[..., Any]:
    """Return a public function that remembers its results by what its arguments look like."""
    function, known = getattr(relay_autotune, name), {}

    @functools.wraps(function)
    def remembered(*args: Any, **named: Any) -> Any:
        key = repr((args, named))
        if key not in known:
            known[key] = function(*args, **named)
        return known[key]

    return remembered


@pytest.fixture(scope="module")
def once() -> dict[str, Callable[..., Any]]:
    """Return functions with a memory, so that many examples cost the analysis of one record."""
    return {name: remembering(name) for name in ("read_records", "analyse", "identify")}


@pytest.mark.long
@pytest.mark.parametrize("name", ["__init__", *relay_autotune.__all__])
def test_help_has_an_example_that_is_true(
    name: str, once: dict[str, Callable[..., Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "to_control":
        pytest.importorskip("control")
    if name in TABLES:
        assert name in (relay_autotune.__doc__ or "")
        return
    shown = relay_autotune if name == "__init__" else getattr(relay_autotune, name)
    if name == "write_report":
        only(monkeypatch, "experiment")
    (tmp_path / "bags").symlink_to(ROOT / "bags")
    monkeypatch.chdir(tmp_path)
    for remembered, function in once.items():
        monkeypatch.setattr(relay_autotune, remembered, function)
    text = inspect.getdoc(shown) or ""
    example = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert example.examples, f"help({name}) has no example"
    said: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example, out=said.append)
    assert not said, "".join(said)
