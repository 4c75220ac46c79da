# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Checks of the values that a parameter file or a command gives to a node."""

from __future__ import annotations

from typing import Any


def check_value(entry: Any, value: Any) -> None:
    """Check that a node accepts a value for one of its parameters."""
    assert entry.problem(value) is None
    if isinstance(entry.default, float):
        assert isinstance(value, float), f"{entry.name}: {value} lacks its decimal point"
    elif entry.default == ():
        assert all(isinstance(v, float) for v in value)
    else:
        assert isinstance(value, type(entry.default))


def check_parameter_file(content: dict[str, Any], tables: dict[str, Any]) -> None:
    """Check that every section of a parameter file names a node that accepts its values."""
    for address, section in content.items():
        node = address.rpartition("/")[2]
        known = {entry.name: entry for entry in tables[node]}
        assert set(section) == {"ros__parameters"}
        for name, value in section["ros__parameters"].items():
            assert name in known, f"{node} has no parameter {name}"
            check_value(known[name], value)
