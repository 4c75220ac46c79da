# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Declare a node's parameters from a table, and explain refused values."""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from relay_autotune.errors import ParameterError, RelayAutotuneError
from relay_autotune.quantities import Quantity

# Parameters that rclpy adds to every node.
_EVERY_NODE = ("use_sim_time", "start_type_description_service")
_QOS_OVERRIDES = "qos_overrides."
_LARGEST_INTEGER = 2**62


def descriptor_of(entry: Quantity, *, read_only: bool = False) -> ParameterDescriptor:
    """Return the descriptor that `ros2 param describe` shows.

    :param entry: the parameter.
    :param read_only: True if its value is fixed once the node runs.
    """
    unit = f" [{entry.unit}]" if entry.unit else ""
    descriptor = ParameterDescriptor(
        description=entry.description + unit,
        additional_constraints=entry.range_text,
        read_only=read_only,
    )
    # A range would refuse a default that means "not given" or "unlimited"; `problem` knows it.
    if not entry.is_number or not math.isfinite(entry.default):  # type: ignore[arg-type]
        return descriptor
    if not math.isfinite(entry.lower) and not math.isfinite(entry.upper):
        return descriptor
    whole = isinstance(entry.default, int)
    most = _LARGEST_INTEGER if whole else sys.float_info.max
    low, high = max(entry.lower, -most), min(entry.upper, most)
    if whole:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    else:
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor


def declare(node: Node, table: Iterable[Quantity], *, read_only: bool = False) -> None:
    """Declare the parameters of a table on a node.

    :param node: the node.
    :param table: the parameters.
    :param read_only: True if they are fixed once the node runs.
    :raises ParameterError: if a value given at the start has the wrong type or is out of range.
    """
    for entry in table:
        default = Parameter.Type.DOUBLE_ARRAY if entry.default == () else entry.default
        try:
            node.declare_parameter(entry.name, default, descriptor_of(entry, read_only=read_only))
        except InvalidParameterTypeException as error:
            raise ParameterError(_wrong_type(entry, error)) from error
        except InvalidParameterValueException as error:
            found = str(error).rsplit("value: ", maxsplit=1)[-1].split(":")[0]
            raise ParameterError(
                f"{entry.name} is {found}, expected {entry.range_text}"
            ) from error
        _check(entry, value_of(node, entry))


def unknown_parameters(names: Iterable[str], table: Iterable[Quantity]) -> list[str]:
    """Return a sentence on each name that is no parameter.

    rclpy ignores unknown names without a message; an ignored limit is dangerous.

    :param names: names of the values given at the start.
    :param table: the node's parameters.
    """
    known = [*(entry.name for entry in table), *_EVERY_NODE]
    found = []
    for name in names:
        if name in known or name.startswith(_QOS_OVERRIDES):
            continue
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else "--help lists the parameters"
        found.append(f"there is no parameter {name}, so that it has no effect; {hint}")
    return found


def value_of(node: Node, entry: Quantity) -> Any:
    """Return the present value of a parameter; () for an array that was not given."""
    if entry.default == ():
        given = node.get_parameter_or(entry.name, None)
        return () if given is None or given.value is None else tuple(given.value)
    return node.get_parameter(entry.name).value


def values_of(node: Node, table: Iterable[Quantity]) -> dict[str, Any]:
    """Return the present values of a table's parameters by name."""
    return {entry.name: value_of(node, entry) for entry in table}


def merged(node: Node, table: Sequence[Quantity], changes: Iterable[Parameter]) -> dict[str, Any]:
    """Return a table's values as they would be after changes.

    :param node: the node.
    :param table: its parameters.
    :param changes: the changes about to be made; names that are not in the table are ignored.
    :raises ParameterError: if a changed value is out of range.
    """
    values = values_of(node, table)
    by_name = {entry.name: entry for entry in table}
    for change in changes:
        entry = by_name.get(change.name)
        if entry is None:
            continue
        _check(entry, change.value)
        values[change.name] = change.value
    return values


def ask_before_changes(node: Node, require: Callable[[list[Parameter]], object]) -> None:
    """Ask before each change of a node's parameters.

    :param node: the node.
    :param require: takes the changes; raises RelayAutotuneError with the reason to refuse them.
    """

    def asked(changes: list[Parameter]) -> SetParametersResult:
        try:
            require(changes)
        except RelayAutotuneError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(asked)


def _check(entry: Quantity, value: Any) -> None:
    problem = entry.problem(value)
    if problem is not None:
        raise ParameterError(problem)


def _wrong_type(entry: Quantity, error: InvalidParameterTypeException) -> str:
    found = str(error).split("' of type '")[0].rsplit("'", maxsplit=1)[-1]
    if entry.default == ():
        return f"{entry.name} is {found}, expected numbers with a decimal point, such as [2.0]"
    if isinstance(entry.default, float):
        return f"{entry.name} is {found}, expected a number with a decimal point, such as 2.0"
    kind = {int: "a whole number", bool: "true or false", str: "a text"}[type(entry.default)]
    return f"{entry.name} is {found}, expected {kind}"
