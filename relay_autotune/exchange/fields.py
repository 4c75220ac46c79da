# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Results as documents and as messages, and back, by what their fields declare.

A field is declared once, by :func:`relay_autotune.quantities.result_field`; what its type means in
a document and in a message is said here, once for all results.
"""

from __future__ import annotations

import array
import enum
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, dataclass, is_dataclass
from functools import cache
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.quantities import ResultField, result_fields
from relay_autotune.text import visible

_T = TypeVar("_T")

# Largest relative difference, by rounding, of a number from the one that follows from others.
_SAME = 1e-9


def float64_array(values: ArrayLike) -> array.array[float]:
    """Copy numbers into the array type that rclpy takes without looking at each of them.

    :param values: any shape; flattened row by row.
    """
    flat = np.ascontiguousarray(values, dtype=np.float64)
    return array.array("d", flat.tobytes())


@cache
def _part_of(kind: Any) -> tuple[Any, bool]:
    """Return the class of the results that a field holds, or None, and whether it holds many."""
    if isinstance(kind, UnionType):
        kind = next(each for each in get_args(kind) if each is not type(None))
    many = get_origin(kind) is tuple
    if many:
        kind = get_args(kind)[0]
    return (kind if is_dataclass(kind) else None), many


@dataclass(frozen=True)
class Special:
    """How a class is written and read, if not by its fields.

    :param to_document: its fields in documents; those of the result that holds it lie beside
        them.
    :param of_document: the way back.
    :param to_message: writes it into a message.
    :param of_message: the way back; it raises :class:`WrongFieldError`.
    """

    to_document: Callable[[Any], dict[str, Any]]
    of_document: Callable[[Any], Any]
    to_message: Callable[[Any, Any], None] | None = None
    of_message: Callable[[Any], Any] | None = None


SPECIAL: dict[type, Special] = {}


class WrongFieldError(Exception):
    """A field of a message, and what is wrong with it; :func:`of_message` says of what it is."""


# Documents.


def to_document(value: object) -> dict[str, Any]:
    """Return a result as it appears in documents.

    :param value: an instance of a class that declares its fields.
    """
    special = SPECIAL.get(type(value))
    if special is not None:
        return dict(special.to_document(value))
    found: dict[str, Any] = {}
    kind: Any = type(value)
    for each in result_fields(kind):
        held = getattr(value, each.name)
        name = each.document or each.name
        if each.document is None or (each.optional and held == each.default):
            continue
        part, many = _part_of(each.kind)
        if part is not None and many:
            found[name] = [to_document(item) for item in held]
        elif part is not None and part in SPECIAL:
            found |= to_document(held)
        elif part is not None:
            found[name] = None if held is None else to_document(held)
        elif each.kind is complex:
            found |= {"real": json_number(held.real), "imaginary": json_number(held.imag)}
        elif isinstance(held, np.ndarray):
            held = named(value.parameters, held)  # type: ignore[attr-defined]
            found[name] = (
                {n: [low, held[n]] for n, low in found[name].items()} if name in found else held
            )
        elif name in found:
            found[name] = [found[name], json_number(held)]
        elif isinstance(held, enum.Enum):
            found[name] = held.name.lower()
        else:
            found[name] = _plain(held)
    return found


def of_document(kind: type[_T], document: Any, **given: Any) -> _T:
    """Return the result that a document tells.

    A field that documents of earlier versions lack has its default.

    :param kind: class of the result.
    :param document: as `json` reads it.
    :param given: fields that are known otherwise.
    :raises LookupError, TypeError, ValueError, AttributeError: if it tells no such result.
    """
    special = SPECIAL.get(kind)
    if special is not None:
        return special.of_document(document)
    found = dict(given)
    seen: set[str] = set()
    for each in result_fields(kind):  # type: ignore[arg-type]
        if each.document is None or each.derived or each.name in given:
            continue
        name = each.document or each.name
        part, many = _part_of(each.kind)
        if part is not None and not many and part in SPECIAL:
            found[each.name] = of_document(part, document)
        elif each.kind is complex:
            found[each.name] = complex(number(document["real"]), number(document["imaginary"]))
        elif name in document or each.default is MISSING:
            held = document[name]
            if each.document:
                # Two fields share the name: the lower end, then the upper one.
                held = _end(held, 1 if name in seen else 0)
                seen.add(name)
            found[each.name] = _of_json(each, held, part, many, document)
    return kind(**found)


def _end(held: Any, which: int) -> Any:
    if isinstance(held, dict):
        return {name: _end(ends, which) for name, ends in held.items()}
    low, high = held
    return (low, high)[which]


def _of_json(each: ResultField, held: Any, part: Any, many: bool, document: dict[str, Any]) -> Any:
    if part is not None and many:
        return tuple(of_document(part, item) for item in held)
    if part is not None:
        return None if held is None else of_document(part, held)
    if get_origin(each.kind) is np.ndarray:
        return np.array([number(held[name]) for name in document["values"]])
    if get_origin(each.kind) is tuple:
        return tuple(map(get_args(each.kind)[0], held))
    if isinstance(each.kind, enum.EnumType):
        return each.kind[str(held).upper()]
    if each.word:
        return word(held)
    if each.kind is float:
        return each.null if held is None else float(held)
    return each.kind(held)


def _plain(value: Any) -> Any:
    if isinstance(value, str | tuple):
        return list(value) if isinstance(value, tuple) else value
    return json_number(value)


def json_number(value: Any) -> Any:
    """Return a number as JSON has it: null if not finite, [re, im] for a complex one."""
    if isinstance(value, bool | int):
        return value
    z = complex(value)
    if z.imag != 0.0:
        return [json_number(z.real), json_number(z.imag)]
    return z.real if math.isfinite(z.real) else None


def json_numbers(values: Iterable[complex]) -> list[Any]:
    """Return several numbers as JSON has them."""
    return [json_number(value) for value in values]


def named(names: Sequence[str], values: Iterable[float]) -> dict[str, Any]:
    """Return numbers by their names, as JSON has them."""
    return {name: json_number(value) for name, value in zip(names, values, strict=True)}


def number(value: Any) -> float:
    """Return a number of a document; NaN for null."""
    return math.nan if value is None else float(value)


def word(value: Any) -> str:
    """Return the name of a method, a rule or a parameter.

    :raises ValueError: if it is not made of letters, digits and underscores.
    """
    if not isinstance(value, str) or not value.isidentifier():
        raise ValueError(f"{value!r} is not a name")
    return value


def columns(kind: Any) -> tuple[str, ...]:
    """Return the fields of a result that are columns of tables of many bags."""
    found = sorted((f for f in result_fields(kind) if f.column), key=lambda f: f.column)
    return tuple(f.name for f in found)


# Messages.


def to_message(message: Any, value: object, prefix: str = "") -> None:
    """Write a result into the fields of a message.

    :param message: of rclpy, or a stand-in with the same fields.
    :param value: an instance of a class that declares its fields.
    :param prefix: of the names of its fields.
    """
    special = SPECIAL.get(type(value))
    if special is not None and special.to_message is not None:
        special.to_message(message, value)
        return
    kind: Any = type(value)
    for each in result_fields(kind):
        if each.message is None:
            continue
        held, name = getattr(value, each.name), each.message or prefix + each.name
        part, many = _part_of(each.kind)
        if part is not None and many:
            _write_columns(message, held, part, each.prefix)
        elif part is not None:
            to_message(message, part() if held is None else held, each.prefix)
        elif get_origin(each.kind) is np.ndarray:
            setattr(message, name, float64_array(held))
        elif get_origin(each.kind) is tuple:
            setattr(message, name, list(map(str, held)))
        else:
            setattr(message, name, each.kind(held))


def _parts(each: ResultField, prefix: str) -> tuple[tuple[str, str], ...]:
    """Return the names in messages of a field's parts, each with the attribute that it holds."""
    if each.kind is complex:
        return (f"{prefix}real", "real"), (f"{prefix}imaginary", "imag")
    return ((each.message or prefix + each.name, ""),)


def _write_columns(message: Any, items: Sequence[object], kind: type, prefix: str) -> None:
    for each in result_fields(kind):
        held = [getattr(item, each.name) for item in items]
        for name, which in _parts(each, prefix):
            values = [getattr(value, which) for value in held] if which else held
            setattr(message, name, list(values) if each.kind is str else float64_array(values))


def of_message(kind: type[_T], message: Any, error: type[RelayAutotuneError], of: str) -> _T:
    """Return the result that a message tells.

    :param kind: class of the result.
    :param message: of rclpy, or decoded from a bag.
    :param error: what to raise.
    :param of: what the fields belong to, as in "of the model".
    :raises RelayAutotuneError: of that kind, if a number is outside of its declared range, arrays
        that go together differ in length, or a derived number contradicts the others.
    """
    try:
        return _of_message(kind, message, "")
    except WrongFieldError as found:
        name, problem = found.args
        raise error(f"{name} {of} {problem}") from None


def _of_message(kind: type[_T], message: Any, prefix: str) -> _T:
    special = SPECIAL.get(kind)
    if special is not None and special.of_message is not None:
        return special.of_message(message)
    found: dict[str, Any] = {}
    for each in result_fields(kind):  # type: ignore[arg-type]
        if each.message is None or each.derived:
            continue
        part, many = _part_of(each.kind)
        if part is not None and many:
            found[each.name] = _read_columns(part, message, each.prefix)
        elif part is not None:
            nested = _of_message(part, message, each.prefix)
            # A part that was not computed has a default in each of its fields.
            absent = each.default is None and repr(nested) == repr(part())
            found[each.name] = None if absent else nested
        else:
            found[each.name] = _of_field(each, message, prefix)
    value = kind(**found)
    _check_derived(value, message, prefix)
    return value


def _of_field(each: ResultField, message: Any, prefix: str) -> Any:
    name = each.message or prefix + each.name
    held = getattr(message, name)
    if get_origin(each.kind) is np.ndarray:
        held = np.asarray(held, dtype=np.float64)
        require_length(name, len(held), len(message.parameters), "parameters")
    elif get_origin(each.kind) is tuple:
        held = tuple(_shown(get_args(each.kind)[0](item)) for item in held)
    else:
        held = _shown(each.kind(held))
    problem = each.problem(held) if isinstance(held, float | np.ndarray) else None
    if problem is not None:
        raise WrongFieldError(name, problem)
    return held


def _shown(held: Any) -> Any:
    """Return a value of another node; in a text nothing acts on a terminal or a log."""
    return visible(held) if type(held) is str else held


def _read_columns(kind: Any, message: Any, prefix: str) -> tuple[Any, ...]:
    columns: dict[str, list[Any]] = {}
    first = ""
    for each in result_fields(kind):
        parts = []
        for name, _ in _parts(each, prefix):
            held, first = list(getattr(message, name)), first or name
            require_length(name, len(held), len(getattr(message, first)), first)
            problem = None if each.kind is str else each.problem(held)
            if problem is not None:
                raise WrongFieldError(name, problem)
            parts.append(held)
        columns[each.name] = list(map(each.kind, *parts))
    return tuple(
        kind(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)
    )


def require_length(name: str, found: int, expected: int, first: str) -> None:
    """Refuse an array of a message that does not go with another one.

    :param name: of the array.
    :param found: its length.
    :param expected: the length that it has to have.
    :param first: name of the other one.
    :raises WrongFieldError: if it has another length.
    """
    if found != expected:
        raise WrongFieldError(
            name, f"has {found} numbers, expected {expected}: one for each of {first}"
        )


def _check_derived(value: Any, message: Any, prefix: str) -> None:
    kind: Any = type(value)
    derived = [f for f in result_fields(kind) if f.derived]
    said = {f.name: float(getattr(message, prefix + f.name)) for f in derived}
    # A message that is written by hand may leave out the derived numbers.
    for name in said if any(said.values()) else ():
        follows = getattr(value, name)
        if not abs(said[name] - follows) <= _SAME * abs(follows):
            raise WrongFieldError(
                name,
                f"is {said[name]:g}, but the other numbers make it {follows:g}: they contradict "
                "each other",
            )
