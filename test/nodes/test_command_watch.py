# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""When commands that came over their topic count as silent, so that no gains fail by that."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from relay_autotune.nodes import verifier
from relay_autotune.nodes.verifier import CommandWatch


class Loop:
    """A loop on a clock of the test, whose samples are answered after 10 ms, or not at all."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 6310.0
        monkeypatch.setattr(verifier, "time", SimpleNamespace(monotonic=lambda: self.now))
        self.watch = CommandWatch()

    def run(self, seconds: float, every: float = 0.1, *, answered: bool = True) -> None:
        for _ in range(round(seconds / every)):
            self.watch.sample()
            if answered:
                self.now += 0.01
                self.watch.hear()
            self.now += every - 0.01 * answered


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Loop:
    return Loop(monkeypatch)


def test_commands_that_never_came_cannot_fall_silent(loop: Loop) -> None:
    """They go straight to the actuator; one that went astray changes nothing."""
    loop.run(60.0, answered=False)
    loop.watch.hear()
    loop.run(60.0, answered=False)
    assert loop.watch.too_long() == 0.0 == loop.watch.unsure()


@pytest.mark.parametrize(("every", "fails_by", "ends_by"), [(0.1, 1.0, 2.0), (1.0, 5.0, 20.0)])
def test_a_silence_ends_a_proof_and_before_that_lets_no_gains_fail(
    loop: Loop, every: float, fails_by: float, ends_by: float
) -> None:
    loop.run(60.0 * every, every)
    assert loop.watch.too_long() == 0.0 == loop.watch.unsure()
    loop.run(fails_by - every, every, answered=False)
    # A command may come yet.
    assert loop.watch.unsure() is None
    loop.run(2.0 * every, every, answered=False)
    assert loop.watch.unsure() == pytest.approx(fails_by + every)
    assert loop.watch.too_long() == 0.0
    loop.run(ends_by - fails_by, every, answered=False)
    assert loop.watch.too_long() == pytest.approx(ends_by + every)
    # A relay_node that was started anew: the next proof is none of the silence.
    loop.run(10.0 * every, every)
    assert loop.watch.too_long() == 0.0
    assert loop.watch.unsure() == pytest.approx(ends_by + every, rel=0.01)
    loop.watch.begin()
    assert loop.watch.unsure() == 0.0


def test_a_sensor_that_is_silent_is_no_silence_of_the_commands(loop: Loop) -> None:
    loop.run(6.0)
    loop.now += 60.0
    loop.run(0.1, answered=False)
    assert loop.watch.unsure() is None
    loop.run(0.1)
    assert loop.watch.unsure() == 0.0


def test_the_commands_of_a_tune_do_not_count(loop: Loop) -> None:
    loop.run(6.0)
    loop.watch.forget()
    loop.run(60.0, answered=False)
    assert loop.watch.too_long() == 0.0
