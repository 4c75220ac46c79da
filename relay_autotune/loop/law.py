# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""A control law as it runs, sample by sample.

Every law has the form, with the error ``e = r - y`` and the sampling period h,

    u = kc (b r - V y) + (kc/ti) I (r - V y) - kc td S (y, or y - r),

where V is a filter on the measurement, I the integral and S the derivative, each a rational
function of z. From these follow the law's transfer functions in z, and a controller that runs.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.sampled import (
    UNLIMITED,
    Limits,
    filter_elements,
    has_filter,
    require_period,
    without_filter,
)
from relay_autotune.process.transfer_function import TransferFunction

# Largest excess of a weight that counts as the same.
_SAME_WEIGHT = 0.005


# A time constant, or one for each of k functions, shape (k, 1).
Time = Any


@dataclass(frozen=True)
class Rational:
    """A rational function of z, in powers of ``z^-1``.

    Coefficients of shape (k, 1) are those of k functions at once.

    :param top: coefficients of 1, z^-n, z^-2n and so on.
    :param bottom: coefficients of 1, z^-1, z^-2 and so on; the first one is 1.
    :param apart: n, above 1 for a long memory.
    """

    top: tuple[Any, ...]
    bottom: tuple[Any, ...] = (1.0,)
    apart: Any = 1

    def __call__(self, back: ComplexArray) -> ComplexArray:
        """Return the value at each ``z^-1``, of any shape; of k functions at (n,): (k, n)."""
        far = back**self.apart
        return np.asarray(polynomial(self.top, far) / polynomial(self.bottom, back))

    def times(self, factor: float) -> Rational:
        """Return the function times a number."""
        return replace(self, top=tuple(factor * c for c in self.top))


def polynomial(coefficients: tuple[Any, ...], x: ComplexArray) -> Any:
    """Return a polynomial's values.

    :param coefficients: lowest power first, each a number, or of k polynomials shape (k, 1).
    :param x: any shape; of k polynomials (n,).
    """
    found = coefficients[-1]
    for c in coefficients[-2::-1]:
        found = c + x * found
    return found


_ONE = Rational((1.0,))
_NOTHING = Rational((0.0,))


class Running:
    """A rational function of z, run sample by sample from rest.

    :param function: the function.
    """

    def __init__(self, function: Rational) -> None:
        self._function = function
        self._inputs = [0.0] * (1 + int(function.apart) * (len(function.top) - 1))
        self._outputs = [0.0] * (len(function.bottom) - 1)

    def step(self, value: float) -> float:
        """Return its output for the next input.

        :param value: of the input.
        """
        self._inputs = [value, *self._inputs[:-1]]
        heard = self._inputs[:: int(self._function.apart)]
        found = sum(b * x for b, x in zip(self._function.top, heard, strict=True))
        past = zip(self._function.bottom[1:], self._outputs, strict=True)
        found -= sum(a * y for a, y in past)
        if self._outputs:
            self._outputs = [found, *self._outputs[:-1]]
        return found


# The response of a filter to an impulse has ended after this many time constants.
_SETTLED = 12.0


def taps_of(function: Rational, tf: float, period: float) -> FloatArray:
    """Return the response to an impulse, until it has died away, shape (n,).

    :param function: of at most the first order.
    :param tf: its time constant [s].
    :param period: of the samples [s].
    """
    taps = np.zeros(1 + int(function.apart) * (len(function.top) - 1))
    taps[:: int(function.apart)] = function.top
    if len(function.bottom) > 1:
        decay = (-function.bottom[1]) ** np.arange(int(_SETTLED * tf / period) + 2)
        taps = np.convolve(taps, decay)[: decay.size]
    return taps


class Integral(enum.Enum):
    """When a law adds a sample's error to its integral: the lead in half periods, and in words."""

    BEFORE = 1.0, "before the output (backward)"
    TRAPEZOID = 0.0, "before the output (trapezoid)"
    AFTER = -1.0, "after the output (forward)"

    def __init__(self, lead: float, words: str) -> None:
        self.lead, self.words = lead, words

    def over(self, period: float) -> Rational:
        """Return the integral of a unit signal, ``h (z + 1)/(z - 1)/2 + lead h/2``.

        :param period: h [s].
        """
        half = 0.5 * period
        return Rational((half * (1.0 + self.lead), half * (1.0 - self.lead)), (1.0, -1.0))


class Slope(enum.Enum):
    """The signal whose derivative a law takes."""

    MEASUREMENT = "the measurement"
    ERROR = "the error"
    NONE = "none"


@dataclass(frozen=True)
class Smoothing:
    """How a law smooths its derivative, or the whole measurement.

    :param words: its description in the guide.
    :param setting: the time constant that it has, from the one that is wanted and the period [s].
    :param slope: the derivative of a signal, for its own time constants and the period.
    :param value: the filter on the measurement in the other parts; likewise.
    :param adjustable: True if the time constant can be chosen.
    :param on_measurement: True if all parts see the measurement through the filter.
    """

    words: str
    setting: Callable[[float, float], float]
    slope: Callable[[Time, float], Rational]
    value: Callable[[Time, float], Rational] = lambda _tf, _period: _ONE
    adjustable: bool = True
    on_measurement: bool = False


def _measurement_filter(tf: Time, period: float) -> tuple[Rational, Rational]:
    """Return value and slope of the second-order filter of controller_node."""
    used = has_filter(np.asarray(tf), period)
    found = filter_elements(np.where(used, tf, period), period, np)
    f11, f12, f21, f22, p1, p2, n1, n2 = (
        np.where(used, with_it, none)
        for with_it, none in zip(found, without_filter(period), strict=True)
    )
    bottom = (1.0, -(f11 + f22), f11 * f22 - f12 * f21)
    value = (n1, p1 - f22 * n1 + f12 * n2, f12 * p2 - f22 * p1)
    slope = (n2, p2 - f11 * n2 + f21 * n1, f21 * p1 - f11 * p2)
    return Rational(value, bottom), Rational(slope, bottom)


def _first_order(tf: Time, period: float) -> Rational:
    """Return ``d_k = (1 - a) d_{k-1} + a (y_k - y_{k-1})/h`` with ``a = h/tf``."""
    a = period / np.maximum(tf, period)
    return Rational((a / period, -a / period), (1.0, a - 1.0))


def averaged_over(tf: Time, period: float) -> Any:
    """Return the number of differences whose mean lags ``tf`` more than one difference.

    :param tf: s.
    :param period: of the samples [s].
    """
    return 1 + np.rint(2.0 * np.asarray(tf) / period).astype(int)


def _mean(tf: Time, period: float) -> Rational:
    count = averaged_over(tf, period)
    last = 1.0 / (count * period)
    return Rational((last, -last), (1.0,), count)


PLAIN = Smoothing(
    "none",
    lambda _tf, _period: 0.0,
    lambda _tf, period: Rational((1.0 / period, -1.0 / period)),
    adjustable=False,
)
ON_MEASUREMENT = Smoothing(
    "second order, on the measurement",
    lambda tf, _period: tf,
    lambda tf, period: _measurement_filter(tf, period)[1],
    lambda tf, period: _measurement_filter(tf, period)[0],
    on_measurement=True,
)
FIRST_ORDER = Smoothing(
    "first order, on the derivative", lambda tf, period: tf if tf > period else 0.0, _first_order
)
MEAN = Smoothing(
    "mean of the last N differences",
    lambda tf, period: 0.5 * period * (averaged_over(tf, period) - 1),
    _mean,
)
FOUR_SAMPLES = Smoothing(
    "fixed, over four samples",
    lambda _tf, _period: 0.0,
    lambda _tf, period: Rational(tuple(c / (10.0 * period) for c in (3.0, 1.0, -1.0, -3.0))),
    adjustable=False,
)


@dataclass(frozen=True, kw_only=True)
class Law:
    """A control law.

    :param name: by which it is chosen.
    :param integral: when the error is added to the integral.
    :param slope: the signal whose derivative is taken.
    :param smoothing: of the derivative, or of the measurement.
    :param weights: set-point weights that it can have; (): any from 0 to 1.
    :param delay: samples until a command takes effect.
    :param only_positive: True if it has no gains for a process of negative gain.
    :param needs_integral: True if it does not run without integral action.
    """

    name: str
    integral: Integral = Integral.BEFORE
    slope: Slope = Slope.MEASUREMENT
    smoothing: Smoothing = PLAIN
    weights: tuple[float, ...] = (1.0,)
    delay: int = 0
    only_positive: bool = False
    needs_integral: bool = False

    def lag(self, period: float) -> float:
        """Return the dead time that stands for hold and delay in a continuous loop [s].

        :param period: of the samples [s].
        """
        return (0.5 + self.delay) * period

    def best(self, wanted: Controller, period: float) -> Controller:
        """Return the nearest controller that this law can run.

        :param wanted: the gains that are wanted.
        :param period: of the samples [s].
        :raises TuningError: if it cannot run gains of this sign, or without integral action.
        """
        if self.only_positive and wanted.kc < 0.0:
            raise TuningError(
                f"{self.name} takes positive gains only, found kc = {wanted.kc:g}: a higher "
                "command has to raise the measurement; turn the direction of the actuator"
            )
        if self.needs_integral and wanted.ti == 0.0:
            raise TuningError(
                f"{self.name} does not run without integral action, found ti = 0: choose a rule "
                "with integral action"
            )
        td = 0.0 if self.slope is Slope.NONE else wanted.td
        filtered = td > 0.0 or self.smoothing.on_measurement
        tf = self.smoothing.setting(wanted.tf, period) if filtered else 0.0
        return replace(wanted, td=td, tf=tf, b=self.weight(wanted.b))

    def weight(self, wanted: float) -> float:
        """Return the largest set-point weight up to the wanted one, or the least.

        :param wanted: from 0 to 1.
        """
        allowed = [w for w in self.weights if w <= wanted + _SAME_WEIGHT]
        return wanted if not self.weights else max(allowed, default=min(self.weights))

    def at(self, gains: Controller, period: float) -> SampledLaw:
        """Return the law with gains, at a sampling period.

        :param gains: what :meth:`best` returns.
        :param period: of the samples [s].
        """
        return SampledLaw(self, gains, period)


@dataclass(frozen=True)
class SampledLaw:
    """A law with its gains, at its sampling period.

    It is a linear controller as a function of s, on which ``z = exp(s h)``. Of controller_node's
    law there is the limit for h -> 0 as well, the continuous controller.

    :param law: the law.
    :param gains: its gains, in the ISA form.
    :param period: h [s]; 0: the continuous limit.
    """

    law: Law
    gains: Controller
    period: float

    @property
    def i(self) -> float:
        """Integral gain [u/(y s)]."""
        return self.gains.i

    @property
    def times(self) -> tuple[float, ...]:
        """Times at which it changes its effect [s]."""
        return self.gains.times

    @property
    def value(self) -> Rational:
        """The filter V on the measurement."""
        return self.law.smoothing.value(self.gains.tf, self.period)

    @property
    def integral(self) -> Rational:
        """The integral action, from error to command."""
        if self.gains.i == 0.0:
            return _NOTHING
        return self.law.integral.over(self.period).times(self.gains.i)

    @property
    def derivative(self) -> Rational:
        """The derivative action, from measurement to -command."""
        if self.gains.td == 0.0:
            return _NOTHING
        return self.law.smoothing.slope(self.gains.tf, self.period).times(self.gains.d)

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return -command per measurement at ``z = exp(s h)``, with the law's delay [u/y].

        :param s: rad/s, any shape.
        """
        if self.period == 0.0:
            return self.gains(s)
        back = np.exp(-np.asarray(s) * self.period)
        through = (self.gains.kc + self.integral(back)) * self.value(back) + self.derivative(back)
        return np.asarray(through * back**self.law.delay)

    def from_setpoint(self, s: ComplexArray) -> ComplexArray:
        """Return command per set-point at ``z = exp(s h)``, with the law's delay [u/y].

        :param s: rad/s, any shape.
        """
        if self.period == 0.0:
            return self.gains.from_setpoint(s)
        back = np.exp(-np.asarray(s) * self.period)
        through = self.gains.kc * self.gains.b + self.integral(back)
        return np.asarray(through * back**self.law.delay) + self.kick(s)

    def kick(self, s: ComplexArray) -> ComplexArray:
        """Return the part of :meth:`from_setpoint` that the derivative of the error brings.

        :param s: rad/s, any shape.
        """
        if self.law.slope is not Slope.ERROR:
            return 0.0 * np.asarray(s)
        back = np.exp(-np.asarray(s) * self.period)
        return np.asarray(self.derivative(back) * back**self.law.delay)

    @property
    def jump(self) -> float:
        """Largest command after a unit step of the set-point before the process answers [u/y].

        It comes when the derivative of the error has its peak, which is not the first sample where
        that is spread over several.
        """
        kicks, integral = self.kicks, Running(self.integral)
        peak = int(np.argmax(np.abs(kicks)))
        integrated = [integral.step(1.0) for _ in range(1 + peak)]
        return float(self.gains.kc * self.gains.b + integrated[-1] + kicks[peak])

    @property
    def kicks(self) -> FloatArray:
        """Command by the derivative of the error after a unit step, sample by sample [u/y]."""
        if self.law.slope is not Slope.ERROR:
            return np.zeros(1)
        # The steps of its response are the response to an impulse.
        return np.cumsum(taps_of(self.derivative, self.gains.tf, self.period))

    def characteristic(self, model: TransferFunction) -> tuple[TransferFunction, ...]:
        """Return the terms L_k of the characteristic equation of the continuous loop."""
        return self.gains.characteristic(model)

    def running(self) -> RunningLaw:
        """Return the law as it runs, from rest."""
        return RunningLaw(self)


class RunningLaw:
    """A law that is called once for each sample, from rest.

    At a limit its integral stops, whatever its program does there.

    :param law: the law with its gains.
    """

    def __init__(self, law: SampledLaw) -> None:
        self.period = law.period
        self._gains = law.gains
        self._on_error = law.law.slope is Slope.ERROR
        self._value = Running(law.value)
        self._integral = Running(law.integral)
        self._derivative = Running(law.derivative)
        self._waiting = [0.0] * law.law.delay
        self._setpoint = self._measurement = self._total = self._bias = 0.0

    def take_over(self, setpoint: float, measurement: float, command: float) -> None:
        """Go on from a command without a bump, as if all had been constant until now.

        The integral takes up the difference. To be called before the first sample.

        :param setpoint: y.
        :param measurement: y.
        :param command: u.
        """
        self._setpoint, self._measurement = setpoint, measurement
        self._bias = command - self._gains.kc * self._gains.b * setpoint
        self._waiting = [command] * len(self._waiting)

    def step(self, setpoint: float, measurement: float, limits: Limits = UNLIMITED) -> float:
        """Return the command for this sample [u].

        :param setpoint: y.
        :param measurement: y.
        :param limits: range of the command.
        """
        moved = measurement - self._measurement
        value = self._value.step(moved)
        if self._on_error:
            moved -= setpoint - self._setpoint
        before = self._total
        self._total = self._integral.step(setpoint - self._measurement - value)
        wanted = (
            self._bias
            + self._gains.kc * (self._gains.b * setpoint - value)
            + self._total
            - self._derivative.step(moved)
        )
        given = limits.clip(wanted)
        if (wanted - given) * (self._total - before) > 0.0:
            self._bias -= self._total - before
        self._waiting.append(given)
        return self._waiting.pop(0)


@dataclass(frozen=True)
class LawRate:
    """A law, and how often a program runs it.

    :param law: the law.
    :param period: of its runs [s]; 0: continuously, which controller_node's law alone can be.
    :raises TuningError: if the period is not positive and finite.
    """

    law: Law
    period: float

    def __post_init__(self) -> None:
        if self.period != 0.0 or not self.law.smoothing.on_measurement:
            require_period(self.period)

    def of(self, gains: Controller) -> SampledLaw:
        """Return the law with gains, those parts left out that it lacks.

        :param gains: the gains.
        :raises TuningError: if it cannot run them.
        """
        return self.law.at(self.law.best(gains, self.period), self.period)
