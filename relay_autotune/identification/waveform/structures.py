"""The structures that the waveform fit knows: what is nonlinear in each, and how it reads."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.identification.waveform.factors import Denominator, Lag, Quadratic, UnstableLag
from relay_autotune.identification.waveform.rational import free_motion, responses
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Input

FloatArray = NDArray[np.float64]
Build = Callable[[FloatArray], TransferFunction]

# Below this damping two lags are reported as a pair; at 1, where they merge, neither is smooth.
_PAIR = 1.02
_LOG_STEP = 1.0
_DEAD_TIME_STEP = 0.3
_LOG_DAMPING = (math.log(0.005), math.log(50.0))
_LOG_RANGE = 30.0


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@dataclass(frozen=True)
class Reading:
    """A fitted structure in the terms of the field.

    :param parameters: names of the values.
    :param values: shape (p,).
    :param build: the transfer function of any such values.
    """

    parameters: tuple[str, ...]
    values: FloatArray
    build: Build

    @property
    def model(self) -> TransferFunction | None:
        """The transfer function; None where a value is not finite, or the gain zero."""
        if not np.all(np.isfinite(self.values)) or self.values[0] == 0.0:
            return None
        return self.build(self.values)


@dataclass(frozen=True)
class RationalStructure:
    """A structure by its denominator and the powers of s in its numerator.

    Theta is the logarithms of the denominator's parameters and the dead time. The coefficients
    of the numerator are linear: with powers (0, 1) they are K and K z.

    :param name: one of ``relay_autotune.process.transfer_function.STRUCTURES``.
    :param denominator: its denominator.
    :param powers: of s in the numerator.
    """

    name: str
    denominator: Denominator
    powers: tuple[int, ...] = (0,)

    @property
    def order(self) -> int:
        """Number of poles."""
        return self.denominator.order

    @property
    def unstable(self) -> bool:
        """True if a pole lies in the right half plane, whose free motion is always a column."""
        return any(f.unstable for f in self.denominator.factors)

    def columns(
        self, theta: FloatArray, time: FloatArray, u: Input
    ) -> tuple[FloatArray, FloatArray]:
        """Return the responses, shape (k, n), and their derivatives, shape (m, k, n).

        :param theta: shape (m,).
        :param time: sample times [s], shape (n,).
        :param u: the input; its deviation from ``u.initial`` acts.
        """
        return responses(self.denominator, self.powers, theta, time, u)

    def relaxation(
        self, theta: FloatArray, time: FloatArray, *, growing_only: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Return what a free state adds, shape (q, n), and its derivatives, shape (m, q, n).

        :param theta: shape (m,).
        :param time: sample times [s], shape (n,).
        :param growing_only: True: of the poles in the right half plane alone.
        """
        return free_motion(self.denominator, theta, time, growing_only=growing_only)

    def scale(self, theta: FloatArray) -> FloatArray:
        """Return the size of a unit step in each direction; of the dead time, all lags [s]."""
        lags = sum(abs(c) for c in self.denominator.constants(theta[:-1]))
        return np.array([*[1.0] * (theta.size - 1), lags + float(theta[-1]) or 1.0])

    def move(self, theta: FloatArray, step: FloatArray, longest: float = math.inf) -> FloatArray:
        """Return theta after a step in units of :meth:`scale`, within its bounds.

        :param theta: shape (m,).
        :param step: shape (m,).
        :param longest: time constant beyond which a lag is an integrator [s].
        """
        # Of so few, plain numbers are quicker than arrays.
        *logs, dead_time = theta.tolist()
        *moves, by_dead_time = step.tolist()
        logs = [
            _clip(at + _clip(by, -_LOG_STEP, _LOG_STEP), -_LOG_RANGE, _LOG_RANGE)
            for at, by in zip(logs, moves, strict=True)
        ]
        first, limit = 0, math.log(longest)
        for factor in self.denominator.factors:
            logs[first] = min(logs[first], limit)
            if isinstance(factor, Quadratic):
                logs[first + 1] = _clip(logs[first + 1], *_LOG_DAMPING)
            first += factor.parameters
        limited = _clip(by_dead_time, -_DEAD_TIME_STEP, _DEAD_TIME_STEP)
        later = dead_time + limited * float(self.scale(theta)[-1])
        return np.array([*logs, max(later, 0.0)])

    def read(
        self, theta: FloatArray, coefficients: FloatArray, like: FloatArray | None = None
    ) -> Reading | None:
        """Return the fit in the terms of the field; None if the structure's name does not hold.

        :param theta: shape (m,).
        :param coefficients: of the numerator, shape (k,).
        :param like: a theta beside which the reading takes the same form; default: ``theta``.
        """
        gain, dead_time = float(coefficients[0]), float(theta[-1])
        if gain == 0.0:
            return None
        zero = float(coefficients[1]) / gain if len(self.powers) > 1 else 0.0
        return _READERS[self.name](
            _Fitted(self, gain, zero, theta[:-1], dead_time, theta if like is None else like)
        )


@dataclass(frozen=True)
class _Fitted:
    structure: RationalStructure
    gain: float
    zero: float
    theta: FloatArray
    dead_time: float
    like: FloatArray


def _lags(fit: _Fitted) -> Reading | None:
    n = fit.structure.order
    tau = math.exp(fit.theta[0])
    if fit.structure.name == "fopdt":
        return Reading(
            ("gain", "time_constant", "dead_time"),
            np.array((fit.gain, tau, fit.dead_time)),
            lambda v: TransferFunction.fopdt(v[0], v[1], v[2]),
        )
    if fit.structure.name == "lag_n":
        return Reading(
            ("gain", "time_constant", "dead_time"),
            np.array((fit.gain, tau, fit.dead_time)),
            lambda v: TransferFunction.lag_n(v[0], v[1], n, v[2]),
        )
    return Reading(
        ("gain", "time_constant", "zero", "dead_time"),
        np.array((fit.gain, tau, fit.zero, fit.dead_time)),
        lambda v: TransferFunction.lag_n_zero(v[0], v[1], n, v[2], v[3]),
    )


def _second_order(fit: _Fitted) -> Reading | None:
    with_zero = len(fit.structure.powers) > 1
    names, pair = _pair(fit)
    values = np.array((fit.gain, *pair, *((fit.zero,) if with_zero else ()), fit.dead_time))
    parameters = ("gain", *names, *(("zero",) if with_zero else ()), "dead_time")
    lags = names[0] == "time_constant_1"

    def build(v: FloatArray) -> TransferFunction:
        z = float(v[3]) if with_zero else 0.0
        if lags:
            return TransferFunction.sopdt(v[0], (v[1], v[2]), v[-1], z)
        return TransferFunction.oscillator(v[0], v[1], v[2], v[-1], z)

    return Reading(parameters, values, build)


def _pair(fit: _Fitted) -> tuple[tuple[str, str], tuple[float, float]]:
    """Return the quadratic factor, which comes first, as two lags or as an oscillating pair."""
    theta = fit.theta[:2]
    damping = math.exp(theta[1])
    if math.exp(fit.like[1]) >= _PAIR:
        larger, smaller = (c.real for c in Quadratic().constants(theta))
        return ("time_constant_1", "time_constant_2"), (larger, smaller)
    return ("natural_frequency", "damping"), (math.exp(-theta[0]), damping)


def _third_order(fit: _Fitted) -> Reading | None:
    names, pair = _pair(fit)
    tau = math.exp(fit.theta[2])
    lags = names[0] == "time_constant_1"
    if lags is not (fit.structure.name == "three_lags"):
        return None
    if lags:
        constants = sorted((*pair, tau), reverse=True)
        return Reading(
            ("gain", "time_constant_1", "time_constant_2", "time_constant_3", "dead_time"),
            np.array((fit.gain, *constants, fit.dead_time)),
            lambda v: TransferFunction.three_lags(v[0], tuple(v[1:4]), v[4]),
        )
    return Reading(
        ("gain", "time_constant", "natural_frequency", "damping", "dead_time"),
        np.array((fit.gain, tau, *pair, fit.dead_time)),
        lambda v: TransferFunction.lag_complex(v[0], v[1], v[2], v[3], v[4]),
    )


def _two_equal_one(fit: _Fitted) -> Reading | None:
    return Reading(
        ("gain", "time_constant_1", "time_constant_2", "dead_time"),
        np.array((fit.gain, math.exp(fit.theta[0]), math.exp(fit.theta[1]), fit.dead_time)),
        lambda v: TransferFunction.two_equal_one(v[0], v[1], v[2], v[3]),
    )


def _integrating(fit: _Fitted) -> Reading | None:
    if fit.structure.name == "ipdt":
        return Reading(
            ("gain", "dead_time"),
            np.array((fit.gain, fit.dead_time)),
            lambda v: TransferFunction.ipdt(v[0], v[1]),
        )
    tau = math.exp(fit.theta[0])
    if fit.structure.name == "integrator_lag":
        return Reading(
            ("gain", "time_constant", "dead_time"),
            np.array((fit.gain, tau, fit.dead_time)),
            lambda v: TransferFunction.integrator_lag(v[0], v[1], v[2]),
        )
    if fit.zero >= 0.0:
        return None
    return Reading(
        ("gain", "inverse_time_constant", "time_constant", "dead_time"),
        np.array((fit.gain, -fit.zero, tau, fit.dead_time)),
        lambda v: TransferFunction.integrator_inverse(v[0], v[1], v[2], v[3]),
    )


def _unstable(fit: _Fitted) -> Reading | None:
    if fit.structure.name == "unstable_fopdt":
        return Reading(
            ("gain", "time_constant", "dead_time"),
            np.array((fit.gain, math.exp(fit.theta[0]), fit.dead_time)),
            lambda v: TransferFunction.unstable_fopdt(v[0], v[1], v[2]),
        )
    return Reading(
        ("gain", "time_constant_1", "time_constant_2", "dead_time"),
        np.array((fit.gain, math.exp(fit.theta[0]), math.exp(fit.theta[1]), fit.dead_time)),
        lambda v: TransferFunction.unstable_sopdt(v[0], v[1], v[2], v[3]),
    )


_READERS = {
    "fopdt": _lags,
    "lag_n": _lags,
    "lag_n_zero": _lags,
    "sopdt": _second_order,
    "sopdt_zero": _second_order,
    "two_equal_one": _two_equal_one,
    "three_lags": _third_order,
    "lag_complex": _third_order,
    "ipdt": _integrating,
    "integrator_lag": _integrating,
    "integrator_inverse": _integrating,
    "unstable_fopdt": _unstable,
    "unstable_sopdt": _unstable,
}


def lag_n(order: int) -> RationalStructure:
    """Return n equal lags; one of them is a FOPDT."""
    name = "fopdt" if order == 1 else "lag_n"
    return RationalStructure(name, Denominator((Lag(order),)))


def lag_n_zero(order: int) -> RationalStructure:
    """Return n equal lags with a zero."""
    return RationalStructure("lag_n_zero", Denominator((Lag(order),)), (0, 1))


FOPDT = lag_n(1)
SOPDT = RationalStructure("sopdt", Denominator((Quadratic(),)))
SOPDT_ZERO = RationalStructure("sopdt_zero", Denominator((Quadratic(),)), (0, 1))
TWO_EQUAL_ONE = RationalStructure("two_equal_one", Denominator((Lag(2), Lag())))
THREE_LAGS = RationalStructure("three_lags", Denominator((Quadratic(), Lag())))
LAG_COMPLEX = RationalStructure("lag_complex", Denominator((Quadratic(), Lag())))
IPDT = RationalStructure("ipdt", Denominator((), 1))
INTEGRATOR_LAG = RationalStructure("integrator_lag", Denominator((Lag(),), 1))
INTEGRATOR_INVERSE = RationalStructure("integrator_inverse", Denominator((Lag(),), 1), (0, 1))
UNSTABLE_FOPDT = RationalStructure("unstable_fopdt", Denominator((UnstableLag(),)))
UNSTABLE_SOPDT = RationalStructure("unstable_sopdt", Denominator((UnstableLag(), Lag())))
