# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Message types of measurement and command: how value and stamp are read and written."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from std_msgs.msg import Float32, Float64, Float64MultiArray

from relay_autotune.errors import ParameterError

FLOAT64 = "std_msgs/msg/Float64"
FLOAT32 = "std_msgs/msg/Float32"
ARRAY = "std_msgs/msg/Float64MultiArray"

COMMAND_TYPES = (FLOAT64, FLOAT32, ARRAY)
_COMMANDS = {FLOAT64: Float64, FLOAT32: Float32, ARRAY: Float64MultiArray}

_STEP = re.compile(r"([A-Za-z]\w*)((?:\[\d+\])*)")


@dataclass(frozen=True)
class Reader:
    """Access to a number in a message.

    :param kind: the message class.
    :param type_name: its name, such as ``sensor_msgs/msg/Temperature``.
    :param value: returns the number.
    :param stamp_ns: returns the header's stamp [ns since the epoch]; None: it has no header.
    """

    kind: Any
    type_name: str
    value: Callable[[Any], float]
    stamp_ns: Callable[[Any], int] | None


def reader_of(type_name: str, field: str) -> Reader:
    """Return the reader of the measurement for a message type.

    :param type_name: such as ``sensor_msgs/msg/Temperature``.
    :param field: path of a numeric field, such as ``position[2]`` or ``twist.linear.x``.
    :raises ParameterError: if the type does not exist, or the field is not a number.
    """
    package, _, rest = type_name.partition("/")
    try:
        kind = getattr(importlib.import_module(f"{package}.msg"), rest.removeprefix("msg/"))
        example = kind()
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ParameterError(
            f"measurement_type is {type_name!r}, expected an installed message type such as "
            f"{FLOAT64}"
        ) from error
    path = _path(field)
    _check(example, path, type_name, field)
    if path == ["data"]:
        value: Callable[[Any], float] = _data
    else:

        def value(message: Any) -> float:
            found = message
            for step in path:
                found = found[step] if isinstance(step, int) else getattr(found, step)
            return float(found)

    return Reader(kind, type_name, value, _header_stamp if hasattr(example, "header") else None)


def command_setter(type_name: str) -> tuple[Any, Callable[[Any, float], None]]:
    """Return a message of a command type, and the function that writes a command into it.

    :param type_name: one of `COMMAND_TYPES`.
    """
    message = _COMMANDS[type_name]()
    return message, _set_array if type_name == ARRAY else _set_data


def _data(message: Any) -> float:
    return message.data


def _set_data(message: Any, command: float) -> None:
    message.data = command


def _set_array(message: Any, command: float) -> None:
    message.data = [command]


def _header_stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _path(field: str) -> list[str | int]:
    path: list[str | int] = []
    for part in field.split("."):
        found = _STEP.fullmatch(part)
        if found is None:
            raise ParameterError(
                f"measurement_field is {field!r}, expected a path such as data or position[2]"
            )
        path.append(found[1])
        path += [int(number) for number in re.findall(r"\d+", found[2])]
    return path


def _check(example: Any, path: list[str | int], type_name: str, field: str) -> None:
    found = example
    for step in path:
        if isinstance(step, int):
            # An array's length is known only when a message comes.
            return
        if not hasattr(found, step) or step.startswith("_"):
            known = ", ".join(getattr(found, "get_fields_and_field_types", dict)())
            raise ParameterError(
                f"measurement_field is {field!r}, which {type_name} does not have; expected a "
                f"number, the fields there are: {known}"
            )
        found = getattr(found, step)
    if isinstance(found, bool) or not isinstance(found, (int, float)):
        raise ParameterError(
            f"measurement_field is {field!r}, which is not a number in {type_name}"
        )
