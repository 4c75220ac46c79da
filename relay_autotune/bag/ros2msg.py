# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The fields of message types in a definition of the encoding ``ros2msg``.

Each line is a field, ``TYPE NAME [DEFAULT]``, a constant, ``TYPE NAME=VALUE``, or a comment. The
types that the first one depends on follow, each after a line of 80 ``=`` and ``MSG: NAME``.
"""

from __future__ import annotations

import re
from typing import Any

_HEADING = re.compile(r"^={80}\nMSG: ([\w/]+)[ \t]*\n", re.MULTILINE)
_LINE = re.compile(
    r"([A-Za-z][\w/]*)(?:<=\d+)?(?:\[((?:<=)?\d+)?(\]))?[ \t]+([A-Za-z]\w*)(?:[ \t]*(=|#)|[ \t]|$)"
)
PRIMITIVE = re.compile(r"bool|byte|char|w?string|float(32|64)|u?int(8|16|32|64)")

# Names of their own, from the time of ROS 1.
_SHORT = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}

Fields = list[tuple[str, tuple[int, Any]]]


def types_from_ros2msg(text: str, type_name: str) -> dict[str, tuple[list[Any], Fields]]:
    """Return constants, which are left out, and fields of each type, by its name.

    They have the form in which rosbags gives those of IDL: a field is its name with (1, (primitive
    type, 0)), (2, name of a type), (3, (item, elements)) or (4, (item, bound of a sequence)).

    :param text: the definition.
    :param type_name: of the first type.
    :raises ValueError: if a line makes no sense.
    """
    first, *others = _HEADING.split(text)
    found: dict[str, tuple[list[Any], Fields]] = {type_name: ([], _fields(first, type_name))}
    for name, lines in zip(others[::2], others[1::2], strict=True):
        full = _full(name, type_name)
        found[full] = ([], _fields(lines, full))
    return found


def _fields(text: str, owner: str) -> Fields:
    fields: Fields = []
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line[0] == "#":
            continue
        match = _LINE.match(line)
        if match is None:
            raise ValueError(f"line {number} of {owner}, {line[:60]!r}, is not a field")
        kind, count, array, name, behind = match.groups()
        if behind == "=":
            continue
        scalar = (1, (kind, 0)) if PRIMITIVE.fullmatch(kind) else (2, _full(kind, owner))
        if not array:
            fields.append((name, scalar))
        elif count and count[0] != "<":
            fields.append((name, (3, (scalar, int(count)))))
        else:
            fields.append((name, (4, (scalar, int((count or "0").lstrip("<="))))))
    return fields


def _full(name: str, owner: str) -> str:
    """Return package/msg/Type of a name within the definition of another type."""
    if name in _SHORT:
        return _SHORT[name]
    if "/" not in name:
        return f"{owner.rpartition('/')[0]}/{name}"
    return name.replace("/", "/msg/") if name.count("/") == 1 else name
