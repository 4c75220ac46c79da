# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of a relay experiment: defaults, units, ranges and checks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from relay_autotune.errors import ParameterError
from relay_autotune.quantities import check, declared, quantity
from relay_autotune.reasons import Code, Reason

# An amplitude that is not given starts at this part of the command's range.
FIRST_SHARE = 0.01


@dataclass(frozen=True)
class ExperimentParameters:
    """What the user may set of a relay experiment.

    >>> from relay_autotune import ExperimentParameters
    >>> ExperimentParameters(amplitude=1.0, measurement_min=30.0, measurement_max=50.0).bias_ratio
    0.3
    """

    amplitude: float = quantity(0.0, "u", lower=0.0).means(
        "Half the distance of the two command levels; 0: the tune finds it between command_min "
        "and command_max, from small to large."
    )
    target_amplitude: float = quantity(0.0, "y", lower=0.0).means(
        "For amplitude 0: half the swing of the measurement that is large enough; 0: twenty times "
        "noise or resolution, within a third of the way to a limit of the measurement."
    )
    bias: float = quantity(0.0, "u").means(
        "Offset of the middle of the two levels from the baseline; 0: bias_ratio decides."
    )
    bias_ratio: float = quantity(0.3, lower=-1.0, upper=1.0, open_ended=True).means(
        "Bias as a fraction of the amplitude, used if bias is 0; a biased relay also determines "
        "the static gain, 0 makes the relay symmetric."
    )
    hysteresis: float = quantity(0.0, "y", lower=0.0).means(
        "Half width of the band about the set-point in which the relay does not switch; "
        "0: three times the measured noise standard deviation."
    )
    setpoint: float = quantity(math.nan, "y").means(
        "Measurement about which the relay switches; NaN: the measured mean at the start."
    )
    process_gain_sign: int = quantity(0, lower=-1, upper=1).means(
        "1 if a higher command raises the measurement in the end, -1 if it lowers it; "
        "0: found by the kick."
    )
    settle_time: float = quantity(0.0, "s", lower=0.0).means(
        "Time at the baseline before the kick; 0: until the measurement is steady."
    )
    min_cycles: int = quantity(3, lower=2, upper=1000).means(
        "Number of successive cycles that must agree before the experiment ends."
    )
    max_cycles: int = quantity(12, lower=2, upper=1000).means(
        "Number of cycles after which the experiment ends, whether they agree or not."
    )
    cycle_tolerance: float = quantity(0.02, lower=0.0, upper=1.0, open_ended=True).means(
        "Largest difference of half periods and of peaks between agreeing cycles, as a fraction "
        "of the half period and of the amplitude; widened by noise and by the sample interval."
    )
    measurement_min: float = quantity(-math.inf, "y").means(
        "The experiment is aborted when the measurement falls below this."
    )
    measurement_max: float = quantity(math.inf, "y").means(
        "The experiment is aborted when the measurement rises above this."
    )
    max_deviation: float = quantity(0.0, "y", lower=0.0).means(
        "The experiment is aborted when the measurement is further than this from the set-point, "
        "once that is known; 0: no limit."
    )
    command_min: float = quantity(-math.inf, "u").means("Lowest command that may be sent.")
    command_max: float = quantity(math.inf, "u").means("Highest command that may be sent.")
    command_rate: float = quantity(0.0, "u/s", lower=0.0).means(
        "Fastest change of the relay's command; the safe command at the end is still a step; 0: "
        "no limit."
    )
    extra_delay: float = quantity(0.0, "s", lower=0.0).means(
        "Dead time that the relay adds to its switches, for the second test of the method li."
    )
    max_half_cycle: float = quantity(0.0, "s", lower=0.0).means(
        "Longest stay of the relay at one level; 0: ten times the longest so far, and more for "
        "a biased relay."
    )
    max_duration: float = quantity(0.0, "s", lower=0.0).means(
        "Longest duration of the whole experiment; 0: each of its parts has a limit scaled to "
        "what was seen before."
    )
    sample_period: float = quantity(0.0, "s", lower=0.0).means(
        "Period of the samples, if they have no time of their own; 0: the time is their stamp."
    )

    @property
    def relay_bias(self) -> float:
        """The offset mu0 of the middle of the levels from the baseline [u]."""
        return self.bias_at(self.amplitude)

    def bias_at(self, amplitude: float) -> float:
        """Return that offset at an amplitude [u].

        :param amplitude: of the relay [u].
        """
        return self.bias or self.bias_ratio * amplitude

    @property
    def finds_amplitude(self) -> bool:
        """True if the amplitude is not given, and the experiment finds it by itself."""
        return self.amplitude == 0.0

    def band(self, noise_std: float) -> float:
        """Return half the width of the relay's band [y].

        :param noise_std: standard deviation of the noise [y].
        """
        return self.hysteresis if self.hysteresis > 0.0 else 3.0 * noise_std

    def room(self, setpoint: float) -> float:
        """Return the distance of the set-point to the nearest limit of the measurement [y].

        :param setpoint: about which the relay switches [y].
        """
        room = min(setpoint - self.measurement_min, self.measurement_max - setpoint)
        return min(room, self.max_deviation) if self.max_deviation > 0.0 else room

    @property
    def first_amplitude(self) -> float:
        """The amplitude with which the relay begins where it finds its own [u]."""
        first = FIRST_SHARE * (self.command_max - self.command_min)
        return first if abs(self.bias) < first else 1.5 * abs(self.bias)

    def why_one_way(self, baseline: float) -> Reason | None:
        """Return why a baseline leaves the relay one way only; None: it can go both.

        No relay oscillates about an end of the actuator: with one level the process already is
        where it goes with the other.

        :param baseline: command of the operating point [u].
        """
        first = self.first_amplitude if self.finds_amplitude else 0.0
        bias = self.bias_at(first)
        for name, limit, room, step in (
            ("command_min", self.command_min, baseline - self.command_min, first - bias),
            ("command_max", self.command_max, self.command_max - baseline, first + bias),
        ):
            if room == 0.0 or (self.finds_amplitude and 0.0 < room < step):
                where = "too near to" if room else "at"
                return Code.ONE_WAY(baseline=baseline, where=where, limit=name, value=limit)
        return None

    def validate(self, baseline: float | None = None) -> None:
        """Refuse values out of range and values that contradict each other.

        :param baseline: command of the operating point [u]; None: not known yet, and the
            command limits are not compared with the levels of the relay.
        :raises ParameterError: with a sentence that names the parameter, the value found and the
            values expected.
        """
        check(self, ParameterError)
        self.validate_but_amplitude()
        if self.finds_amplitude:
            limits = ("command_min", "command_max")
            lacking = [name for name in limits if not math.isfinite(getattr(self, name))]
            if lacking:
                raise ParameterError(
                    "amplitude is 0, to be found within the limits of the command; "
                    f"{' and '.join(lacking)} not given: give both limits, or the amplitude, half "
                    "the step that the process may see"
                )
        elif abs(self.relay_bias) >= self.amplitude:
            raise ParameterError(
                f"bias is {self.bias:g}, expected less than the amplitude {self.amplitude:g} in "
                f"magnitude: otherwise both levels lie on one side of the baseline and the "
                f"measurement never comes back"
            )
        if baseline is not None:
            self._validate_levels(baseline)

    def validate_but_amplitude(self) -> None:
        """Refuse values that contradict each other, whatever amplitude a start request gives.

        :raises ParameterError: with a sentence that names both and their values.
        """
        if self.max_cycles < self.min_cycles:
            raise ParameterError(
                f"max_cycles is {self.max_cycles}, expected at least min_cycles, "
                f"which is {self.min_cycles}"
            )
        if 0.0 < self.max_duration <= self.settle_time:
            raise ParameterError(
                f"max_duration is {self.max_duration:g} s, expected more than settle_time, "
                f"which is {self.settle_time:g} s"
            )
        for signal in ("measurement", "command"):
            low, high = getattr(self, f"{signal}_min"), getattr(self, f"{signal}_max")
            if low >= high:
                raise ParameterError(
                    f"{signal}_min is {low:g}, expected less than {signal}_max, which is {high:g}"
                )
        if not math.isnan(self.setpoint) and not (
            self.measurement_min < self.setpoint < self.measurement_max
        ):
            raise ParameterError(
                f"setpoint is {self.setpoint:g}, expected between measurement_min "
                f"{self.measurement_min:g} and measurement_max {self.measurement_max:g}"
            )

    def _validate_levels(self, baseline: float) -> None:
        if not math.isfinite(baseline):
            raise ParameterError(f"the baseline is {baseline:g}, expected a finite command")
        if why := self.why_one_way(baseline):
            raise ParameterError(why)
        if self.finds_amplitude:
            if not self.command_min <= baseline <= self.command_max:
                raise ParameterError(
                    f"the baseline is {baseline:g}, expected from command_min "
                    f"{self.command_min:g} to command_max {self.command_max:g}"
                )
            return
        levels = {
            "baseline": baseline,
            "low level": baseline + self.relay_bias - self.amplitude,
            "high level": baseline + self.relay_bias + self.amplitude,
        }
        for name, level in levels.items():
            if not self.command_min <= level <= self.command_max:
                raise ParameterError(
                    f"the {name} of the relay is {level:g} (baseline {baseline:g}, bias "
                    f"{self.relay_bias:g}, amplitude {self.amplitude:g}), expected from "
                    f"command_min {self.command_min:g} to command_max {self.command_max:g}: "
                    f"choose a smaller amplitude or another baseline"
                )
        if not levels["low level"] < levels["high level"]:
            raise ParameterError(
                f"amplitude is {self.amplitude:g}, expected enough to tell the two levels apart "
                f"at a baseline of {baseline:g}"
            )


PARAMETERS = declared(ExperimentParameters)
