# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The command after the end of an experiment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from relay_autotune.record.record import Cycle, RelaySettings

# Half the ultimate gain: the quarter-decay margin of Ziegler and Nichols for proportional control.
HOLD_SHARE = 0.5


@dataclass(frozen=True)
class SafePolicy:
    """How the process is left when an experiment ends.

    :param command: command after an abort or a failure [u]; NaN: the baseline.
    :param hold: True for a process that drifts or runs away at a constant command (integrating or
        unstable): proportional control holds it as soon as its ultimate gain is roughly known, or
        from the kick on if ``gain`` is given.
    :param gain: gain of that proportional control [u/y]; 0: half of the ultimate gain.
    :param give_back: True if another controller takes over at once at any end; the experiment's
        ``safe_command`` then follows that controller's command.
    """

    command: float = math.nan
    hold: bool = False
    gain: float = 0.0
    give_back: bool = False


@dataclass(frozen=True)
class ProportionalHold:
    r"""Proportional control about the set-point, ``u = u0 + k (r - y)``, within limits.

    k is half of the describing function's ultimate gain ``4 mu/(pi a)``, where a is half the
    swing of the measurement, with the sign of the process; u0 is the mean command of the last
    cycle, which balanced the process.

    :param centre: u0 [u].
    :param gain: k [u/y].
    :param setpoint: r [y].
    :param low: lowest command [u].
    :param high: highest command [u].
    """

    centre: float
    gain: float
    setpoint: float
    low: float
    high: float

    @classmethod
    def after(
        cls, settings: RelaySettings | None, cycles: Sequence[Cycle], gain: float = 0.0
    ) -> ProportionalHold | None:
        """Return the hold for an experiment, None if no gain is known.

        :param settings: the relay's settings; its levels are the limits.
        :param cycles: the cycles so far.
        :param gain: a gain that the user gave [u/y]; 0: none.
        """
        if settings is None:
            return None
        centre = settings.baseline
        if cycles:
            last = cycles[-1]
            centre = last.mean_command
            half_swing = 0.5 * (last.peak_max - last.peak_min)
            if gain == 0.0 and half_swing > 0.0:
                gain = HOLD_SHARE * 4.0 * settings.amplitude / (math.pi * half_swing)
                gain = -gain if settings.reverse_acting else gain
        if gain == 0.0:
            return None
        return cls(
            centre=centre,
            gain=gain,
            setpoint=settings.setpoint,
            low=settings.low,
            high=settings.high,
        )

    def command(self, measurement: float) -> float:
        """Return the command [u] for a measurement [y]; the centre if it is not finite."""
        if not math.isfinite(measurement):
            return self.centre
        wanted = self.centre + self.gain * (self.setpoint - measurement)
        return min(max(wanted, self.low), self.high)
