# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Experiments in the recordings of other programs, which do not mark them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from relay_autotune.bag.pairing import (
    Pair,
    characterise,
    has_joints,
    named_pair,
    plausible_pairs,
)
from relay_autotune.bag.signals import Selection, Signal, join, preceded
from relay_autotune.bag.topics import Topics, split_name
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.record.excitation import find_experiments
from relay_autotune.record.record import Record

# Least number of samples of a record that is split into experiments.
_FEWEST_SAMPLES = 12

# Difference of two topics' lags to the recorder beyond which their clocks differ [ns].
_CLOCK_DIFFERENCE_NS = 100_000_000


def experiments_of_pair(topics: Topics, wanted: Selection) -> tuple[list[Record], list[str]]:
    """Return the experiments in two topics, and notes about them.

    :param topics: the bag.
    :param wanted: the topics, as far as they are named, or the joint that they are of; a part
        that is named is one experiment, whatever it looks like.
    :raises SelectionError: if the names do not fit, or more than one pair does.
    :raises BagError: if nothing stands out of the noise.
    """
    first: list[str] = []
    measurement, command = wanted.measurement, wanted.command
    if wanted.joint:
        measurement, command, why = named_pair(topics, wanted)
        flags = " ".join(
            f"--{role} {shlex.quote(name)}"
            for role, name in (("measurement", measurement), ("command", command))
        )
        first = [f"using {flags}: {why}"]
    pair, notes = _pair(topics, measurement, command)
    notes = [*first, *notes]
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
    record = join(signals[0], preceded(signals[1], wanted.command_before))
    records, found = take_apart(record, whole=wanted.is_part)
    return records, [*notes, *found]


def take_apart(record: Record, *, whole: bool = False) -> tuple[list[Record], list[str]]:
    """Return the experiments in a record of unknown origin, and notes about them.

    :param record: the record.
    :param whole: whether it is one experiment, whatever it looks like.
    :raises BagError: if nothing stands out of the noise.
    """
    if whole or len(record) < _FEWEST_SAMPLES:
        return [record], []
    stretches = find_experiments(record)
    if not stretches:
        if np.ptp(record.measurement) == 0.0 or np.ptp(record.command) == 0.0:
            # The identification then tells why nothing can be learned from it.
            return [record], []
        raise BagError(
            "no relay phase, step, pulse or moving closed loop stands out of the noise: at rest "
            "a controller's command only follows the noise of the measurement, which would give "
            "a wrong model; record an experiment, or name a part to be used all the same with "
            "--start and --end"
        )
    records = [record.part(stretch.first, stretch.last + 1) for stretch in stretches]
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


def _pair(topics: Topics, measurement: str | None, command: str | None) -> tuple[Pair, list[str]]:
    if measurement is not None and command is not None:
        names = (
            _checked(topics, "measurement", measurement),
            _checked(topics, "command", command),
        )
        if names[0] == names[1]:
            raise SelectionError(
                f"{names[0]} was named as measurement and as command; expected two topics"
            )
        measured, commanded = topics.signals(names).values()
        return Pair(measured.signal, commanded.signal, "named"), []
    if measurement is not None:
        given = _checked(topics, "measurement", measurement)
        fits = [p for p in _plausible(topics, given) if p.measurement.name == given]
    elif command is not None:
        given = _checked(topics, "command", command)
        fits = [p for p in _plausible(topics, given) if p.command.name == given]
    else:
        fits = _plausible(topics)
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
        + ("; or name a joint with --joint" if has_joints(topics) else "")
    )
