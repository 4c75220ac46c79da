# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The actuator's limits, play and stiction, each against its definition."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_autotune.errors import ParameterError
from relay_autotune.process.virtual_process import Actuator

COMMANDS = st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=50)


def test_an_ideal_actuator_follows_exactly() -> None:
    actuator = Actuator(0.3)
    assert [actuator.move(u) for u in (0.3, -2.0, 7.5)] == [0.3, -2.0, 7.5]


def test_limits_hold_the_position() -> None:
    actuator = Actuator(0.0, minimum=-1.0, maximum=2.0)
    assert [actuator.move(u) for u in (-5.0, 5.0, 1.0)] == [-1.0, 2.0, 1.0]


def test_play_is_lost_at_each_reversal() -> None:
    actuator = Actuator(0.0, dead_band=1.0)
    # Up: half the play behind; back down: nothing happens until the whole play is passed.
    assert [actuator.move(u) for u in (2.0, 1.5, 1.0, 0.5)] == [1.5, 1.5, 1.5, 1.0]


def test_stiction_holds_and_then_jumps() -> None:
    actuator = Actuator(0.0, stiction=0.5)
    assert [actuator.move(u) for u in (0.5, 0.6, 0.2, 0.05)] == [0.0, 0.6, 0.6, 0.05]


def test_a_command_that_is_not_finite_is_not_followed() -> None:
    actuator = Actuator(1.0)
    assert [actuator.move(u) for u in (math.nan, math.inf, -math.inf)] == [1.0, 1.0, 1.0]


@given(COMMANDS, st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_the_position_stays_near_the_command_and_within_limits(
    commands: list[float], dead_band: float, stiction: float
) -> None:
    actuator = Actuator(0.0, minimum=-4.0, maximum=5.0, dead_band=dead_band, stiction=stiction)
    for u in commands:
        position = actuator.move(u)
        assert -4.0 <= position <= 5.0
        wanted = min(max(u, -4.0), 5.0)
        assert abs(position - wanted) <= 0.5 * dead_band + stiction + 1e-12


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"minimum": 1.0, "maximum": 1.0}, "lower limit must be below"),
        ({"minimum": 1.0}, "cannot start at 0"),
        ({"dead_band": -1.0}, "dead_band is -1, expected at least 0 u"),
        ({"stiction": math.nan}, "stiction is nan, expected at least 0 u"),
    ],
)
def test_what_cannot_be_is_refused(arguments: dict[str, float], said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        Actuator(0.0, **arguments)
