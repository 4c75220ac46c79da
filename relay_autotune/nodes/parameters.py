"""Declaring a node's parameters from a table, and refusing values with a sentence."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from relay_autotune.errors import ParameterError

_LARGEST_INTEGER = 2**62


@dataclass(frozen=True)
class NodeParameter:
    """A parameter of a node.

    :param name: its name.
    :param default: its default, which also tells its type; NaN: not given; (): an array of
        numbers that is not given.
    :param unit: y of the measurement, u of the command, s seconds; "": none.
    :param description: what it does, one sentence without the unit.
    :param minimum: least value, inclusive.
    :param maximum: greatest value, inclusive.
    :param choices: the words it may be, for a string; (): any.
    """

    name: str
    default: float | int | bool | str | tuple[float, ...]
    unit: str
    description: str
    minimum: float = -math.inf
    maximum: float = math.inf
    choices: tuple[str, ...] = ()

    def check(self, value: Any) -> None:
        """Refuse a value that is out of range.

        :raises ParameterError: with a sentence that names value and range.
        """
        if self.choices and value not in self.choices:
            raise ParameterError(
                f"{self.name} must be one of {', '.join(self.choices)}, found {value!r}"
            )
        if isinstance(value, (str, bool)) or value is None:
            return
        if isinstance(value, (int, float)):
            self._check_number(float(value))
            return
        for number in value:
            if not math.isfinite(number):
                raise ParameterError(f"{self.name} needs finite numbers, found {list(value)}")

    def _check_number(self, value: float) -> None:
        not_given = isinstance(self.default, float) and math.isnan(self.default)
        if math.isnan(value) and not_given:
            return
        # An infinite limit is given as the default of a parameter that may be infinite.
        if math.isinf(value) and value == self.default:
            return
        if not (math.isfinite(value) and self.minimum <= value <= self.maximum):
            raise ParameterError(f"{self.name} must be {self.range_text()}, found {value:g}")

    def range_text(self) -> str:
        """Say the range in words, such as "finite and at least 0"."""
        unit = f" {self.unit}" if self.unit else ""
        match math.isfinite(self.minimum), math.isfinite(self.maximum):
            case True, True:
                return f"from {self.minimum:g} to {self.maximum:g}{unit}"
            case True, False:
                return f"finite and at least {self.minimum:g}{unit}"
            case False, True:
                return f"finite and at most {self.maximum:g}{unit}"
        return "finite"

    def descriptor(self, *, read_only: bool = False) -> ParameterDescriptor:
        """Return the descriptor that `ros2 param describe` shows.

        :param read_only: True if the value is fixed once the node runs.
        """
        description = self.description if not self.unit else f"{self.description} [{self.unit}]"
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        bounded = math.isfinite(self.minimum) or math.isfinite(self.maximum)
        if isinstance(self.default, bool) or not bounded:
            pass
        elif isinstance(self.default, int):
            descriptor.integer_range = [
                IntegerRange(
                    from_value=int(max(self.minimum, -_LARGEST_INTEGER)),
                    to_value=int(min(self.maximum, _LARGEST_INTEGER)),
                )
            ]
        elif isinstance(self.default, float) and math.isfinite(self.default):
            # A range would refuse a default that means "not given"; such are checked by `check`.
            descriptor.floating_point_range = [
                FloatingPointRange(
                    from_value=max(self.minimum, -sys.float_info.max),
                    to_value=min(self.maximum, sys.float_info.max),
                )
            ]
        if self.choices:
            descriptor.additional_constraints = f"one of {', '.join(self.choices)}"
        elif isinstance(self.default, (int, float)) and not isinstance(self.default, bool):
            descriptor.additional_constraints = self.range_text()
        return descriptor


def declare(node: Node, table: Iterable[NodeParameter], *, read_only: bool = False) -> None:
    """Declare the parameters of a table on a node.

    :param node: the node.
    :param table: the parameters.
    :param read_only: True if they are fixed once the node runs.
    :raises ParameterError: if a value given at the start has the wrong type or is out of range.
    """
    for entry in table:
        default = Parameter.Type.DOUBLE_ARRAY if entry.default == () else entry.default
        try:
            node.declare_parameter(entry.name, default, entry.descriptor(read_only=read_only))
        except InvalidParameterTypeException as error:
            raise ParameterError(_wrong_type(entry, error)) from error
        except InvalidParameterValueException as error:
            given = node.get_parameter_or(entry.name, None)
            value = getattr(given, "value", None)
            found = _overridden(error) if value is None else value
            raise ParameterError(
                f"{entry.name} must be {entry.range_text()}, found {found}"
            ) from error
        entry.check(value_of(node, entry))


def value_of(node: Node, entry: NodeParameter) -> Any:
    """Return the present value of a parameter, () for an array that is not given."""
    if entry.default == ():
        value = node.get_parameter_or(entry.name, None)
        return () if value is None or value.value is None else tuple(value.value)
    return node.get_parameter(entry.name).value


def values_of(node: Node, table: Iterable[NodeParameter]) -> dict[str, Any]:
    """Return the present values of a table's parameters by name."""
    return {entry.name: value_of(node, entry) for entry in table}


def merged(
    node: Node, table: Sequence[NodeParameter], changes: Iterable[Parameter]
) -> dict[str, Any]:
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
        if entry is not None:
            entry.check(change.value)
            values[change.name] = change.value
    return values


def _wrong_type(entry: NodeParameter, error: InvalidParameterTypeException) -> str:
    wanted = "numbers" if entry.default == () else type(entry.default).__name__
    hint = ""
    if isinstance(entry.default, (float, tuple)):
        hint = "; write numbers with a decimal point, such as 2.0"
    return f"{entry.name} has the wrong type, expected {wanted}{hint} ({error})"


def _overridden(error: InvalidParameterValueException) -> str:
    return str(error).rsplit("value: ", maxsplit=1)[-1].strip(" .'\"")
