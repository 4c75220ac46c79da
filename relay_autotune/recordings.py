# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The experiments in a recording: those of relay_node, also one cut short, or of any program.

Measurement and command, which `relay_autotune.bag` reads each on its own, are joined to records.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.bag.definitions import CYCLE, EXPERIMENT, EXPERIMENT_METADATA, FLOAT64
from relay_autotune.bag.limits import LARGEST_VALUE
from relay_autotune.bag.reader import is_text, opened, paths_of
from relay_autotune.bag.signals import Selection, Signal
from relay_autotune.bag.topics import Progress, Topics
from relay_autotune.errors import BagError, RecordError, SelectionError
from relay_autotune.exchange.messages import (
    record_from_cycles,
    record_from_message,
    settings_from_message,
    stamp_nanoseconds,
    start_seconds,
    unbroken,
)
from relay_autotune.quantities import result_fields
from relay_autotune.record.record import (
    Cycle,
    Outcome,
    PiecewiseConstant,
    Record,
    RelaySettings,
    usual_before_moves,
)
from relay_autotune.text import is_unit


@dataclass(frozen=True)
class Recording:
    """What was found in one recording.

    :param experiments: the records, at least one.
    :param notes: what to know about it, each a sentence.
    :param of_one_process: whether they are parts of one measurement and one command.
    """

    experiments: tuple[Record, ...]
    notes: tuple[str, ...] = ()
    of_one_process: bool = False


def read_experiments(
    path: Path | str | Sequence[Path | str],
    selection: Selection | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Return every experiment of a recording.

    Topics that are named are used. Else the experiments that relay_node recorded are returned;
    else an experiment of relay_node whose recording was cut short; else the one pair of topics
    that looks like measurement and command.

    :param path: a rosbag2 directory, an MCAP or ``.db3`` file, or a text with columns (``.csv``,
        ``.txt``, ``.dat``, ``.tsv`` or ``.log``); or several of the first three that are one
        timeline.
    :param selection: what is wanted of it; default: everything.
    :param progress: called with the progress of reading a bag.
    :raises SelectionError: if the selection does not fit, or more than one pair does.
    :raises BagError: if the recording cannot be read, or holds nothing to identify from.
    """
    paths = paths_of(path)
    path, wanted = paths[0], selection or Selection()
    if len(paths) > 1 and any(map(is_text, paths)):
        raise SelectionError("CSV files cannot be joined to one timeline; expected bags")
    if is_text(path):
        if wanted.joint:
            raise SelectionError(
                f"--joint {wanted.joint} is for bags, whose messages name joints; of {path} name "
                "two columns with --measurement and --command"
            )
        records, notes = _of_csv(path, wanted)
    elif (wanted.time, wanted.time_unit, wanted.period) != (None, None, None):
        raise SelectionError(
            f"--time, --time-unit and --period are for CSV files, but {path} is not one"
        )
    else:
        with opened(paths, wanted.clock, wanted.largest_chunk, progress) as topics:
            records, notes = _of_topics(topics, wanted)
    parts = tuple(records)
    if wanted.is_part:
        parts = tuple(p for r in records for p in window(r, wanted.start, wanted.end))
    # Those of relay_node may be of several loops, and tell of themselves how they ended.
    of_one = all(record.outcome is Outcome.UNKNOWN for record in records)
    return Recording(parts, tuple(notes), of_one)


_HEADER: dict[str, Any] = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}


def _defaults_of(kind: type) -> dict[str, Any]:
    """Return the fields that a message has of one of our types, each with its default."""
    fields = [each for each in result_fields(kind) if each.message is not None]
    absent = {each.name: math.nan if each.nan else each.kind() for each in fields}
    given = {each.name: each.default for each in fields if each.default is not MISSING}
    return absent | given


# Defaults of the fields that an older definition lacks. A field that is added to one of these
# messages needs its default here, so that old bags can still be replayed.
DEFAULTS: dict[str, dict[str, Any]] = {
    EXPERIMENT: {
        "header": _HEADER,
        "settings": _defaults_of(RelaySettings),
        "noise_std": math.nan,
        "sought_width": 0.0,
        **dict.fromkeys(("experiment_id", "reason", "sought"), ""),
        "why": {"code": 0, "names": (), "values": ()},
        "notes": (),
        **dict.fromkeys(("outcome", "lost_samples"), 0),
        **dict.fromkeys(("time", "receive_time", "command_time"), ()),
        **dict.fromkeys(("measurement", "command", "cycle_start"), ()),
    },
    CYCLE: {
        "header": _HEADER,
        "settings": _defaults_of(RelaySettings),
        "experiment_id": "",
        "lead_in": 0,
        **dict.fromkeys(("time", "measurement", "command"), ()),
        **_defaults_of(Cycle),
    },
}


def _messages(topics: Topics, type_name: str) -> list[Any]:
    """Return the messages of one of our types, with defaults of the fields that they lack."""
    return [_with_defaults(each, DEFAULTS[type_name]) for each in topics.decoded(type_name)]


def _with_defaults(message: Any, defaults: Mapping[str, Any]) -> SimpleNamespace:
    fields = dict(vars(message)) if message is not None else {}
    for name, default in defaults.items():
        if isinstance(default, Mapping):
            fields[name] = _with_defaults(fields.get(name), default)
        else:
            fields.setdefault(name, default)
    return SimpleNamespace(**fields)


def _of_topics(topics: Topics, wanted: Selection) -> tuple[list[Record], list[str]]:
    if not topics.types():
        raise BagError("; ".join((f"{topics.path} holds no topic", *topics.notes)))
    records, notes = list[Record](), list[str]()
    if not (wanted.joint or wanted.measurement is not None or wanted.command is not None):
        records, notes = recorded_experiments(topics)
        records = records or interrupted_experiment(topics)
    if not records:
        records, notes = _of_pair(topics, wanted)
    return records, [*topics.notes, *notes]


# Least number of samples of a record that is split into experiments.
_FEWEST_SAMPLES = 12

# Difference of two topics' lags to the recorder beyond which their clocks differ [ns].
_CLOCK_DIFFERENCE_NS = 100_000_000


def _of_pair(topics: Topics, wanted: Selection) -> tuple[list[Record], list[str]]:
    """Return the experiments in two topics of any program, and notes about them."""
    # Our own recordings need neither the search for a pair nor that for experiments.
    from relay_autotune.bag.pairing import pair_of

    names, notes = pair_of(topics, wanted)
    signals = list(topics.signals(names).values())
    measured, commanded = signals
    notes = [*notes, *measured.notes, *commanded.notes]
    difference = abs(measured.lag_ns - commanded.lag_ns)
    if difference > _CLOCK_DIFFERENCE_NS:
        # The publishers' clocks disagree: both are put on the recorder's.
        signals = [replace(each, time_ns=each.time_ns + each.lag_ns) for each in signals]
        notes.append(
            f"the clocks behind {names[0]} and {names[1]} differ by {difference / 1e9:.3f} s; "
            f"they are aligned by the recorder's clock"
        )
    units = {letter: topics.unit(name) for letter, name in zip("yu", names, strict=True)}
    record = _in_units(join(*signals, before=wanted.command_before), units)
    records, found = _taken_apart(record, whole=wanted.is_part)
    return records, [*notes, *found]


def _taken_apart(record: Record, *, whole: bool) -> tuple[list[Record], list[str]]:
    """Return the experiments in a record of unknown origin, and notes about them.

    :param record: the record.
    :param whole: whether it is one experiment, whatever it looks like.
    :raises BagError: if nothing stands out of the noise.
    """
    from relay_autotune.record.excitation import find_experiments, frozen, gaps_of

    missing = _missing_rows(record)
    missing += [_stay(record, *stay) for stay in frozen(record.measurement)]
    if whole or len(record) < _FEWEST_SAMPLES:
        return [record], missing
    stretches = find_experiments(record)
    if not stretches:
        if np.ptp(record.measurement) == 0.0 or np.ptp(record.command) == 0.0:
            # The identification then tells why nothing can be learned from it.
            return [record], missing
        raise BagError(
            "; ".join((*missing, ""))
            + "no relay phase, step, pulse or moving closed loop stands out of the noise: at rest "
            "a controller's command only follows the noise of the measurement, which would give "
            "a wrong model; record an experiment, or name a part to be used all the same with "
            "--start and --end"
        )
    gaps = gaps_of(record)
    records = [
        record.part(each.first, each.last + 1, gaps.known_from(each.first)) for each in stretches
    ]
    if len(stretches) == 1 and len(records[0]) == len(record):
        return records, missing
    begins = record.time[[stretch.first for stretch in stretches]]
    ends = record.time[[stretch.last for stretch in stretches]]
    return records, missing + [
        f"experiment {number} of {len(records)}, {begin:g} s to {end:g} s: {stretch.reason}"
        for number, (begin, end, stretch) in enumerate(
            zip(begins, ends, stretches, strict=True), start=1
        )
    ]


def _stay(record: Record, begin: int, stop: int) -> str:
    """Return a note about samples that repeat one value."""
    return (
        f"the measurement stands still from {record.time[begin]:g} s to "
        f"{record.time[stop - 1]:g} s: {stop - begin} samples are all "
        f"{record.measurement[begin]:g}, and those before hardly ever repeat a value: a frozen "
        "sensor or log, or the end of the sensor's range"
    )


def _missing_rows(record: Record) -> list[str]:
    """Return a note about the gaps in the rows of a table, if there are some."""
    from relay_autotune.record.excitation import gaps_of

    gaps = gaps_of(record)
    if not gaps.before.size:
        return []
    note = (
        f"gaps in the rows: {gaps.before.size}, the longest {gaps.longest:.3g} s, the first after "
        f"{record.time[gaps.before[0] - 1]:g} s (if a clock jumped, leave one side out with "
        "--start or --end)"
    )
    if gaps.hidden.size:
        end = record.time[gaps.hidden[0]]
        note += (
            f"; over {gaps.hidden.size} of them the command changed, the first time before "
            f"{end:g} s, and nobody knows when: an experiment ends there, so log without gaps, or "
            f"add a row at each change"
        )
    return [note]


def _of_csv(path: Path, wanted: Selection) -> tuple[list[Record], list[str]]:
    from relay_autotune.bag.csv_file import read_csv

    records: list[Record] = []
    notes: list[str] = []
    faults: list[BagError] = []
    for number, log in enumerate(read_csv(path, wanted)):
        notes += log.notes
        if number and wanted.command_before is not None:
            notes.append("--command-before was used for the first recording in the file alone")
        try:
            before = None if number else wanted.command_before
            record = join(log.measurement, log.command, before=before, dated=log.dated)
            record = _in_units(record, log.units)
            if len(log.command) != len(log.measurement):
                unseen = max(record.unseen, _between_readings(log.command))
                record = replace(record, unseen=unseen)
            found, said = _taken_apart(record, whole=wanted.is_part)
        except BagError as fault:
            faults.append(fault)
            continue
        records += found
        notes += said
    if not records and len(faults) > 1:
        raise BagError(
            f"none of the {len(faults)} recordings in the file can be used; the first: {faults[0]}"
        )
    if not records:
        raise faults[0]
    return records, [*notes, *(f"one of the recordings is left out: {f}" for f in faults)]


def _between_readings(command: Signal) -> float:
    """Return the time between readings of a command [s]; 0: it was written where it changed."""
    if np.all(np.diff(command.values)):
        return 0.0
    return usual_before_moves(_seconds(command.time_ns, int(command.time_ns[0])), command.values)


def _in_units(record: Record, units: Mapping[str, str]) -> Record:
    """Return a record with those of its units that are known."""
    return replace(record, units={name: unit for name, unit in units.items() if is_unit(unit)})


def read_records(
    path: Path | str,
    *,
    measurement: str | None = None,
    command: str | None = None,
    time: str | None = None,
    start: float | None = None,
    end: float | None = None,
) -> tuple[Record, ...]:
    """Return the experiments in a recording.

    >>> from relay_autotune import read_records
    >>> read_records("bags/heater.csv")
    (<Record: 450 samples over 898 s, recorded elsewhere>,)
    >>> (record,) = read_records("bags/step_test", measurement="/reactor/temperature",
    ...                          command="/reactor/heater")

    :param path: a rosbag2 directory, an MCAP file, or a CSV file with a header line.
    :param measurement: topic or column of the measurement; None: found.
    :param command: topic or column of the command; None: found.
    :param time: column of the time [s] in a CSV file; None: the first.
    :param start: beginning of the part to use [s from the first sample]; None: all.
    :param end: end of the part to use [s from the first sample]; None: all.
    :raises BagError: if it cannot be read, or the choice of topics or columns does not fit.
    """
    wanted = Selection(measurement, command, time, start, end)
    return read_experiments(path, wanted).experiments


_STAMP_ERROR_NS = 1000


def recorded_experiments(topics: Topics) -> tuple[list[Record], list[str]]:
    """Return the experiments whose record was published, each once, and notes about others.

    They are recognised by the type of their messages, so that any recording of the topic will
    do, under whatever name.

    :param topics: the bag.
    :raises BagError: if there are some, but none can be used.
    """
    records: dict[str, Record] = {}
    refused: list[str] = []
    for number, message in enumerate(_messages(topics, EXPERIMENT)):
        key = str(message.experiment_id) or f"number {number}"
        try:
            records.setdefault(key, record_from_message(message))
        except (RecordError, TypeError, ValueError, AttributeError) as error:
            said = f"; it ended because: {message.reason}" if message.reason else ""
            refused.append(f"experiment {key} in {topics.path} is of no use: {error}{said}")
    if refused and not records:
        raise BagError(refused[0])
    return list(records.values()), refused


def interrupted_experiment(topics: Topics) -> list[Record]:
    """Return the experiment that was being recorded when relay_node was killed.

    :param topics: the bag; one that relay_node wrote says which topics are the loop's.
    :return: none if the bag is not one of relay_node.
    :raises BagError: if it ends before the first sample was answered.
    """
    for about in topics.metadata(EXPERIMENT_METADATA):
        if {"measurement", "command", "experiment_id"} <= about.keys():
            return [_rebuilt(topics, about)]
    return []


def _rebuilt(topics: Topics, about: Mapping[str, str]) -> Record:
    names = (about["measurement"], about["command"])
    found = topics.columns(names, FLOAT64)
    if set(found) != set(names):
        raise BagError(f"{topics.path} ends before the first sample of its experiment")
    samples, answers = (found[name] for name in names)
    # Here each sample is followed by its answer, before the next one; the last may be missing.
    answer = np.searchsorted(answers.order, samples.order)
    following = np.append(samples.order[1:], np.iinfo(np.int64).max)
    answered = answer < answers.order.size
    answered[answered] = answers.order[answer[answered]] < following[answered]
    if not bool(np.any(answered)):
        raise BagError(f"{topics.path} ends before the first sample of its experiment")
    answer = answer[answered]
    taken = samples.publish_time[answered]
    origin = int(taken[0])
    cycles = unbroken(_messages(topics, CYCLE))
    try:
        return Record(
            time=(taken - origin) / 1e9,
            measurement=samples.values[answered],
            command=answers.values[answer],
            receive_time=(samples.log_time[answered] - origin) / 1e9,
            command_time=(answers.publish_time[answer] - origin) / 1e9,
            settings=settings_from_message(cycles[-1].settings) if cycles else None,
            cycle_start=_cycle_start(cycles, taken),
            outcome=Outcome.ABORTED,
            reason="the recording ends without the experiment's end "
            f"(after {(taken[-1] - origin) / 1e9:.3f} s)",
            experiment_id=about["experiment_id"],
            start=start_seconds(origin),
        )
    except RecordError as error:
        raise BagError(f"the samples in {topics.path} are of no use: {error}") from error


def _cycle_start(cycles: Sequence[Any], taken: IntArray) -> tuple[int, ...]:
    """Return the samples that bound the cycles.

    :param cycles: their messages, in order and without a gap; those of older versions may lack
        the samples.
    :param taken: time of each sample [ns], shape (n,).
    """
    with suppress(RecordError):
        joined = record_from_cycles(cycles)
        origin = stamp_nanoseconds(cycles[0].header.stamp)
        bounds = np.round(1e9 * joined.time[list(joined.cycle_start)]).astype(np.int64)
        # The stamps went through seconds in double precision.
        near = np.searchsorted(taken, origin + bounds - _STAMP_ERROR_NS)
        return tuple(sorted({int(i) for i in near if i < taken.size}))
    return ()


def join(
    measurement: Signal, command: Signal, *, before: float | None = None, dated: bool = True
) -> Record:
    """Return the record of a loop of which measurement and command were recorded.

    ``command[i]`` is the level in force when sample ``i + 1`` is taken. Where commands came more
    often than samples, or before the first one, ``held_input`` of the record carries them all.
    Samples taken before the first command is known are left out.

    :param measurement: what the loop measured.
    :param command: what it commanded; each value holds until the next.
    :param before: the command that held before its first value; None: it is not known.
    :param dated: whether the times are since the epoch.
    :raises BagError: if one of them is empty, constant, not finite or absurdly large, or they
        do not overlap.
    """
    _check(measurement, "measurement")
    _check(command, "command", before)
    t, y = measurement.time_ns, measurement.values
    c, u = command.time_ns, command.values
    # The last sample before the first command is kept: it is the one that command answers.
    first = max(int(np.searchsorted(t, c[0], side="right")) - 1, 0)
    t, y = t[first:], y[first:]
    if c[0] > t[-1]:
        raise BagError(
            f"the command {command.name} begins {(c[0] - t[-1]) / 1e9:g} s after the last "
            f"sample of {measurement.name}; expected recordings of the same time"
        )
    if c[-1] < t[0] and _never_changes(command, before):
        raise BagError(f"the command {command.name} ends before {measurement.name} begins")
    # The level that holds at the end of each sample's interval, and when it was commanded.
    last = np.searchsorted(c, t[1:], side="left") - 1
    held = np.maximum(np.append(last, c.size - 1), 0)
    sent = np.maximum(t, c[held])
    origin = int(t[0])
    record = Record(
        time=_seconds(t, origin),
        measurement=y,
        command=u[held],
        command_time=_seconds(sent, origin),
        start=start_seconds(origin) if dated else 0.0,
    )
    exact = PiecewiseConstant.from_samples(_seconds(c, origin), u, before)
    seen = record.input()
    if not (
        seen.initial == exact.initial
        and np.array_equal(seen.times, exact.times)
        and np.array_equal(seen.values, exact.values)
    ):
        record = replace(record, held_input=exact)
    return record


def window(record: Record, start: float | None, end: float | None) -> list[Record]:
    """Return the part of a record between two times; the command's history is kept.

    It is apart where a gap in a table hides a change of the command. Pieces without a move, or of
    few samples, are left out where others remain.

    :param record: the record.
    :param start: first time to keep [s from the first sample]; None: the beginning.
    :param end: last time to keep [s from the first sample]; None: the end.
    :raises SelectionError: if no sample lies between them.
    """
    from relay_autotune.record.excitation import gaps_of

    time = record.time - record.time[0]
    low = 0 if start is None else int(np.searchsorted(time, start, side="left"))
    high = time.size if end is None else int(np.searchsorted(time, end, side="right"))
    if high <= low:
        raise SelectionError(
            f"no sample lies between --start {0.0 if start is None else start:g} s and "
            f"--end {time[-1] if end is None else end:g} s; the recording is {time[-1]:g} s long"
        )
    gaps = gaps_of(record)
    ends = [low, *gaps.hidden[(gaps.hidden > low) & (gaps.hidden < high)].tolist(), high]
    pieces = [record.part(a, b, gaps.known_from(a)) for a, b in pairwise(ends)]
    long = [piece for piece in pieces if len(piece) >= _FEWEST_SAMPLES] or pieces[:1]
    return [piece for piece in long if np.ptp(piece.command) > 0.0] or long[:1]


def _never_changes(signal: Signal, before: float | None) -> bool:
    return before in (None, signal.values[0]) and bool(np.all(signal.values == signal.values[0]))


def _check(signal: Signal, role: str, before: float | None = None) -> None:
    name = role if signal.name == role else f"{role} {signal.name}"
    if len(signal) == 0:
        raise BagError(f"the {name} holds no value")
    # NaN compares as False.
    wrong = np.flatnonzero(~(np.abs(signal.values) <= LARGEST_VALUE))
    if wrong.size:
        where = (signal.time_ns[wrong[0]] - signal.time_ns[0]) / 1e9
        raise BagError(
            f"the {name} is {signal.values[wrong[0]]} at {where:g} s "
            f"({wrong.size} of {len(signal)} values are not finite, or beyond "
            f"{LARGEST_VALUE:g}, which no quantity is); leave such a stretch out of the "
            f"recording"
        )
    if _never_changes(signal, before):
        what, remedy = "is constant", ""
        if role == "command":
            what = "never changes"
            remedy = "; if it was another before the recording, give that as --command-before"
        raise BagError(
            f"the {name} {what} ({signal.values[0]:g} in all of {len(signal)} "
            f"values): nothing can be identified from it{remedy}"
        )


def _seconds(time_ns: IntArray, origin: int) -> FloatArray:
    return (time_ns - origin) / 1e9
