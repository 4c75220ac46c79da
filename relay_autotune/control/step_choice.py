# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which step of the set-point proves gains: high enough for the noise, within the limits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from relay_autotune.control.controller import PredictedLoop, Step
from relay_autotune.control.verification import (
    NOISE_ALLOWANCE,
    Plan,
    least_text,
    plan,
    rounded,
)
from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Gains
from relay_autotune.loop.law import LawRate
from relay_autotune.loop.laws import LAWS, OWN_LAW
from relay_autotune.loop.sampled import Limits
from relay_autotune.record.record import Record

# The step that proves most: multiples of the tune's swing and of the noise, whichever is larger;
# and the multiple at which the noise does not decide the overshoot, if it takes but a part of the
# way to a limit.
_OF_SWING = 0.5
_OF_NOISE = 20.0
_CLEAR_OF_NOISE, _OF_WIDE_ROOM = 40.0, 1.0 / 3.0
# Part of the way to a limit that a step may go, for its overshoot.
_OF_ROOM = 0.8


@dataclass(frozen=True)
class StepRange:
    """The steps of a set-point that the limits allow.

    :param low: lowest step [y].
    :param high: highest one [y].
    :param least: smallest magnitude with which the noise does not decide [y].
    """

    low: float = -math.inf
    high: float = math.inf
    least: float = 0.0

    @property
    def words(self) -> str:
        """Which steps are allowed, and why."""
        said = "other than 0"
        if math.isfinite(self.high - self.low):
            said = (
                f"from {self.low:g} to {self.high:g} y: the limits allow no more, with the "
                f"overshoot that the model predicts"
            )
        return said + (f"; {least_text(self.least, 'y')}" if self.least > 0.0 else "")

    def allows(self, step: float) -> bool:
        """Return whether a step is within the range, and not 0.

        :param step: y.
        """
        return step != 0.0 and self.low <= step <= self.high and abs(step) >= self.least

    def nearest(self, step: float) -> float:
        """Return the step that the limits allow and that is nearest to one [y].

        :param step: y.
        """
        visible = math.copysign(max(abs(step), self.least), step)
        return min(max(visible, self.low), self.high)

    def require(self, step: float) -> None:
        """Refuse a step.

        :param step: y.
        :raises TuningError: if it is outside.
        """
        if not self.allows(step):
            raise TuningError(f"the step of the set-point is {step:g} y, expected {self.words}")


@dataclass(frozen=True)
class StepChoice:
    """What decides the step of the set-point that is to prove gains after a tune.

    :param record: of the tune, with its settings; the loop rests about its set-point and mean
        command.
    :param loop: the gains, what runs them, and the process.
    :param measurement: its range [y].
    :param command: its range [u].
    :param noise_std: of :func:`noise_of` [y].
    """

    record: Record
    loop: PredictedLoop
    measurement: Limits
    command: Limits
    noise_std: float

    @property
    def _noise(self) -> float:
        return 0.0 if math.isnan(self.noise_std) else self.noise_std

    @property
    def best(self) -> float:
        """The step that proves gains best [y], in two digits; 0: not known.

        It is half of the swing that the tune made, at least twenty times the noise, upward if the
        limits allow; the process then rests at most at 0.8 of the way to a limit. It is forty
        times the noise if that is a third of the way at most.
        """
        record = self.record
        if record.settings is None or len(record.cycle_start) < 2:
            return 0.0
        first, stop = record.cycle_start[-2:]
        swing = 0.5 * float(np.ptp(record.measurement[first : stop + 1]))
        wanted = max(_OF_SWING * swing, _OF_NOISE * self._noise)
        down, up = self._ways
        sign = 1.0 if _OF_ROOM * up >= wanted or up >= down else -1.0
        room = max(up if sign > 0.0 else down, 0.0)
        clear = min(_CLEAR_OF_NOISE * self._noise, _OF_WIDE_ROOM * room)
        height = max(min(wanted, _OF_ROOM * room), clear)
        return sign * float(f"{height:.2g}")

    @cached_property
    def _plan(self) -> Plan:
        """The plan of a step by 1; without limits a step of any height is in proportion.

        :raises TuningError: as :func:`plan`.
        """
        return plan(self.loop, Step(setpoint=1.0), self.record.mean_interval)

    @property
    def lasts(self) -> float:
        """How long a step is observed [s]."""
        return self._plan.duration

    @property
    def settles(self) -> float:
        """How long the loop takes to settle with gains of a design [s].

        NaN in the design: as long as a step is observed; 0: the gains are in force already.
        """
        if not isinstance(gains := self.loop.control.gains, Gains):
            return 0.0
        return gains.settling_time if math.isfinite(gains.settling_time) else self.lasts

    @cached_property
    def allowed(self) -> StepRange:
        """The steps that limits allow and noise does not hide, in two digits.

        The predicted peak, with an allowance for the noise, stays within the limits of the
        measurement, and the command can hold the new set-point.

        :raises TuningError: as :func:`plan`.
        """
        assert self.record.settings is not None
        setpoint, spared = self.record.settings.setpoint, NOISE_ALLOWANCE * self._noise
        low, high = setpoint - self.measurement.low, self.measurement.high - setpoint
        down, up = self._ways
        return StepRange(
            0.0 - rounded(min(down, (low - spared) / self._plan.peak), math.floor),
            rounded(min(up, (high - spared) / self._plan.peak), math.floor),
            rounded(self._plan.visible * self._noise),
        )

    def expected(self, step: float) -> str:
        """Return the predicted range of the command with a step and the noise, for people.

        :param step: of the set-point [y].
        :raises TuningError: as :func:`plan`.
        """
        assert self.record.settings is not None
        low, high = sorted(step * end for end in self._plan.command)
        noise = NOISE_ALLOWANCE * self._noise * self._noise_gain
        rest, clip = self.record.settings.baseline, self.command.clip
        return f"from {clip(rest + low - noise):.3g} to {clip(rest + high + noise):.3g} u"

    @property
    def _noise_gain(self) -> float:
        """Standard deviation of the command over that of the noise [u/y]."""
        control = self.loop.control
        rate = control.rate or LawRate(LAWS[OWN_LAW], self.record.mean_interval)
        return Loop(rate.of(control.gains), self.loop.model).noise_gain()

    @property
    def _ways(self) -> tuple[float, float]:
        """How far below and above its set-point the loop can rest [y]."""
        record, model = self.record, self.loop.model
        assert record.settings is not None
        setpoint = record.settings.setpoint
        down, up = setpoint - self.measurement.low, self.measurement.high - setpoint
        if model.integrators == 0:
            baseline = record.settings.baseline
            if len(record.cycle_start) > 1:
                first, stop = record.cycle_start[-2:]
                baseline = float(np.mean(record.command[first:stop]))
            ends = sorted(
                model.gain * (end - baseline) for end in (self.command.low, self.command.high)
            )
            down, up = min(down, -ends[0]), min(up, ends[1])
        return down, up
