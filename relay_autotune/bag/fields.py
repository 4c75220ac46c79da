# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which number of a message is meant: `TOPIC[:FIELD]`, such as `/imu:linear_acceleration.x`."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator

from relay_autotune.bag.cdr import Path, Step
from relay_autotune.bag.mcap_records import Channel
from relay_autotune.bag.schema import Number, Repeated, Struct, Type, numeric_paths
from relay_autotune.errors import SelectionError

# The field that a message of several numbers is there for.
_MEANT = {
    "sensor_msgs/msg/Temperature": "temperature",
    "sensor_msgs/msg/FluidPressure": "fluid_pressure",
    "sensor_msgs/msg/RelativeHumidity": "relative_humidity",
    "sensor_msgs/msg/Illuminance": "illuminance",
    "sensor_msgs/msg/Range": "range",
    "sensor_msgs/msg/BatteryState": "voltage",
}

_STEP = re.compile(r"\.?([A-Za-z]\w*)|\[(\d{1,9})\]")

_FIELDS_OF_SINGLE = 2

# Fields that a message of an error lists at most.
_LISTED = 12


def split_name(wanted: str) -> tuple[str, str]:
    """Return topic and field of ``TOPIC[:FIELD]``; the field is empty where there is none."""
    topic, _, field = wanted.partition(":")
    return topic, field


def named_field(root: Struct, field: str, topic: str) -> Path:
    """Return the number that a field's name means.

    :param root: type of the topic's messages.
    :param field: names joined by dots, elements in brackets; empty: the only number.
    :param topic: for the error.
    :raises SelectionError: if there is no such number, or no name was given and there are several.
    """
    if not field:
        only = only_field(root)
        if only is None and not any(True for _ in _listed(root)):
            raise SelectionError(f"{topic} is of type {root.name}, which holds no numbers")
        if only is None:
            raise SelectionError(
                f"{topic} is of type {root.name}, which holds several numbers; name one, as in "
                f"{topic}:{next(_listed(root), 'FIELD')}; it has {_some(root)}"
            )
        field = only
    kind: Type = root
    steps: list[Step] = []
    for step in _steps(field, topic):
        if isinstance(kind, Struct) and isinstance(step, str) and step in dict(kind.fields):
            kind = dict(kind.fields)[step]
        elif isinstance(kind, Repeated) and isinstance(step, int):
            if kind.count is not None and step >= kind.count:
                raise SelectionError(
                    f"{topic} has no {field!r}: an array of {kind.count} elements ends at "
                    f"[{kind.count - 1}]"
                )
            kind = kind.item
        else:
            raise SelectionError(f"{topic} has no field {field!r}; it has {_some(root)}")
        steps.append(step)
    if not isinstance(kind, Number):
        some = itertools.islice(_listed(kind), _LISTED)
        inner = [f"{field}{'' if p[:1] == '[' else '.'}{p}" for p in some]
        raise SelectionError(
            f"{field!r} of {topic} is not a number; expected the name of one"
            + (f", such as {', '.join(inner)}" if inner else "")
        )
    return Path(root, tuple(steps))


def only_field(root: Struct) -> str | None:
    """Return the number that a message is there for; None if it may be any of several."""
    if root.name in _MEANT:
        return _MEANT[root.name]
    found = list(itertools.islice(_listed(root), 2))
    return found[0] if len(found) == 1 and "[" not in found[0] else None


def may_be_single(channel: Channel) -> bool:
    """Tell by a look at its definition whether a topic's messages may be there for one number.

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


def _steps(field: str, topic: str) -> Iterator[Step]:
    at = 0
    while at < len(field):
        match = _STEP.match(field, at)
        if match is None:
            raise SelectionError(
                f"{field!r} is not the name of a field of {topic}; expected one such as "
                f"linear_acceleration.x or position[3]"
            )
        yield match[1] if match[1] else int(match[2])
        at = match.end()


def _listed(kind: Type) -> Iterator[str]:
    """Yield the names of numbers, without those of the header."""
    return numeric_paths(kind, without=("header", "stamp"))


def _some(root: Struct) -> str:
    names = list(itertools.islice(_listed(root), _LISTED + 1))
    if not names:
        return "no numbers"
    return ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
