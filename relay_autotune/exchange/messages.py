"""Between the core's dataclasses and the messages of `relay_autotune_msgs`.

Nothing here imports ROS: every function takes any object with the fields of the message, an
rclpy message or one decoded from a bag, so a live node and a replay read a record alike.
"""

from __future__ import annotations

import array
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from relay_autotune.errors import ModelError, RecordError, RelayAutotuneError, TuningError
from relay_autotune.escape import visible
from relay_autotune.experiment.early_end import Finding
from relay_autotune.record.record import LARGEST, Cycle, FloatArray, Outcome, Record, RelaySettings
from relay_autotune.verdict import NOT_JUDGED, Judgement

if TYPE_CHECKING:
    from relay_autotune.identification import Identification
    from relay_autotune.process.transfer_function import TransferFunction
    from relay_autotune.tuning import Gains

NANOSECONDS = 1_000_000_000
_PREDICTED = ("ms", "ms_low", "ms_high")
# The numbers of a relay's settings; an experiment that ends while it settles lacks some.
_OF_EITHER_SIGN = ("setpoint", "baseline", "bias")
_NOT_NEGATIVE = ("amplitude", "hysteresis", "extra_delay", "sample_period")
_KNOWN_LATER = ("setpoint", "hysteresis")
# Arrays of a model, by the one whose length they have.
_SHAPES = {
    "parameters": ("std", "covariance", "ci95_low", "ci95_high"),
    "point_frequency": ("point_real", "point_imaginary", "point_std"),
    "combinations": (
        "combination_units",
        *(f"combination_{name}" for name in ("value", "std", "ci95_low", "ci95_high")),
    ),
}
# The roots of more take long, and no structure has as many.
_MOST_COEFFICIENTS = 50
# How far p, i and d may be from what kc, ti and td make, by rounding.
_SAME = 1e-9


def float64_array(values: ArrayLike) -> array.array[float]:
    """Copy numbers into the array type that rclpy takes without looking at each of them.

    :param values: any shape; flattened row by row.
    """
    flat = np.ascontiguousarray(values, dtype=np.float64)
    return array.array("d", flat.tobytes())


def set_stamp(stamp: Any, nanoseconds: int) -> None:
    """Write a time into a `builtin_interfaces/Time`.

    :param stamp: the message with the fields ``sec`` and ``nanosec``.
    :param nanoseconds: time since the epoch [ns].
    """
    stamp.sec, stamp.nanosec = divmod(int(nanoseconds), NANOSECONDS)


def stamp_nanoseconds(stamp: Any) -> int:
    """Return the time of a `builtin_interfaces/Time` since the epoch [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def start_nanoseconds(start: float) -> int:
    """Return a time in seconds as nanoseconds, so that the way back gives the same double.

    :param start: time since the epoch [s].
    """
    # Splitting first keeps the product below 1e9, where doubles are finer than a nanosecond.
    seconds = math.floor(start)
    return seconds * NANOSECONDS + round((start - seconds) * 1e9)


def start_seconds(nanoseconds: int) -> float:
    """Return a time in nanoseconds as seconds [s], the double nearest to it.

    :param nanoseconds: time since the epoch [ns].
    """
    seconds, rest = divmod(int(nanoseconds), NANOSECONDS)
    return seconds + rest * 1e-9


def fill_settings(message: Any, settings: RelaySettings | None) -> None:
    """Write the relay's settings into a `RelaySettings` message.

    :param message: the message to fill.
    :param settings: None (no relay experiment) leaves the amplitude 0, which no relay has.
    """
    if settings is None:
        message.amplitude = 0.0
        return
    message.setpoint = float(settings.setpoint)
    message.baseline = float(settings.baseline)
    message.amplitude = float(settings.amplitude)
    message.bias = float(settings.bias)
    message.hysteresis = float(settings.hysteresis)
    message.extra_delay = float(settings.extra_delay)
    message.sample_period = float(settings.sample_period)
    message.reverse_acting = bool(settings.reverse_acting)


def settings_from_message(message: Any) -> RelaySettings | None:
    """Read a `RelaySettings` message; None if its amplitude says that no relay acted.

    :raises RecordError: if a number cannot be.
    """
    if float(message.amplitude) == 0.0:
        return None
    for name in (*_OF_EITHER_SIGN, *_NOT_NEGATIVE):
        value = float(getattr(message, name))
        unknown = math.isnan(value) and name in _KNOWN_LATER
        if not unknown and not (-LARGEST if name in _OF_EITHER_SIGN else 0.0) <= value <= LARGEST:
            least = f"{-LARGEST:g}" if name in _OF_EITHER_SIGN else "0"
            raise RecordError(
                f"the relay's {name} is {value:g}, expected a number from {least} to {LARGEST:g}"
            )
    return RelaySettings(
        setpoint=float(message.setpoint),
        baseline=float(message.baseline),
        amplitude=float(message.amplitude),
        bias=float(message.bias),
        hysteresis=float(message.hysteresis),
        extra_delay=float(message.extra_delay),
        sample_period=float(message.sample_period),
        reverse_acting=bool(message.reverse_acting),
    )


def fill_experiment(message: Any, record: Record, *, arrays: bool = True) -> None:
    """Write a record into a `RelayExperiment` message.

    :param message: the message to fill.
    :param record: the record.
    :param arrays: False writes the summary alone and leaves the samples out.
    """
    set_stamp(message.header.stamp, start_nanoseconds(record.start))
    message.experiment_id = record.experiment_id
    message.outcome = int(record.outcome)
    message.reason = record.reason
    fill_settings(message.settings, record.settings)
    message.noise_std = float(record.noise_std)
    message.lost_samples = int(record.lost_samples)
    if arrays:
        message.time = float64_array(record.time)
        message.receive_time = float64_array(record.receive_time)
        message.command_time = float64_array(record.command_time)
        message.measurement = float64_array(record.measurement)
        message.command = float64_array(record.command)
        message.cycle_start = array.array("I", record.cycle_start)


def record_from_message(message: Any) -> Record:
    """Read the record in a `RelayExperiment` message.

    :param message: the message, of rclpy or decoded from a bag.
    :raises RecordError: if its fields contradict each other.
    """
    try:
        outcome = Outcome(int(message.outcome))
    except ValueError as error:
        raise RecordError(
            f"the experiment's outcome is {message.outcome}; "
            f"expected one of {', '.join(f'{o.value} ({o.name})' for o in Outcome)}"
        ) from error
    return Record(
        time=_column(message.time),
        measurement=_column(message.measurement),
        command=_column(message.command),
        receive_time=_column(message.receive_time),
        command_time=_column(message.command_time),
        settings=settings_from_message(message.settings),
        noise_std=float(message.noise_std),
        cycle_start=tuple(int(i) for i in message.cycle_start),
        outcome=outcome,
        reason=visible(str(message.reason)),
        experiment_id=visible(str(message.experiment_id)),
        start=start_seconds(stamp_nanoseconds(message.header.stamp)),
        lost_samples=int(message.lost_samples),
    )


def fill_cycle(
    message: Any,
    cycle: Cycle,
    *,
    settings: RelaySettings | None,
    experiment_id: str,
    start_ns: int,
    time: FloatArray,
    measurement: FloatArray,
    command: FloatArray,
    lead_in: int = 0,
) -> None:
    """Write a finished cycle with its samples into a `RelayCycle` message.

    :param message: the message to fill.
    :param cycle: the cycle's features.
    :param settings: the relay's settings.
    :param experiment_id: the id of the experiment.
    :param start_ns: time of the experiment's first sample since the epoch [ns].
    :param time: times of the samples from the experiment's first one [s], shape (n,): those
        before the cycle (``lead_in``), the cycle's own, and the one that begins the next cycle.
    :param measurement: the samples [y], shape (n,).
    :param command: the answers [u], shape (n,).
    :param lead_in: number of samples before the cycle. The first cycle carries the settling and
        the kick, so that who holds all cycles holds the experiment from its start at rest.
    """
    first = float(time[0])
    set_stamp(message.header.stamp, start_ns + round(first * 1e9))
    message.experiment_id = experiment_id
    message.index = int(cycle.index)
    message.lead_in = int(lead_in)
    fill_settings(message.settings, settings)
    message.time = float64_array(time - first)
    message.measurement = float64_array(measurement)
    message.command = float64_array(command)
    message.period = float(cycle.period)
    message.period_high = float(cycle.period_high)
    message.period_low = float(cycle.period_low)
    message.peak_max = float(cycle.peak_max)
    message.peak_min = float(cycle.peak_min)
    message.time_to_peak_max = float(cycle.time_to_peak_max)
    message.time_to_peak_min = float(cycle.time_to_peak_min)
    message.converged = bool(cycle.converged)
    message.disturbed = bool(cycle.disturbed)


def record_from_cycles(messages: Iterable[Any]) -> Record:
    """Join `RelayCycle` messages of one experiment to a record that has no outcome yet.

    Cycles may come in any order; of those that are there, the unbroken run up to the newest one
    is used.

    :param messages: the messages, at least one.
    :raises RecordError: if there is none or their samples contradict each other.
    """
    by_index = {int(m.index): m for m in messages}
    if not by_index:
        raise RecordError("no cycle to join to a record; expected at least one")
    newest = max(by_index)
    first = newest
    while first - 1 in by_index:
        first -= 1
    run = [by_index[i] for i in range(first, newest + 1)]
    for message in run:
        _check_cycle(message)
    start = stamp_nanoseconds(run[0].header.stamp)
    columns: dict[str, list[FloatArray]] = {"time": [], "measurement": [], "command": []}
    starts: list[int] = []
    length = 0
    for message in run:
        # The last sample of each cycle is the first one of the next.
        keep = slice(None) if message is run[-1] else slice(0, -1)
        offset = (stamp_nanoseconds(message.header.stamp) - start) * 1e-9
        time = _column(message.time)[keep] + offset
        starts.append(length + int(message.lead_in))
        length += time.size
        columns["time"].append(time)
        columns["measurement"].append(_column(message.measurement)[keep])
        columns["command"].append(_column(message.command)[keep])
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    return Record(
        time=joined["time"],
        measurement=joined["measurement"],
        command=joined["command"],
        settings=settings_from_message(run[-1].settings),
        cycle_start=(*starts, length - 1),
        experiment_id=visible(str(run[-1].experiment_id)),
        start=start_seconds(start),
    )


def _check_cycle(message: Any) -> None:
    lengths = {len(message.time), len(message.measurement), len(message.command)}
    length = min(lengths)
    # The cycle's own samples, and the one that begins the next.
    if len(lengths) > 1 or not 0 <= int(message.lead_in) < length - 1:
        raise RecordError(
            f"cycle {int(message.index)} has {len(message.time)} times, "
            f"{len(message.measurement)} measurements and {len(message.command)} commands, "
            f"{int(message.lead_in)} of them before the cycle; expected as many of each, and at "
            f"least two of the cycle"
        )


def fill_transfer_function(
    message: Any,
    identification: Identification,
    *,
    experiment_id: str = "",
    final: bool = True,
    stamp_ns: int = 0,
    finding: Finding | None = None,
    judgement: Judgement | None = None,
) -> None:
    """Write an identified model into a `TransferFunction` message.

    :param message: the message to fill.
    :param identification: the model with its uncertainty and the quality of its fit.
    :param experiment_id: the id of the experiment it comes from.
    :param final: True once the experiment has ended.
    :param stamp_ns: time of the experiment's first sample since the epoch [ns].
    :param finding: of a running experiment, with the predicted Ms; None: it is not predicted.
    :param judgement: of the experiment; None: it was not judged.
    """
    from relay_autotune.identification.judgement.validation import DIFFERENCES

    model = identification.model
    set_stamp(message.header.stamp, stamp_ns)
    message.experiment_id = experiment_id
    message.method = identification.method
    message.structure = identification.structure
    message.final = bool(final)
    message.gain = float(model.gain)
    message.zeros = _real_time_constants(model.zeros)
    message.time_constants = _real_time_constants(model.time_constants)
    message.numerator = float64_array(model.numerator)
    message.denominator = float64_array(model.denominator)
    message.dead_time = float(model.dead_time)
    message.order = int(model.order)
    message.parameters = [str(name) for name in identification.parameters]
    message.std = float64_array(identification.std)
    message.covariance = float64_array(identification.covariance)
    message.ci95_low = float64_array(identification.ci95_low)
    message.ci95_high = float64_array(identification.ci95_high)
    message.ultimate_gain = float(identification.ultimate_gain)
    message.ultimate_gain_std = float(identification.ultimate_gain_std)
    message.ultimate_frequency = float(identification.ultimate_frequency)
    message.ultimate_frequency_std = float(identification.ultimate_frequency_std)
    message.residual_rms = float(identification.fit.residual_rms)
    message.noise_std = float(identification.fit.noise_std)
    message.fit = float(identification.fit.fit)
    message.whiteness_p = float(identification.fit.whiteness_p)
    message.prediction = float(identification.fit.prediction)
    message.noise_to_signal = float(identification.fit.noise_to_signal)
    message.noise_to_signal_power = float(identification.fit.noise_to_signal_power)
    validation = identification.validation
    for name in DIFFERENCES:
        value = math.nan if validation is None else getattr(validation, name)
        setattr(message, f"validation_{name}", float(value))
    message.validation_reason = "" if validation is None else validation.reason
    message.integrated_error = float(identification.integrated_error)
    points = identification.points
    message.point_frequency = float64_array([p.frequency for p in points])
    message.point_real = float64_array([p.value.real for p in points])
    message.point_imaginary = float64_array([p.value.imag for p in points])
    message.point_std = float64_array([p.std for p in points])
    message.warnings = [str(text) for text in identification.warnings]
    message.undetermined = [str(name) for name in identification.undetermined]
    combinations = identification.combinations
    message.combinations = [c.name for c in combinations]
    message.combination_units = [c.unit for c in combinations]
    for name in ("value", "std", "ci95_low", "ci95_high"):
        numbers = float64_array([getattr(c, name) for c in combinations])
        setattr(message, f"combination_{name}", numbers)
    message.advice = [str(text) for text in identification.advice]
    message.support = float(identification.support)
    for name in _PREDICTED:
        setattr(message, name, math.nan if finding is None else float(getattr(finding, name)))
    _fill_verdict(message, judgement)


def _fill_verdict(message: Any, judgement: Judgement | None) -> None:
    judgement = judgement or NOT_JUDGED
    message.verdict = int(judgement.verdict)
    message.verdict_reason = judgement.reason


def finding_from_message(message: Any) -> Finding:
    """Read what a `TransferFunction` message says of a running experiment.

    :param message: the message.
    :raises ParameterError: if its numbers cannot be.
    """
    return Finding(
        float(message.ultimate_gain),
        float(message.ultimate_gain_std),
        **{name: float(getattr(message, name)) for name in _PREDICTED},
    )


def transfer_function_from_message(message: Any) -> TransferFunction:
    """Read the model in a `TransferFunction` message.

    :param message: the message, of rclpy or decoded from a bag.
    :raises ModelError: if its coefficients are no transfer function, or the arrays that tell how
        sure it is do not go with its parameters.
    """
    from relay_autotune.process.transfer_function import TransferFunction

    for of, names in _SHAPES.items():
        count = len(getattr(message, of))
        for name in names:
            found = len(getattr(message, name))
            expected = count * count if name == "covariance" else count
            if found != expected:
                raise ModelError(
                    f"{name} of the model has {found} numbers, expected {expected}: one for each "
                    f"of {of}"
                )
    for name in ("std", "point_std", "combination_std"):
        if any(value < 0.0 for value in getattr(message, name)):
            raise ModelError(f"{name} of the model has a negative number, expected >= 0 or NaN")
    if max(len(message.numerator), len(message.denominator)) > _MOST_COEFFICIENTS:
        raise ModelError(
            f"the model has {len(message.numerator)} and {len(message.denominator)} "
            f"coefficients, expected {_MOST_COEFFICIENTS} at most"
        )
    return TransferFunction.from_polynomials(
        tuple(float(c) for c in message.numerator),
        tuple(float(c) for c in message.denominator),
        dead_time=float(message.dead_time),
        structure=str(message.structure) or "general",
    )


def gains_from_message(message: Any) -> Gains:
    """Read the gains in a `PidGains` message.

    :param message: the message, of rclpy or decoded from a bag.
    :raises TuningError: if they cannot be, or its two forms contradict each other.
    """
    from relay_autotune.loop.gains import NUMBERS, Gains

    parallel = ("p", "i", "d")
    numbers = {name: float(getattr(message, name)) for name in NUMBERS}
    gains = Gains(
        **{name: value for name, value in numbers.items() if name not in parallel},
        rule=str(message.rule),
        form=str(message.form),
        reason=str(message.reason),
        warnings=tuple(str(text) for text in message.warnings),
    )
    for name in parallel:
        told, follows = numbers[name], getattr(gains, name)
        # Who writes gains by hand may leave the other form out.
        if any(numbers[n] for n in parallel) and not abs(told - follows) <= _SAME * abs(follows):
            raise TuningError(
                f"{name} of the gains is {told:g}, but kc, ti and td make it {follows:g}: the two "
                f"forms contradict each other"
            )
    return gains


def fill_gains(
    message: Any,
    gains: Gains,
    *,
    experiment_id: str = "",
    final: bool = True,
    stamp_ns: int = 0,
    judgement: Judgement | None = None,
) -> None:
    """Write controller gains into a `PidGains` message.

    :param message: the message to fill.
    :param gains: the gains with what they promise.
    :param experiment_id: the id of the experiment they come from.
    :param final: True once the experiment has ended.
    :param stamp_ns: time of the experiment's first sample since the epoch [ns].
    :param judgement: of the experiment; None: it was not judged.
    """
    # A relay_node, which has no gains, need not load what computes them.
    from relay_autotune.loop.gains import NUMBERS

    set_stamp(message.header.stamp, stamp_ns)
    message.experiment_id = experiment_id
    message.rule = gains.rule
    message.form = gains.form
    message.reason = gains.reason
    message.final = bool(final)
    message.warnings = [str(text) for text in gains.warnings]
    for name in NUMBERS:
        setattr(message, name, float(getattr(gains, name)))
    _fill_verdict(message, judgement)


def without_impossible(message: Any) -> list[str]:
    """Empty the model and the gains of a result or feedback of `Tune` where they cannot be.

    :param message: of the action; changed in place.
    :returns: a sentence for each part that was emptied.
    """
    said = []
    for name, read in (
        ("transfer_function", transfer_function_from_message),
        ("gains", gains_from_message),
    ):
        part = getattr(message, name, None)
        if part is None or not part.experiment_id:
            continue
        try:
            read(part)
        except RelayAutotuneError as error:
            setattr(message, name, type(part)())
            said.append(f"{name} refused: {error}")
    return said


def _column(values: Any) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


def _real_time_constants(values: Sequence[complex]) -> array.array[float]:
    # The fields hold real numbers; a complex pair is told by numerator and denominator alone.
    if any(complex(value).imag != 0.0 for value in values):
        return array.array("d")
    return array.array("d", (complex(value).real for value in values))
