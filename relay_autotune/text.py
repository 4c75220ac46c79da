# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Numbers and transfer functions as text: plain, LaTeX and MathML; foreign text, escaped.

A name in a file, or a reason from the network, may hold sequences that move a terminal's cursor,
change its title or colours, reverse the direction of writing, or begin a new line that looks like
one of ours. Such text is escaped where it enters, so that it can be told from our own lines and
can be typed as shown. File names must stay unchanged for opening, so they are escaped only where
they are shown.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from relay_autotune.process.transfer_function import TransferFunction


_MINUS, _TIMES = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}"
_SPACE = r" \, "
# Half a unit of the fourth digit of 9999, the finest of four digits.
_FINEST = 5e-5

# Interval at which users are told what is waited for [s]: below a second on a busy machine, too.
TOLD_EVERY = 0.8

# Coefficients of 1, s, s^2 of one factor.
_Polynomial = tuple[float, ...]


def digits(value: float, count: int = 4) -> str:
    """Return a number with ``count`` significant digits; a dash if it is not finite.

    :param value: the number.
    :param count: significant digits.
    """
    if not math.isfinite(value):
        return "-"
    return f"{value:#.{count}g}".rstrip(".") if value else "0"


def duration(seconds: float) -> str:
    """Return a duration as text, such as "12 min 5 s".

    :param seconds: the duration [s], not negative.
    """
    if seconds < 90.0:
        return f"{seconds:.{1 if seconds < 10.0 else 0}f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 90:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min"


def plus_minus(value: float, half: float) -> str:
    """Return the half width of an interval, such as ``± 0.12``; empty if it is not known.

    A half width below the shown digits of the value would be rounding, not accuracy.

    :param value: in the middle.
    :param half: half the width.
    """
    if not math.isfinite(half):
        return ""
    if half < _FINEST * abs(value):
        return f"± less than {100.0 * _FINEST:g} %"
    return f"± {digits(half, 2)}"


def date_text(start: float) -> str:
    """Return a date and time in UTC.

    :param start: s since the epoch.
    """
    try:
        return f"{datetime.fromtimestamp(start, tz=UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):
        return f"{start:g} s after 1970"


def process_text(model: TransferFunction) -> str:
    """Return a transfer function on one line, such as ``1.65 e^(-10 s) / (1 + 20 s)``.

    :param model: the process.
    """
    above = [digits(model.gain), *map(_plain, _polynomials(model.zeros))]
    if model.dead_time:
        above.append(f"e^(-{digits(model.dead_time)} s)")
    below = [_plain(p) for p in _polynomials(model.time_constants)]
    if model.integrators:
        below.insert(0, "s" if model.integrators == 1 else f"s^{model.integrators}")
    if not below:
        return " ".join(above)
    return f"{' '.join(above)} / {below[0] if len(below) == 1 else '(' + ' '.join(below) + ')'}"


def process_latex(model: TransferFunction) -> str:
    r"""Return a transfer function as LaTeX, such as ``\frac{1.65}{1 + 20 s} e^{-10 s}``.

    :param model: the process.
    """
    above = _factors(model.zeros, _latex_factor)
    below = _factors(model.time_constants, _latex_factor)
    if model.integrators > 0:
        below.insert(0, "s" if model.integrators == 1 else f"s^{{{model.integrators}}}")
    if model.integrators < 0:
        above.insert(0, "s" if model.integrators == -1 else f"s^{{{-model.integrators}}}")
    top = _SPACE.join([_latex_number(model.gain), *above])
    text = rf"\frac{{{top}}}{{{_SPACE.join(below)}}}" if below else top
    if model.dead_time:
        text += rf" \, e^{{-{_latex_number(model.dead_time)} s}}"
    return text


def process_mathml(model: TransferFunction) -> str:
    """Return a transfer function as MathML, which browsers draw by themselves.

    :param model: the process.
    """
    above = _factors(model.zeros, _mathml_factor)
    below = _factors(model.time_constants, _mathml_factor)
    if model.integrators:
        power = _mathml_power("<mi>s</mi>", abs(model.integrators))
        (below if model.integrators > 0 else above).insert(0, power)
    top = "".join([_mathml_number(model.gain), *above])
    if model.dead_time:
        exponent = f"<mo>{_MINUS}</mo>{_mathml_number(model.dead_time)}<mi>s</mi>"
        top += f"<msup><mi>e</mi><mrow>{exponent}</mrow></msup>"
    if below:
        top = f"<mfrac><mrow>{top}</mrow><mrow>{''.join(below)}</mrow></mfrac>"
    return f'<math display="block"><mrow>{top}</mrow></math>'


def _polynomials(constants: Iterable[complex]) -> list[_Polynomial]:
    """Return a factor for each real constant and for each conjugate pair.

    A pair is (1 + z s)(1 + z* s) = 1 + 2 Re(z) s + |z|^2 s^2.
    """
    found: list[_Polynomial] = []
    for value in constants:
        if value.imag > 0.0:
            found.append((1.0, 2.0 * value.real, abs(value) ** 2))
        elif value.imag == 0.0:
            found.append((1.0, value.real))
    return found


def _plain(polynomial: _Polynomial) -> str:
    sign = "-" if polynomial[1] < 0.0 and len(polynomial) == 2 else "+"
    if len(polynomial) == 2:
        return f"(1 {sign} {digits(abs(polynomial[1]))} s)"
    return f"(1 + {digits(polynomial[1])} s + {digits(polynomial[2])} s^2)"


def _factors(constants: Iterable[complex], draw: Callable[[_Polynomial, int], str]) -> list[str]:
    """Return the factors, equal ones as a power."""
    counted = Counter(_polynomials(constants))
    return [draw(polynomial, power) for polynomial, power in counted.items()]


def _latex_number(value: float) -> str:
    mantissa, _, exponent = digits(value).partition("e")
    return rf"{mantissa} \times 10^{{{int(exponent)}}}" if exponent else mantissa


def _latex_factor(polynomial: _Polynomial, power: int) -> str:
    text = "1"
    for k, c in enumerate(polynomial[1:], start=1):
        text += f" {'-' if c < 0.0 else '+'} {_latex_number(abs(c))} s" + ("^2" if k == 2 else "")
    return f"({text})" + (f"^{{{power}}}" if power > 1 else "")


def _mathml_number(value: float) -> str:
    sign = f"<mo>{_MINUS}</mo>" if value < 0.0 else ""
    mantissa, _, exponent = digits(abs(value)).partition("e")
    text = f"{sign}<mn>{mantissa}</mn>"
    if exponent:
        text += f"<mo>{_TIMES}</mo><msup><mn>10</mn><mn>{int(exponent)}</mn></msup>"
    return text


def _mathml_power(inner: str, power: int) -> str:
    return f"<msup><mrow>{inner}</mrow><mn>{power}</mn></msup>" if power > 1 else inner


def _mathml_factor(polynomial: _Polynomial, power: int) -> str:
    text = "<mn>1</mn>"
    for k, c in enumerate(polynomial[1:], start=1):
        variable = "<mi>s</mi>" if k == 1 else "<msup><mi>s</mi><mn>2</mn></msup>"
        text += f"<mo>{_MINUS if c < 0.0 else '+'}</mo>{_mathml_number(abs(c))}{variable}"
    return _mathml_power(f"<mrow><mo>(</mo>{text}<mo>)</mo></mrow>", power)


# A spreadsheet takes a cell that begins with one of these for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def visible(text: str, keep: str = "") -> str:
    """Return a text with each unprintable character as an escape sequence of Python.

    These are control characters, line breaks, marks of the direction of writing, characters
    without width, and bytes that were no text. Visible characters stay unchanged.

    :param text: the text.
    :param keep: unprintable characters that stay unchanged.
    """
    if text.isprintable():
        return text
    return "".join(
        char if char.isprintable() or char in keep else char.encode("unicode_escape").decode()
        for char in text
    )


def cell(text: str) -> str:
    """Return a text as a table cell that no spreadsheet takes for a formula.

    :param text: the text; if it begins like a formula, an apostrophe is put before it.
    """
    text = visible(text)
    return f"'{text}" if text.startswith(_FORMULA) else text
