# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The structures of processes: one row each, with everything else derived from the rows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError, look_up
from relay_autotune.process.factors import (
    DEAD_TIME,
    GAIN,
    INVERSE,
    PAIR,
    PARAMETERS,
    TIME_CONSTANT_1,
    TIME_CONSTANT_2,
    TIME_CONSTANT_3,
    TWO_LAGS,
    ZERO,
    Denominator,
    Factor,
    Lag,
    Parameter,
    Quadratic,
    exactly,
    positive,
)
from relay_autotune.process.transfer_function import TransferFunction

GENERAL = "general"

# Below this damping two lags are reported as a pair. Not 1, because there the lags merge and their
# time constants are not smooth.
_DAMPING_OF_A_PAIR = 1.02
# Time constants nearer to each other than this share are equal.
_EQUAL = 1e-6


@dataclass(frozen=True)
class Structure:
    """A structure by its factors: ``gain (1 + z s) exp(-D s)/(s^integrators product)``.

    The nonlinear parameters of a fit are theta: the logarithms of the factors' parameters, then
    the dead time. The coefficients of the numerator are linear: K, and with a zero K z.

    :param name: of the structure.
    :param factors: of the denominator, in the order of theta.
    :param integrators: poles at s = 0.
    :param zero: parameter of its zero; None: no zero.
    :param either: True: the two lags may also be an oscillating pair, with other parameters.
    :param with_pair: the structure that it is where its two lags are an oscillating pair, if that
        has a name of its own.
    :param any_order: True: the number of equal lags belongs to the model, see :meth:`of_order`.
    """

    name: str
    factors: tuple[Factor, ...] = ()
    integrators: int = 0
    zero: Parameter | None = None
    either: bool = False
    with_pair: Structure | None = None
    any_order: bool = False

    @cached_property
    def denominator(self) -> Denominator:
        """The denominator."""
        return Denominator(self.factors, self.integrators)

    @property
    def powers(self) -> tuple[int, ...]:
        """Powers of s in the numerator."""
        return (0,) if self.zero is None else (0, 1)

    @property
    def order(self) -> int:
        """Number of poles."""
        return self.denominator.order

    @property
    def given_order(self) -> int:
        """Number of equal lags if it must be given with the name; else 0."""
        return self.order if self.any_order else 0

    @property
    def unstable(self) -> bool:
        """True if a pole lies in the right half plane."""
        return any(f.unstable for f in self.factors)

    @property
    def equal_lags(self) -> bool:
        """True if it is one lag, or several equal ones, and dead time."""
        plain = self.zero is None and not self.integrators and len(self.factors) == 1
        return plain and isinstance(self.factors[0], Lag) and not self.unstable

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters, in the order of the values."""
        own = {GAIN, DEAD_TIME, self.zero, *(p for f in self.factors for p in f.parameters)}
        return tuple(p for p in PARAMETERS if p in own)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def logarithmic(self) -> NDArray[np.bool_]:
        """Which of the parameters cannot change sign, shape (p,)."""
        return np.array([p.logarithmic for p in self.parameters], dtype=bool)

    @cached_property
    def least(self) -> FloatArray:
        """Smallest value of each parameter, shape (p,)."""
        return np.array([p.least for p in self.parameters])

    def unit(self, parameter: Parameter) -> str:
        """Return the unit of a parameter in this structure."""
        if parameter != GAIN or self.integrators <= 0:
            return parameter.unit
        return "y/(u s)" if self.integrators == 1 else f"y/(u s^{self.integrators})"

    def of_order(self, order: int) -> Structure:
        """Return the structure with ``order`` equal lags.

        :raises ModelError: if the order is less than one.
        """
        if order < 1:
            raise ModelError(f"the order of equal lags must be at least 1, found {order}")
        (parameters,) = [f.parameters for f in self.factors if isinstance(f, Lag)]
        return replace(self, factors=(Lag(order, parameters),))

    def form(self, pair: bool) -> Structure:
        """Return the structure with its quadratic factor as a pair or as two lags.

        :param pair: True: natural frequency and damping instead of two lags.
        """
        wanted = Quadratic(PAIR if pair else TWO_LAGS)
        factors = [wanted if isinstance(f, Quadratic) else f for f in self.factors]
        return replace(self, factors=tuple(factors)) if self.either else self

    def build(self, values: Sequence[float] | FloatArray) -> TransferFunction:
        """Return the transfer function with given values.

        :param values: of :attr:`parameters`, in their order, shape (p,).
        :raises ModelError: if a time constant or a natural frequency is not positive, the gain
            zero, the dead time negative, or a value not finite.
        """
        given = dict(zip(self.parameters, map(float, values), strict=True))
        gain = -given[GAIN] if self.unstable else given[GAIN]
        zeros: tuple[float, ...] = ()
        if self.zero is not None:
            value = positive(given[self.zero]) if self.zero.logarithmic else given[self.zero]
            zeros = (-value if self.zero.turned else value,)
        constants: list[complex] = []
        for factor in sorted(self.factors, key=lambda f: PARAMETERS.index(f.parameters[0])):
            constants += factor.poles([given[p] for p in factor.parameters])
        dead_time = given[DEAD_TIME]
        return TransferFunction(
            gain, zeros, tuple(constants), self.integrators, dead_time, self.name
        )

    def values_of(self, model: TransferFunction) -> FloatArray:
        """Return the values of a model, the way back from :meth:`build`.

        :param model: of this structure.
        :raises ModelError: if it is not of this structure.
        """
        given = {GAIN: -model.gain if self.unstable else model.gain, DEAD_TIME: model.dead_time}
        # A pair comes last among the parameters.
        constants = sorted(model.time_constants, key=lambda c: c.imag != 0.0)
        exactly(self.order - self.integrators, constants)
        for factor in sorted(self.factors, key=lambda f: PARAMETERS.index(f.parameters[0])):
            count = factor.multiplicity * len(factor.parameters)
            own, constants = constants[:count], constants[count:]
            given.update(zip(factor.parameters, factor.values_of(own), strict=True))
        if self.zero is not None:
            zero = model.zeros[0].real if model.zeros else 0.0
            given[self.zero] = -zero if self.zero.turned else zero
        return np.array([given[p] for p in self.parameters])

    def read(
        self, theta: FloatArray, coefficients: FloatArray, like: FloatArray | None = None
    ) -> tuple[Structure, FloatArray] | None:
        """Return the structure and the values of its parameters for a fit.

        :param theta: shape (m,).
        :param coefficients: those of the numerator come first, shape (k,).
        :param like: the theta that decides between lags and pair; default: ``theta``.
        :return: None if the fit is not of this structure: no gain, a zero of the wrong sign.
        """
        gain = float(coefficients[0])
        form = self._form_at(theta if like is None else like)
        if gain == 0.0 or form is None:
            return None
        given = {GAIN: gain, DEAD_TIME: float(theta[-1])}
        lags: list[Parameter] = []
        for factor, own in zip(form.factors, self.denominator.split(theta[:-1]), strict=True):
            given.update(zip(factor.parameters, factor.values(own), strict=True))
            if not factor.unstable and factor.multiplicity == 1 and factor.parameters != PAIR:
                lags += factor.parameters
        # Lags that could be exchanged are ordered by size.
        given.update(zip(lags, sorted((given[p] for p in lags), reverse=True), strict=True))
        if self.zero is not None:
            zero = float(coefficients[1]) / gain
            given[self.zero] = -zero if self.zero.turned else zero
            if self.zero.logarithmic and not given[self.zero] > 0.0:
                return None
        return form, np.array([given[p] for p in form.parameters])

    def model_at(self, theta: FloatArray, coefficients: FloatArray) -> TransferFunction | None:
        """Return the model of a fit; None if it is not of this structure.

        :param theta: shape (m,).
        :param coefficients: those of the numerator come first, shape (k,).
        """
        found = self.read(theta, coefficients)
        if found is None or not np.all(np.isfinite(found[1])):
            return None
        return found[0].build(found[1])

    def _form_at(self, theta: FloatArray) -> Structure | None:
        """Return the structure as two lags or as a pair, by the damping; None: neither fits."""
        for factor, own in zip(self.factors, self.denominator.split(theta[:-1]), strict=True):
            if isinstance(factor, Quadratic):
                pair = not math.exp(own[1]) >= _DAMPING_OF_A_PAIR
                same = pair is (factor.parameters == PAIR)
                return self if same else self.form(pair) if self.either else self.with_pair
        return self

    def holds(self, model: TransferFunction) -> bool:
        """Return whether a model is of this structure, by its poles and zeros.

        :param model: any; lags of which only some are equal count as different ones.
        """
        lags, zeros = model.time_constants, model.zeros
        unstable = sum(f.unstable for f in self.factors)
        if model.integrators != self.integrators or len(zeros) != len(self.powers) - 1:
            return False
        if sum(t.real <= 0.0 for t in lags) != unstable:
            return False
        if self.zero is not None and self.zero.turned and not zeros[0].real < 0.0:
            return False
        pair = any(t.imag != 0.0 for t in lags)
        if self.any_order:
            far = max((abs(t - lags[0]) for t in lags), default=math.inf)
            return len(lags) > 1 and not pair and far <= _EQUAL * abs(lags[0])
        repeated = any(f.multiplicity > 1 for f in self.factors)
        if repeated or len(lags) != self.order - self.integrators:
            return False
        return self.either or pair is any(f.parameters == PAIR for f in self.factors)

    def of_fields(
        self,
        *,
        gain: float,
        time_constants: Sequence[float] = (),
        zeros: Sequence[float] = (),
        dead_time: float = 0.0,
        order: int = 0,
        natural_frequency: float = 0.0,
        damping: float = 0.0,
    ) -> TransferFunction:
        """Return a model from the fields of flags, messages and plant_node's parameters.

        :param gain: K [y/u, y/(u s)].
        :param time_constants: in the order of the parameters [s]; one for equal lags; empty with
            ``natural_frequency`` and ``damping`` where the structure may have a complex pair.
        :param zeros: time constants of ``(1 + z s)`` [s].
        :param dead_time: D [s].
        :param order: number of equal lags.
        :param natural_frequency: w0 of a complex pair [rad/s].
        :param damping: zeta of a complex pair.
        :raises ModelError: if the number of values does not match the structure, or a value is
            out of range.
        """
        found = self.of_order(order) if self.any_order else self
        found = found.form(pair=not time_constants)
        fields = {
            "gain": [gain],
            "dead_time": [dead_time],
            "natural_frequency": [natural_frequency],
            "damping": [damping],
        }
        count = Counter(p.field for p in found.parameters)
        for name, given in (("time_constants", time_constants), ("zeros", zeros)):
            if count[name]:
                fields[name] = [c.real for c in exactly(count[name], given, name)]
        values = [fields[p.field].pop(0) * (-1.0 if p.turned else 1.0) for p in found.parameters]
        return found.build(values)


@dataclass(frozen=True)
class GivenModel(Structure):
    """A model known only by its transfer function, such as one read from a file.

    :param given: the parameters whose values are reported with it.
    :param model: the transfer function.
    """

    given: tuple[Parameter, ...] = ()
    model: TransferFunction = field(default_factory=lambda: TransferFunction(1.0))

    @classmethod
    def of(cls, model: TransferFunction, names: Sequence[str] = ()) -> GivenModel:
        """Return the structure of a model.

        :param model: the transfer function.
        :param names: names of the parameters whose values are reported with it.
        """
        by_name = {p.name: p for p in PARAMETERS}
        given = tuple(by_name.get(name) or Parameter(name, "") for name in names)
        return cls(model.structure, (), model.integrators, given=given, model=model)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters whose values are reported."""
        return self.given

    def build(self, values: Sequence[float] | FloatArray) -> TransferFunction:
        """Return the model itself.

        :param values: its reported values; not used.
        """
        assert len(values) == len(self.given)
        return self.model

    def values_of(self, model: TransferFunction) -> FloatArray:
        """Return NaN for each value: they do not follow from the transfer function."""
        del model
        return np.full(len(self.given), math.nan)


_ONE, _TWO, _THREE = (TIME_CONSTANT_1,), (TIME_CONSTANT_2,), (TIME_CONSTANT_3,)

FOPDT = Structure("fopdt", (Lag(),))
LAG_N = Structure("lag_n", (Lag(2),), any_order=True)
LAG_N_ZERO = Structure("lag_n_zero", (Lag(2),), zero=ZERO, any_order=True)
SOPDT = Structure("sopdt", (Quadratic(),), either=True)
SOPDT_ZERO = Structure("sopdt_zero", (Quadratic(),), zero=ZERO, either=True)
TWO_EQUAL_ONE = Structure("two_equal_one", (Lag(2, _ONE), Lag(1, _TWO)))
LAG_COMPLEX = Structure("lag_complex", (Quadratic(PAIR), Lag()))
THREE_LAGS = Structure("three_lags", (Quadratic(), Lag(1, _THREE)), with_pair=LAG_COMPLEX)
IPDT = Structure("ipdt", (), 1)
INTEGRATOR_LAG = Structure("integrator_lag", (Lag(),), 1)
INTEGRATOR_INVERSE = Structure("integrator_inverse", (Lag(),), 1, INVERSE)
UNSTABLE_FOPDT = Structure("unstable_fopdt", (Lag(unstable=True),))
UNSTABLE_SOPDT = Structure("unstable_sopdt", (Lag(1, _ONE, unstable=True), Lag(1, _TWO)))

# All structures by name, the simple ones first.
TABLE = {
    structure.name: structure
    for structure in (
        *(FOPDT, LAG_N, LAG_N_ZERO, SOPDT, SOPDT_ZERO, TWO_EQUAL_ONE, THREE_LAGS, LAG_COMPLEX),
        *(IPDT, INTEGRATOR_LAG, INTEGRATOR_INVERSE, UNSTABLE_FOPDT, UNSTABLE_SOPDT),
    )
}

# The fields of a model, without its structure.
FIELDS = (
    *("gain", "time_constants", "zeros", "dead_time"),
    *("order", "natural_frequency", "damping"),
)

# Names of structures; the last one means any other transfer function.
STRUCTURES = (*TABLE, GENERAL)


def structure_named(name: str) -> Structure:
    """Return a structure by its name.

    :raises ModelError: if the name is unknown; the message lists the known names.
    """
    return look_up(TABLE, name, "structure", ModelError)


def recognised(model: TransferFunction) -> TransferFunction:
    """Return a model with the name of the first structure that it has; unchanged if of none.

    :param model: any.
    """
    name = next((s.name for s in TABLE.values() if s.holds(model)), model.structure)
    return replace(model, structure=name)


def structure_of(model: TransferFunction, names: Sequence[str]) -> Structure:
    """Return the structure of a model with given parameter names.

    :param model: the model, with the name of its structure.
    :param names: names of its parameters, in order.
    :return: the structure; a `GivenModel` if no structure has these parameters.
    """
    found = TABLE.get(model.structure)
    if found is not None:
        found = found.of_order(model.order) if found.any_order and model.order else found
        for form in (found.form(False), found.form(True)):
            if form.names == tuple(names):
                return form
    return GivenModel.of(model, names)


def equal_lags(order: int) -> Structure:
    """Return n equal lags with dead time; one of them is a FOPDT."""
    return FOPDT if order == 1 else LAG_N.of_order(order)
