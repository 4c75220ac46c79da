# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A fixed reference workload, so that times can be compared between machines.

Import this before numpy: it pins the linear algebra to one thread.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np

_RNG = np.random.default_rng(0)
_TIMES = np.sort(_RNG.uniform(0.0, 100.0, 20_000))
_EDGES = np.linspace(0.0, 100.0, 12)
_TALL = _RNG.standard_normal((1000, 4))
_ROUNDS = 12


@dataclass(frozen=True)
class Timing:
    """How long something took.

    :param seconds: median over the turns.
    :param multiple: median over the turns of its time divided by the reference's in that turn.
    """

    seconds: float
    multiple: float


def workload() -> float:
    """Do the operations of a fit in fixed amounts: exponentials, look-ups, tall QR factors."""
    total = 0.0
    for _ in range(_ROUNDS):
        decayed = np.exp(-_TIMES / 20.0)[np.searchsorted(_EDGES, _TIMES[::-1])]
        q, _ = np.linalg.qr(_TALL)
        total += float(decayed.sum() + np.abs(q[0]).sum())
    return total


def clocked(work: Callable[[], object]) -> float:
    """Return how long one call takes the processor, with the processes that it waits for [s].

    All of it runs in one thread. So this is the elapsed time on an idle machine, and nearly the
    same on a busy one.
    """
    start = _processor_time()
    work()
    return _processor_time() - start


def _processor_time() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def take_turns(
    works: Mapping[str, Callable[[], object]], turns: int, *, warm_up: bool = True
) -> dict[str, Timing]:
    """Time several pieces of work and the reference in turns, so that the conditions are equal.

    :param works: what is timed, by name.
    :param turns: how often each is timed.
    :param warm_up: True: after one turn that does not count.
    :return: for each name, and for "reference".
    """
    everything = {"reference": workload, **works}
    if warm_up:
        for work in everything.values():
            work()
    taken = np.array([[clocked(work) for work in everything.values()] for _ in range(turns)])
    medians = np.median(taken, axis=0)
    multiples = np.median(taken / taken[:, :1], axis=0)
    return {
        name: Timing(float(seconds), float(multiple))
        for name, seconds, multiple in zip(everything, medians, multiples, strict=True)
    }
