"""Declaring a node's parameters from a table, and refusing values with a sentence."""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from relay_autotune.errors import ParameterError

# What rclpy adds to every node.
_EVERY_NODE = ("use_sim_time", "start_type_description_service")
_QOS_OVERRIDES = "qos_overrides."
_LARGEST_INTEGER = 2**62


class Entry(Protocol):
    """A row of a table of parameters: a `NodeParameter`, or one of the experiment's own table."""

    @property
    def name(self) -> str:
        """Name of the parameter."""

    @property
    def default(self) -> Any:
        """Its default, which also tells its type."""

    @property
    def unit(self) -> str:
        """Its unit."""

    @property
    def description(self) -> str:
        """What it does."""

    @property
    def lower(self) -> float:
        """Smallest value allowed."""

    @property
    def upper(self) -> float:
        """Largest value allowed."""

    @property
    def range_text(self) -> str:
        """The range in words."""

    def problem(self, value: Any) -> str | None:
        """Say what is wrong with a value, None if nothing is."""


@dataclass(frozen=True)
class NodeParameter:
    """A parameter of a node.

    :param name: its name.
    :param default: its default, which also tells its type; NaN: not given; (): an array of
        numbers that is not given.
    :param unit: y of the measurement, u of the command, s seconds; "": none.
    :param description: what it does, one sentence.
    :param lower: smallest value allowed.
    :param upper: largest value allowed.
    :param choices: the words it may be, for a string; (): any.
    """

    name: str
    default: float | int | bool | str | tuple[float, ...]
    unit: str
    description: str
    lower: float = -math.inf
    upper: float = math.inf
    choices: tuple[str, ...] = ()

    @property
    def range_text(self) -> str:
        """The range in words, such as "a finite number of at least 0 s"."""
        if self.choices:
            return f"one of {', '.join(filter(None, self.choices))}"
        if isinstance(self.default, str):
            return "a text"
        if isinstance(self.default, bool):
            return "true or false"
        unit = f" {self.unit}" if self.unit else ""
        text = "finite numbers" if isinstance(self.default, tuple) else "a finite number"
        if math.isfinite(self.lower) and math.isfinite(self.upper):
            text += f" from {self.lower:g} to {self.upper:g}{unit}"
        elif math.isfinite(self.lower):
            text += f" of at least {self.lower:g}{unit}"
        if isinstance(self.default, float) and math.isnan(self.default):
            text += ", or NaN where it is not given"
        return text

    def problem(self, value: Any) -> str | None:
        """Return a sentence on what is wrong with a value, or None if it may be taken."""
        if self.choices:
            fine = value in self.choices
        elif isinstance(self.default, tuple):
            fine = all(math.isfinite(number) for number in value)
        elif isinstance(self.default, (str, bool)):
            fine = True
        else:
            # An infinite default says that the parameter may be infinite: a limit that is none.
            fine = math.isfinite(value) and self.lower <= value <= self.upper
            fine = fine or value == self.default
            fine = fine or (math.isnan(value) and math.isnan(self.default))
        return None if fine else f"{self.name} is {value!r}, expected {self.range_text}"


def descriptor_of(entry: Entry, *, read_only: bool = False) -> ParameterDescriptor:
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
    number = isinstance(entry.default, (int, float)) and not isinstance(entry.default, bool)
    # A range would refuse a default that means "not given" or "unlimited"; `problem` knows it.
    if not number or not math.isfinite(entry.default):
        return descriptor
    if not math.isfinite(entry.lower) and not math.isfinite(entry.upper):
        return descriptor
    if isinstance(entry.default, int):
        descriptor.integer_range = [
            IntegerRange(
                from_value=int(max(entry.lower, -_LARGEST_INTEGER)),
                to_value=int(min(entry.upper, _LARGEST_INTEGER)),
            )
        ]
    else:
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=max(entry.lower, -sys.float_info.max),
                to_value=min(entry.upper, sys.float_info.max),
            )
        ]
    return descriptor


def declare(node: Node, table: Iterable[Entry], *, read_only: bool = False) -> None:
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


def unknown_parameters(names: Iterable[str], table: Iterable[Entry]) -> list[str]:
    """Return a sentence on each name that no parameter has.

    rclpy passes over them without a word, and over the limits that they may have been.

    :param names: of the values that were given at the start.
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


def value_of(node: Node, entry: Entry) -> Any:
    """Return the present value of a parameter, () for an array that is not given."""
    if entry.default == ():
        given = node.get_parameter_or(entry.name, None)
        return () if given is None or given.value is None else tuple(given.value)
    return node.get_parameter(entry.name).value


def values_of(node: Node, table: Iterable[Entry]) -> dict[str, Any]:
    """Return the present values of a table's parameters by name."""
    return {entry.name: value_of(node, entry) for entry in table}


def merged(node: Node, table: Sequence[Entry], changes: Iterable[Parameter]) -> dict[str, Any]:
    """Return a table's values as they would be after changes.

    :param node: the node.
    :param table: its parameters.
    :param changes: what is about to be set; names that are not in the table are left alone.
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


def _check(entry: Entry, value: Any) -> None:
    problem = entry.problem(value)
    # Only what is unlimited by default may be infinite.
    infinite = isinstance(value, float) and math.isinf(value) and not math.isinf(entry.default)
    if problem is None and infinite:
        problem = f"{entry.name} is {value:g}, expected a finite number"
    if problem is not None:
        raise ParameterError(problem)


def _wrong_type(entry: Entry, error: InvalidParameterTypeException) -> str:
    found = str(error).split("' of type '")[0].rsplit("'", maxsplit=1)[-1]
    if entry.default == ():
        return f"{entry.name} is {found}, expected numbers with a decimal point, such as [2.0]"
    if isinstance(entry.default, float):
        return f"{entry.name} is {found}, expected a number with a decimal point, such as 2.0"
    kind = {int: "a whole number", bool: "true or false", str: "a text"}[type(entry.default)]
    return f"{entry.name} is {found}, expected {kind}"
