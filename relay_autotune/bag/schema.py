# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Message types as their bag defines them: a tree of structures, arrays and numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from relay_autotune.bag.idl import types_from_idl
from relay_autotune.bag.limits import DEEPEST_TYPE, LARGEST_DEFINITION, MOST_FIELDS
from relay_autotune.bag.mcap_records import Channel
from relay_autotune.bag.ros2msg import types_from_ros2msg
from relay_autotune.errors import BagError
from relay_autotune.text import visible

_NUMBERS = {
    **dict.fromkeys(("bool", "byte", "octet", "char", "uint8"), "u1"),
    "int8": "i1",
    "uint16": "u2",
    "int16": "i2",
    "uint32": "u4",
    "int32": "i4",
    "uint64": "u8",
    "int64": "i8",
    "float32": "f4",
    "float64": "f8",
}


@dataclass(frozen=True)
class Number:
    """A number.

    :param name: as ROS calls it, such as ``float64``.
    :param form: its type for numpy without byte order; a bool is one byte.
    """

    name: str
    form: str

    @property
    def size(self) -> int:
        """Its size, which is also its alignment [bytes]."""
        return int(self.form[1:])


@dataclass(frozen=True)
class Text:
    """A string; ``wide`` ones are written in different ways by different middlewares."""

    wide: bool = False


@dataclass(frozen=True)
class Struct:
    """A message type.

    :param name: such as ``std_msgs/msg/Header``.
    :param fields: name and type of each, in order.
    """

    name: str
    fields: tuple[tuple[str, Type], ...]


@dataclass(frozen=True)
class Repeated:
    """An array or a sequence.

    :param item: type of each element.
    :param count: number of elements; None: it precedes them.
    """

    item: Type
    count: int | None


Type = Number | Text | Struct | Repeated

_STAMP = (("sec", Number("int32", "i4")), ("nanosec", Number("uint32", "u4")))
_TIME = Struct("builtin_interfaces/msg/Time", _STAMP)
_HEADER = (("stamp", _TIME), ("frame_id", Text()))
# Before each file that a definition in IDL consists of.
_IDL_HEADING = re.compile(r"^={80}\nIDL: .*\n", re.MULTILINE)

# The files that one includes are all there; the parser knows no directives.
_IDL_DIRECTIVE = re.compile(r"^\s*#.*$", re.MULTILINE)

# Types that a definition may leave out.
_KNOWN = {
    "builtin_interfaces/msg/Time": _TIME,
    "builtin_interfaces/msg/Duration": Struct("builtin_interfaces/msg/Duration", _STAMP),
    "std_msgs/msg/Header": Struct("std_msgs/msg/Header", _HEADER),
}

# The messages of std_msgs that are one number need no parser.
_SCALARS = {
    f"std_msgs/msg/{name.capitalize().replace('Uint', 'UInt')}": (
        f"{name} data",
        Struct("", (("data", Number(name, form)),)),
    )
    for name, form in _NUMBERS.items()
    if name != "octet"
}


def number_named(name: str) -> Number:
    """Return the number that ROS calls so, such as ``float64``."""
    return Number(name, _NUMBERS[name])


def message_type(channel: Channel) -> Struct:
    """Return the type of a channel's messages.

    :raises BagError: if its definition is missing or makes no sense.
    """
    if channel.encoding != "cdr":
        raise BagError(
            f"the messages of {channel.topic} are encoded as {channel.encoding!r}; expected 'cdr'"
        )
    if len(channel.definition) > LARGEST_DEFINITION:
        raise _senseless(channel, f"it has {len(channel.definition)} bytes")
    try:
        text = channel.definition.decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise _senseless(channel, "it is not UTF-8") from None
    if channel.type in _SCALARS and channel.schema_encoding == "ros2msg":
        expected, found = _SCALARS[channel.type]
        lines = (line.split("#", 1)[0].split() for line in text.splitlines())
        if [" ".join(line) for line in lines if line] == [expected]:
            return found
    return _Tree(channel, _parsed(channel, text)).struct(channel.type, 0)


def _parsed(channel: Channel, text: str) -> Mapping[str, Any]:
    if not text.strip():
        raise _senseless(channel, "it is empty")
    try:
        if channel.schema_encoding == "ros2msg":
            return types_from_ros2msg(text, channel.type)
        if channel.schema_encoding in ("ros2idl", "omgidl"):
            return types_from_idl(_IDL_DIRECTIVE.sub("", _IDL_HEADING.sub("", text)))
    except ValueError as error:
        raise _senseless(channel, first_line(error)) from None
    raise _senseless(
        channel, f"it is in {channel.schema_encoding!r}; expected 'ros2msg' or 'ros2idl'"
    )


class _Tree:
    """Resolves the names of a definition, within limits."""

    def __init__(self, channel: Channel, types: Mapping[str, Any]) -> None:
        self._channel = channel
        self._types = types
        self._fields = 0
        self._done: dict[str, Struct] = {}

    def struct(self, name: str, depth: int) -> Struct:
        if name in self._done:
            return self._done[name]
        if depth > DEEPEST_TYPE:
            raise _senseless(self._channel, f"{name} lies {depth} types deep, or holds itself")
        if name not in self._types:
            if name in _KNOWN:
                return _KNOWN[name]
            raise _senseless(self._channel, f"{name} is missing")
        _, fields = self._types[name]
        self._fields += len(fields)
        if self._fields > MOST_FIELDS:
            raise _senseless(self._channel, f"it has more than {MOST_FIELDS} fields")
        # A structure without fields takes a byte.
        listed = fields or [("structure_needs_at_least_one_member", (1, ("uint8", 0)))]
        found = Struct(name, tuple((str(n), self._type(what, depth)) for n, what in listed))
        self._done[name] = found
        return found

    def _type(self, what: Any, depth: int) -> Type:
        kind, detail = int(what[0]), what[1]
        if kind == 2:
            return self.struct(str(detail), depth + 1)
        if kind == 1:
            name = str(detail[0])
            if name in ("string", "wstring"):
                return Text(wide=name == "wstring")
            if name not in _NUMBERS:
                raise _senseless(self._channel, f"{name} is a type that no field may have")
            return Number(name, _NUMBERS[name])
        item, count = self._type(detail[0], depth + 1), int(detail[1])
        if kind == 3:
            if not 0 < count < 2**32:
                raise _senseless(self._channel, f"an array of {count} elements")
            return Repeated(item, count)
        return Repeated(item, None)


def numeric_paths(root: Type, without: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the paths of a type's numbers; one element stands for those of an array.

    A type of a kilobyte can hold more paths than can be listed: take only some.

    :param root: the type.
    :param without: names of its own fields that are left out.
    """
    if isinstance(root, Struct) and without:
        root = Struct(root.name, tuple(f for f in root.fields if f[0] not in without))
    return _paths(root, "", {})


def _paths(kind: Type, prefix: str, known: dict[int, bool]) -> Iterator[str]:
    if isinstance(kind, Number):
        yield prefix
    elif isinstance(kind, Repeated):
        yield from _paths(kind.item, f"{prefix}[0]", known)
    elif isinstance(kind, Struct):
        for name, inner in kind.fields:
            # Where there are none, looking once is enough.
            if _has_numbers(inner, known):
                yield from _paths(inner, f"{prefix}.{name}" if prefix else name, known)


def _has_numbers(kind: Type, known: dict[int, bool]) -> bool:
    if isinstance(kind, Repeated):
        return _has_numbers(kind.item, known)
    if not isinstance(kind, Struct):
        return isinstance(kind, Number)
    if id(kind) not in known:
        known[id(kind)] = any(_has_numbers(inner, known) for _, inner in kind.fields)
    return known[id(kind)]


def first_line(error: Exception) -> str:
    """Return what an error says, in one line."""
    lines = str(error).strip().splitlines()
    return visible(" ".join(lines[:2])[:120]) if lines else type(error).__name__


def _senseless(channel: Channel, why: str) -> BagError:
    return BagError(
        f"the definition of {channel.type or 'the messages'} in the recording, of "
        f"{channel.topic}, makes no sense: {why}"
    )
