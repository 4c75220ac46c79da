"""Meaning and range of a value, declared once at the field that holds it.

A frozen dataclass declares its fields by :func:`quantity`. Checks, ROS parameters with their
descriptors, command-line flags with their help, and the tables of the guide follow from it::

    @dataclass(frozen=True)
    class DesignOptions:
        ms: float = quantity(1.4, "", "Largest Ms.", lower=1.2, upper=4.0)

        def __post_init__(self) -> None:
            check(self, TuningError)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any

from relay_autotune.errors import RelayAutotuneError

_DECLARED = "quantity"


@dataclass(frozen=True)
class Quantity:
    """A value that a user may set.

    :param name: its name, as a field and as a ROS parameter.
    :param default: its default, which also decides its type. NaN: not given. Infinite: no limit.
        (): an array of numbers that is not given.
    :param unit: y of the measurement, u of the command, s seconds; "" for a pure number or a word.
    :param description: one sentence for people.
    :param lower: smallest value allowed.
    :param upper: largest value allowed.
    :param open_ended: True if ``lower`` and ``upper`` themselves are not allowed.
    :param choices: the allowed words, for a text; (): any text.
    :param flag: its name on the command line; empty: ``name``.
    """

    name: str
    default: float | int | bool | str | tuple[float, ...]
    unit: str
    description: str
    lower: float = -math.inf
    upper: float = math.inf
    open_ended: bool = False
    choices: tuple[str, ...] = ()
    flag: str = ""

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
        return text + self._or_not_given

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
        elif not isinstance(value, (int, float)):
            return f"{self.name} is {value!r}, expected {self.range_text}"
        elif math.isinf(value) and value != self.default:
            # Only the default of a limit may be infinite: there is no limit then.
            return f"{self.name} is {value:g}, expected a finite number{self._or_not_given}"
        elif isinstance(self.default, int) and value != value // 1:
            return f"{self.name} is {value:g}, expected a whole number"
        else:
            fine = self._includes(value)
        found = f"{value:g}" if self.is_number else repr(value)
        return None if fine else f"{self.name} is {found}, expected {self.range_text}"

    def _includes(self, value: float) -> bool:
        if math.isnan(value):
            return self.default != self.default
        if self.open_ended:
            return self.lower < value < self.upper
        return self.lower <= value <= self.upper


def quantity(
    default: float | int | bool | str,
    unit: str,
    description: str,
    lower: float = -math.inf,
    upper: float = math.inf,
    *,
    open_ended: bool = False,
    choices: tuple[str, ...] = (),
    flag: str = "",
) -> Any:
    """Declare the field of a dataclass as a quantity; the arguments are :class:`Quantity`'s."""
    words = (default, unit, description, lower, upper, open_ended, choices, flag)
    return field(default=default, metadata={_DECLARED: words})


@cache
def declared(kind: type) -> tuple[Quantity, ...]:
    """Return the quantities that a dataclass declares, in the order of its fields."""
    return tuple(
        Quantity(each.name, *each.metadata[_DECLARED])
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
