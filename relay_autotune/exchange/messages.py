# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Conversions between the core's dataclasses and the messages of `relay_autotune_msgs`.

Nothing here imports ROS: every function takes any object with the fields of the message, an
rclpy message or one decoded from a bag, so a live node and a replay read a record alike.
"""

from __future__ import annotations

import array
import contextlib
import itertools
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import (
    ModelError,
    ParameterError,
    RecordError,
    RelayAutotuneError,
    TuningError,
)
from relay_autotune.exchange.fields import float64_array, of_message, to_message
from relay_autotune.experiment.early_end import FitProgress
from relay_autotune.quantities import Quantity
from relay_autotune.reasons import Code, Reason, Value, other
from relay_autotune.record.record import Cycle, Outcome, Record, RelaySettings
from relay_autotune.text import visible
from relay_autotune.verdict import NOT_JUDGED, Judgement, Verdict

if TYPE_CHECKING:
    from relay_autotune.identification.result import Identification
    from relay_autotune.loop.gains import Gains
    from relay_autotune.process.transfer_function import TransferFunction

NANOSECONDS = 1_000_000_000
# The samples of a record, those of a cycle first.
_OF_CYCLE = ("time", "measurement", "command")
_SAMPLES = (*_OF_CYCLE, "receive_time", "command_time")


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


def fill_reason(message: Any, reason: Reason) -> None:
    """Write code and values of a reason into a `Reason` message.

    :param message: the message to fill.
    :param reason: its notes are left out.
    """
    message.code = int(reason.code)
    message.names = [name for name, _ in reason.facts]
    message.values = [str(value) for _, value in reason.facts]


def fill_whys(message: Any, reason: Reason) -> None:
    """Write a reason with its notes into the fields ``why`` and ``notes`` of a message.

    :param message: the message to fill.
    :param reason: the reason.
    """
    fill_reason(message.why, reason)
    for note in reason.notes:
        message.notes.append(type(message.why)())
        fill_reason(message.notes[-1], note)


def reason_from_message(message: Any, said: str = "", notes: Iterable[Any] = ()) -> Reason:
    """Read a `Reason` message.

    :param message: the message; one of code 0, as an older recording has: it says nothing.
    :param said: the sentence that came with it.
    :param notes: further messages of this kind, that belong to it.
    """
    said = visible(said)
    if int(message.code) == Code.NONE:
        return other(said)
    known = int(message.code) in set(Code)
    code = Code(int(message.code)) if known else Code.OTHER
    facts = [
        (visible(name), _value_of(text))
        for name, text in zip(message.names, message.values, strict=False)
    ]
    if not known:
        facts.append(("number", int(message.code)))
    if not said:
        # Values of another node need not be those that the table's sentence wants.
        said = ", ".join([code.name.lower().replace("_", " "), *(f"{n} {v}" for n, v in facts)])
    return Reason(code, tuple(facts), tuple(map(reason_from_message, notes)), said)


def _value_of(text: str) -> Value:
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return visible(text)


def fill_settings(message: Any, settings: RelaySettings | None) -> None:
    """Write the relay's settings into a `RelaySettings` message.

    :param message: the message to fill.
    :param settings: None (no relay experiment) leaves the amplitude 0, which no relay has.
    """
    if settings is None:
        message.amplitude = 0.0
    else:
        to_message(message, settings)


def settings_from_message(message: Any) -> RelaySettings | None:
    """Read a `RelaySettings` message; None if its amplitude is 0, since no relay acted.

    :raises RecordError: if a number is out of range.
    """
    if float(message.amplitude) == 0.0:
        return None
    return of_message(RelaySettings, message, RecordError, "of the relay")


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
    fill_whys(message, record.why)
    fill_settings(message.settings, record.settings)
    message.noise_std = float(record.noise_std)
    message.lost_samples = int(record.lost_samples)
    if arrays:
        for name in _SAMPLES:
            setattr(message, name, float64_array(getattr(record, name)))
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
    samples: dict[str, Any] = {name: _column(getattr(message, name)) for name in _SAMPLES}
    return Record(
        **samples,
        settings=settings_from_message(message.settings),
        noise_std=float(message.noise_std),
        cycle_start=tuple(int(i) for i in message.cycle_start),
        outcome=outcome,
        reason=visible(str(message.reason)),
        why=reason_from_message(message.why, message.reason, message.notes),
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
        the kick, so that all cycles together hold the experiment from its start at rest.
    """
    first = float(time[0])
    set_stamp(message.header.stamp, start_ns + round(first * 1e9))
    message.experiment_id = experiment_id
    message.lead_in = int(lead_in)
    fill_settings(message.settings, settings)
    message.time = float64_array(time - first)
    message.measurement = float64_array(measurement)
    message.command = float64_array(command)
    to_message(message, cycle)


def record_from_cycles(messages: Iterable[Any]) -> Record:
    """Join `RelayCycle` messages of one experiment to a record that has no outcome yet.

    Cycles may come in any order; of those that are there, the unbroken run up to the newest one
    is used.

    :param messages: the messages, at least one.
    :raises RecordError: if there is none or their samples contradict each other.
    """
    run = unbroken(messages)
    if not run:
        raise RecordError("no cycle to join to a record; expected at least one")
    for message in run:
        _check_cycle(message)
    start = stamp_nanoseconds(run[0].header.stamp)
    columns: dict[str, list[FloatArray]] = {name: [] for name in _OF_CYCLE}
    starts: list[int] = []
    length = 0
    for message in run:
        # The last sample of each cycle is the first one of the next.
        keep = slice(None) if message is run[-1] else slice(0, -1)
        starts.append(length + int(message.lead_in))
        late = (stamp_nanoseconds(message.header.stamp) - start) * 1e-9
        for name, parts in columns.items():
            column = _column(getattr(message, name))[keep]
            parts.append(column + late if name == "time" else column)
        length += columns["time"][-1].size
    joined: dict[str, Any] = {name: np.concatenate(parts) for name, parts in columns.items()}
    return Record(
        **joined,
        settings=settings_from_message(run[-1].settings),
        cycle_start=(*starts, length - 1),
        experiment_id=visible(str(run[-1].experiment_id)),
        start=start_seconds(start),
    )


def unbroken(messages: Iterable[Any]) -> list[Any]:
    """Return the cycles without a gap in their numbers up to the newest, in order.

    :param messages: of cycles, in any order.
    """
    by_index = {int(message.index): message for message in messages}
    newest_first = itertools.count(max(by_index, default=-1), -1)
    run = [by_index[k] for k in itertools.takewhile(by_index.__contains__, newest_first)]
    return run[::-1]


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
    finding: FitProgress | None = None,
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
    # Imported here, since a relay_node has no models.
    from relay_autotune.exchange import models  # noqa: F401  (it says how they are written)

    _fill_envelope(message, experiment_id, final, stamp_ns, judgement)
    # K_u stands in both; that of the model counts.
    to_message(message, finding or FitProgress())
    to_message(message, identification)


def _fill_envelope(
    message: Any, experiment_id: str, final: bool, stamp_ns: int, judgement: Judgement | None
) -> None:
    judgement = judgement or NOT_JUDGED
    set_stamp(message.header.stamp, stamp_ns)
    message.experiment_id = experiment_id
    message.final = bool(final)
    message.verdict = int(judgement.verdict)
    message.verdict_reason = judgement.reason
    fill_reason(message.verdict_why, _why_of(judgement))


def _why_of(judgement: Judgement) -> Reason:
    worst = judgement.worst
    if judgement.refused or worst is None:
        return other(judgement.reason)
    return Code.CHECK_FAILED(
        sentence=worst.said, check=worst.name, value=worst.value, limit=worst.limit
    )


def finding_from_message(message: Any) -> FitProgress:
    """Read the finding on a running experiment in a `TransferFunction` message.

    :param message: the message.
    :raises ParameterError: if a number is out of range.
    """
    return of_message(FitProgress, message, ParameterError, "of the experiment")


def identification_from_message(message: Any) -> Identification:
    """Read the model with its accuracy in a `TransferFunction` message.

    :param message: the message, of rclpy or decoded from a bag.
    :raises ModelError: if its coefficients are no transfer function, its parameters make another
        one, or its uncertainty is out of range.
    """
    from relay_autotune.exchange import models  # noqa: F401  (it says how they are read)
    from relay_autotune.identification.result import Identification

    return of_message(Identification, message, ModelError, "of the model")


def transfer_function_from_message(message: Any) -> TransferFunction:
    """Read the model in a `TransferFunction` message.

    :param message: the message, of rclpy or decoded from a bag.
    :raises ModelError: if its coefficients are no transfer function, or the arrays of its
        uncertainty do not go with its parameters.
    """
    return identification_from_message(message).model


def gains_from_message(message: Any) -> Gains:
    """Read the gains in a `PidGains` message.

    :param message: the message, of rclpy or decoded from a bag.
    :raises TuningError: if a number is out of range, or its two forms contradict each other.
    """
    from relay_autotune.loop.gains import Gains

    return of_message(Gains, message, TuningError, "of the gains")


def fill_gains(
    message: Any,
    gains: Gains,
    *,
    experiment_id: str = "",
    stamp_ns: int = 0,
    judgement: Judgement | None = None,
) -> None:
    """Write controller gains into a `PidGains` message.

    :param message: the message to fill.
    :param gains: the gains with their predicted performance.
    :param experiment_id: the id of the experiment they come from, which has ended.
    :param stamp_ns: time of the experiment's first sample since the epoch [ns].
    :param judgement: of the experiment; None: it was not judged.
    """
    _fill_envelope(message, experiment_id, True, stamp_ns, judgement)
    to_message(message, gains)


def why_doubtful(message: Any) -> str:
    """Return why a result is doubtful; empty: it is trusted.

    :param message: the `PidGains`, `TransferFunction` or `Tune.Result`.
    """
    if message.verdict == Verdict.TRUSTED:
        return ""
    return message.verdict_reason or "no verdict was given"


def how_ended(message: Any) -> str:
    """Return how a proof of gains has ended, and why, in words.

    :param message: the `Verify.Result`.
    """
    known = {message.PASSED: "passed", message.FAILED: "failed"}
    return f"{known.get(message.verdict, 'ended without a verdict')}: {message.reason}"


def made_visible(message: Any) -> Any:
    """Return a message of another node, in whose texts nothing acts on a terminal or a log.

    :param message: of rclpy; changed in place.
    """
    for name, kind in message.get_fields_and_field_types().items():
        held = getattr(message, name)
        if isinstance(held, str):
            if not held.isprintable():
                setattr(message, name, visible(held))
        elif "string" in kind:
            setattr(message, name, [visible(text) for text in held])
        elif "/" in kind:
            for part in held if "sequence" in kind or "[" in kind else (held,):
                made_visible(part)
    return message


# Numbers of a feedback; one that is impossible is not given.
_OF_FEEDBACK = (
    Quantity("progress", 0.0, "", 0.0, 1.0),
    Quantity("elapsed", 0.0, "s", 0.0),
    Quantity("remaining", math.nan, "s", 0.0),
    Quantity("period", math.nan, "s", 0.0),
    Quantity("amplitude", math.nan, "y", 0.0),
    Quantity("ultimate_gain", math.nan, "u/y"),
    Quantity("ultimate_gain_std", math.nan, "u/y", 0.0),
)


def without_impossible(message: Any) -> list[str]:
    """Empty what is impossible in a result or feedback of `Tune`: model, gains, numbers.

    :param message: of the action; changed in place.
    :returns: a sentence for each part that was emptied.
    """
    said = []
    for each in _OF_FEEDBACK:
        if each.problem(getattr(message, each.name, each.default)) is not None:
            setattr(message, each.name, each.default)
    if getattr(message, "verdict", Verdict.UNKNOWN) > max(Verdict):
        message.verdict = int(Verdict.UNKNOWN)
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
