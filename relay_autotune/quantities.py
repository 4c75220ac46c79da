# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Meaning and range of a value, declared once at the field that holds it.

A frozen dataclass declares its fields by :func:`quantity`. Checks, ROS parameters with their
descriptors, command-line flags with their help, and the tables of the guide follow from it::

    @dataclass(frozen=True)
    class DesignOptions:
        ms: float = quantity(1.4, lower=1.2, upper=4.0).means("Largest Ms.")

        def __post_init__(self) -> None:
            check(self, TuningError)

A result declares its fields by :func:`result_field`; messages, documents, their way back, checks
and the columns of tables follow from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache
from typing import Any, Self, TypeVar, get_type_hints

from relay_autotune.errors import RelayAutotuneError

LARGEST = 1e152
"""Largest number that anybody may give: squares up to its own can be added without overflow."""
SHORTEST, LONGEST = 1e-9, 1e9
"""A time that anybody may give is 0 or between these [s]: the resolution of the clocks of ROS, and
thirty years."""

# Longest part of a value that is shown.
_SHOWN = 60
_DECLARED = "quantity"
_RESULT = "result_field"
_Getter = TypeVar("_Getter", bound=Callable[..., float])


@dataclass(frozen=True)
class Quantity:
    """A value that a user may set; `means` says in one sentence what it is.

    :param name: its name, as a field and as a ROS parameter.
    :param default: its default, which also decides its type. NaN: not given. Infinite: no limit.
        (): an array of numbers that is not given.
    :param unit: y of the measurement, u of the command, s seconds; "" for a pure number or a word.
    :param lower: smallest value allowed.
    :param upper: largest value allowed.
    :param open_ended: True if ``lower`` and ``upper`` themselves are not allowed.
    :param zero: False if 0 is not allowed.
    :param choices: the allowed words, for a text; (): any text.
    :param flag: its name on the command line; empty: ``name``.
    :param description: one sentence for people.
    """

    name: str
    default: float | int | bool | str | tuple[float, ...]
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    open_ended: bool = False
    zero: bool = True
    choices: tuple[str, ...] = ()
    flag: str = ""
    description: str = ""

    def means(self, description: str) -> Self:
        """Return the quantity with its description.

        :param description: one sentence for people.
        """
        return replace(self, description=description)

    @property
    def is_number(self) -> bool:
        """True if the value is one number."""
        return isinstance(self.default, (int, float)) and not isinstance(self.default, bool)

    @property
    def range_text(self) -> str:
        """The range in words, such as "at least 0 s"."""
        if self.choices:
            return f"one of {', '.join(filter(None, self.choices))}"
        if isinstance(self.default, str):
            return "a text"
        if isinstance(self.default, bool):
            return "true or false"
        if isinstance(self.default, tuple):
            return "finite numbers"
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.lower) and math.isinf(self.upper):
            text = f"any number [{self.unit}]" if self.unit else "any number"
        elif math.isinf(self.upper):
            text = f"{'above' if self.open_ended else 'at least'} {self.lower:g}{unit}"
        elif self.open_ended:
            text = f"between {self.lower:g} and {self.upper:g}{unit}"
        else:
            text = f"from {self.lower:g} to {self.upper:g}{unit}"
        return text + " but 0" * (not self.zero) + self._or_not_given

    @property
    def _or_not_given(self) -> str:
        return ", or NaN where it is not given" if self.default != self.default else ""

    def problem(self, value: Any) -> str | None:
        """Return what is wrong with a value, or None if it is allowed."""
        if self.choices:
            fine = value in self.choices
        elif isinstance(self.default, tuple):
            fine = all(math.isfinite(number) for number in value)
        elif not self.is_number:
            fine = True
        elif isinstance(value, bool) or not isinstance(value, (int, float)):
            return f"{self.name} is {repr(value)[:_SHOWN]}, expected {self.range_text}"
        elif isinstance(value, int) and abs(value) > LARGEST:
            # It may have more digits than a float can hold.
            return f"{self.name} is a number of many digits, expected {self.range_text}"
        elif math.isinf(value) and value != self.default:
            # Only the default of a limit may be infinite: there is no limit then.
            return f"{self.name} is {value:g}, expected a finite number{self._or_not_given}"
        elif not self._is_possible(abs(value)):
            return f"{self.name} is {value:g}, expected {self._possible}"
        elif isinstance(self.default, int) and value != value // 1:
            return f"{self.name} is {value:g}, expected a whole number"
        else:
            fine = self._includes(value)
        if fine:
            return None
        found = f"{value:g}" if self.is_number else repr(value)[:_SHOWN]
        # Imported here, since a start need not load it.
        from difflib import get_close_matches

        near = get_close_matches(str(value), self.choices, n=1)
        meant = f" (did you mean {near[0]}?)" if near else ""
        return f"{self.name} is {found}{meant}, expected {self.range_text}"

    def _is_possible(self, size: float) -> bool:
        # What is infinite here is the default.
        if size == 0.0 or not math.isfinite(size):
            return True
        return SHORTEST <= size <= LONGEST if self.unit == "s" else size <= LARGEST

    @property
    def _possible(self) -> str:
        if self.unit != "s":
            return f"a number of at most {LARGEST:g}"
        zero = ", or 0" if self._includes(0.0) else ""
        return f"a time from {SHORTEST:g} to {LONGEST:g} s{zero}"

    def _includes(self, value: float) -> bool:
        if math.isnan(value):
            return self.default != self.default
        if value == 0.0 and not self.zero:
            return False
        if self.open_ended:
            return self.lower < value < self.upper
        return self.lower <= value <= self.upper


@dataclass(frozen=True)
class _Field:
    """The field of a dataclass as it is declared, before it is said what it means.

    :param quantity: without name and description.
    """

    quantity: Quantity

    def means(self, sentence: str) -> Any:
        """Return the field of a dataclass.

        :param sentence: for people.
        """
        found = self.quantity.means(sentence)
        return field(default=found.default, metadata={_DECLARED: found})


def quantity(
    default: float | int | bool | str, unit: str = "", *others: Any, **named: Any
) -> _Field:
    """Declare the field of a dataclass as a quantity; the arguments are :class:`Quantity`'s."""
    return _Field(Quantity("", default, unit, *others, **named))


@cache
def declared(kind: type) -> tuple[Quantity, ...]:
    """Return the quantities that a dataclass declares, in the order of its fields."""
    return tuple(
        replace(each.metadata[_DECLARED], name=each.name)
        for each in fields(kind)
        if _DECLARED in each.metadata
    )


def check(values: object, error: type[RelayAutotuneError]) -> None:
    """Refuse a value of a dataclass that is outside of its declared range.

    :param values: an instance of a class with declared quantities.
    :param error: what to raise.
    :raises RelayAutotuneError: of that kind; the message names the field, the value and the range.
    """
    kind: Any = type(values)
    for each in declared(kind):
        problem = each.problem(getattr(values, each.name))
        if problem is not None:
            raise error(problem)


@dataclass(frozen=True)
class ResultField:
    """A field of a result: how documents and messages carry it.

    :param name: of the field.
    :param kind: its type.
    :param unit: of the number; "" for a pure number, a word or several values.
    :param default: what stands where it is not given; MISSING: it has to be given.
    :param lower: smallest number allowed.
    :param upper: largest number allowed.
    :param nan: True if NaN is allowed, which means that it was not estimated.
    :param null: the number for which documents have null.
    :param document: its name in documents; two fields of one name are a list there, the lower end
        first; None: documents do not have it.
    :param message: its whole name in messages; "": its own name behind the prefix of the field
        that holds it; None: messages do not have it.
    :param prefix: of the names that the fields of this field have in messages.
    :param after: the field that it follows in documents; "": it is the first; None: in the order
        of the class.
    :param column: place among the columns of tables of many bags, those of equal place in the
        order of documents; 0: it is no column.
    :param word: True: a name of letters, digits and underscores.
    :param derived: True: a property, which is checked when it is read instead of set.
    :param optional: True: documents leave it out where it is the default.
    """

    name: str
    kind: Any
    unit: str
    default: Any = MISSING
    lower: float = -math.inf
    upper: float = math.inf
    nan: bool = False
    null: float = math.nan
    document: str | None = ""
    message: str | None = ""
    prefix: str = ""
    after: str | None = None
    column: int = 0
    word: bool = False
    derived: bool = False
    optional: bool = False

    def problem(self, values: Any) -> str | None:
        """Return a sentence on what is wrong with a number or an array, None if nothing is.

        :param values: of the field.
        """
        if self.lower == -math.inf and self.upper == math.inf and self.nan:
            return None
        for value in values if isinstance(values, Iterable) else (values,):
            fine = self.nan if math.isnan(value) else self.lower <= value <= self.upper
            if not fine:
                return f"is {value:g}, expected {self.range_text}"
        return None

    @property
    def range_text(self) -> str:
        """The range in words, such as "a number >= 0"."""
        if math.isinf(self.upper):
            text = "a number" if math.isinf(self.lower) else f"a number >= {self.lower:g}"
        else:
            text = f"a number from {self.lower:g} to {self.upper:g}"
        return f"{text} or NaN" if self.nan else text


def result_field(
    unit: str = "", default: Any = MISSING, *, nan: bool | None = None, **carried: Any
) -> Any:
    """Declare the field of a dataclass as one of a result; arguments as for :class:`ResultField`.

    The docstring below the field says what it means.

    :param nan: None: NaN is allowed where it is the default.
    """
    if nan is None:
        nan = isinstance(default, float) and math.isnan(default)
    words = {"unit": unit, "default": default, "nan": nan, **carried}
    return field(default=default, metadata={_RESULT: words})


def derived(unit: str, *, after: str, column: int = 0) -> Callable[[_Getter], _Getter]:
    """Declare a property of a result that documents and messages carry beside its fields.

    :param unit: of the number.
    :param after: the field that it follows.
    :param column: as for :class:`ResultField`.
    """

    def declare(getter: _Getter) -> _Getter:
        words = {"unit": unit, "after": after, "column": column, "derived": True}
        setattr(getter, _RESULT, words)
        return getter

    return declare


@cache
def result_fields(kind: Any) -> tuple[ResultField, ...]:
    """Return what a result declares, in the order of documents."""
    types = get_type_hints(kind)
    found = [
        ResultField(own.name, types[own.name], **own.metadata[_RESULT])
        for own in fields(kind)
        if _RESULT in own.metadata
    ]
    for base in reversed(kind.__mro__):
        for name, member in vars(base).items():
            words = getattr(getattr(member, "fget", None), _RESULT, None)
            if words is not None:
                found.append(ResultField(name, float, default=MISSING, **words))
    ordered = [each for each in found if each.after is None]
    for each in (each for each in found if each.after is not None):
        names = [before.name for before in ordered]
        ordered.insert(names.index(each.after) + 1 if each.after else 0, each)
    return tuple(ordered)


NORMAL_95 = 1.96
"""Half of the width of the 95 % interval of a normal estimate, in standard deviations."""
