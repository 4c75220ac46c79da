# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of models, and the factors of a denominator that they make."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError


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

    def numerators(self, powers: Sequence[int]) -> FloatArray:
        """Return those of ``s^k``: coefficients, lowest power first, shape (p, d).

        :param powers: k of each basis response, p of them.
        """
        # The constants T of what grows stand for -f.
        turned = sum(f.multiplicity for f in self.factors if f.unstable)
        return (-1.0) ** turned * np.eye(max(powers) + 1)[list(powers)]

    def with_slopes(self, theta: FloatArray, powers: Sequence[int]) -> FloatArray:
        r"""Return numerators over the extended denominator, for responses and derivatives.

        With Q the product of the factors ``f_j^{n_j}`` and R that of the ``f_j``, a basis
        response ``s^k/Q`` is ``s^k R`` over the extended denominator Q R, its derivative by a
        parameter of factor j is ``-n_j s^k f_j' R/f_j`` and by the dead time ``-s^{k+1} R``.

        :param theta: shape (parameters,).
        :param powers: k of each basis response, p of them.
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
