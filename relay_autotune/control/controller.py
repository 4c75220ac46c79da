# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""A PI or PID controller as it runs on a loop: sample by sample, in manual or automatic.

The law is that of :class:`~relay_autotune.loop.gains.Controller`, sample by sample as in
:class:`~relay_autotune.loop.sampled.PidLaw`,

    u = kc (b r - yf + (1/ti) int (r - yf) dt - td dyf/dt),   yf = y/(1 + tf s + (tf s)^2/2),

with the integral advanced by the backward rule and limited by back-calculation (Astrom and
Hagglund 1995, section 3.5). At any change (gains, limits, manual to automatic) the integral takes
up the difference, so that the command has no bump.

Numbers are bounded: gains by :class:`GainBounds`, measurement, set-point and command by
`LARGEST_VALUE`, so that no product of them overflows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate, RunningLaw, SampledLaw
from relay_autotune.loop.sampled import (
    UNLIMITED,
    ClosedLoop,
    Limits,
    PidLaw,
    filter_matrices,
    require_period,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Plant

# A measurement, set-point or command of a larger magnitude is an error of its sender [y, u].
LARGEST_VALUE = 1e12
# No controller needs a larger gain [u/y] or a longer time [s].
LARGEST_GAIN = 1e12
LONGEST_TIME = 1e9

# A sample interval that differs by at most this part from the nominal one uses its filter.
_JITTER = 0.2
# An interval longer than this many nominal ones is a gap; the integral does not run through it.
_LONGEST_INTERVAL = 5.0
# A sample that comes this part of a law's period before its next run is taken for that run.
_EARLY = 0.25


@dataclass(frozen=True)
class GainBounds:
    """Bounds for new gains.

    :param kc_max: largest magnitude of the proportional gain [u/y].
    :param ti_min: shortest integral time [s]; no integral action (0) is always allowed.
    :param rate: the law that runs them; None: our own.
    """

    kc_max: float = LARGEST_GAIN
    ti_min: float = 0.0
    rate: LawRate | None = None

    def require(self, gains: Controller) -> None:
        """Refuse gains that are outside.

        :param gains: the controller.
        :raises TuningError: if a gain is outside its bounds, or the law cannot run them.
        """
        largest = min(self.kc_max, LARGEST_GAIN)
        longest = max(gains.ti, gains.td, gains.tf)
        if abs(gains.kc) > largest:
            problem = f"kc is {gains.kc:g}, expected at most {largest:g} either way"
        elif 0.0 < gains.ti < self.ti_min:
            problem = f"ti is {gains.ti:g} s, expected at least {self.ti_min:g} s"
        elif longest > LONGEST_TIME:
            problem = f"a time is {longest:g} s, expected at most {LONGEST_TIME:g} s"
        elif not 0.0 <= gains.b <= 1.0:
            problem = f"b is {gains.b:g}, expected 0 to 1"
        else:
            if self.rate is not None:
                self.rate.of(gains)
            return
        raise TuningError(f"gains out of bounds: {problem}")


def is_usable(value: float) -> bool:
    """Return True if a measurement, set-point or command is a possible value [y, u].

    :param value: the number.
    """
    # NaN compares as false.
    return abs(value) <= LARGEST_VALUE


class PidController:
    """Answer each measurement with a command.

    :param gains: the controller; None: it only holds its command.
    :param command: first command [u].
    :param limits: range of the command.
    :param automatic: False: it starts in manual.
    :param usual_interval: nominal interval of the samples [s]; 0: the first interval.
    """

    def __init__(
        self,
        gains: Controller | None,
        command: float,
        *,
        limits: Limits = UNLIMITED,
        automatic: bool = True,
        usual_interval: float = 0.0,
    ) -> None:
        self.gains = gains
        """The gains in force; changed by `use`."""
        self._limits = limits
        self.is_manual = not automatic
        """True if it was switched to manual."""
        self.command = limits.clip(command)
        """The last command [u]."""
        self._law: PidLaw | None = None
        self._time = math.nan
        self._nominal = math.nan
        self._usual = usual_interval
        self._motion = filter_matrices(0.0, 1.0)
        self._align = True

    @property
    def is_automatic(self) -> bool:
        """True if it controls, False if it holds its command."""
        return not self.is_manual and self.gains is not None

    def use(self, gains: Controller | None) -> None:
        """Change the gains without a bump.

        :param gains: the gains; None: hold the command.
        """
        self.gains = gains
        self._nominal = math.nan
        self._align = True

    def limit(self, limits: Limits) -> None:
        """Change the limits.

        :param limits: range of the command.
        """
        self._limits = limits
        self.command = limits.clip(self.command)

    def switch(self, *, automatic: bool) -> None:
        """Go to automatic, from the present command on, or to manual."""
        self.is_manual = not automatic
        self._align = True

    def track(self, command: float) -> None:
        """Track the command of another controller, to continue from there [u].

        :param command: ignored if it is not finite, or beyond `LARGEST_VALUE`.
        """
        if is_usable(command):
            self.command = self._limits.clip(command)
            self._align = True

    def step(self, time: float, setpoint: float, measurement: float) -> float:
        """Take a sample and return the command [u].

        :param time: of the sample [s], not decreasing.
        :param setpoint: [y].
        :param measurement: [y]; ignored, like a set-point, if it is not finite, or beyond
            `LARGEST_VALUE`.
        """
        if not (is_usable(measurement) and is_usable(setpoint)):
            return self.command
        interval = 0.0 if math.isnan(self._time) else max(time - self._time, 0.0)
        self._time = time
        gains = self.gains
        if gains is None:
            return self.command
        command = self._answer(gains, interval, setpoint, measurement)
        if is_usable(command):
            self.command = command
        else:
            # The law's memory is no longer valid, so start again from this command.
            self._law, self._align = None, True
        return self.command

    def _answer(
        self, gains: Controller, interval: float, setpoint: float, measurement: float
    ) -> float:
        law = self._heard(gains, interval, measurement)
        if self._align or self.is_manual:
            # Set the integral so that the command continues from its present value.
            law.integral = self.command - law.proportional(gains, setpoint)
            self._align = False
            return self.command
        if not math.isnan(self._nominal):
            interval = min(interval, _LONGEST_INTERVAL * max(self._nominal, self._usual))
        return law.command(gains, setpoint, interval, self._limits)

    def _heard(self, gains: Controller, interval: float, measurement: float) -> PidLaw:
        """Pass a measurement to the filter, over an interval that may vary."""
        law = self._law
        if law is None:
            self._law = law = PidLaw(measurement, self.command)
        elif interval > 0.0:
            near = abs(interval - self._nominal) <= _JITTER * self._nominal
            motion = self._motion
            if not near:
                motion = filter_matrices(gains.tf, interval)
                if math.isnan(self._nominal):
                    self._nominal, self._motion = interval, motion
            law.hear(motion, measurement)
        else:
            law.replace_last(measurement)
        return law


class LawController(PidController):
    """Answer with the law of another program, at the samples that are next to its runs.

    Between its runs the command is held.

    :param rate: the law, and how often it runs.
    :param others: as of `PidController`.
    """

    def __init__(self, rate: LawRate, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._rate = rate
        self._running: RunningLaw
        self._wait = 0.0

    def _answer(
        self, gains: Controller, interval: float, setpoint: float, measurement: float
    ) -> float:
        period = self._rate.period
        if self._align or self.is_manual:
            self._running = self._rate.of(gains).running()
            self._running.take_over(setpoint, measurement, self.command)
            self._align, self._wait = False, period
            return self.command
        self._wait -= interval
        if self._wait > _EARLY * period:
            return self.command
        # A sensor that is slower than the law leaves runs out; they are not made up for.
        self._wait = max(self._wait, -0.5 * period) + period
        return self._running.step(setpoint, measurement, self._limits)


def running(rate: LawRate | None, *args: Any, **others: Any) -> PidController:
    """Return the controller that runs a law.

    :param rate: the law, and how often it runs; None: our own, at each sample.
    :param others: as of `PidController`.
    """
    if rate is None:
        return PidController(*args, **others)
    return LawController(rate, *args, **others)


@dataclass(frozen=True)
class Control:
    """Gains, and what runs them.

    :param gains: the controller.
    :param rate: the law that runs them, and how often; None: our own, at each sample.
    :param elsewhere: True: another program runs the law, by its own clock; False: the node that
        takes the samples runs it, at those next to its runs.
    """

    gains: Controller
    rate: LawRate | None = None
    elsewhere: bool = False

    @property
    def law(self) -> Controller | SampledLaw:
        """The law with the gains.

        :raises TuningError: if it cannot run them.
        """
        return self.gains if self.rate is None else self.rate.of(self.gains)


@dataclass(frozen=True)
class Step:
    """A step of a closed loop.

    :param setpoint: height of the set-point's step, at the first sample [y]; 0: none.
    :param load: height of the step added to the command [u]; 0: none.
    :param load_time: when that enters, after the first sample [s].
    """

    setpoint: float = 0.0
    load: float = 0.0
    load_time: float = 0.0


@dataclass(frozen=True)
class PredictedLoop:
    """A controller on a process as it was identified.

    :param control: the controller.
    :param model: the process.
    """

    control: Control
    model: TransferFunction

    def with_gain(self, factor: float) -> PredictedLoop:
        """Return the loop with a process of another gain.

        :param factor: on the gain of the process.
        """
        return replace(self, model=replace(self.model, gain=factor * self.model.gain))

    def run(
        self,
        time: FloatArray,
        step: Step,
        *,
        limits: Limits = UNLIMITED,
        noise: FloatArray | None = None,
    ) -> ClosedLoop:
        """Simulate the loop, exact between samples, from rest, after steps of set-point and load.

        :param time: instants of the samples [s], increasing, the first at the step, shape (n,).
        :param step: what moves it.
        :param limits: range of the command, as deviations [u].
        :param noise: on the measurement at each run of the controller [y], shape (n,); None: none.
        """
        plant, samples = Plant(self.model), time - time[0]
        control = self.control
        controller = running(control.rate, control.gains, 0.0, limits=limits)
        interval = float(np.median(np.diff(time))) if time.size > 1 else 1.0
        runs, until = samples, np.arange(1, time.size + 1)
        if control.elsewhere and control.rate is not None:
            # Its runs go on where a sample is lost, and between the samples of a slow sensor.
            interval = control.rate.period
            runs = interval * np.arange(int(samples[-1] / interval) + 1)
            until = np.searchsorted(runs, samples, side="right")
        seen = np.zeros(runs.size) if noise is None else noise
        controller.step(-interval, 0.0, 0.0)
        measurement, command = np.empty(time.size), np.empty(time.size)
        done, applied, y = 0, 0.0, 0.0
        for k, t in enumerate(samples):
            for n in range(done, until[k]):
                run = float(runs[n])
                y = plant.advance(run, applied)
                applied = controller.step(run, step.setpoint, float(y + seen[n]))
                applied += step.load if run + interval > step.load_time else 0.0
            done = until[k]
            if runs[done - 1] != t:
                y = plant.advance(float(t), applied)
            measurement[k], command[k] = y, controller.command
        return ClosedLoop(time, measurement, command)


def simulate_closed_loop(
    controller: Controller | SampledLaw,
    model: TransferFunction,
    *,
    period: float,
    duration: float,
    setpoint: float = 0.0,
    load: float = 0.0,
    load_time: float = 0.0,
    low: float = -math.inf,
    high: float = math.inf,
    noise: FloatArray | None = None,
) -> ClosedLoop:
    """Run a controller at its sampling period; the process is exact between samples.

    >>> from relay_autotune import Controller, TransferFunction, simulate_closed_loop
    >>> oven = TransferFunction.fopdt(1.65, 20.0, 10.0)
    >>> run = simulate_closed_loop(
    ...     Controller(kc=0.6, ti=20.0), oven, period=0.5, duration=300.0, setpoint=1.0)
    >>> print(f"{run.measurement[-1]:.3f} y, {run.command[-1]:.3f} u")
    1.000 y, 0.606 u

    :param controller: PI or PID gains, which our own law runs, or another law with its gains.
    :param model: the process, at rest, without the half period that a design adds to it.
    :param period: sampling period [s].
    :param duration: s.
    :param setpoint: step of the set-point at t = 0 [y].
    :param load: step of the load at the process input [u].
    :param load_time: instant of that step [s].
    :param low: least command [u].
    :param high: largest command [u].
    :param noise: noise on each sample of the controller [y], shape (n,); None: no noise.
    :raises TuningError: if the period is not positive or the limits leave no range.
    """
    require_period(period)
    control = (
        Control(controller)
        if isinstance(controller, Controller)
        else Control(controller.gains, LawRate(controller.law, period))
    )
    time = np.arange(int(duration / period) + 1, dtype=np.float64) * period
    step = Step(setpoint, load, load_time)
    return PredictedLoop(control, model).run(time, step, limits=Limits(low, high), noise=noise)
