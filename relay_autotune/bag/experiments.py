# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The experiments of relay_node in a bag: whole ones, and one that was cut short."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from relay_autotune.arrays import IntArray
from relay_autotune.bag.names import CYCLE, EXPERIMENT, EXPERIMENT_METADATA, FLOAT64
from relay_autotune.bag.topics import Topics
from relay_autotune.errors import BagError, RecordError
from relay_autotune.exchange.messages import (
    record_from_message,
    settings_from_message,
    stamp_nanoseconds,
    start_seconds,
)
from relay_autotune.record.record import Outcome, Record

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
    for number, message in enumerate(topics.decoded(EXPERIMENT)):
        key = str(message.experiment_id) or f"number {number}"
        try:
            records.setdefault(key, record_from_message(message))
        except (RecordError, TypeError, ValueError, AttributeError) as error:
            said = f"; it ended because: {message.reason}" if message.reason else ""
            refused.append(f"experiment {key} in {topics.path} is of no use: {error}{said}")
    if refused and not records:
        raise BagError(refused[0])
    return list(records.values()), refused


def interrupted_experiment(topics: Topics) -> Record | None:
    """Return the experiment that was being recorded when relay_node was killed.

    :param topics: the bag; one that relay_node wrote says which topics are the loop's.
    :return: None if the bag is not one of relay_node.
    :raises BagError: if it ends before the first sample was answered.
    """
    for about in topics.metadata(EXPERIMENT_METADATA):
        if {"measurement", "command", "experiment_id"} <= about.keys():
            return _rebuilt(topics, about)
    return None


def _rebuilt(topics: Topics, about: Mapping[str, str]) -> Record:
    names = (about["measurement"], about["command"])
    found = topics.columns(names, FLOAT64)
    if set(found) != set(names):
        raise BagError(f"{topics.path} ends before the first sample of its experiment")
    samples, answers = (found[name] for name in names)
    # Here each sample is followed by its answer, before the next one; the last may be missing.
    answer = np.searchsorted(answers.order, samples.order)
    following = np.append(samples.order[1:], np.iinfo(np.int64).max)
    answered = answer < len(answers)
    answered[answered] = answers.order[answer[answered]] < following[answered]
    if not bool(np.any(answered)):
        raise BagError(f"{topics.path} ends before the first sample of its experiment")
    answer = answer[answered]
    taken = samples.publish_time[answered]
    origin = int(taken[0])
    cycles = _unbroken(topics.decoded(CYCLE))
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


def _unbroken(cycles: Sequence[Any]) -> list[Any]:
    """Return the cycles without a gap in their numbers up to the newest, in order."""
    by_index = {int(cycle.index): cycle for cycle in cycles}
    run: list[Any] = []
    index = max(by_index, default=-1)
    while index in by_index:
        run.insert(0, by_index[index])
        index -= 1
    return run


def _cycle_start(cycles: Sequence[Any], taken: IntArray) -> tuple[int, ...]:
    """Return the samples that bound the cycles.

    :param cycles: their messages, in order and without a gap.
    :param taken: time of each sample [ns], shape (n,).
    """
    bounds: list[int] = []
    for cycle in cycles:
        stamp = stamp_nanoseconds(cycle.header.stamp)
        lead_in = min(int(cycle.lead_in), max(len(cycle.time) - 1, 0))
        bounds += [stamp + round(float(t) * 1e9) for t in cycle.time[lead_in:][:1]]
    bounds += [
        stamp_nanoseconds(cycle.header.stamp) + round(float(cycle.time[-1]) * 1e9)
        for cycle in cycles[-1:]
        if len(cycle.time)
    ]
    # The stamps went through seconds in double precision.
    near = np.searchsorted(taken, np.array(bounds, dtype=np.int64) - _STAMP_ERROR_NS)
    return tuple(sorted({int(i) for i in near if i < taken.size}))
