# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A table that a logger wrote: the command changed at some instant between two rows."""

from dataclasses import replace

import numpy as np
import pytest

from relay_autotune import DesignOptions, Known, Record, analyse, identify
from relay_autotune.errors import RecordError
from relay_autotune.record.excitation import find_experiments
from relay_autotune.tuning.of_record import warned_of_rows

pytestmark = pytest.mark.long

_GAIN, _LAGS, _DEAD_TIME = 1.1, (170.0, 38.0), 32.0


def _step_response(time: np.ndarray) -> np.ndarray:
    slow, fast = _LAGS
    t = np.maximum(time - _DEAD_TIME, 0.0)
    rest = (slow * np.exp(-t / slow) - fast * np.exp(-t / fast)) / (slow - fast)
    return _GAIN * (1.0 - rest)


def _logged(interval: float, instants: tuple[float, ...]) -> Record:
    time = np.arange(0.0, 5400.0, interval)
    noise = np.random.default_rng(0).normal(0.0, 0.05, time.size)
    moves = list(zip(instants, (5.0, -10.0, 5.0), strict=True))
    y = sum(size * _step_response(time - instant) for instant, size in moves) + noise
    u = sum(size * (time >= instant) for instant, size in moves)
    return Record(time=time, measurement=y, command=u)


def _true_ms(gains) -> float:
    s = 1j * np.geomspace(1e-4, 1.0, 4000)
    process = _GAIN * np.exp(-s * _DEAD_TIME) / np.prod([1.0 + tau * s for tau in _LAGS], axis=0)
    controller = gains.kc * (1.0 + 1.0 / (gains.ti * s) + gains.td * s) / (1.0 + gains.tf * s)
    return float(np.max(1.0 / np.abs(1.0 + process * controller)))


# Up to three quarters of an interval before the row that shows the change.
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("interval", "instants"),
    [(30.0, (609.0, 2240.0, 3906.0)), (60.0, (615.0, 2240.0, 3920.0))],
)
def test_a_faster_controller_gets_gains_that_hold_whenever_the_command_changed(interval, instants):
    asked = DesignOptions(sample_period=1.0)
    found = analyse(_logged(interval, instants), rule="robust", options=asked, alone=True)
    assert _true_ms(found.best_gains) < 1.5
    assert any("before its row" in warning for warning in found.model.warnings)


def _in_loop(*, late: int, doubled: bool = False) -> Record:
    """Return rows of a lag of 10 s with a dead time of one row, each 1 s.

    :param late: rows by which the command is logged after the measurement that it has moved.
    :param doubled: whether a row stands just before and just after each change.
    """
    u = np.repeat([0.0, 10.0, 20.0, 10.0, 0.0, -10.0, 0.0], 30)
    decay = np.exp(-0.1)
    y = np.zeros(u.size + 2)
    for k in range(u.size):
        y[k + 2] = decay * y[k + 1] + (1.0 - decay) * u[k]
    time, y = np.arange(u.size) * 1.0, y[: u.size]
    y += np.random.default_rng(0).normal(0.0, 0.1, u.size)
    logged = np.concatenate((u[:1].repeat(late), u[: u.size - late]))
    if doubled:
        at = np.flatnonzero(np.diff(u)) + 1
        time = np.insert(time, at, time[at] - 0.001)
        y, logged = np.insert(y, at, y[at]), np.insert(logged, at, u[at - 1])
    return Record(time=time, measurement=y, command=logged)


def _ms_of_loop(gains) -> float:
    s = 1j * np.geomspace(1e-3, 10.0, 4000)
    # The command is held for a row.
    process = np.exp(-1.5 * s) / (1.0 + 10.0 * s)
    law = gains.kc * (1.0 + 1.0 / (gains.ti * s) + gains.td * s)
    return float(np.max(1.0 / np.abs(1.0 + process * law / (1.0 + gains.tf * s))))


@pytest.mark.parametrize("late", [0, 1])
def test_gains_hold_whichever_came_first_in_a_row(late):
    found = analyse(_in_loop(late=late), alone=True)
    assert found.verdict.name == "TRUSTED"
    assert _ms_of_loop(found.best_gains) < 1.65
    (warning,) = (w for w in found.model.warnings if "before its row" in w)
    assert "up to 1.00 s" in warning


@pytest.mark.nightly
def test_rows_about_each_change_tell_when_it_came():
    found = analyse(_in_loop(late=0, doubled=True), alone=True)
    assert not any("before its row" in warning for warning in found.model.warnings)
    # As fast as Ms 1.4 allows, where rows alone leave 1.2.
    assert 1.35 < _ms_of_loop(found.best_gains) < 1.5


@pytest.mark.nightly
def test_rows_that_are_close_against_the_dead_time_are_told_nothing_of_it():
    found = analyse(_logged(2.0, (600.0, 2220.0, 3900.0)), rule="robust", alone=True)
    assert not any("before its row" in warning for warning in found.model.warnings)
    assert _true_ms(found.best_gains) < 1.5


@pytest.mark.nightly
def test_an_archive_of_changes_tells_when_the_command_moved():
    """Rows come where the measurement has moved by a band, or the command."""
    every = _logged(2.0, (600.0, 2240.0, 3906.0))
    y, u = every.measurement, every.command
    kept = [0]
    for i in range(1, y.size):
        if abs(y[i] - y[kept[-1]]) >= 0.2 or u[i] != u[kept[-1]]:
            kept.append(i)
    record = Record(time=every.time[kept], measurement=y[kept], command=u[kept])
    assert record.is_of_changes
    assert not every.is_of_changes
    found = analyse(record, rule="robust", alone=True)
    assert found.verdict.name == "TRUSTED"
    assert 1.2 < _true_ms(found.best_gains) < 1.5
    # The usual time between rows is that of a rest, and several times as long.
    assert record.interval >= 8.0
    assert "for a controller that runs every 2 s" in found.best_gains.reason


def test_a_part_of_a_table_tells_no_more_of_when_the_command_moved():
    record = _in_loop(late=1)
    assert record.unseen == record.part(40, len(record)).unseen == 1.0


def test_what_is_unseen_is_a_time():
    with pytest.raises(RecordError, match="unseen of the record is -1 s, expected a time from 0"):
        Record(time=[0.0, 1.0], measurement=[1.0, 2.0], command=[0.0, 1.0], unseen=-1.0)
    at_once = Record(time=[0.0, 0.0, 0.0], measurement=[1.0, 1.0, 3.0], command=[0.0, 1.0, 1.0])
    assert at_once.is_of_changes
    assert at_once.unseen == 0.0
    for size in (1, 2, 3):
        assert not find_experiments(at_once.part(0, size))


def test_where_nothing_is_unseen_nothing_is_said_of_it():
    """A method may read another K_u from the cycles than its model has."""
    record = replace(_in_loop(late=0), unseen=0.0)
    found = identify(record, "waveform", Known(structure="fopdt"))
    higher = replace(found, ultimate_gain=2.0 * found.ultimate_gain)
    assert warned_of_rows(higher, record) is higher
