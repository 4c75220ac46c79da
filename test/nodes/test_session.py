# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The time base and the stamps of a running experiment."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from relay_autotune.errors import RecordError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.nodes.quality import QUIET_AFTER_GO
from relay_autotune.nodes.session import Session

# Recordings that nobody looks at.
UNKEPT = SimpleNamespace(sample=lambda _: None)


def experiment(sample_period: float = 0.0) -> RelayExperiment:
    parameters = ExperimentParameters(
        amplitude=1.0, settle_time=100.0, sample_period=sample_period
    )
    return RelayExperiment(parameters, 0.5, "one")


def test_samples_are_timed_by_their_source_stamps() -> None:
    kept: list[Any] = []
    session = Session(experiment(), SimpleNamespace(sample=kept.append))
    start = 1_700_000_000_000_000_000
    for k, source in enumerate((start, start + 90_000_001, start + 210_000_000)):
        before = time.time_ns()
        assert session.answer(float(k), source, source + 5_000) == 0.5
        session.answered()
        assert before <= kept[-1][3] <= time.time_ns()
    record = session.record()
    assert record.time == pytest.approx([0.0, 0.090000001, 0.21], abs=1e-15)
    assert record.receive_time == pytest.approx(record.time + 5e-6, abs=1e-12)
    assert [k[:3] for k in kept][1] == (start + 90_005_001, start + 90_000_001, 1.0)
    assert record.start == pytest.approx(1.7e9)
    assert np.all(record.command == 0.5)


def test_where_the_stamps_are_the_only_clock_a_simulation_may_run_at_any_pace() -> None:
    session = Session(experiment(), UNKEPT, one_clock=True)
    for k in range(300):
        # Half as fast as our clock, which the stamps would otherwise be held against.
        assert session.answer(1.0, 10_000_000 * (k + 1), 20_000_000 * k) == 0.5
        session.answered()
    assert not session.experiment.finished
    record = session.record()
    assert record.time == pytest.approx(0.01 * np.arange(300))
    assert np.array_equal(record.receive_time, record.time)
    assert np.array_equal(record.command_time, record.time)


def test_without_source_stamps_the_arrival_counts() -> None:
    session = Session(experiment(), UNKEPT)
    for received in (10, 30, 60):
        session.answer(0.0, None, received * 10**9)
        session.answered()
    assert list(session.record().time) == pytest.approx([0.0, 20.0, 50.0])


def test_simulated_time_is_the_clocks() -> None:
    now = iter([5_000_000_000, 5_000_000_000, 5_100_000_000, 5_100_000_000])
    session = Session(experiment(), UNKEPT, clock=lambda: next(now))
    for _ in range(2):
        session.answer(0.0, time.time_ns(), time.time_ns())
        session.answered()
    record = session.record()
    assert list(record.time) == pytest.approx([0.0, 0.1])
    assert list(record.command_time) == pytest.approx([0.0, 0.1])
    assert record.start == 5.0


def test_repeated_samples_and_arrivals_are_of_one_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Any] = []
    session = Session(experiment(), SimpleNamespace(sample=kept.append), repeats=True)
    start = 1_700_000_000_000_000_000
    # The sensor's own clock is behind, and it was silent when the tune began.
    steps = [(0, True), (20, True), (33, False), (53, True), (52, False), (52, False), (60, False)]
    for milliseconds, repeated in steps:
        now = start + milliseconds * 1_000_000
        monkeypatch.setattr(time, "time_ns", lambda now=now: now)
        if repeated:
            session.repeat(4.0)
        else:
            session.answer(4.5, now - 5_000_000_000, now)
        session.answered()
    # What waited while a value was repeated counts from then on.
    expected = [0.0, 0.02, 0.033, 0.053, 0.053, 0.053, 0.06]
    record = session.record()
    assert record.time == pytest.approx(expected, abs=1e-12)
    assert record.receive_time == pytest.approx(expected, abs=1e-12)
    assert not session.experiment.finished, session.experiment.reason
    assert [k[2] for k in kept] == [4.0, 4.0, 4.5, 4.0, 4.5, 4.5, 4.5]


def test_a_simulated_clock_that_goes_back_is_noticed_while_the_sensor_is_silent() -> None:
    now = [5_000_000_000]
    session = Session(experiment(), UNKEPT, clock=lambda: now[0], repeats=True)
    session.answer(4.0, time.time_ns(), time.time_ns())
    session.answered()
    now[0] = 5_400_000_000
    assert session.repeat(4.0) == 0.5
    session.answered()
    assert session.record().time == pytest.approx([0.0, 0.4])
    now[0] = 1_000_000_000
    session.repeat(4.0)
    assert session.experiment.finished
    assert "time went backwards" in session.experiment.reason


class Lockstep:
    """A session by sample number, whose first sample was answered just now."""

    def __init__(self) -> None:
        self.session = Session(experiment(sample_period=0.1), UNKEPT)
        self.session.answer(7.0, time.time_ns(), None)
        self.answered_at = time.time_ns()
        self.session.answered()

    def take(self, value: float, after: float) -> float | None:
        stamp = self.answered_at + round(after * 1e9)
        answer = self.session.answer(value, stamp, None)
        if answer is not None:
            self.session.answered()
        return answer


def test_sample_k_is_at_k_periods() -> None:
    loop = Lockstep()
    for k in range(1, 4):
        assert loop.take(7.0 + k, 0.02 * k) == 0.5
    record = loop.session.record()
    assert list(record.time) == [k * 0.1 for k in range(4)]
    assert list(record.command_time) == list(record.time)


def test_what_was_sent_before_the_first_answer_is_a_repeat() -> None:
    loop = Lockstep()
    assert loop.take(7.0, -0.15) is None
    assert loop.take(7.0, -0.05) is None
    assert loop.take(7.5, 0.02) == 0.5
    assert loop.session.sample_count == 2


def test_what_crossed_the_first_answer_is_a_repeat() -> None:
    loop = Lockstep()
    assert loop.take(7.0, 0.2 * QUIET_AFTER_GO) is None
    assert loop.session.may_be_no_repeat
    # Sample 1 may say the same, but not as early.
    assert loop.take(7.0, QUIET_AFTER_GO) == 0.5
    assert loop.session.answer_after_all() is None
    assert loop.session.sample_count == 2


def test_another_value_is_no_repeat() -> None:
    assert Lockstep().take(7.1, 0.2 * QUIET_AFTER_GO) == 0.5


def test_a_sample_taken_for_a_repeat_is_answered_if_none_follows() -> None:
    loop = Lockstep()
    assert loop.take(7.0, 0.2 * QUIET_AFTER_GO) is None
    assert loop.session.answer_after_all() == 0.5
    loop.session.answered()
    assert loop.session.answer_after_all() is None
    assert list(loop.session.record().measurement) == [7.0, 7.0]


def test_without_a_sample_there_is_no_record() -> None:
    with pytest.raises(RecordError, match="found none"):
        Session(experiment(), UNKEPT).record()
