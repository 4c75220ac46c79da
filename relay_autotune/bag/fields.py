# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which number of a message is meant: `TOPIC[:FIELD]`, such as `/imu:linear_acceleration.x`."""

from __future__ import annotations

from relay_autotune.bag.cdr import Path
from relay_autotune.bag.field_path import first_numbers, some_numbers, steps_of
from relay_autotune.bag.mcap_records import Channel
from relay_autotune.bag.schema import Struct, Type
from relay_autotune.errors import FieldError, SelectionError

# The field that a message of several numbers is about.
_MEANT = {
    "sensor_msgs/msg/Temperature": "temperature",
    "sensor_msgs/msg/FluidPressure": "fluid_pressure",
    "sensor_msgs/msg/RelativeHumidity": "relative_humidity",
    "sensor_msgs/msg/Illuminance": "illuminance",
    "sensor_msgs/msg/Range": "range",
    "sensor_msgs/msg/BatteryState": "voltage",
}

_FIELDS_OF_SINGLE = 2


def split_name(wanted: str) -> tuple[str, str]:
    """Return topic and field of ``TOPIC[:FIELD]``; the field is empty where there is none."""
    topic, _, field = wanted.partition(":")
    return topic, field


def named_field(root: Struct, field: str, topic: str) -> Path:
    """Return the number that a field's name means.

    :param root: type of the topic's messages.
    :param field: a path, see `relay_autotune.bag.field_path`; empty: the only number.
    :param topic: for the error.
    :raises SelectionError: if there is no such number, or no name was given and there are several.
    """
    if not field:
        only = only_field(root)
        if only is None and not first_numbers(root, 1):
            raise SelectionError(f"{topic} is of type {root.name}, which holds no numbers")
        if only is None:
            raise SelectionError(
                f"{topic} is of type {root.name}, which holds several numbers; name one, as in "
                f"{topic}:{first_numbers(root, 1)[0]}; it has {some_numbers(root)}"
            )
        field = only
    try:
        return Path(root, steps_of(root, field, topic))
    except FieldError as error:
        raise SelectionError(str(error)) from None


def only_field(root: Struct) -> str | None:
    """Return the number that a message is about; None if it may be any of several."""
    if root.name in _MEANT:
        return _MEANT[root.name]
    found = first_numbers(root, 2)
    return found[0] if len(found) == 1 and "[" not in found[0] else None


def may_be_single(channel: Channel) -> bool:
    """Return whether a topic's messages may be about one number, by a look at the definition.

    A robot's bag holds hundreds of types; to parse all of them takes seconds.
    """
    if channel.type in _MEANT or channel.schema_encoding != "ros2msg":
        return True
    own = channel.definition.split(b"\n===", 1)[0]
    lines = (line.split(b"#", 1)[0].strip() for line in own.splitlines())
    # A header, and the field; a line with a value is that of a constant.
    return sum(bool(line) and b"=" not in line for line in lines) <= _FIELDS_OF_SINGLE


def stamp_of(root: Struct) -> tuple[Path, Path] | None:
    """Return seconds and nanoseconds of a message's own time stamp; None if it has none."""
    for steps in (("header", "stamp"), ("stamp",)):
        kind: Type | None = root
        for step in steps:
            kind = dict(kind.fields).get(step) if isinstance(kind, Struct) else None
        if isinstance(kind, Struct) and {"sec", "nanosec"} <= dict(kind.fields).keys():
            return Path(root, (*steps, "sec")), Path(root, (*steps, "nanosec"))
    return None
