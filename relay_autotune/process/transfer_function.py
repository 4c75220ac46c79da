# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Transfer functions: rational functions of s with a dead time; as text, LaTeX and MathML."""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from relay_autotune.arrays import ComplexArray
from relay_autotune.errors import ModelError
from relay_autotune.process.factors import exactly, oscillating_pair, positive
from relay_autotune.text import digits

_MINUS, _TIMES = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}"
_SPACE = r" \, "

# Coefficients of 1, s, s^2 of one factor.
_Polynomial = tuple[float, ...]


def _conjugate_closed(values: tuple[complex, ...]) -> bool:
    rest = [v for v in values if v.imag != 0.0]
    while rest:
        value = rest.pop()
        partner = [r for r in rest if abs(r - value.conjugate()) <= 1e-9 * abs(value)]
        if not partner:
            return False
        rest.remove(partner[0])
    return True


def _real_product(constants: Sequence[complex]) -> NDArray[np.float64]:
    """Coefficients of prod(1 + c s), highest power first."""
    # prod(s + c) has the same coefficients in the other order.
    return np.atleast_1d(np.poly([-c for c in constants]).real)[::-1]


@dataclass(frozen=True)
class TransferFunction:
    r"""A process in time-constant form.

    >>> from relay_autotune import TransferFunction
    >>> print(TransferFunction.fopdt(gain=1.65, time_constant=20.0, dead_time=10.0))
    1.650 e^(-10.00 s) / (1 + 20.00 s)
    >>> print(TransferFunction(0.5, time_constants=(3.0,), integrators=1, dead_time=1.0))
    0.5000 e^(-1.000 s) / (s (1 + 3.000 s))

    ``G(s) = gain prod(1 + z s) / (s^integrators prod(1 + T s)) exp(-dead_time s)``.

    Right-half-plane zeros and poles have constants with a negative real part; complex ones come
    in conjugate pairs. An unstable FOPDT ``K exp(-D s)/(tau s - 1)`` is thus held as gain ``-K``
    and time constant ``-tau``; its constructor takes K and tau.

    :param gain: gain of the form above [y/u, per second for each integrator].
    :param zeros: time constants z [s].
    :param time_constants: time constants T [s].
    :param integrators: poles at s = 0; negative: zeros there.
    :param dead_time: D >= 0 [s].
    :param structure: name of the structure, one of ``STRUCTURES``.
    :raises ModelError: if a value is not finite, the gain is zero, the dead time negative, a
        complex constant lacks its conjugate, or there are more zeros than poles.
    """

    gain: float
    zeros: tuple[complex, ...] = ()
    time_constants: tuple[complex, ...] = ()
    integrators: int = 0
    dead_time: float = 0.0
    structure: str = "general"

    def __post_init__(self) -> None:
        zeros = tuple(complex(z) for z in self.zeros if z != 0.0)
        constants = tuple(complex(t) for t in self.time_constants if t != 0.0)
        numbers = (self.gain, self.dead_time, *zeros, *constants)
        if not all(cmath.isfinite(n) for n in numbers):
            raise ModelError(f"every number of a transfer function must be finite, found {self!r}")
        if self.gain == 0.0:
            raise ModelError("the gain of a transfer function must not be zero")
        if self.dead_time < 0.0:
            raise ModelError(f"the dead time must be >= 0 s, found {self.dead_time:g} s")
        if not (_conjugate_closed(zeros) and _conjugate_closed(constants)):
            raise ModelError("complex zeros and poles must come in conjugate pairs")
        if len(zeros) > len(constants) + self.integrators:
            raise ModelError(
                f"a process has at least as many poles as zeros, found "
                f"{len(constants) + self.integrators} and {len(zeros)}"
            )
        object.__setattr__(self, "gain", float(self.gain))
        object.__setattr__(self, "dead_time", float(self.dead_time))
        object.__setattr__(self, "zeros", zeros)
        object.__setattr__(self, "time_constants", constants)

    def __str__(self) -> str:
        """Return the transfer function on one line."""
        return process_text(self)

    def _repr_latex_(self) -> str:
        """Return the transfer function as notebooks show it."""
        return f"$\\displaystyle {process_latex(self)}$"

    def __call__(self, s: ArrayLike) -> ComplexArray:
        """Return G at each complex frequency ``s`` [rad/s], any shape."""
        s = np.asarray(s, dtype=np.complex128)
        delay = np.exp(-self.dead_time * s)
        value: ComplexArray = np.asarray(self.gain * delay)
        if self.integrators:
            value = np.asarray(value * s ** float(-self.integrators))
        for z in self.zeros:
            value = np.asarray(value * (1.0 + z * s))
        for t in self.time_constants:
            value = np.asarray(value / (1.0 + t * s))
        return value

    def after(
        self,
        gain: float,
        zeros: tuple[complex, ...],
        time_constants: tuple[complex, ...],
        integrators: int,
        dead_time: float = 0.0,
    ) -> TransferFunction:
        """Return this one behind another, whose factors are given as for the class."""
        return TransferFunction(
            gain * self.gain,
            zeros + self.zeros,
            time_constants + self.time_constants,
            integrators + self.integrators,
            dead_time + self.dead_time,
        )

    def phase(self, frequency: ArrayLike) -> NDArray[np.float64]:
        """Return the phase of ``process_sign * G(j w)`` without jumps [rad].

        Each factor's angle is continuous from w = 0 on, so no unwrapping is needed however far
        apart the frequencies lie.

        :param frequency: w > 0 [rad/s], any shape.
        """
        w = np.asarray(frequency, dtype=np.float64)
        start = 0.0 if self.gain * self.process_sign > 0.0 else -math.pi
        angle = start - self.integrators * math.pi / 2.0 - self.dead_time * w
        for z in self.zeros:
            angle = angle + np.angle(1.0 + 1j * w * z)
        for t in self.time_constants:
            angle = angle - np.angle(1.0 + 1j * w * t)
        return np.asarray(angle)

    @property
    def process_sign(self) -> int:
        """Sign that the controller's gain must have: +1 for a direct-acting process, else -1.

        This is the sign of the gain, reversed by each real unstable pole (``K/(tau s - 1)`` has a
        negative static gain and needs a positive controller), but not by right-half-plane zeros.
        """
        turned = sum(1 for t in self.time_constants if t.real < 0.0 and t.imag == 0.0)
        return int(math.copysign(1.0, self.gain)) * (-1) ** turned

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.time_constants) + max(self.integrators, 0)

    @property
    def response_time(self) -> float:
        """Dead time and lags together, about the time that it takes to answer [s]."""
        return self.dead_time + sum(abs(t) for t in self.time_constants)

    @property
    def is_stable(self) -> bool:
        """True if every pole lies in the open left half plane."""
        return self.integrators <= 0 and all(t.real > 0.0 for t in self.time_constants)

    @property
    def grows(self) -> bool:
        """True if a pole lies in the open right half plane; that of an integrator does not."""
        return any(t.real < 0.0 for t in self.time_constants)

    def growth_in(self, time: float) -> float:
        """Return a time in time constants of what grows fastest; 0 where nothing does.

        :param time: s.
        """
        return max((time / -t.real for t in self.time_constants if t.real < 0.0), default=0.0)

    @property
    def numerator(self) -> tuple[float, ...]:
        """Coefficients of powers of s, highest first, without the dead time."""
        coefficients = self.gain * _real_product(self.zeros)
        return tuple(float(c) for c in coefficients) + (0.0,) * max(-self.integrators, 0)

    @property
    def denominator(self) -> tuple[float, ...]:
        """Coefficients of powers of s, highest first; the lowest one that is not zero is 1."""
        coefficients = _real_product(self.time_constants)
        return tuple(float(c) for c in coefficients) + (0.0,) * max(self.integrators, 0)

    @classmethod
    def from_polynomials(
        cls,
        numerator: Sequence[float],
        denominator: Sequence[float],
        dead_time: float = 0.0,
        structure: str = "general",
    ) -> TransferFunction:
        """Build a transfer function from coefficients of powers of s, highest first.

        :param numerator: shape (m,), not all zero, as the denominator, shape (n,).
        :param dead_time: D >= 0 [s].
        :raises ModelError: if a polynomial is empty, zero or not finite, or the function improper.
        """
        lows, roots, integrators = [], [], 0
        for name, given in (("numerator", numerator), ("denominator", denominator)):
            c = np.trim_zeros(np.atleast_1d(np.asarray(given, dtype=np.float64)), "f")
            if c.size == 0 or not bool(np.all(np.isfinite(c))):
                raise ModelError(
                    f"the {name} needs finite coefficients that are not all zero, "
                    f"found {np.atleast_1d(given).tolist()}"
                )
            stripped = np.trim_zeros(c, "b")
            integrators = c.size - stripped.size - integrators
            lows.append(float(stripped[-1]))
            # With 1/s as the variable the roots are minus the time constants.
            try:
                with np.errstate(over="raise"):
                    roots.append(tuple(complex(-r) for r in np.roots(stripped[::-1])))
            except (FloatingPointError, np.linalg.LinAlgError) as error:
                raise ModelError(
                    f"the coefficients {list(c)} of the {name} span too many powers of ten; "
                    "choose another unit of time"
                ) from error
        return cls(lows[0] / lows[1], roots[0], roots[1], integrators, dead_time, structure)

    @classmethod
    def fopdt(cls, gain: float, time_constant: float, dead_time: float) -> TransferFunction:
        """Return ``K exp(-D s)/(tau s + 1)`` (model 1 of Chang et al., eq 1 of Wang et al.)."""
        return cls(gain, (), (positive(time_constant),), 0, dead_time, "fopdt")

    @classmethod
    def lag_n(
        cls, gain: float, time_constant: float, order: int, dead_time: float
    ) -> TransferFunction:
        """Return ``K exp(-D s)/(tau s + 1)^n`` (models 2 and 3 of Chang et al.)."""
        return cls(gain, (), (positive(time_constant),) * order, 0, dead_time, "lag_n")

    @classmethod
    def sopdt(
        cls, gain: float, time_constants: Sequence[complex], dead_time: float, zero: float = 0.0
    ) -> TransferFunction:
        """Return ``K (z s + 1) exp(-D s)/((tau1 s + 1)(tau2 s + 1))`` (model 4 of Chang et al.).

        Underdamped: give the two conjugate time constants, or use :meth:`oscillator`.
        """
        name = "sopdt_zero" if zero else "sopdt"
        return cls(gain, (zero,), exactly(2, time_constants), 0, dead_time, name)

    @classmethod
    def oscillator(
        cls,
        gain: float,
        natural_frequency: float,
        damping: float,
        dead_time: float,
        zero: float = 0.0,
    ) -> TransferFunction:
        """Return ``K (z s + 1) exp(-D s)/(s^2/w0^2 + 2 zeta s/w0 + 1)``, any damping."""
        pair = oscillating_pair(natural_frequency, damping)
        return cls.sopdt(gain, pair, dead_time, zero)


def process_text(model: TransferFunction) -> str:
    """Return a transfer function on one line, such as ``1.65 e^(-10 s) / (1 + 20 s)``.

    :param model: the process.
    """
    above, below = _sides(model, _plain_factor, _plain_power("s", abs(model.integrators)))
    top = " ".join([digits(model.gain), *above])
    if model.dead_time:
        top += f" e^(-{digits(model.dead_time)} s)"
    if not below:
        return top
    return f"{top} / {below[0] if len(below) == 1 else '(' + ' '.join(below) + ')'}"


def process_latex(model: TransferFunction) -> str:
    r"""Return a transfer function as LaTeX, such as ``\frac{1.65}{1 + 20 s} e^{-10 s}``.

    :param model: the process.
    """
    above, below = _sides(model, _latex_factor, _latex_power("s", abs(model.integrators)))
    top = _SPACE.join([_latex_number(model.gain), *above])
    text = rf"\frac{{{top}}}{{{_SPACE.join(below)}}}" if below else top
    if model.dead_time:
        text += rf" \, e^{{-{_latex_number(model.dead_time)} s}}"
    return text


def process_mathml(model: TransferFunction) -> str:
    """Return a transfer function as MathML, which browsers draw by themselves.

    :param model: the process.
    """
    power = _mathml_power("<mi>s</mi>", abs(model.integrators))
    above, below = _sides(model, _mathml_factor, power)
    top = "".join([_mathml_number(model.gain), *above])
    if model.dead_time:
        exponent = f"<mo>{_MINUS}</mo>{_mathml_number(model.dead_time)}<mi>s</mi>"
        top += f"<msup><mi>e</mi><mrow>{exponent}</mrow></msup>"
    if below:
        top = f"<mfrac><mrow>{top}</mrow><mrow>{''.join(below)}</mrow></mfrac>"
    return f'<math display="block"><mrow>{top}</mrow></math>'


# A lag of this share of the slowest one changes nothing that could be seen.
_NO_LAG = 1e-9


def _polynomials(constants: Iterable[complex], model: TransferFunction) -> list[_Polynomial]:
    """Return a factor for each real constant and for each conjugate pair.

    A pair is (1 + z s)(1 + z* s) = 1 + 2 Re(z) s + |z|^2 s^2.
    """
    found: list[_Polynomial] = []
    slowest = max(map(abs, (*model.time_constants, *model.zeros, model.dead_time)))
    for value in constants:
        if abs(value) < _NO_LAG * slowest:
            continue
        if value.imag > 0.0:
            found.append((1.0, 2.0 * value.real, abs(value) ** 2))
        elif value.imag == 0.0:
            found.append((1.0, value.real))
    return found


def _sides(
    model: TransferFunction, draw: Callable[[_Polynomial, int], str], integrators: str
) -> tuple[list[str], list[str]]:
    """Return the factors above and below the line, equal ones as a power.

    :param draw: from a polynomial and its power to text.
    :param integrators: their power of s.
    """
    above, below = (
        [draw(*each) for each in Counter(_polynomials(constants, model)).items()]
        for constants in (model.zeros, model.time_constants)
    )
    if model.integrators:
        (below if model.integrators > 0 else above).insert(0, integrators)
    return above, below


def _plain_power(inner: str, power: int) -> str:
    return f"{inner}^{power}" if power > 1 else inner


def _plain_factor(polynomial: _Polynomial, power: int) -> str:
    return _plain_power(_sum(polynomial, digits), power)


def _sum(polynomial: _Polynomial, number: Callable[[float], str]) -> str:
    """Return a polynomial in brackets, as plain text and LaTeX write it.

    :param number: from a positive value to text.
    """
    text = "1"
    for k, c in enumerate(polynomial[1:], start=1):
        text += f" {'-' if c < 0.0 else '+'} {number(abs(c))} s" + ("^2" if k == 2 else "")
    return f"({text})"


def _latex_power(inner: str, power: int) -> str:
    return f"{inner}^{{{power}}}" if power > 1 else inner


def _latex_number(value: float) -> str:
    mantissa, _, exponent = digits(value).partition("e")
    return rf"{mantissa} \times 10^{{{int(exponent)}}}" if exponent else mantissa


def _latex_factor(polynomial: _Polynomial, power: int) -> str:
    return _latex_power(_sum(polynomial, _latex_number), power)


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
