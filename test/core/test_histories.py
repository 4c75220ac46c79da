# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Random histories: whatever happens to the loop, an experiment ends, with a reason, in time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from fopdt_plant import FopdtPlant
from histories import History
from hypothesis import given, settings
from hypothesis import strategies as st

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import GAP, Samples
from relay_autotune.experiment.relay_law import MOST_COMPENSATED, OVERDUE, DwellFilter
from relay_autotune.record.record import Outcome

PART = 30


# Parts of one long list of random histories: the first ones show a fault that is common.
@pytest.mark.long
@pytest.mark.parametrize(
    "part", [0, 1, 2, *(pytest.param(k, marks=pytest.mark.nightly) for k in range(3, 30))]
)
def test_random_histories_end_within_their_bound(part):
    for seed in range(part * PART, (part + 1) * PART):
        history = History(seed)
        history.run()
        assert not history.problem, f"{history.problem}: {history}"


def test_a_stay_that_only_shifts_of_the_levels_end_grants_the_next_no_longer_one():
    # An actuator with a third of its gain: the weaker level never passes the band by itself.
    history = History(1625)
    tune = history.run()
    assert not history.problem, f"{history.problem}: {history}"
    assert f"{MOST_COMPENSATED} stays ended only when the levels were shifted" in tune.reason
    time, _, command = tune.samples(0, tune.sample_count)
    # Shifts only make a level larger in its own direction, within a stay.
    rises = np.sign(command - tune.settings.baseline)
    turns = np.flatnonzero(np.diff(rises)) + 1
    stays = np.diff(time[turns])
    own = history.limit.period * history.period
    # The patience of the limit cycle with its bias, and twice half of it again.
    assert stays.max() < 2.0 * 10.0 * (1.3 / 0.7) * own
    assert history.samples < 0.05 * history.bound


def disturbed(begin, length, *, kind, min_cycles=3, period=0.01, samples=20_000):
    """Run an experiment on a process with a period of about 0.5 s that something happens to."""
    plant, tune = (
        FopdtPlant(1.0, 1.0, 0.1),
        RelayExperiment(
            ExperimentParameters(amplitude=1.0, process_gain_sign=1, min_cycles=min_cycles), 0.0
        ),
    )
    command, acting, now = 0.0, 0.0, 0.0
    for k in range(samples):
        acts = tune.facts.kicked_at + begin <= k * period < tune.facts.kicked_at + begin + length
        if not (acts and kind == "stuck"):
            acting = command
        load = 0.5 if acts and kind == "load" else 0.0
        y = plant.advance(k * period, acting + load)
        if acts and kind == "gap":
            continue
        if kind == "clock" and acts and now == 0.0:
            now = length
        command = tune.step(k * period + now, y)
        if tune.finished:
            break
    return tune


@pytest.mark.parametrize("begin", [0.25, 0.6, 0.75, 1.0, 1.2])
@pytest.mark.parametrize("kind", ["stuck", "load"])
def test_one_long_stay_is_no_end_of_all_cycles(kind, begin):
    tune = disturbed(begin, 2.5, kind=kind)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert tune.cycles[-1].converged
    undisturbed = disturbed(9e9, 0.0, kind=kind).cycles[-1].period
    # Levels that were shifted for a load stay so, and one half cycle is longer then.
    most = 1.15 if kind == "stuck" else 2.5
    assert 0.9 * undisturbed < tune.cycles[-1].period < most * undisturbed
    assert tune.elapsed < 60.0
    assert tune.switches < 150


@pytest.mark.long
@pytest.mark.parametrize("size", [0.3, 3.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("kind", ["gap", "clock"])
def test_a_gap_and_a_step_of_the_clock_count_as_no_more_than_some_samples(kind, size):
    if kind == "gap" and size > 1e3:
        pytest.skip("a process that goes on for so long takes too long to simulate")
    for begin in (0.35, 0.8, 1.15):
        tune = disturbed(begin, size, kind=kind, samples=120_000)
        assert tune.finished
        assert tune.sample_count < 120 + 12 * 50 + 3 * OVERDUE * GAP, tune.reason


def test_fast_switching_after_slow_cycles_ends_it():
    plant, command = FopdtPlant(1.0, 1.0, 1.0), 0.0
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0, min_cycles=12), 0.0)
    for k in range(20_000):
        y = plant.advance(0.02 * k, command)
        if len(tune.cycles) == 2:
            # A loose contact.
            y = 0.3 * (-1) ** (k // 2)
        command = tune.step(0.02 * k, y)
        if tune.finished:
            break
    assert tune.outcome is Outcome.FAILED
    assert "the relay switches fast, 40 times with at most one stay of 0.5 times" in tune.reason
    cycle = tune.cycles[0].period
    assert tune.elapsed < tune.cycles[-1].start + cycle + 3.0 * cycle + 2.0


@pytest.mark.parametrize("late", [0.0, 0.005])
@pytest.mark.parametrize("seed", range(5))
def test_short_cycles_that_look_whole_are_fast_switching_too(seed, late):
    rng, t = np.random.default_rng(seed), 0.0
    plant, command, broken_at = FopdtPlant(2.0, 0.05, 0.025), 0.0, math.inf
    parameters = ExperimentParameters(
        amplitude=0.5, process_gain_sign=1, settle_time=0.1, min_cycles=100, max_cycles=100
    )
    tune, after = RelayExperiment(parameters, 0.0), rng.uniform()
    for k in range(4_000):
        # Three of ten samples come late on a busy machine.
        t += 0.005 + (rng.exponential(late) if rng.random() < 0.3 else 0.0)
        y = plant.advance(t, command) + 1e-4 * math.sin(7.0 * k**2)
        if tune.cycles:
            broken_at = min(broken_at, t + after)
        if t >= broken_at:
            # Each sample lies on the other side of the relay's band.
            y = 0.3 * (-1) ** k
        command = tune.step(t, y)
        if tune.finished:
            break
    assert tune.outcome is Outcome.FAILED, tune.reason
    assert "the relay switches fast" in tune.reason


def test_stays_that_are_too_unlike_for_a_cycle_are_counted_all_the_same():
    tune, command, k = (
        RelayExperiment(
            ExperimentParameters(
                amplitude=1.0, process_gain_sign=1, settle_time=1.0, max_cycles=7
            ),
            0.0,
        ),
        0.0,
        0,
    )
    # It falls at once, and rises ever so slowly.
    while not tune.finished and k < 100_000:
        y = 0.5 if k % 100 == 99 else -0.5
        command = tune.step(0.01 * k, y if k > 150 else 0.0)
        k += 1
    assert tune.outcome is Outcome.FAILED, tune.reason
    assert "max_cycles, 7, are over" in tune.reason
    assert k < 150 + 9 * 4 * 100
    assert command == 0.0


def test_whatever_is_counted_it_lasts_no_longer_than_its_parts(monkeypatch):
    # Let the count of cycles be lost altogether.
    monkeypatch.setattr(DwellFilter, "add", lambda *_, **__: False)
    monkeypatch.setattr(DwellFilter, "is_overdue", lambda *_: False)
    tune = disturbed(9e9, 0.0, kind="load", samples=60_000)
    assert tune.outcome is Outcome.FAILED
    assert "longer than its parts may take" in tune.reason


@settings(max_examples=50)
@given(
    intervals=st.lists(st.floats(0.5, 1.5), min_size=2, max_size=80),
    at=st.integers(0, 79),
    gap=st.floats(0.0, 1e9),
)
def test_gaps_are_taken_out_of_the_time_and_nothing_else_is(intervals, at, gap):
    plain, torn = Samples(), Samples()
    at %= len(intervals)
    time = late = 0.0
    for k, interval in enumerate((0.0, *intervals)):
        time += interval
        late += interval + (gap if k == at + 1 else 0.0)
        plain.add(time, 0.0)
        torn.add(late, 0.0)
    assert plain.seen == plain.time
    # One interval alone may be a gap or not.
    if len(intervals) > 1:
        assert torn.seen[-1] <= time + min(gap, 1.5 * GAP * 1.5) + 1e-6 * (1.0 + gap)
    assert math.isfinite(torn.interval)


def test_samples_of_one_instant_take_no_time():
    coarse = Samples()
    for k in range(5000):
        coarse.add(0.1 * (k // 100), 0.0)
    assert coarse.seen == coarse.time
