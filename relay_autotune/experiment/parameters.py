"""The parameters of a relay experiment: defaults, units, ranges and checks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from relay_autotune.errors import ParameterError


@dataclass(frozen=True)
class Parameter:
    """What one parameter means and which values it may take.

    :param name: its name, as a field of :class:`ExperimentParameters` and as a ROS parameter.
    :param default: its default; the type of the default is the type of the parameter.
    :param unit: its unit; "y" and "u" are those of measurement and command, "" is none.
    :param description: one sentence for people.
    :param lower: smallest value allowed.
    :param upper: largest value allowed.
    :param open_ended: True if ``lower`` and ``upper`` themselves are not allowed.
    :param nan_allowed: True if NaN stands for "not given".
    """

    name: str
    default: float | int
    unit: str
    description: str
    lower: float = -math.inf
    upper: float = math.inf
    open_ended: bool = False
    nan_allowed: bool = False

    @property
    def range_text(self) -> str:
        """The range in words, for messages and parameter descriptions."""
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.lower) and math.isinf(self.upper):
            text = "any number" if self.unit == "" else f"any number [{self.unit}]"
        elif math.isinf(self.upper):
            relation = "above" if self.open_ended else "at least"
            text = f"{relation} {self.lower:g}{unit}"
        else:
            relation = "between" if self.open_ended else "from"
            joint = "and" if self.open_ended else "to"
            text = f"{relation} {self.lower:g} {joint} {self.upper:g}{unit}"
        return f"{text}, or NaN where it is not given" if self.nan_allowed else text

    def problem(self, value: float) -> str | None:
        """Return a sentence on what is wrong with a value, or None if it is within range."""
        if math.isnan(value):
            inside = self.nan_allowed
        elif self.open_ended:
            inside = self.lower < value < self.upper
        else:
            inside = self.lower <= value <= self.upper
        if inside:
            return None
        return f"{self.name} is {value:g}, expected {self.range_text}"


PARAMETERS: tuple[Parameter, ...] = (
    Parameter(
        "amplitude",
        0.0,
        "u",
        "Half the distance of the two command levels; 0: found by itself between command_min and "
        "command_max, from small to large.",
        lower=0.0,
    ),
    Parameter(
        "target_amplitude",
        0.0,
        "y",
        "Half the swing of the measurement at which an amplitude that is found by itself is large "
        "enough; 0: when the oscillation stands clear of noise, hysteresis and resolution.",
        lower=0.0,
    ),
    Parameter(
        "bias",
        0.0,
        "u",
        "Offset of the middle of the two levels from the baseline; 0: bias_ratio decides.",
    ),
    Parameter(
        "bias_ratio",
        0.3,
        "",
        "Bias as a fraction of the amplitude, used where bias is 0; a biased relay also tells "
        "the static gain, 0 makes the relay symmetric.",
        lower=-1.0,
        upper=1.0,
        open_ended=True,
    ),
    Parameter(
        "hysteresis",
        0.0,
        "y",
        "Half width of the band about the set-point in which the relay does not switch; "
        "0: three times the measured noise standard deviation.",
        lower=0.0,
    ),
    Parameter(
        "setpoint",
        math.nan,
        "y",
        "Measurement about which the relay switches; NaN: the measured mean at the start.",
        nan_allowed=True,
    ),
    Parameter(
        "process_gain_sign",
        0,
        "",
        "1 if a higher command raises the measurement in the end, -1 if it lowers it; "
        "0: found by the kick.",
        lower=-1,
        upper=1,
    ),
    Parameter(
        "settle_time",
        0.0,
        "s",
        "Time at the baseline before the kick; 0: until the measurement is seen to be steady.",
        lower=0.0,
    ),
    Parameter(
        "min_cycles",
        3,
        "",
        "Number of successive cycles that must agree before the experiment ends.",
        lower=2,
        upper=1000,
    ),
    Parameter(
        "max_cycles",
        12,
        "",
        "Number of cycles after which the experiment ends, agreeing or not.",
        lower=2,
        upper=1000,
    ),
    Parameter(
        "cycle_tolerance",
        0.02,
        "",
        "Largest difference of half periods and of peaks between agreeing cycles, as a fraction "
        "of the half period and of the amplitude; widened by noise and by the sample interval.",
        lower=0.0,
        upper=1.0,
        open_ended=True,
    ),
    Parameter(
        "measurement_min",
        -math.inf,
        "y",
        "The experiment is aborted when the measurement falls below this.",
    ),
    Parameter(
        "measurement_max",
        math.inf,
        "y",
        "The experiment is aborted when the measurement rises above this.",
    ),
    Parameter(
        "max_deviation",
        0.0,
        "y",
        "The experiment is aborted when the measurement is further than this from the set-point, "
        "once that is known; 0: no limit.",
        lower=0.0,
    ),
    Parameter("command_min", -math.inf, "u", "Lowest command that may be sent."),
    Parameter("command_max", math.inf, "u", "Highest command that may be sent."),
    Parameter(
        "command_rate",
        0.0,
        "u/s",
        "Fastest change of the relay's command; the safe command at the end is a step all the "
        "same; 0: no limit.",
        lower=0.0,
    ),
    Parameter(
        "extra_delay",
        0.0,
        "s",
        "Dead time that the relay adds to its switches, for the second test of the method li.",
        lower=0.0,
    ),
    Parameter(
        "max_half_cycle",
        0.0,
        "s",
        "Longest stay of the relay at one level; 0: ten times the longest so far, and more for "
        "a biased relay.",
        lower=0.0,
    ),
    Parameter(
        "max_duration",
        0.0,
        "s",
        "Longest duration of the whole experiment; 0: each of its parts has a limit scaled to "
        "what was seen before.",
        lower=0.0,
    ),
    Parameter(
        "sample_period",
        0.0,
        "s",
        "Period of the samples where they carry no time of their own; 0: by their stamps.",
        lower=0.0,
    ),
)

# These may be infinite ("unlimited"); every other parameter must be a finite number.
_LIMITS = frozenset({"measurement_min", "measurement_max", "command_min", "command_max"})


@dataclass(frozen=True)
class ExperimentParameters:
    """What the user may set of a relay experiment; :data:`PARAMETERS` describes each field."""

    amplitude: float = 0.0
    target_amplitude: float = 0.0
    bias: float = 0.0
    bias_ratio: float = 0.3
    hysteresis: float = 0.0
    setpoint: float = math.nan
    process_gain_sign: int = 0
    settle_time: float = 0.0
    min_cycles: int = 3
    max_cycles: int = 12
    cycle_tolerance: float = 0.02
    measurement_min: float = -math.inf
    measurement_max: float = math.inf
    max_deviation: float = 0.0
    command_min: float = -math.inf
    command_max: float = math.inf
    command_rate: float = 0.0
    extra_delay: float = 0.0
    max_half_cycle: float = 0.0
    max_duration: float = 0.0
    sample_period: float = 0.0

    @property
    def relay_bias(self) -> float:
        """The offset mu0 of the middle of the levels from the baseline [u]."""
        return self.bias if self.bias != 0.0 else self.bias_ratio * self.amplitude

    @property
    def finds_amplitude(self) -> bool:
        """True if the amplitude is not given, and the experiment finds it by itself."""
        return self.amplitude == 0.0

    def validate(self, baseline: float | None = None) -> None:
        """Refuse values out of range and values that contradict each other.

        :param baseline: command of the operating point [u]; None: not known yet, and the
            command limits are not compared with the levels of the relay.
        :raises ParameterError: with a sentence that names the parameter, the value found and the
            values expected.
        """
        self._validate_each()
        self._validate_together()
        if baseline is not None:
            self._validate_levels(baseline)

    def _validate_each(self) -> None:
        for parameter in PARAMETERS:
            value = getattr(self, parameter.name)
            problem = parameter.problem(value)
            if problem is None and math.isinf(value) and parameter.name not in _LIMITS:
                problem = f"{parameter.name} is {value:g}, expected a finite number"
            if problem is None and isinstance(parameter.default, int) and value != int(value):
                problem = f"{parameter.name} is {value:g}, expected a whole number"
            if problem is not None:
                raise ParameterError(problem)

    def _validate_together(self) -> None:
        if self.finds_amplitude:
            if not (math.isfinite(self.command_min) and math.isfinite(self.command_max)):
                raise ParameterError(
                    f"amplitude is 0, to be found between command_min and command_max, which are "
                    f"{self.command_min:g} and {self.command_max:g}: give both limits, or give "
                    f"the amplitude, half the step that the process may see"
                )
        elif abs(self.relay_bias) >= self.amplitude:
            raise ParameterError(
                f"bias is {self.bias:g}, expected less than the amplitude {self.amplitude:g} in "
                f"magnitude: otherwise both levels lie on one side of the baseline and the "
                f"measurement never comes back"
            )
        if self.max_cycles < self.min_cycles:
            raise ParameterError(
                f"max_cycles is {self.max_cycles}, expected at least min_cycles, "
                f"which is {self.min_cycles}"
            )
        for quantity in ("measurement", "command"):
            low, high = getattr(self, f"{quantity}_min"), getattr(self, f"{quantity}_max")
            if low >= high:
                raise ParameterError(
                    f"{quantity}_min is {low:g}, expected less than {quantity}_max, "
                    f"which is {high:g}"
                )
        if not math.isnan(self.setpoint) and not (
            self.measurement_min < self.setpoint < self.measurement_max
        ):
            raise ParameterError(
                f"setpoint is {self.setpoint:g}, expected between measurement_min "
                f"{self.measurement_min:g} and measurement_max {self.measurement_max:g}"
            )
        if 0.0 < self.max_duration <= self.settle_time:
            raise ParameterError(
                f"max_duration is {self.max_duration:g} s, expected more than settle_time, "
                f"which is {self.settle_time:g} s"
            )

    def _validate_levels(self, baseline: float) -> None:
        if not math.isfinite(baseline):
            raise ParameterError(f"the baseline is {baseline:g}, expected a finite command")
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
