# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Messages of installed types: how a number in them is read, and a command written."""

from __future__ import annotations

import importlib
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import yaml
from rosidl_parser import definition

from relay_autotune.bag.definitions import FLOAT64
from relay_autotune.bag.field_path import (
    NUMBERS,
    Number,
    Repeated,
    Step,
    Struct,
    Text,
    Type,
    reading,
    setting,
    steps_of,
)
from relay_autotune.errors import FieldError, ParameterError
from relay_autotune.exchange.messages import set_stamp, stamp_nanoseconds

# Sequences that a message must have of the same length, or its consumer reads beyond an end.
_ALIKE = {"control_msgs/msg/MultiDOFCommand": ("dof_names", "values", "values_dot")}
# Names of numbers in IDL that ROS calls otherwise.
_PLAIN = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}


@dataclass(frozen=True)
class Reader:
    """Access to a number in a message.

    :param kind: the message class.
    :param type_name: its name, such as ``sensor_msgs/msg/Temperature``.
    :param value: returns the number; raises `FieldError` where a message does not tell it.
    :param stamp_ns: returns the header's stamp [ns since the epoch]; None: it has no header.
    """

    kind: Any
    type_name: str
    value: Callable[[Any], float]
    stamp_ns: Callable[[Any], int] | None


def reader_of(type_name: str, field: str, parameter: str = "measurement_field") -> Reader:
    """Return the reader of the measurement, or of a number beside it, for a message type.

    :param type_name: such as ``sensor_msgs/msg/Temperature``.
    :param field: path of a numeric field, such as ``velocity[left_wheel]`` or ``twist.linear.x``.
    :param parameter: which one names the field, for the error.
    :raises ParameterError: if the type does not exist, or the field is not a number.
    """
    kind = message_class(type_name, "measurement_type")
    struct = struct_of(kind)
    try:
        steps = steps_of(struct, field, struct.name)
    except FieldError as error:
        raise ParameterError(f"{parameter}: {error}") from None
    stamped = hasattr(kind(), "header")
    stamp = (lambda message: stamp_nanoseconds(message.header.stamp)) if stamped else None
    return Reader(kind, struct.name, reading(steps), stamp)


def command_reader(values: Mapping[str, Any]) -> Callable[[Any], float] | None:
    """Return what reads the controller's command from the measurement's messages.

    :param values: the parameters of relay_node or controller_node.
    :return: None: these messages do not have it.
    :raises ParameterError: if they cannot have it.
    """
    field = values["controller_command_field"]
    if not field:
        return None
    return reader_of(values["measurement_type"], field, "controller_command_field").value


def message_class(type_name: str, parameter: str) -> Any:
    """Return the class of a message type.

    :param type_name: such as ``sensor_msgs/msg/Temperature``.
    :param parameter: which parameter names it, for the error.
    :raises ParameterError: if no such type is installed.
    """
    package, _, rest = type_name.partition("/")
    try:
        kind = getattr(importlib.import_module(f"{package}.msg"), rest.removeprefix("msg/"))
        kind()
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ParameterError(
            f"{parameter} is {type_name!r}, expected an installed message type such as {FLOAT64}"
        ) from error
    return kind


@cache
def struct_of(kind: Any) -> Struct:
    """Return the fields of a message class.

    :param kind: as rosidl generates them.
    """
    module = kind.__module__.split(".")
    names = kind.get_fields_and_field_types()
    fields = zip(names, map(_type_of, kind.SLOT_TYPES), strict=True)
    return Struct("/".join((*module[:2], kind.__name__)), tuple(fields))


def _type_of(slot: Any) -> Type:
    if isinstance(slot, definition.NamespacedType):
        module = importlib.import_module(".".join(slot.namespaces))
        return struct_of(getattr(module, slot.name))
    if isinstance(slot, definition.AbstractNestedType):
        count = slot.size if isinstance(slot, definition.Array) else None
        return Repeated(_type_of(slot.value_type), count)
    if isinstance(slot, definition.AbstractGenericString):
        return Text(wide=isinstance(slot, definition.AbstractWString))
    return NUMBERS[_PLAIN.get(slot.typename, slot.typename)]


class CommandMessage:
    """Write commands into a message.

    :param type_name: such as ``geometry_msgs/msg/TwistStamped``.
    :param field: path of the command in it; ``data`` of an array without other elements is its
        only element.
    :param given: what stands in the other elements, as `ros2 topic pub` takes it; empty: what a
        new message holds, zeros.
    :param taken: True: the others are those of a message that comes later.
    :param now_ns: returns the time for the stamp of a header [ns].
    :raises ParameterError: if there is no such type or field, or it does not hold the values.
    """

    def __init__(
        self,
        type_name: str = FLOAT64,
        field: str = "data",
        given: str = "",
        *,
        taken: bool = False,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        if taken and given:
            raise ParameterError(
                "command_message and command_others other_commands are both given: expected one "
                "source of the other elements"
            )
        self.kind = message_class(type_name, "command_type")
        root, message = struct_of(self.kind), self.kind()
        # As the graph calls it: std_msgs/Float64 is a name of this type, too.
        self.type_name = root.name
        _fill(message, _mapping(given), "")
        self.field = self._only_element(root, field, message, taken=taken)
        try:
            steps = steps_of(root, self.field, root.name)
        except FieldError as error:
            raise ParameterError(f"command_field: {error}") from None
        number = _number_of(root, steps)
        if number.form not in "fd":
            raise ParameterError(
                f"command_field: {self.field} of {root.name} is a {number.name}; expected a "
                f"float32 or float64, which can hold the relay's levels"
            )
        self._is_single = number.form == "f"
        self.value: Callable[[Any], float] = reading(steps)
        """Returns the command in a message [u]; raises `FieldError` if it does not tell it."""
        self._put = setting(steps)
        self._beside = "what other_commands says" if taken else given or "zeros"
        self._stamped = hasattr(message, "header")
        self._now_ns = now_ns
        self._message: Any = None
        self.why_unknown = ""
        """Why the other elements are not known; empty: they are."""
        if taken:
            self.why_unknown = "no message has come on other_commands"
            return
        try:
            self._require_whole(message)
        except FieldError as error:
            raise ParameterError(
                f"command_field: {error}; give all elements by command_message, such as "
                f"'{{data: [0.0, 0.0]}}'"
            ) from None
        self._message = message

    def written(self, command: float) -> Any | None:
        """Return the message with a command [u]; None while the other elements are not known."""
        message = self._message
        if message is None:
            return None
        self._put(message, command)
        if self._stamped:
            set_stamp(message.header.stamp, self._now_ns())
        return message

    def on_wire(self, command: float) -> float:
        """Return a command as its receivers read it [u]: a float32 is rounded."""
        if not self._is_single:
            return command
        return float(struct.unpack("f", struct.pack("f", command))[0])

    def take_others(self, message: Any) -> None:
        """Take the other elements from a message; those before stay where it lacks the command's.

        :param message: of this type; it becomes the node's own.
        """
        try:
            self._require_whole(message)
        except FieldError as error:
            self.why_unknown = f"the message on other_commands does not fit: {error}"
            return
        self._message, self.why_unknown = message, ""

    @property
    def described(self) -> str:
        """What is commanded, and what stands beside it, for people."""
        if self.field == "data":
            return self.type_name
        return f"{self.field} of {self.type_name}, beside {self._beside},"

    def _only_element(self, root: Struct, field: str, message: Any, *, taken: bool) -> str:
        kind = dict(root.fields).get("data")
        if field != "data" or not isinstance(kind, Repeated):
            return field
        if not taken and len(message.data) == 0:
            message.data = [0.0]
        if taken or len(message.data) != 1:
            raise ParameterError(
                f"command_field is data, an array of several elements in {self.type_name}; "
                f"expected one of them, such as data[0]"
            )
        return "data[0]"

    def _require_whole(self, message: Any) -> None:
        self._put(message, self.value(message))
        alike = _ALIKE.get(self.type_name, ())
        if len({len(getattr(message, name)) for name in alike}) > 1:
            found = ", ".join(f"{len(getattr(message, name))} {name}" for name in alike)
            raise FieldError(f"expected as many of {', '.join(alike)}; found {found}")


def _number_of(root: Struct, steps: tuple[Step, ...]) -> Number:
    kind: Type = root
    for step in steps:
        kind = dict(kind.fields)[step] if isinstance(kind, Struct) else kind.item  # type: ignore
    assert isinstance(kind, Number)
    return kind


def _mapping(text: str) -> Mapping[str, Any]:
    try:
        found = yaml.safe_load(text) or {}
    except yaml.YAMLError as error:
        why = str(error).splitlines()[0]
        raise ParameterError(f"command_message is {text!r}, which is not YAML: {why}") from None
    if not isinstance(found, Mapping):
        raise ParameterError(
            f"command_message is {text!r}, expected fields and values, such as "
            f"'{{data: [0.0, 0.0]}}'"
        )
    return found


def _fill(message: Any, values: Mapping[str, Any], prefix: str) -> None:
    """Set fields of a message from a mapping."""
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        if name not in types:
            raise ParameterError(
                f"command_message has {prefix}{name}, expected one of the fields "
                f"{', '.join(types)}"
            )
        slot = message.SLOT_TYPES[list(types).index(name)]
        path = f"{prefix}{name}"
        try:
            setattr(message, name, _converted(slot, value, path))
        except (AssertionError, TypeError, ValueError, OverflowError):
            raise ParameterError(
                f"command_message: {path} is {value!r}, expected {types[name]}"
            ) from None


def _converted(slot: Any, value: Any, path: str) -> Any:
    if isinstance(slot, definition.NamespacedType):
        if not isinstance(value, Mapping):
            raise TypeError
        inner = getattr(importlib.import_module(".".join(slot.namespaces)), slot.name)()
        _fill(inner, value, f"{path}.")
        return inner
    if isinstance(slot, definition.AbstractNestedType):
        if not isinstance(value, list):
            raise TypeError
        return [_converted(slot.value_type, v, f"{path}[{k}]") for k, v in enumerate(value)]
    if isinstance(slot, definition.BasicType) and slot.typename in ("float", "double"):
        return float(value)
    return value
