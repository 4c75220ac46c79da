# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""No computation holds up another one, and none goes on for ever."""

import math
import threading
from concurrent.futures import Future, wait

import pytest

from relay_autotune.errors import TuningError
from relay_autotune.web.worker import Worker


def ended(worker: Worker, work: Future):
    """Tend a worker until something is computed."""
    while not wait([work], 0.001).done:
        worker.tend()
    return work


class Endless:
    """Something that takes for ever, unless it is told to end."""

    def __init__(self) -> None:
        self.begun, self.over = threading.Event(), False

    def __call__(self) -> str:
        self.begun.set()
        while not self.over:
            # No code on the way takes the end for an error of its own.
            try:
                math.sqrt(2.0)
            except Exception:  # noqa: BLE001
                continue
        return "over"


def test_what_is_asked_later_is_answered_before_what_takes_long():
    worker, endless = Worker(turn=0.01, longest=math.inf), Endless()
    first = worker.ask(endless)
    endless.begun.wait(30.0)
    for number in range(5):
        assert ended(worker, worker.ask(lambda number=number: number)).result() == number
    assert not first.done()
    # It begins again once nothing else is asked.
    endless.over = True
    assert ended(worker, first).result() == "over"
    worker.close()


def test_two_that_take_long_take_turns():
    worker, both = Worker(turn=0.001, longest=math.inf), [Endless(), Endless()]
    asked = [worker.ask(each) for each in both]
    for each in both * 3:
        each.begun.clear()
        while not each.begun.wait(0.001):
            worker.tend()
    both[0].over = both[1].over = True
    assert [ended(worker, each).result() for each in asked] == ["over", "over"]
    worker.close()


def test_what_nobody_waits_for_makes_way_at_once():
    worker, endless = Worker(turn=math.inf, longest=math.inf), Endless()
    first = worker.ask(endless)
    endless.begun.wait(30.0)
    first.cancel()
    assert ended(worker, worker.ask(lambda: 1)).result() == 1
    worker.close()


def test_what_takes_too_long_is_given_up_and_says_so():
    worker = Worker(longest=0.01)
    with pytest.raises(TuningError, match="to compute"):
        ended(worker, worker.ask(Endless())).result()
    assert ended(worker, worker.ask(lambda: 1)).result() == 1
    worker.close()


def test_an_error_belongs_to_whoever_asked():
    worker = Worker()
    with pytest.raises(ZeroDivisionError):
        ended(worker, worker.ask(lambda: 1 / 0)).result()
    assert ended(worker, worker.ask(lambda: 1)).result() == 1
    worker.close()


def test_nothing_is_lost_however_often_it_is_stopped():
    worker = Worker(turn=0.0, longest=math.inf)
    asked = [worker.ask(lambda n=n: sum(range(n))) for n in range(500)]
    for n, each in enumerate(asked):
        assert ended(worker, each).result() == sum(range(n))
    worker.close()
