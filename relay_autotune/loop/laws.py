# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The control laws that other programs run, sample by sample, as rows of one table.

Every law has the form, with the error ``e = r - y`` and the sampling period h,

    u = kc (b r - V y) + (kc/ti) I (r - V y) - kc td S (y, or y - r),

where V is a filter on the measurement, I the integral and S the derivative, each a rational
function of z. A row says which these are. From it follow the law's transfer functions in z, a
controller that runs, the names of its parameters, and the table in the guide. A row is written
from the source of the program, in the version that it names.
"""

from __future__ import annotations

import enum
import math
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


# The response of a filter to an impulse has ended after so many time constants.
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


_PLAIN = Smoothing(
    "none",
    lambda _tf, _period: 0.0,
    lambda _tf, period: Rational((1.0 / period, -1.0 / period)),
    adjustable=False,
)
_ON_MEASUREMENT = Smoothing(
    "second order, on the measurement",
    lambda tf, _period: tf,
    lambda tf, period: _measurement_filter(tf, period)[1],
    lambda tf, period: _measurement_filter(tf, period)[0],
    on_measurement=True,
)
_FIRST_ORDER = Smoothing(
    "first order, on the derivative", lambda tf, period: tf if tf > period else 0.0, _first_order
)
_MEAN = Smoothing(
    "mean of the last N differences",
    lambda tf, period: 0.5 * period * (averaged_over(tf, period) - 1),
    _mean,
)
_FOUR_SAMPLES = Smoothing(
    "fixed, over four samples",
    lambda _tf, _period: 0.0,
    lambda _tf, period: Rational(tuple(c / (10.0 * period) for c in (3.0, 1.0, -1.0, -3.0))),
    adjustable=False,
)


@dataclass(frozen=True)
class Setting:
    """A parameter of the program that runs a law.

    :param name: its name there.
    :param value: its value, or a function of the law with its gains; text is written as it is.
    """

    name: str
    value: float | str | Callable[[SampledLaw], float | str | None]

    def of(self, law: SampledLaw) -> float | str | None:
        """Return the value for a law with its gains; None: it is left out."""
        return self.value(law) if callable(self.value) else self.value


# Returns names and values for the lowest and the highest command; None: it is left out.
Bounds = Callable[[float, float], tuple[tuple[str, float | str | None], ...]]


@dataclass(frozen=True)
class Start:
    """How a program begins from the present command.

    :param words: what to do, a sentence.
    :param name: the input that takes the value; empty: it has none.
    :param value: of that input, from the law with its gains and the command [u].
    :param needs: True if its text does not work without a value.
    """

    words: str
    name: str = ""
    value: Callable[[SampledLaw, float], float] = lambda _law, command: command
    needs: bool = False


@dataclass(frozen=True)
class Law:
    """A control law that some program runs.

    :param name: by which it is chosen.
    :param program: the program and the version whose source was read.
    :param equation: the difference equation.
    :param limits: what happens at the limits of the command.
    :param settings: its parameters.
    :param integral: when the error is added to the integral.
    :param slope: the signal whose derivative is taken.
    :param smoothing: of the derivative, or of the measurement.
    :param weights: set-point weights that it can have; (): any from 0 to 1.
    :param delay: samples until a command takes effect.
    :param form: of its gains, parallel (p, i, d) or ideal (gain and times).
    :param command: unit and scale of the command.
    :param full: its largest command; 0: it may be any.
    :param turned: what to know where a higher command lowers the measurement and its program takes
        that command with the other sign; empty: it takes it as it is.
    :param only_positive: True if it has no gains for a process of negative gain.
    :param needs_integral: True if it does not run without integral action.
    :param head: what stands above its settings.
    :param line: how a setting is written, with ``{name}`` and ``{value}``.
    :param tail: what stands below them.
    :param bounds: its settings for the limits of the command, of which each may be infinite;
        None: they are set elsewhere in the program.
    :param unset: the limits that its program takes where none are set; empty: it has none then.
    :param remark: beginning of a line that is a comment.
    :param sign: what to know where its gains have not the sign of kc; ``{sign}`` is theirs.
    :param start: how it begins from the present command; None: its program has no way.
    :param ending: of the name of a file with its settings.
    :param scale: what to know where its program scales the gains; empty: it does not.
    """

    name: str
    program: str
    equation: str
    limits: str
    settings: tuple[Setting, ...]
    integral: Integral = Integral.BEFORE
    slope: Slope = Slope.MEASUREMENT
    smoothing: Smoothing = _PLAIN
    weights: tuple[float, ...] = (1.0,)
    delay: int = 0
    form: str = "parallel"
    command: str = "any"
    full: float = 0.0
    turned: str = ""
    only_positive: bool = False
    needs_integral: bool = False
    head: str = ""
    line: str = "{name}: {value}"
    tail: str = ""
    bounds: Bounds | None = None
    unset: str = ""
    remark: str = "#"
    sign: str = ""
    start: Start | None = None
    ending: str = "yaml"
    scale: str = ""

    @property
    def sets_gains(self) -> bool:
        """True if its parameters p, i and d are the gains themselves."""
        return [each.name for each in self.settings[:3]] == ["p", "i", "d"]

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
    def kick_variation(self) -> float:
        """Total variation of the command by the derivative of the error after a unit step."""
        if self.law.slope is not Slope.ERROR or self.gains.td == 0.0:
            return 0.0
        # The steps of its response are the response to an impulse.
        return float(np.abs(taps_of(self.derivative, self.gains.tf, self.period)).sum())

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
        if self.period != 0.0 or self.law.name != OWN_LAW:
            require_period(self.period)

    def of(self, gains: Controller) -> SampledLaw:
        """Return the law with gains, those parts left out that it lacks.

        :param gains: the gains.
        :raises TuningError: if it cannot run them.
        """
        return self.law.at(self.law.best(gains, self.period), self.period)


def _gains(
    names: str, fields: str = "p i d", of: Callable[[float], float] = lambda gain: gain
) -> tuple[Setting, ...]:
    """Return the settings that are gains.

    :param names: of the settings.
    :param fields: which of the gains each is; default: those of the parallel form.
    :param of: returns what is written for a gain.
    """

    def setting(name: str, field: str) -> Setting:
        return Setting(name, lambda law: of(float(getattr(law.gains, field))))

    return tuple(map(setting, names.split(), fields.split()))


def _or_none(limit: float) -> float | None:
    return limit if math.isfinite(limit) else None


def _of_255(gain: float) -> float:
    return 255.0 * gain


def _strategy(name: str) -> Setting:
    """Return the anti-windup strategy of control_toolbox; none without an integral."""
    return Setting("antiwindup_strategy", lambda law: name if law.gains.ti > 0.0 else "none")


# Blocks of a PLC often work in shares of measuring ranges.
_SHARES = (
    "KP is in u/y: a block that scales to measuring ranges takes KP times the range of its "
    "measurement over that of its command."
)
_TOOLBOX = "control_toolbox::Pid of ros-controls, 4.11.0 (branch jazzy)"
_CONTROLLERS = "ros2_controllers, 4.42.1 (branch jazzy),"
_ON_Y = "I_k = I_{k-1} + i h e_k, then u_k = p (b r_k - y_k) + I_k - d (y_k - y_{k-1})/h"


def _control_toolbox(
    strategy: str, limits: str, *others: Setting, integral: Integral = Integral.AFTER
) -> tuple[Law, Law]:
    """Return the law of control_toolbox with an anti-windup strategy, and that with a velocity.

    Controllers with a velocity state give it the error of the velocity. A driver that
    differentiates its encoder, and a simulator that moves by the new velocity, have for velocity
    the difference of the position.
    """
    equation = "I_k = I_{k-1} + i h e_k, then u_k = p e_k + I_k + d s_k"
    if integral is Integral.AFTER:
        equation = "u_k = p e_k + I_k + d s_k, then I_{k+1} = I_k + i h e_k"
    plain = Law(
        f"control_toolbox_{strategy}",
        _TOOLBOX,
        f"{equation}; s_k = (e_k - e_{{k-1}})/h",
        limits,
        (*_gains("p i d"), _strategy(strategy), *others),
        integral,
        Slope.ERROR,
    )
    return plain, replace(
        plain,
        name=f"{plain.name}_velocity",
        program=f"{_TOOLBOX}, as {_CONTROLLERS} give it the velocity state of a joint",
        equation=f"{equation}; s_k is minus the velocity, (y_{{k-1}} - y_k)/h",
        slope=Slope.MEASUREMENT,
    )


_BACK_CALCULATION = _control_toolbox(
    "back_calculation",
    "the integral also gets h (u limited - u)/tracking_time_constant",
    # That which control_toolbox takes for 0; written out, since a program that runs keeps the one
    # of the gains before.
    Setting("tracking_time_constant", lambda law: law.gains.tracking or None),
)

_ROWS = (
    Law(
        "controller_node",
        "controller_node of this package",
        "I_k = I_{k-1} + i h (r_k - v_k), then u_k = kc (b r_k - v_k - td s_k) + I_k; v and s are "
        "y and its derivative after 1/(1 + tf s + (tf s)^2/2), exact for a y that is linear "
        "between samples",
        "back-calculation with sqrt(ti td), without derivative ti",
        _gains("kc ti td tf b", "kc ti td tf b"),
        smoothing=_ON_MEASUREMENT,
        weights=(),
        form="ideal",
        head="/**:\n  ros__parameters:",
        line="    {name}: {value}",
        bounds=lambda low, high: (("command_min", _or_none(low)), ("command_max", _or_none(high))),
        start=Start("initial_command is the present command.", "initial_command"),
    ),
    *_BACK_CALCULATION,
    *_control_toolbox("conditional_integration", "no integration while u is limited and e u > 0"),
    *_control_toolbox("none", "the integral winds up"),
    *_control_toolbox(
        "legacy",
        "the integral stays between i_clamp_min and i_clamp_max",
        integral=Integral.BEFORE,
    ),
    replace(
        _BACK_CALCULATION[0],
        name="pid_controller",
        program=f"pid_controller of {_CONTROLLERS} with one state interface; it runs {_TOOLBOX}",
    ),
    Law(
        "arduino_pid_v1",
        "PID_v1 of br3ttb/Arduino-PID-Library, 1.2.1",
        f"{_ON_Y}; b is 1, with P_ON_M 0",
        "the integral stays within the output limits",
        (
            # Their sign is that of ControllerDirection.
            *_gains("Kp Ki Kd", of=abs),
            Setting("SampleTime", lambda law: f"{1000.0 * law.period:.10g}"),
            Setting("POn", lambda law: "P_ON_E" if law.gains.b > 0.5 else "P_ON_M"),
            Setting(
                "ControllerDirection", lambda law: "DIRECT" if law.gains.kc > 0.0 else "REVERSE"
            ),
        ),
        weights=(0.0, 1.0),
        head="#include <PID_v1.h>\n",
        line="const auto {name} = {value};",
        bounds=lambda low, high: (("OutputMin", low), ("OutputMax", high)),
        unset="0 to 255",
        tail="""
double Setpoint = 0.0, Input = 0.0, Output = StartOutput;
PID controller(&Input, &Output, &Setpoint, Kp, Ki, Kd, POn, ControllerDirection);

// at the end of setup(); then in loop(): read Input, controller.Compute(), write Output
void startController() {
  controller.SetOutputLimits(OutputMin, OutputMax);
  controller.SetSampleTime(SampleTime);
  controller.SetMode(AUTOMATIC);
}""",
        remark="//",
        sign="Its gains are never negative: ControllerDirection says the sign",
        start=Start(
            "Output is the present command before SetMode(AUTOMATIC).", "StartOutput", needs=True
        ),
        ending="ino",
    ),
    Law(
        "simple_pid",
        "simple-pid of m-lundberg, 2.0.1",
        f"{_ON_Y}; b is 1, with proportional_on_measurement 0",
        "the integral stays within output_limits",
        (
            *_gains("Kp Ki Kd"),
            Setting("sample_time", lambda law: law.period),
            Setting("proportional_on_measurement", lambda law: str(law.gains.b < 0.5)),
        ),
        weights=(0.0, 1.0),
        head="from simple_pid import PID\n\npid = PID(",
        line="    {name}={value},",
        # Without dt a call that comes a bit early is left out: a third of those of a timer.
        tail=(
            ")\n# pid.setpoint = ...; then, every sample_time, with dt so that none is left out:\n"
            "# command = pid(measurement, dt=pid.sample_time)"
        ),
        bounds=lambda low, high: (("output_limits", f"({_or_none(low)}, {_or_none(high)})"),),
        start=Start("starting_output is the present command.", "starting_output"),
        ending="py",
    ),
    Law(
        "esphome_pid",
        "the PID climate of ESPHome, 2024.11.0-dev",
        "I_k = I_{k-1} + i h e_k, then u_k = p e_k + I_k - d (y_k - y_{k-N})/(N h), "
        "N = derivative_averaging_samples; without deadband, output_averaging_samples 1",
        "the integral stays between min_integral and max_integral",
        (
            *_gains("kp ki kd"),
            Setting(
                "derivative_averaging_samples",
                lambda law: str(averaged_over(law.gains.tf, law.period)) if law.gains.td else None,
            ),
            Setting("output_averaging_samples", "1"),
        ),
        smoothing=_MEAN,
        command="level of the output, -1 (cool) to 1 (heat)",
        full=1.0,
        turned="A higher command cools: let it be the cool_output, the negative half of the "
        "output, so that gains are positive",
        head="climate:\n  - platform: pid\n    control_parameters:",
        line="      {name}: {value}",
        start=Start("starting_integral_term is the present command.", "starting_integral_term"),
    ),
    Law(
        "klipper_heater",
        "the pid heater of Klipper, v0.13.0-730-g84104bbb",
        "I_k = I_{k-1} + h e_k, then u_k = (Kp e_k + Ki I_k - Kd s_k)/255; s_k = (1 - a) s_{k-1} "
        "+ a (y_k - y_{k-1})/h, a = h/smooth_time, at most 1; u acts one report later",
        "the integral keeps its value while u is limited; small changes of u may be left out",
        (
            *_gains("pid_Kp pid_Ki pid_Kd", of=_of_255),
            Setting(
                "smooth_time", lambda law: max(law.gains.tf, law.period) if law.gains.td else None
            ),
        ),
        smoothing=_FIRST_ORDER,
        delay=1,
        command="power of the heater, 0 to 1; the gains are in parts of 255",
        full=1.0,
        only_positive=True,
        head="# of printer.cfg; likewise [heater_bed] or [heater_generic NAME]\n"
        "[extruder]\ncontrol: pid",
        bounds=lambda _low, high: (("max_power", _or_none(high)),),
        ending="cfg",
    ),
    Law(
        "marlin_heater",
        "PID_t of Marlin's temperature.h, commit 000b34772776",
        "I_k = I_{k-1} + e_k, then u_k = (Kp e_k + Ki h I_k - Kd s_k)/255; s_k = K1 s_{k-1} + "
        "(1 - K1) (y_k - y_{k-1})/h, K1 = PID_K1; within PID_FUNCTIONAL_RANGE",
        "the integral, Ki h I, stays between 0 and the largest output",
        (
            *_gains("DEFAULT_Kp DEFAULT_Ki DEFAULT_Kd", of=_of_255),
            Setting(
                "PID_K1",
                lambda law: (
                    1.0 - law.period / max(law.gains.tf, law.period) if law.gains.td else None
                ),
            ),
        ),
        smoothing=_FIRST_ORDER,
        command="power of the heater, 0 to 1; the output is 0 to 255",
        full=1.0,
        only_positive=True,
        line="#define {name} {value}",
        remark="//",
        ending="h",
    ),
    Law(
        "px4_rate",
        "RateControl of PX4, rate_control.cpp of commit 0155b3a86295, for small errors; its D "
        "acts on an acceleration that another module filters, and is left at 0",
        "u_k = p e_k + I_k, then I_{k+1} = I_k + i h e_k",
        "no integration further into the limit of the allocator; the integral within its limit",
        _gains("MC_ROLLRATE_P MC_ROLLRATE_I MC_ROLLRATE_D"),
        integral=Integral.AFTER,
        slope=Slope.NONE,
        command="normalised torque",
        full=1.0,
        line="param set {name} {value}",
        ending="txt",
    ),
    Law(
        "ardupilot_rate",
        "AC_PID::update_all of ArduPilot, commit 00e79c1a8aca, with FLTT, FLTE, SMAX and FF at 0",
        "s_k = s_{k-1} + a ((e_k - e_{k-1})/h - s_{k-1}), a = h/(h + 1/(2 pi FLTD)); "
        "I_k = I_{k-1} + i h e_k, then u_k = p e_k + I_k + d s_k",
        "the integral may only shrink while the limit flag is set; the integral within IMAX",
        (
            *_gains("ATC_RAT_RLL_P ATC_RAT_RLL_I ATC_RAT_RLL_D"),
            Setting(
                "ATC_RAT_RLL_FLTD",
                lambda law: (
                    1.0 / (2.0 * math.pi * (law.gains.tf - law.period))
                    if law.gains.tf > law.period
                    else 0.0
                ),
            ),
            Setting("ATC_RAT_RLL_FLTT", 0.0),
            Setting("ATC_RAT_RLL_FLTE", 0.0),
            Setting("ATC_RAT_RLL_FF", 0.0),
        ),
        slope=Slope.ERROR,
        smoothing=_FIRST_ORDER,
        command="normalised torque",
        full=1.0,
        line="{name},{value}",
        ending="param",
    ),
    Law(
        "iec_61131_3_pid",
        "the example PID of IEC 61131-3, final draft of the 2nd edition (2001)",
        "its error is y - r: X_k = X_{k-1} + h (y_k - r_k), then u_k = KP (E_k + X_k/TR + TD "
        "(3 (E_k - E_{k-3}) + E_{k-1} - E_{k-2})/(10 h)), E = y - r",
        "the integral winds up",
        (
            Setting("KP", lambda law: -law.gains.kc),
            *_gains("TR TD", "ti td"),
            Setting("CYCLE", lambda law: f"T#{1000.0 * law.period:.10g}ms"),
        ),
        slope=Slope.ERROR,
        smoothing=_FOUR_SAMPLES,
        form="ideal",
        needs_integral=True,
        line="{name} := {value};",
        remark="//",
        sign="This block forms ERROR = PV - SP, so KP is {sign} here",
        start=Start(
            "call it once with AUTO false and X0 the present command over KP, since its output "
            "is KP X0 then.",
            "X0",
            lambda law, command: -command / law.gains.kc,
        ),
        ending="st",
        scale=_SHARES,
    ),
    Law(
        "oscat_ft_pid",
        "FT_PID 2.1 of OSCAT BASIC 3.33, with the error as IN",
        "u_k = KP (e_k + I_k + TV (e_k - e_{k-1})/h), I_k = I_{k-1} + h (e_k + e_{k-1})/(2 TN)",
        "the integral stays between ILIM_L and ILIM_H",
        _gains("KP TN TV", "kc ti td"),
        integral=Integral.TRAPEZOID,
        slope=Slope.ERROR,
        form="ideal",
        line="{name} := {value};",
        remark="//",
        start=Start(
            "this block begins at 0, so add the present command to its output Y, and take it "
            "off the limits."
        ),
        ending="st",
        scale=_SHARES,
    ),
)

OWN_LAW = _ROWS[0].name
LAWS: dict[str, Law] = {law.name: law for law in _ROWS}
# The limit of controller_node's law for a sampling period of 0.
CONTINUOUS = LawRate(LAWS[OWN_LAW], 0.0)
