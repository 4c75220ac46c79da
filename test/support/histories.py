# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Random histories of a relay experiment: events of any kind, at any time, of any length.

A history has a process, parameters and one to four events. Each event has its own begin and its
own length, from a fraction of the process's period to hundreds of periods. A history must end
within a bound that is known before it begins; see :func:`bound`.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import GAP, KICK_LIMIT, KICK_SETTLINGS
from relay_autotune.experiment.relay_law import MOST_COMPENSATED, OVERDUE, OVERDUE_SAMPLES
from relay_autotune.record.record import Outcome

HAPPENINGS = (
    *("stuck actuator", "weak actuator", "gap", "load", "clock ahead", "clock back"),
    *("repeated samples", "lost samples", "swapped samples", "silent sensor", "spike"),
)
# One in this many events lasts until the end.
_FOR_GOOD = 8
# Reserve of the bound for the growth of an amplitude that is not given, and for a reversed sign.
_GROWTHS = 20
# Samples at rest before the kick.
SETTLING = 56


class Lags:
    """A process in discrete time: a dead time, lags, and possibly an integrator.

    :param gain: static gain [y/u], or per sample for an integrator.
    :param lags: their time constants [samples].
    :param dead_time: [samples].
    :param integrates: True: an integrator follows the lags.
    """

    def __init__(
        self, gain: float, lags: tuple[float, ...], dead_time: int, *, integrates: bool = False
    ) -> None:
        self.gain, self.integrates = gain, integrates
        self.shares = [-math.expm1(-1.0 / lag) for lag in lags]
        self.states = [0.0] * len(lags)
        self.sum = 0.0
        self.on_the_way = deque([0.0] * dead_time)

    def advance(self, command: float) -> float:
        """Hold a command for one sample interval; return the measurement at its end."""
        self.on_the_way.append(command)
        x = self.gain * self.on_the_way.popleft()
        for k, share in enumerate(self.shares):
            x = self.states[k] = self.states[k] + share * (x - self.states[k])
        if self.integrates:
            self.sum += x
            return self.sum
        return x


def _fopdt(lag: float, dead_time: int, gain: float = 1.0) -> Lags:
    return Lags(gain, (lag,), dead_time)


PROCESSES = {
    "lag 20, dead time 1": lambda: _fopdt(20.0, 1),
    "lag 20, dead time 4": lambda: _fopdt(20.0, 4),
    "lag 10, dead time 10": lambda: _fopdt(10.0, 10, -2.5),
    "lag 4, dead time 20": lambda: _fopdt(4.0, 20),
    "two lags 20 and 5, dead time 3": lambda: Lags(0.4, (20.0, 5.0), 3),
    "four lags 5": lambda: Lags(1.7, (5.0,) * 4, 0),
    "integrator, lag 5, dead time 3": lambda: Lags(0.05, (5.0,), 3, integrates=True),
    "integrator, dead time 5": lambda: Lags(-0.1, (), 5, integrates=True),
}
"""Processes by name, their times in sample intervals."""


@dataclass(frozen=True)
class Limit:
    """The limit cycle of a process under a relay of amplitude 1 with the default bias.

    :param period: [samples].
    :param swing: half the distance of its peaks [y].
    """

    period: int
    swing: float


def _limit_cycle(name: str) -> Limit:
    plant = PROCESSES[name]()
    sign = math.copysign(1.0, plant.gain)
    high, ups, seen = True, [], []
    for k in range(2000):
        seen.append(plant.advance(1.3 if high else -0.7))
        if high != (sign * seen[-1] < 0.0 or (high and sign * seen[-1] == 0.0)):
            high = not high
            if high:
                ups.append(k)
    last = seen[ups[-2] : ups[-1]]
    return Limit(ups[-1] - ups[-2], 0.5 * (max(last) - min(last)))


LIMITS = {name: _limit_cycle(name) for name in PROCESSES}


@dataclass
class Happening:
    """An event in a loop, from a sample on, for a number of samples.

    :param kind: one of HAPPENINGS.
    :param begin: first sample.
    :param length: number of samples; not used for a step of a clock.
    :param size: size of a load [u], of a step of a clock [sample intervals], of a spike [y]; for
        lost or repeated samples, their share.
    """

    kind: str
    begin: int
    length: int
    size: float

    def acts(self, k: int) -> bool:
        return self.begin <= k < self.begin + self.length


@dataclass
class History:
    """One history, drawn from a seed and run to its end.

    :param seed: seed of all its random numbers.
    """

    seed: int
    process: str = ""
    given: dict[str, Any] = field(default_factory=dict)
    happenings: list[Happening] = field(default_factory=list)
    samples: int = 0
    """Number of samples given to the experiment after its settling."""
    tune: RelayExperiment = field(init=False)

    def __post_init__(self) -> None:
        rng = self._rng = np.random.default_rng((self.seed, 13))
        self.process = str(rng.choice(list(PROCESSES)))
        self.plant = PROCESSES[self.process]()
        self.limit = LIMITS[self.process]
        self.period = float(np.exp(rng.uniform(math.log(0.3), math.log(10.0))))
        self.noise = float(rng.choice([0.0, 0.01, 0.05])) * self.limit.swing
        self.given = self._parameters()
        count = int(rng.integers(1, 5))
        self.happenings = [self._happening() for _ in range(count)]
        until_converged = bool(rng.uniform() < 0.9)
        self.tune = RelayExperiment(
            ExperimentParameters(**self.given), 0.0, until_converged=until_converged
        )

    def _parameters(self) -> dict[str, Any]:
        rng = self._rng
        given: dict[str, Any] = {"amplitude": 1.0, "settle_time": (SETTLING - 1) * self.period}
        if rng.uniform() < 0.2:
            given |= {"amplitude": 0.0, "command_min": -3.0, "command_max": 3.0}
        elif rng.uniform() < 0.3:
            given["bias_ratio"] = float(rng.choice([0.0, -0.3, 0.6]))
        if rng.uniform() < 0.5:
            given["process_gain_sign"] = int(math.copysign(1, self.plant.gain))
        if rng.uniform() < 0.2:
            given["hysteresis"] = float(rng.uniform(0.05, 0.5)) * self.limit.swing
        if rng.uniform() < 0.2:
            given["max_cycles"] = int(rng.integers(3, 30))
        if rng.uniform() < 0.1:
            given["extra_delay"] = float(rng.uniform(0.0, 0.5)) * self.limit.period * self.period
        if rng.uniform() < 0.1:
            given["command_rate"] = 2.0 / (self.period * rng.uniform(1.0, 5.0))
        return given

    def _happening(self) -> Happening:
        rng, period = self._rng, self.limit.period
        kind = str(rng.choice(HAPPENINGS))
        begin = SETTLING + int(rng.uniform(0.0, 8.0 * period))
        length = max(1, int(period * np.exp(rng.uniform(math.log(0.05), math.log(100.0)))))
        if rng.integers(_FOR_GOOD) == 0:
            length = 10**9
        size = float(rng.uniform(0.02, 0.6))
        match kind:
            case "load":
                size = float(rng.uniform(-2.0, 2.0))
            case "clock ahead" | "clock back":
                size = float(np.exp(rng.uniform(math.log(0.01), math.log(1e9)))) * period
            case "spike":
                size = float(rng.normal()) * self.limit.swing * 10.0 ** rng.uniform(-1.0, 3.0)
                length = int(rng.integers(1, 4))
        if kind in ("gap", "silent sensor"):
            # The node, and not the experiment, watches for a silent sensor.
            length = min(length, 100 * period)
        return Happening(kind, begin, length, size)

    @property
    def bound(self) -> int:
        """Largest number of samples after the settling; see docs/safety.md.

        With P the longest stay of the relay: no longer than the disturbances last together, and
        than half a period of a relay as unequal as this one. A cycle takes two of them, and one
        that cannot be told three or 200 samples more; the last stay may last ten times as long,
        and more with a bias, and half of it twice again while the levels are shifted, and so may
        those few before it that only shifts of the levels ended.
        """
        p = self.tune.parameters
        bias = 0.3 if p.finds_amplitude else abs(p.relay_bias)
        unequal = (1.0 + bias) / (1.0 - bias)
        rate = 0 if p.command_rate == 0.0 else 5
        own = unequal * (3.0 * self.limit.period + rate) + 2.0 * p.extra_delay / self.period
        stay = own + sum(self._lasts(h) for h in self.happenings)
        turns = p.max_cycles + (_GROWTHS if p.finds_amplitude else 1)
        patience = (1 + MOST_COMPENSATED) * 2.0 * max(10.0 * unequal * stay, OVERDUE_SAMPLES)
        kick = 2.0 * max(KICK_LIMIT / self.period, KICK_SETTLINGS * SETTLING) + 100.0 * stay
        return int(turns * (2.0 * stay + max(OVERDUE * stay, OVERDUE_SAMPLES)) + patience + kick)

    def _lasts(self, happening: Happening) -> float:
        """Return the duration of a disturbance's effect [samples]; 0 for a permanent one."""
        if happening.kind in ("gap", "clock ahead"):
            longest = happening.size if happening.kind == "clock ahead" else happening.length
            return min(longest, GAP)
        return 0.0 if happening.length >= 10**9 else min(float(happening.length), 1e6)

    def run(self) -> RelayExperiment:
        """Run the history until it ends, or exceeds the bound."""
        rng, tune, period = self._rng, self.tune, self.period
        command, last, ahead, held = 0.0, math.nan, 0.0, math.nan
        late: tuple[float, float] | None = None
        for k in itertools.count():
            acting = [h for h in self.happenings if h.acts(k)]
            kinds = {h.kind for h in acting}
            load = sum(h.size for h in acting if h.kind == "load")
            if "stuck actuator" in kinds:
                held = command if math.isnan(held) else held
            else:
                held = math.nan
            moved = command if math.isnan(held) else held
            moved *= math.prod(h.size for h in acting if h.kind == "weak actuator")
            y = self.plant.advance(moved + load) + self.noise * rng.standard_normal()
            for h in self.happenings:
                if h.begin == k and h.kind == "clock ahead":
                    ahead += h.size
                elif h.begin == k and h.kind == "clock back":
                    ahead -= h.size
            y += sum(h.size for h in acting if h.kind == "spike")
            lost = sum(h.size for h in acting if h.kind == "lost samples")
            if kinds & {"gap"} or (lost and rng.uniform() < lost):
                if k > self.bound + 100 * max(h.length for h in self.happenings):
                    break
                continue
            at = (k + ahead) * period
            repeated = "silent sensor" in kinds and not math.isnan(last)
            if repeated:
                command = tune.repeat(at, last)
            elif "swapped samples" in kinds and late is None and rng.uniform() < 0.3:
                # Deliver it after the next sample.
                late = (at, y)
                continue
            else:
                command = tune.step(at, y)
                last = y
            if late is not None:
                command = tune.step(*late)
                late = None
            share = sum(h.size for h in acting if h.kind == "repeated samples")
            while share and rng.uniform() < min(share, 0.9):
                command = tune.step(at, y)
            self.samples = tune.sample_count - SETTLING
            if tune.finished or self.samples > self.bound:
                break
        return tune

    @property
    def problem(self) -> str:
        """The violated requirement after :meth:`run`; empty: all is right."""
        tune = self.tune
        if not tune.finished:
            return f"it goes on after {self.samples} samples, the bound is {self.bound}"
        if not tune.reason:
            return "it gave no reason"
        if tune.after_end(0.0) != tune.safe_command:
            return "its last command is not the safe one"
        if tune.outcome is Outcome.COMPLETED and tune.switches < 2:
            return "it completed without a half cycle"
        return ""

    def __str__(self) -> str:
        told = ", ".join(
            f"{h.kind} from {h.begin} for {h.length} of {h.size:.3g}" for h in self.happenings
        )
        return f"history {self.seed}: {self.process}, {self.given}; {told}"
