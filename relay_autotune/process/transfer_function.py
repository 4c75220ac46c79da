# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Transfer functions: rational functions of s with a dead time; as text, LaTeX and MathML.

The parameters of models, and the factors of a denominator that they make, stand first.
"""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.text import digits


@dataclass(frozen=True)
class Parameter:
    """A parameter of a model.

    :param name: in results.
    :param unit: of its value; of a gain without integrators.
    :param logarithmic: True: it cannot change sign, so its logarithm is fitted and drawn, and the
        interval is that of the logarithm.
    :param least: smallest value.
    :param field: its name in flags, messages and the parameters of plant_node.
    :param turned: True: the field has the opposite sign.
    """

    name: str
    unit: str = "s"
    logarithmic: bool = True
    least: float = -math.inf
    field: str = "time_constants"
    turned: bool = False


GAIN = Parameter("gain", "y/u", field="gain")
INVERSE = Parameter("inverse_time_constant", field="zeros", turned=True)
TIME_CONSTANT = Parameter("time_constant")
TIME_CONSTANT_1 = Parameter("time_constant_1")
TIME_CONSTANT_2 = Parameter("time_constant_2")
TIME_CONSTANT_3 = Parameter("time_constant_3")
NATURAL_FREQUENCY = Parameter("natural_frequency", "rad/s", field="natural_frequency")
DAMPING = Parameter("damping", "", field="damping")
ZERO = Parameter("zero", logarithmic=False, field="zeros")
DEAD_TIME = Parameter("dead_time", logarithmic=False, least=0.0, field="dead_time")

# Every structure lists its parameters in this order.
PARAMETERS = (
    *(GAIN, INVERSE, TIME_CONSTANT, TIME_CONSTANT_1, TIME_CONSTANT_2, TIME_CONSTANT_3),
    *(NATURAL_FREQUENCY, DAMPING, ZERO, DEAD_TIME),
)


def positive(time_constant: float) -> float:
    """Return a time constant [s].

    :raises ModelError: unless it is positive.
    """
    if not time_constant > 0.0:
        raise ModelError(f"a time constant here must be > 0 s, found {time_constant:g} s")
    return float(time_constant)


def exactly(
    count: int, constants: Sequence[complex], name: str = "time_constants"
) -> tuple[complex, ...]:
    """Return the constants if their number is ``count`` [s].

    :raises ModelError: if there are more or fewer.
    """
    if len(constants) != count:
        raise ModelError(f"the structure needs {name} of length {count}, found {len(constants)}")
    return tuple(complex(c) for c in constants)


def oscillating_pair(natural_frequency: float, damping: float) -> tuple[complex, complex]:
    """Return the time constants of ``s^2/w0^2 + 2 zeta s/w0 + 1`` [s].

    :param natural_frequency: w0 [rad/s].
    :param damping: zeta.
    :raises ModelError: if w0 is not positive.
    """
    if not natural_frequency > 0.0:
        raise ModelError(f"a natural frequency must be > 0 rad/s, found {natural_frequency:g}")
    root = np.emath.sqrt(complex(damping * damping - 1.0))
    return (
        complex((damping + root) / natural_frequency),
        complex((damping - root) / natural_frequency),
    )


Polynomial = list[float]

TWO_LAGS = (TIME_CONSTANT_1, TIME_CONSTANT_2)
PAIR = (NATURAL_FREQUENCY, DAMPING)


@dataclass(frozen=True)
class Lag:
    """``(1 + tau s)^n``, or an unstable one, ``(tau s - 1)^n``, with the parameter log tau.

    :param multiplicity: n.
    :param parameters: tau.
    :param unstable: whether its pole lies in the right half plane.
    """

    multiplicity: int = 1
    parameters: tuple[Parameter] = (TIME_CONSTANT,)
    unstable: bool = False

    @property
    def _sign(self) -> float:
        return -1.0 if self.unstable else 1.0

    def polynomial(self, theta: FloatArray) -> Polynomial:
        """Return ``1 + tau s`` or ``tau s - 1``, lowest power first.

        :param theta: (log tau,).
        """
        return [self._sign, math.exp(theta[0])]

    def derivatives(self, theta: FloatArray) -> list[Polynomial]:
        """Return the derivative of :meth:`polynomial` by log tau."""
        return [[0.0, math.exp(theta[0])]]

    def constants(self, theta: FloatArray) -> list[complex]:
        """Return T in ``1 + T s`` of one power of the factor [s]: tau, or -tau."""
        return [complex(self._sign * math.exp(theta[0]))]

    def values(self, theta: FloatArray) -> tuple[float, ...]:
        """Return the parameters that theta stands for: tau [s]."""
        return (math.exp(theta[0]),)

    def poles(self, values: Sequence[float]) -> tuple[complex, ...]:
        """Return T of all powers for a value of tau [s].

        :raises ModelError: unless it is positive.
        """
        return (self._sign * positive(values[0]),) * self.multiplicity

    def values_of(self, constants: Sequence[complex]) -> tuple[float, ...]:
        """Return tau [s] of what :meth:`poles` returns."""
        return (self._sign * constants[0].real,)


@dataclass(frozen=True)
class Quadratic:
    """``1 + 2 zeta s/w0 + (s/w0)^2`` with the parameters log(1/w0) and log zeta.

    The parameters are smooth from underdamped to overdamped, also where two lags merge into a
    pair.

    :param parameters: ``TWO_LAGS`` or ``PAIR``: the form in which it is reported.
    """

    parameters: tuple[Parameter, Parameter] = TWO_LAGS
    multiplicity = 1
    unstable = False

    def polynomial(self, theta: FloatArray) -> Polynomial:
        """Return the factor, lowest power first.

        :param theta: (log(1/w0), log zeta).
        """
        t, zeta = math.exp(theta[0]), math.exp(theta[1])
        return [1.0, 2.0 * zeta * t, t * t]

    def derivatives(self, theta: FloatArray) -> list[Polynomial]:
        """Return the derivatives of :meth:`polynomial` by both parameters."""
        t, zeta = math.exp(theta[0]), math.exp(theta[1])
        return [[0.0, 2.0 * zeta * t, 2.0 * t * t], [0.0, 2.0 * zeta * t, 0.0]]

    def constants(self, theta: FloatArray) -> list[complex]:
        """Return the two time constants, a conjugate pair where zeta < 1 [s]."""
        t, zeta = math.exp(theta[0]), math.exp(theta[1])
        if zeta >= 1.0:
            # The larger one has no cancellation; the smaller one follows from their product.
            larger = t * (zeta + math.sqrt(zeta * zeta - 1.0))
            return [complex(larger), complex(t * t / larger)]
        root = math.sqrt(1.0 - zeta * zeta)
        return [complex(t * zeta, t * root), complex(t * zeta, -t * root)]

    def values(self, theta: FloatArray) -> tuple[float, ...]:
        """Return the parameters that theta stands for, of two lags the larger first."""
        if self.parameters == PAIR:
            return math.exp(-theta[0]), math.exp(theta[1])
        return tuple(c.real for c in self.constants(theta))

    def poles(self, values: Sequence[float]) -> tuple[complex, ...]:
        """Return the two time constants for values of the parameters [s].

        :raises ModelError: if the natural frequency is not positive.
        """
        return oscillating_pair(*values) if self.parameters == PAIR else tuple(values)

    def values_of(self, constants: Sequence[complex]) -> tuple[float, ...]:
        """Return the parameters of the two time constants that :meth:`poles` returns."""
        if self.parameters != PAIR:
            return tuple(c.real for c in constants)
        first, second = constants
        frequency = 1.0 / math.sqrt((first * second).real)
        return frequency, 0.5 * frequency * (first + second).real


Factor = Lag | Quadratic


@dataclass(frozen=True)
class Denominator:
    """A product of factors, times integrators.

    :param factors: in the order of their parameters.
    :param integrators: poles at s = 0.
    """

    factors: tuple[Factor, ...]
    integrators: int = 0

    @property
    def parameters(self) -> int:
        """Number of parameters of all factors."""
        return sum(len(f.parameters) for f in self.factors)

    @property
    def order(self) -> int:
        """Number of poles."""
        per_factor = (
            f.multiplicity * (2 if isinstance(f, Quadratic) else 1) for f in self.factors
        )
        return sum(per_factor) + self.integrators

    def split(self, theta: FloatArray) -> list[FloatArray]:
        """Return each factor's own part of the parameters.

        :param theta: shape (parameters,).
        """
        parts, first = [], 0
        for factor in self.factors:
            last = first + len(factor.parameters)
            parts.append(theta[first:last])
            first = last
        return parts

    def constants(self, theta: FloatArray, more: int = 0) -> tuple[complex, ...]:
        """Return the time constants of all poles but the integrators [s].

        :param theta: shape (parameters,).
        :param more: powers by which each factor is higher.
        """
        parts = zip(self.factors, self.split(theta), strict=True)
        return tuple(c for f, own in parts for c in f.constants(own) * (f.multiplicity + more))

    def numerators(
        self, theta: FloatArray, powers: Sequence[int], *, by_dead_time: bool = True
    ) -> FloatArray:
        r"""Return numerators over the extended denominator, for responses and derivatives.

        With Q the product of the factors ``f_j^{n_j}`` and R that of the ``f_j``, a basis
        response ``s^k/Q`` is ``s^k R`` over the extended denominator Q R, its derivative by a
        parameter of factor j is ``-n_j s^k f_j' R/f_j`` and by the dead time ``-s^{k+1} R``.

        :param theta: shape (parameters,).
        :param powers: k of each basis response, p of them.
        :param by_dead_time: False: without the derivatives by the dead time.
        :return: coefficients, lowest power first, shape (p (2 + parameters), d): all responses,
            then their derivatives by each parameter in turn, then by the dead time.
        """
        own = self.split(theta)
        factors = [f.polynomial(t) for f, t in zip(self.factors, own, strict=True)]
        whole = _product(factors)
        rows = [[0.0] * k + whole for k in powers]
        for j, (factor, part) in enumerate(zip(self.factors, own, strict=True)):
            others = _product(factors[:j] + factors[j + 1 :])
            for derivative in factor.derivatives(part):
                change = _product([[-factor.multiplicity * c for c in derivative], others])
                rows += [[0.0] * k + change for k in powers]
        if by_dead_time:
            rows += [[0.0] * (k + 1) + [-c for c in whole] for k in powers]
        width = max(map(len, rows))
        return np.array([row + [0.0] * (width - len(row)) for row in rows])


def _product(polynomials: Sequence[list[float]]) -> list[float]:
    # With two or three coefficients each, plain numbers are faster than arrays.
    product = [1.0]
    for polynomial in polynomials:
        longer = [0.0] * (len(product) + len(polynomial) - 1)
        for i, a in enumerate(product):
            for k, b in enumerate(polynomial):
                longer[i + k] += a * b
        product = longer
    return product


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
    product = np.ones(1, dtype=np.complex128)
    for constant in constants:
        product = np.convolve(product, np.array([constant, 1.0]))
    return np.ascontiguousarray(product.real)


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
    def is_stable(self) -> bool:
        """True if every pole lies in the open left half plane."""
        return self.integrators <= 0 and all(t.real > 0.0 for t in self.time_constants)

    @property
    def grows(self) -> bool:
        """True if a pole lies in the open right half plane; that of an integrator does not."""
        return any(t.real < 0.0 for t in self.time_constants)

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
                    f"found {list(np.atleast_1d(given))}"
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
    above = [digits(model.gain), *map(_plain, _polynomials(model.zeros, model))]
    if model.dead_time:
        above.append(f"e^(-{digits(model.dead_time)} s)")
    below = [_plain(p) for p in _polynomials(model.time_constants, model)]
    if model.integrators:
        below.insert(0, "s" if model.integrators == 1 else f"s^{model.integrators}")
    if not below:
        return " ".join(above)
    return f"{' '.join(above)} / {below[0] if len(below) == 1 else '(' + ' '.join(below) + ')'}"


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


def _plain(polynomial: _Polynomial) -> str:
    sign = "-" if polynomial[1] < 0.0 and len(polynomial) == 2 else "+"
    if len(polynomial) == 2:
        return f"(1 {sign} {digits(abs(polynomial[1]))} s)"
    return f"(1 + {digits(polynomial[1])} s + {digits(polynomial[2])} s^2)"


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


def _latex_power(inner: str, power: int) -> str:
    return f"{inner}^{{{power}}}" if power > 1 else inner


def _latex_number(value: float) -> str:
    mantissa, _, exponent = digits(value).partition("e")
    return rf"{mantissa} \times 10^{{{int(exponent)}}}" if exponent else mantissa


def _latex_factor(polynomial: _Polynomial, power: int) -> str:
    text = "1"
    for k, c in enumerate(polynomial[1:], start=1):
        text += f" {'-' if c < 0.0 else '+'} {_latex_number(abs(c))} s" + ("^2" if k == 2 else "")
    return _latex_power(f"({text})", power)


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
