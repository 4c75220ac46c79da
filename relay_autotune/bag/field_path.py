# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Message types, and the path of a number in them: fields, and elements by place or by name.

=============================== =================================================================
``linear.x``                    a field of a field
``ranges[3]``                   an element by its place, where nothing names the elements
``velocity[left_wheel]``        the element that a list of names in the message calls so
``values[dof_names=arm_2]``     the same, with the list that is meant
``dof_states[name=left].error`` the element of an array of messages of which a field has this value
=============================== =================================================================

A path means the same for messages of a running loop (:func:`reading`) and for the bytes of
recorded ones (:class:`relay_autotune.bag.cdr.Path`). The names are those of each message, because
their order may change from one to the next.
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from struct import calcsize
from typing import Any

from relay_autotune.errors import FieldError, visible


@dataclass(frozen=True)
class Number:
    """A number.

    :param name: as ROS calls it, such as ``float64``.
    :param form: its letter in ``struct`` and numpy; a bool is one byte.
    """

    name: str
    form: str
    has_numbers = True

    @property
    def size(self) -> int:
        """Its size, which is also its alignment [bytes]."""
        return calcsize(f"<{self.form}")


@dataclass(frozen=True)
class Text:
    """A string; ``wide`` ones are written in different ways by different middlewares."""

    wide: bool = False
    has_numbers = False


@dataclass(frozen=True)
class Struct:
    """A message type.

    :param name: such as ``std_msgs/msg/Header``.
    :param fields: name and type of each, in order; none where a definition names the type.
    """

    name: str
    fields: Fields = ()

    @cached_property
    def has_numbers(self) -> bool:
        """Whether it holds a number; cached, since types that double are looked through once."""
        return any(kind.has_numbers for _, kind in self.fields)


@dataclass(frozen=True)
class Repeated:
    """An array or a sequence.

    :param item: type of each element.
    :param count: number of elements; None: it precedes them.
    """

    item: Type
    count: int | None

    @property
    def has_numbers(self) -> bool:
        """Whether its elements hold a number."""
        return self.item.has_numbers


Type = Number | Text | Struct | Repeated
Fields = tuple[tuple[str, Type], ...]


_FORMS = {
    **dict.fromkeys(("bool", "byte", "octet", "char"), "B"),
    **{f"int{8 << k}": form for k, form in enumerate("bhiq")},
    **{f"uint{8 << k}": form for k, form in enumerate("BHIQ")},
    "float32": "f",
    "float64": "d",
}
# The numbers by the names that ROS has for them.
NUMBERS = {name: Number(name, form) for name, form in _FORMS.items()}


# Fields that are not a quantity of a process.
_HEADER = ("header", "stamp")


def numeric_paths(kind: Type, prefix: str = "") -> Iterator[str]:
    """Yield the paths of a type's numbers; one element stands for those of an array.

    Those of its own header are left out. A type of a kilobyte can hold more paths than can be
    listed: take only some.

    :param kind: the type.
    :param prefix: the path of what is of this type.
    """
    if isinstance(kind, Number):
        yield prefix
    elif isinstance(kind, Repeated):
        yield from numeric_paths(kind.item, f"{prefix}[0]")
    elif isinstance(kind, Struct):
        for name, inner in kind.fields:
            if inner.has_numbers and (prefix or name not in _HEADER):
                yield from numeric_paths(inner, f"{prefix}.{name}" if prefix else name)


# Lists of texts that name the elements of the arrays beside them, and of those in structures
# beside them; and the field by which an element of an array of messages is named.
NAME_LISTS = ("name", "joint_names", "dof_names", "interface_names", "interface_groups", "names")
_OWN_NAME = "name"

_STEP = re.compile(r"\.?([A-Za-z]\w*)|\[(\d{1,9})\]|\[(?:([A-Za-z]\w*)=)?([^\[\]]+)\]")

# Largest number of fields or names that an error lists.
_LISTED = 12


@dataclass(frozen=True)
class Names:
    """What names the elements of an array.

    :param field: a list of texts, or a field of each element.
    :param depth: number of steps of the path to the structure with that list; None: the field is
        one of each element.
    """

    field: str
    depth: int | None


@dataclass(frozen=True)
class Element:
    """An element of an array.

    :param chosen: its place, or its name.
    :param names: what names the elements; None: nothing does.
    """

    chosen: int | str
    names: Names | None

    @property
    def written(self) -> str:
        """How it is written in a path."""
        names, by = self.names, ""
        # Digits alone would be a place.
        if names and isinstance(self.chosen, str):
            by = f"{names.field}=" if names.depth is None or self.chosen.isdecimal() else ""
        return f"[{by}{self.chosen}]"


Step = str | Element


def steps_of(root: Struct, path: str, of: str) -> tuple[Step, ...]:
    """Return the steps from a message to the number that a path names.

    :param root: type of the message.
    :param path: such as ``linear.x`` or ``velocity[left_wheel]``.
    :param of: what has the field, for the error.
    :raises FieldError: if the type has no such number.
    """
    kind: Type = root
    steps: list[Step] = []
    # The structures on the way since the last array, each with the number of steps to it.
    around: list[tuple[int, Struct]] = []
    for step in _parsed(path, of):
        if isinstance(kind, Struct) and isinstance(step, str) and step in dict(kind.fields):
            around.append((len(steps), kind))
            kind = dict(kind.fields)[step]
            steps.append(step)
        elif isinstance(kind, Repeated) and isinstance(step, tuple):
            steps.append(_element(kind, step, around, path, of))
            kind, around = kind.item, []
        else:
            raise FieldError(f"{of} has no field {path!r}; it has {some_numbers(root)}")
    if not isinstance(kind, Number):
        some = itertools.islice(numeric_paths(kind), _LISTED)
        inner = [_spelt(root, f"{path}{'' if p[:1] == '[' else '.'}{p}") for p in some]
        raise FieldError(
            f"{path!r} of {of} is not a number; expected the name of one"
            + (f", such as {', '.join(inner)}" if inner else "")
        )
    return tuple(steps)


def some_numbers(root: Struct) -> str:
    """Return the paths of some numbers of a type, for an error."""
    return _some_of(_spelt_numbers(root)) or "no numbers"


def first_numbers(root: Struct, count: int) -> list[str]:
    """Return the paths of the first numbers of a type, without those of its header."""
    return list(itertools.islice(_spelt_numbers(root), count))


def _spelt_numbers(root: Struct) -> Iterator[str]:
    return (_spelt(root, path) for path in numeric_paths(root))


def _spelt(root: Struct, path: str) -> str:
    """Return a path with NAME in place of each 0 where the elements have names."""
    if "[" not in path:
        return path
    return written(
        [
            replace(step, chosen="NAME")
            if isinstance(step, Element) and step.names and isinstance(step.chosen, int)
            else step
            for step in steps_of(root, path, "")
        ]
    )


def written(steps: Sequence[Step]) -> str:
    """Return the path of some steps."""
    return "".join(
        f".{step}" if isinstance(step, str) else step.written for step in steps
    ).removeprefix(".")


def names_in(steps: Sequence[Step], message: Any) -> list[str]:
    """Return the names of the elements in a message that the first named step chooses from.

    :param steps: of a path, as :func:`steps_of` returns them.
    :param message: as a Python object.
    """
    for at, step in enumerate(steps):
        if isinstance(step, Element) and step.names is not None:
            trail = _walk(message, _way(steps[:at]))
            return [_text(name) for name in _names(step.names, trail[-1], trail)]
    return []


def _parsed(path: str, of: str) -> Iterator[str | tuple[str, str]]:
    """Yield the fields of a path, and what is in its brackets: a key or "", and the rest."""
    at = 0
    while at < len(path):
        match = _STEP.match(path, at)
        if match is None:
            raise FieldError(
                f"{path!r} is not the name of a field of {of}; expected one such as "
                f"linear_acceleration.x, position[3] or velocity[left_wheel]"
            )
        field, place, key, name = match.groups()
        yield field if field else ("", place) if place else (key or "", name.strip())
        at = match.end()


def _element(
    array: Repeated,
    asked: tuple[str, str],
    around: Sequence[tuple[int, Struct]],
    path: str,
    of: str,
) -> Element:
    key, name = asked
    by_place = not key and name.isdecimal()
    if by_place and array.count is not None and int(name) >= array.count:
        raise FieldError(
            f"{of} has no {path!r}: an array of {array.count} elements ends at [{array.count - 1}]"
        )
    names = _names_of(array, key, around)
    only = names[0] if len(names) == 1 else None
    if by_place:
        return Element(int(name), only)
    if only:
        return Element(name, only)
    if key:
        raise FieldError(
            f"{of} has no names {key!r} for {path!r}: expected a field of texts or whole numbers "
            f"in each element, or a list of texts beside the array"
        )
    if names:
        raise FieldError(
            f"{of} has several lists of names, so that {path!r} is not clear; write "
            f"[{names[0].field}={name}] or [{names[1].field}={name}]"
        )
    raise FieldError(
        f"{of} has no list of names for {path!r}, such as {', '.join(NAME_LISTS[:4])}; expected "
        f"the place of the element, as in [0], or the list, as in [LIST={name}]"
    )


def _names_of(array: Repeated, key: str, around: Sequence[tuple[int, Struct]]) -> list[Names]:
    """Return what may name the elements of an array.

    :param array: the array.
    :param key: the field or the list that is meant; empty: the usual ones.
    :param around: the structures on the way to it.
    """
    own, lists = key or _OWN_NAME, (key,) if key else NAME_LISTS
    if isinstance(array.item, Struct):
        kind = dict(array.item.fields).get(own)
        whole = bool(key) and isinstance(kind, Number) and kind.form not in "fd"
        if whole or (isinstance(kind, Text) and not kind.wide):
            return [Names(own, None)]
    for depth, struct in reversed(around):
        fields = dict(struct.fields)
        found = [Names(name, depth) for name in lists if _is_list(fields.get(name))]
        if found:
            return found
    return []


def _is_list(kind: Type | None) -> bool:
    return isinstance(kind, Repeated) and isinstance(kind.item, Text) and not kind.item.wide


# Messages that are Python objects.


def reading(steps: Sequence[Step]) -> Callable[[Any], float]:
    """Return the function that reads the number from a message.

    It raises `FieldError` where the message does not tell which element is meant: its names lack
    the one that is wanted, or have it twice, or it names its elements and a place was given. The
    names are looked at in each message, and searched again when they have changed.

    :param steps: of the path, as :func:`steps_of` returns them.
    """
    way = _way(steps)

    def value(message: Any) -> float:
        found = _walk(message, way)[-1]
        # A byte comes as a text of bytes.
        return float(found[0] if isinstance(found, bytes) else found)

    return value


def setting(steps: Sequence[Step]) -> Callable[[Any, float], None]:
    """Return the function that writes the number into a message; it raises as a reading does.

    :param steps: of the path, as :func:`steps_of` returns them.
    """
    *way, last = _way(steps)

    def put(message: Any, number: float) -> None:
        trail = _walk(message, way)
        if isinstance(last, str):
            setattr(trail[-1], last, number)
        else:
            trail[-1][last.place(trail[-1], trail)] = number

    return put


def _way(steps: Sequence[Step]) -> list[str | _Finder]:
    return [step if isinstance(step, str) else _Finder(steps, k) for k, step in enumerate(steps)]


def _walk(message: Any, way: Sequence[str | _Finder]) -> list[Any]:
    """Return a message, and what each step leads to."""
    found, trail = message, [message]
    for step in way:
        found = getattr(found, step) if isinstance(step, str) else found[step.place(found, trail)]
        trail.append(found)
    return trail


class _Finder:
    """Find an element in the arrays of messages.

    :param steps: of the path.
    :param at: which of them the element is.
    """

    def __init__(self, steps: Sequence[Step], at: int) -> None:
        element = steps[at]
        assert isinstance(element, Element)
        self._element = element
        self._steps, self._at = steps, at
        self._seen: list[Any] | None = None
        self._count = -1
        self._place = 0

    def place(self, array: Any, trail: Sequence[Any]) -> int:
        """Return the place of the element.

        :param array: the array.
        :param trail: the message, and what each step before has led to.
        :raises FieldError: if it is not there, or not clear.
        """
        by = self._element.names
        names = [] if by is None else _names(by, array, trail)
        count = len(array)
        if names != self._seen or count != self._count:
            self._place = self._found(names, count)
            self._seen, self._count = list(names), count
        return self._place

    def _found(self, names: Sequence[Any], count: int) -> int:
        chosen, by = self._element.chosen, self._element.names
        if isinstance(chosen, int):
            if chosen >= count:
                raise FieldError(f"{self._shown()}: the array has length {count}")
            if by is not None and len(names) == count:
                right = self._shown(_text(names[chosen]))
                raise FieldError(
                    f"{self._shown()}: this message names its elements; write {right}"
                )
            return chosen
        assert by is not None
        wanted = [_text(name) for name in names]
        where = [k for k, name in enumerate(wanted) if name == chosen]
        source = f"the list {by.field}" if by.depth is not None else f"the elements' {by.field}"
        if len(where) > 1:
            raise FieldError(
                f"{self._shown()}: {source} has {chosen!r} {len(where)} times, so that it is not "
                f"clear which element is meant"
            )
        if not where:
            near = difflib.get_close_matches(chosen, wanted, n=1)
            meant = f"; write {self._shown(near[0])}" if near else ""
            raise FieldError(
                f"{self._shown()}: {source} has no {chosen!r}; it has "
                f"{_some_of(wanted) or 'no names'}{meant}"
            )
        if len(wanted) != count:
            raise FieldError(
                f"{self._shown()}: {source} has length {len(wanted)}, but the array {count}"
            )
        return where[0]

    def _shown(self, name: str | None = None) -> str:
        """Return the path up to the element, by another name if given."""
        last = self._element if name is None else replace(self._element, chosen=name)
        return visible(written([*self._steps[: self._at], last]))


def _names(by: Names, array: Any, trail: Sequence[Any]) -> Sequence[Any]:
    if by.depth is None:
        return [getattr(item, by.field) for item in array]
    found: Sequence[Any] = getattr(trail[by.depth], by.field)
    return found


def _text(name: Any) -> str:
    return name if isinstance(name, str) else str(int(name))


def _some_of(names: Iterable[str]) -> str:
    found = list(itertools.islice(names, _LISTED + 1))
    return ", ".join(map(visible, found[:_LISTED])) + ", ..." * (len(found) > _LISTED)


# Units that the definitions of messages say, by type and field; a number among these fields is
# what a message of several numbers is about.
UNITS = {
    "sensor_msgs/msg/Temperature": {"temperature": "°C"},
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/msg/RelativeHumidity": {"relative_humidity": ""},
    "sensor_msgs/msg/Illuminance": {"illuminance": "lx"},
    "sensor_msgs/msg/Range": {"range": "m"},
    "sensor_msgs/msg/BatteryState": {"voltage": "V"},
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
}


def unit_of_field(type_name: str, field: str) -> str:
    """Return the unit of a number in a message; empty: its definition does not say one.

    :param type_name: such as ``sensor_msgs/msg/Temperature``.
    :param field: path of the number in it.
    """
    return UNITS.get(type_name, {}).get(field.partition(".")[0], "")
