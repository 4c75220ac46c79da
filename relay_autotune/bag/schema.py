# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Message types: a tree of structures, arrays and numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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
    :param fields: name and type of each, in order; none where a definition names the type.
    """

    name: str
    fields: Fields = ()


@dataclass(frozen=True)
class Repeated:
    """An array or a sequence.

    :param item: type of each element.
    :param count: number of elements; None: it precedes them.
    """

    item: Type
    count: int | None


Type = Number | Text | Struct | Repeated
Fields = tuple[tuple[str, Type], ...]


def number_named(name: str) -> Number:
    """Return the number that ROS calls so, such as ``float64``."""
    return Number(name, _NUMBERS[name])


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
