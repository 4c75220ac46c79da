# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Message types that are installed: their fields, and how value and stamp are read."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from rosidl_parser import definition

from relay_autotune.bag.field_path import reading, steps_of
from relay_autotune.bag.schema import Repeated, Struct, Text, Type, number_named
from relay_autotune.errors import FieldError, ParameterError

FLOAT64 = "std_msgs/msg/Float64"

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
    try:
        steps = steps_of(struct_of(kind), field, type_name)
    except FieldError as error:
        raise ParameterError(f"{parameter}: {error}") from None
    example = kind()
    is_plain = steps == ("data",) and isinstance(example.data, float)
    stamp = _header_stamp if hasattr(example, "header") else None
    return Reader(kind, type_name, _data if is_plain else reading(steps), stamp)


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
    return number_named(_PLAIN.get(slot.typename, slot.typename))


def _data(message: Any) -> float:
    return message.data


def _header_stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
