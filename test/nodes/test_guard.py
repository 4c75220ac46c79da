"""An actuator that tells its position, and when it counts as one that does not follow."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from relay_autotune.nodes.guard import FollowWatch

LOW, HIGH = 0.5, 1.5
TIMEOUT = 0.4
EVERY = 0.01


def noticed(
    position: Callable[[float], float],
    stay: float,
    tolerance: Callable[[], float] = lambda: 0.25,
    end: float = 20.0,
) -> float:
    """Return when an actuator under a relay counts as one that does not follow; inf: never.

    :param position: over time [s].
    :param stay: of the relay at a level [s].
    """
    watch = FollowWatch(tolerance, TIMEOUT)
    for k in range(round(end / EVERY)):
        if watch.add(k * EVERY, command(k * EVERY, stay), position(k * EVERY)):
            return k * EVERY
    return float("inf")


def command(time: float, stay: float) -> float:
    return HIGH if int(time / stay + 1e-9) % 2 else LOW


@pytest.mark.parametrize("stay", [0.06, 0.35, 3.0])
@pytest.mark.parametrize("stuck_at", [LOW, 1.0, HIGH, 7.0])
def test_one_that_is_stuck_is_noticed_whether_the_relay_is_fast_or_slow(stay, stuck_at):
    began = 5.0
    found = noticed(lambda t: command(t, stay) if t < began else stuck_at, stay)
    assert began < found <= began + TIMEOUT + max(8.0 * stay, TIMEOUT) + EVERY


@pytest.mark.parametrize("stay", [0.06, 0.35, 3.0])
def test_one_that_lags_by_half_of_a_stay_follows(stay):
    lag = min(0.5 * stay, 0.5 * TIMEOUT)
    assert noticed(lambda t: command(max(t - lag, 0.0), stay), stay) == float("inf")


def test_one_that_lags_by_a_stay_does_not():
    stay = 0.1
    assert noticed(lambda t: command(max(t - stay, 0.0), stay), stay) < 3.0 * TIMEOUT


def test_what_is_told_late_for_less_than_the_timeout_is_no_fault():
    stay, held = 0.06, 0.35

    def position(time: float) -> float:
        since = time % 2.0
        return command(time - since if since < held else time, stay)

    assert noticed(position, stay) == float("inf")


def test_while_an_amplitude_is_found_no_distance_counts():
    stay, found = 0.06, 5.0
    told: list[float] = []

    def position(time: float) -> float:
        told.append(time)
        return LOW

    at = noticed(position, stay, lambda: float("inf") if told[-1] < found else 0.25)
    assert found < at < found + 2.0 * TIMEOUT
