# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Processes of every structure, those of the papers among them, and noisy records of each."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np

from relay_autotune.process.structures import (
    INTEGRATOR_INVERSE,
    INTEGRATOR_LAG,
    IPDT,
    LAG_COMPLEX,
    LAG_N_ZERO,
    THREE_LAGS,
    TWO_EQUAL_ONE,
    UNSTABLE_FOPDT,
    UNSTABLE_SOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint, ultimate_point
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))
from relay_runs import RelayRun, simulate_relay
from sampled_relay import exact_limit_cycle, simulate_sampled_relay

PER_CYCLE = 200


@dataclass(frozen=True)
class Process:
    """A process under an ideal relay of amplitude 1, at rest at zero before the first kick.

    :param title: the process as people write it.
    :param model: the process.
    :param bias: of the relay [u].
    :param cycles: length of the record in limit cycles.
    :param extra_delay: dead time that the relay adds [s].
    """

    title: str
    model: TransferFunction
    bias: float = 0.0
    cycles: int = 5
    extra_delay: float = 0.0

    @cached_property
    def truth(self) -> UltimatePoint:
        """The true ultimate point."""
        return true_point(self.model)

    @cached_property
    def run(self) -> RelayRun:
        """The ideal experiment, 200 samples for each limit cycle from the kick on."""
        settings = RelaySettings(0.0, 0.0, 1.0, self.bias, 0.0, self.extra_delay)
        period = exact_limit_cycle(self.model, settings, tolerance=1e-6).period / PER_CYCLE
        time = period * np.arange(PER_CYCLE * self.cycles)
        return simulate_relay(self.model, settings, cycles=self.cycles + 2, time=time)

    def record(self, ratio: float, seed: int, *, relay_sees_noise: bool = False) -> Record:
        """Return one noisy experiment.

        :param ratio: noise-to-signal ratio.
        :param seed: of the noise.
        :param relay_sees_noise: False: the relay is ideal and switches between samples; True: it
            looks at the noisy samples, with the hysteresis that relay_node would choose, three
            standard deviations.
        """
        std = noise_std(self.run, ratio)
        rng = np.random.default_rng((seed, round(1000.0 * ratio), *self.title.encode()))
        if not relay_sees_noise:
            return self.run.record(noise_std=std, rng=rng)
        noise = std * rng.standard_normal(self.run.time.size)
        settings = replace(self.run.settings, hysteresis=3.0 * std)
        period = float(self.run.time[1])
        record = simulate_sampled_relay(self.model, settings, period=period, noise=noise)
        u = record.input()
        # The samples begin with the kick; that the process rested before it is known here too.
        kicked = PiecewiseConstant(
            np.append(record.time[0], u.times), np.append(u.initial, u.values), settings.baseline
        )
        return replace(record, noise_std=std, held_input=kicked)


def noise_std(run: RelayRun, ratio: float) -> float:
    """Return the standard deviation of Gaussian noise [y] for a noise-to-signal ratio.

    :param run: an experiment about zero.
    :param ratio: mean|noise|/mean|signal about the operating point| (Wang et al. 1997, N2).
    """
    return ratio * float(np.mean(np.abs(run.measurement))) * math.sqrt(math.pi / 2.0)


def true_point(model: TransferFunction) -> UltimatePoint:
    """Return the ultimate point of a process that has one."""
    point = ultimate_point(model)
    assert point is not None
    return point


def same_structure(a: TransferFunction, b: TransferFunction) -> bool:
    """Return whether two models have one structure, with as many lags."""
    return (a.structure, a.order) == (b.structure, b.order)


_T = TransferFunction
PROCESSES = (
    Process("1.65 e^(-10 s)/(20 s + 1)", _T.fopdt(1.65, 20.0, 10.0)),
    Process("e^(-2 s)/(2 s + 1)", _T.fopdt(1.0, 2.0, 2.0)),
    Process("e^(-0.1 s)/(s + 1)", _T.fopdt(1.0, 1.0, 0.1)),
    Process("e^(-0.1 s)/(s + 1), biased relay", _T.fopdt(1.0, 1.0, 0.1), bias=0.3),
    Process("e^(-10 s)/(s + 1)", _T.fopdt(1.0, 1.0, 10.0)),
    Process("e^(-0.01 s)/(2 s + 1)^2, 16 cycles", _T.lag_n(1.0, 2.0, 2, 0.01), cycles=16),
    Process("e^(-10 s)/(s + 1)^2", _T.lag_n(1.0, 1.0, 2, 10.0)),
    Process("e^(-10 s)/(s + 1)^3", _T.lag_n(1.0, 1.0, 3, 10.0)),
    Process("e^(-0.6 s)/(6 s + 1)^8", _T.lag_n(1.0, 6.0, 8, 0.6)),
    Process("(1 - s) e^(-s)/(2 s + 1)^3", LAG_N_ZERO.of_order(3).build((1.0, 2.0, -1.0, 1.0))),
    Process("e^(-s)/((5 s + 1)(s + 1))", _T.sopdt(1.0, (5.0, 1.0), 1.0)),
    Process("e^(-0.5 s)/(s^2 + 0.8 s + 1)", _T.oscillator(1.0, 1.0, 0.4, 0.5)),
    Process("e^(-2 s)/((10 s + 1)^2 (3 s + 1))", TWO_EQUAL_ONE.build((1.0, 10.0, 3.0, 2.0))),
    Process("e^(-2 s)/((10 s + 1)(3 s + 1)(s + 1))", THREE_LAGS.build((1.0, 10.0, 3.0, 1.0, 2.0))),
    Process("e^(-s)/((2 s + 1)(s^2 + 0.8 s + 1))", LAG_COMPLEX.build((1.0, 2.0, 1.0, 0.4, 1.0))),
    Process("0.5 e^(-s)/s", IPDT.build((0.5, 1.0))),
    Process("0.5 e^(-s)/(s (2 s + 1))", INTEGRATOR_LAG.build((0.5, 2.0, 1.0))),
    Process(
        "0.547 (1 - 0.418 s) e^(-0.1 s)/(s (1.06 s + 1))",
        INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
    ),
    Process("e^(-0.3 s)/(s - 1)", UNSTABLE_FOPDT.build((1.0, 1.0, 0.3))),
    Process("e^(-0.2 s)/((2 s - 1)(0.2 s + 1))", UNSTABLE_SOPDT.build((1.0, 2.0, 0.2, 0.2))),
)
