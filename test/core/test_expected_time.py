# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How long a computation is expected to take."""

import time

import pytest
from analysed import relay_record

from relay_autotune.analysis import analyse
from relay_autotune.expected_time import expected_time


def test_a_machine_that_is_ten_times_slower_takes_ten_times_as_long():
    ticks = iter((0.0, 0.02, 0.0, 0.2))
    fast, slow = (expected_time(1000, clock=lambda: next(ticks)) for _ in range(2))
    assert slow == pytest.approx(10.0 * fast)


def test_two_records_take_the_time_of_both_and_other_methods_take_more():
    def frozen():
        ticks = iter((0.0, 0.02))
        return lambda: next(ticks)

    one, other = (expected_time(n, clock=frozen()) for n in (500, 5000))
    assert one < other < 2.0 * one
    assert expected_time(500, 5000, clock=frozen()) == pytest.approx(one + other)
    assert expected_time(500, alone=True, clock=frozen()) < one


@pytest.mark.nightly
def test_an_analysis_takes_about_as_long_as_is_said():
    record = relay_record()
    begun = time.process_time()
    analyse(record, alone=True)
    took = time.process_time() - begun
    assert 0.2 < took / expected_time(len(record), alone=True, clock=time.process_time) < 5.0
