"""The experiments in a recording, whoever made it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from relay_autotune.bag.csv_file import read_csv
from relay_autotune.bag.experiments import interrupted_experiment, recorded_experiments
from relay_autotune.bag.fields import split_name
from relay_autotune.bag.limits import LARGEST_CHUNK
from relay_autotune.bag.mcap_file import McapFile
from relay_autotune.bag.pairing import Pair, characterise, plausible_pairs
from relay_autotune.bag.signals import Signal, cut, join, window
from relay_autotune.bag.timing import CLOCKS
from relay_autotune.bag.topics import Progress, Topics
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.excitation import find_experiments
from relay_autotune.record import Record

# A file compressed as a whole, as rosbag2 and the zstd command name it.
_WHOLE = ([".mcap", ".zstd"], [".mcap", ".zst"])

# Fewer are not taken apart.
_FEWEST_SAMPLES = 12

# Beyond this, two topics' lags to the recorder differ by their clocks, not by the transport.
_CLOCK_DIFFERENCE_NS = 100_000_000


@dataclass(frozen=True)
class Recording:
    """What was found in one recording.

    :param path: as it was given.
    :param experiments: the records, at least one.
    :param notes: what to know about it, each a sentence.
    """

    path: Path
    experiments: tuple[Record, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Selection:
    """What of a recording is wanted.

    :param measurement: topic or column of the measurement; None: found.
    :param command: topic or column of the command; None: found.
    :param time: column of the time in a CSV file; None: the first.
    :param start: beginning of the part to use [s from the first sample]; None: all.
    :param end: end of the part to use [s from the first sample]; None: all.
    :param clock: which time of a message counts, one of ``CLOCKS``.
    :param largest_chunk: size of a chunk, or a message outside of chunks, beyond which it is left
        out [bytes].
    """

    measurement: str | None = None
    command: str | None = None
    time: str | None = None
    start: float | None = None
    end: float | None = None
    clock: str = CLOCKS[0]
    largest_chunk: int = LARGEST_CHUNK


def read_experiments(
    path: Path | str | Sequence[Path | str],
    selection: Selection | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Return every experiment of a recording.

    Topics that are named are used. Else the experiments that relay_node recorded are returned;
    else an experiment of relay_node whose recording was cut short; else the one pair of topics
    that looks like measurement and command.

    :param path: a rosbag2 directory, an MCAP file, or a CSV file (by its ending); or several of
        the first two that are one timeline.
    :param selection: what is wanted of it; default: everything.
    :param progress: told of how far a bag has been read.
    :raises SelectionError: if the selection does not fit, or more than one pair does.
    :raises BagError: if the recording cannot be read, or holds nothing to identify from.
    """
    paths = [Path(path)] if isinstance(path, Path | str) else [Path(part) for part in path]
    path, wanted = paths[0], selection or Selection()
    if len(paths) > 1 and any(part.suffix.lower() == ".csv" for part in paths):
        raise SelectionError("CSV files cannot be joined to one timeline; expected bags")
    if path.suffix.lower() == ".csv":
        columns = (wanted.measurement, wanted.command, wanted.time)
        measured, commanded, dated = read_csv(path, *columns)
        records, notes = _experiments(join(measured, commanded, dated=dated), wanted)
    elif wanted.time is not None:
        raise SelectionError(f"--time names a column of a CSV file, but {path} is none")
    else:
        with ExitStack() as opened:
            files = [
                opened.enter_context(McapFile(file, wanted.largest_chunk))
                for part in paths
                for file in _data_files(part)
            ]
            topics = Topics(path, files, wanted.clock, progress)
            try:
                records, notes = _of_topics(topics, wanted)
            except BagError as error:
                # What was found amiss may be why.
                amiss = [note for note in topics.notes if note not in str(error)]
                if not amiss:
                    raise
                raise type(error)("; ".join((str(error), *amiss))) from error
    parts = tuple(window(record, wanted.start, wanted.end) for record in records)
    return Recording(path, parts, tuple(notes))


def _data_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    try:
        entries = sorted(path.iterdir(), key=_natural)
    except OSError as error:
        raise BagError(f"cannot read {path}: {error.strerror or error}") from error
    # The folder itself counts: a killed recorder's metadata.yaml is missing or out of date.
    files = [entry for entry in entries if entry.suffix == ".mcap"]
    plain = {file.name for file in files}
    # A recorder that was killed while it compressed leaves both.
    files += [e for e in entries if e.suffixes[-2:] in _WHOLE and e.stem not in plain]
    files.sort(key=_natural)
    if not files:
        found = ", ".join(entry.name for entry in entries[:5]) or "nothing"
        advice = (
            "convert it with: ros2 bag convert"
            if any(entry.suffix == ".db3" for entry in entries)
            else "expected a rosbag2 directory with .mcap files"
        )
        raise BagError(f"the directory {path} holds no .mcap file, but {found}; {advice}")
    return files


def _natural(path: Path) -> list[tuple[int, str]]:
    # Split bags are numbered without leading zeros: bag_2 comes before bag_10.
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _of_topics(topics: Topics, wanted: Selection) -> tuple[list[Record], list[str]]:
    if not topics.types():
        raise BagError("; ".join((f"{topics.path} holds no topic", *topics.notes)))
    if wanted.measurement is not None or wanted.command is not None:
        records, notes = _joined(topics, wanted, *_named_pair(topics, wanted))
    else:
        records, notes = recorded_experiments(topics)
        if not records:
            interrupted = interrupted_experiment(topics)
            if interrupted is not None:
                records = [interrupted]
            else:
                records, notes = _joined(topics, wanted, *_found_pair(topics))
    return records, [*topics.notes, *notes]


def _joined(
    topics: Topics, wanted: Selection, pair: Pair, notes: list[str]
) -> tuple[list[Record], list[str]]:
    names = (pair.measurement.name, pair.command.name)
    measured, commanded = topics.signals(names).values()
    notes = [*notes, *measured.notes, *commanded.notes]
    signals = [measured.signal, commanded.signal]
    difference = abs(measured.lag_ns - commanded.lag_ns)
    if difference > _CLOCK_DIFFERENCE_NS:
        # The publishers' clocks disagree: both are put on the recorder's.
        signals = [
            replace(timed.signal, time_ns=timed.signal.time_ns + timed.lag_ns)
            for timed in (measured, commanded)
        ]
        notes.append(
            f"the clocks behind {names[0]} and {names[1]} differ by {difference / 1e9:.3f} s; "
            f"they are aligned by the recorder's clock"
        )
    records, found = _experiments(join(signals[0], signals[1]), wanted)
    return records, [*notes, *found]


def _experiments(record: Record, wanted: Selection) -> tuple[list[Record], list[str]]:
    """Take a record of unknown origin apart, unless a part of it was asked for."""
    if wanted.start is not None or wanted.end is not None or len(record) < _FEWEST_SAMPLES:
        return [record], []
    stretches = find_experiments(record)
    if not stretches:
        if np.ptp(record.measurement) == 0.0 or np.ptp(record.command) == 0.0:
            # Why nothing can be told from it is said where that is tried.
            return [record], []
        raise BagError(
            "no relay phase, step, pulse or moving closed loop stands out of the noise: at rest "
            "a controller's command follows the measurement, and read as an answer to it would "
            "give a wrong model; record an experiment, or name a part to be used all the same "
            "with --start and --end"
        )
    records = [cut(record, stretch.first, stretch.last + 1) for stretch in stretches]
    if len(stretches) == 1 and len(records[0]) == len(record):
        return records, []
    begins = record.time[[stretch.first for stretch in stretches]]
    ends = record.time[[stretch.last for stretch in stretches]]
    return records, [
        f"experiment {number} of {len(records)}, {begin:g} s to {end:g} s: {stretch.reason}"
        for number, (begin, end, stretch) in enumerate(
            zip(begins, ends, stretches, strict=True), start=1
        )
    ]


def _named_pair(topics: Topics, wanted: Selection) -> tuple[Pair, list[str]]:
    if wanted.measurement is not None and wanted.command is not None:
        names = (
            _checked(topics, "measurement", wanted.measurement),
            _checked(topics, "command", wanted.command),
        )
        if names[0] == names[1]:
            raise SelectionError(
                f"{names[0]} was named as measurement and as command; expected two topics"
            )
        measured, commanded = topics.signals(names).values()
        return Pair(measured.signal, commanded.signal, "named"), []
    if wanted.measurement is not None:
        given = _checked(topics, "measurement", wanted.measurement)
        fits = [p for p in _plausible(topics, given) if p.measurement.name == given]
    else:
        given = _checked(topics, "command", wanted.command or "")
        fits = [p for p in _plausible(topics, given) if p.command.name == given]
    return _only(topics, fits)


def _checked(topics: Topics, role: str, wanted: str) -> str:
    types = topics.types()
    topic, part = split_name(wanted)
    if topic not in types and f"/{topic}" in types:
        topic = f"/{topic}"
    if topic not in types:
        raise SelectionError(
            f"{topics.path} has no topic {topic!r} for the {role}; it has {topics.listing()}"
        )
    return topics.field_of(topic, part)


def _plausible(topics: Topics, given: str | None = None) -> list[Pair]:
    signals: list[Signal] = [timed.signal for timed in topics.signals().values()]
    return plausible_pairs(signals, given)


def _found_pair(topics: Topics) -> tuple[Pair, list[str]]:
    return _only(topics, _plausible(topics))


def _only(topics: Topics, pairs: Sequence[Pair]) -> tuple[Pair, list[str]]:
    if len(pairs) == 1:
        pair = pairs[0]
        names = f"--measurement {pair.measurement.name} --command {pair.command.name}"
        return pair, [f"using {names}: {pair.reason}"]
    if pairs:
        listed = "".join(
            f"\n  --measurement {pair.measurement.name} --command {pair.command.name}"
            f"  ({pair.reason})"
            for pair in pairs
        )
        raise SelectionError(
            f"{topics.path} holds {len(pairs)} pairs of topics that may be measurement and "
            f"command; choose one:{listed}"
        )
    looks = {name: characterise(t.signal).text for name, t in topics.signals().items()}
    raise SelectionError(
        f"{topics.path} holds no recorded experiment and no pair of topics that looks like "
        f"measurement and command; it has {topics.listing(looks)}; name two "
        f"with --measurement TOPIC[:FIELD] --command TOPIC[:FIELD]"
    )
