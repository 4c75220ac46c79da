# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The processes on which identification is measured, their records and what is known of them."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from numpy.typing import NDArray

from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))
from relay_runs import RelayRun, simulate_relay
from sampled_relay import exact_limit_cycle, simulate_sampled_relay

FloatArray = NDArray[np.float64]

QUANTITIES = ("K", "tau", "D", "K_u", "w_u")
PER_CYCLE, CYCLES = 200, 5
SAMPLES = PER_CYCLE * CYCLES

_STEP = 1e-5


@dataclass(frozen=True)
class Case:
    """One FOPDT process under a relay of amplitude 1, at rest at zero before the first kick.

    :param title: the process as people write it.
    :param values: K [y/u], tau [s], D [s].
    :param bias: of the relay [u].
    """

    title: str
    values: tuple[float, float, float]
    bias: float = 0.0

    @cached_property
    def model(self) -> TransferFunction:
        """The process."""
        return TransferFunction.fopdt(*self.values)

    @cached_property
    def truth(self) -> FloatArray:
        """True values of ``QUANTITIES``, shape (5,)."""
        return quantities(np.array(self.values))

    @cached_property
    def period(self) -> float:
        """Sample period: a fixed share of the limit cycle [s]."""
        return exact_limit_cycle(self.model, self.settings(0.0)).period / PER_CYCLE

    @cached_property
    def run(self) -> RelayRun:
        """The ideal experiment, sampled from the kick on, over the time of five limit cycles."""
        time = self.period * np.arange(SAMPLES)
        return simulate_relay(self.model, self.settings(0.0), cycles=CYCLES + 2, time=time)

    def settings(self, hysteresis: float) -> RelaySettings:
        """Return the relay with a hysteresis [y]."""
        return RelaySettings(0.0, 0.0, 1.0, self.bias, hysteresis)

    def noise_std(self, ratio: float) -> float:
        """Return the standard deviation of Gaussian noise [y] for a noise-to-signal ratio.

        :param ratio: mean|noise|/mean|signal about the operating point| (Wang et al. 1997, N2).
        """
        return ratio * float(np.mean(np.abs(self.run.measurement))) * math.sqrt(math.pi / 2.0)

    def record(self, ratio: float, seed: int, *, relay_sees_noise: bool = False) -> Record:
        """Return one noisy experiment of 1,000 samples.

        :param ratio: noise-to-signal ratio.
        :param seed: of the noise.
        :param relay_sees_noise: False: an ideal relay that switches between samples, where the
            noise-free output crosses; True: a relay that looks at the noisy samples, with the
            hysteresis that relay_node would choose, three standard deviations.
        """
        std = self.noise_std(ratio)
        # No two cases or ratios share their noise, so that their rows are independent.
        rng = np.random.default_rng((seed, round(1000.0 * ratio), *self.title.encode()))
        if not relay_sees_noise:
            return self.run.record(noise_std=std, rng=rng)
        noise = std * rng.standard_normal(SAMPLES)
        settings = self.settings(3.0 * std)
        record = simulate_sampled_relay(self.model, settings, period=self.period, noise=noise)
        u = record.input()
        # The samples begin with the kick; that the process rested before it is known here too.
        kicked = PiecewiseConstant(
            np.append(record.time[0], u.times), np.append(u.initial, u.values), settings.baseline
        )
        return replace(record, held_input=kicked)

    def bound(
        self, time: FloatArray, u: PiecewiseConstant, beside: Sequence[FloatArray] = ()
    ) -> FloatArray:
        """Return the Cramer-Rao bound of ``QUANTITIES`` for noise of unit standard deviation.

        From central differences of the exact response; an offset is estimated beside the model.

        :param time: of the samples [s], shape (n,).
        :param u: the input.
        :param beside: what else is estimated, such as a drift: its course, shape (n,) each.
        :return: covariance of the relative errors, shape (5, 5).
        """
        by_output, by_quantity = [], []
        for k, value in enumerate(self.values):
            step = np.zeros(3)
            step[k] = _STEP * value
            up, down = np.array(self.values) + step, np.array(self.values) - step
            change = output(up, time, u) - output(down, time, u)
            by_output.append(change / (2.0 * _STEP))
            by_quantity.append(np.log(quantities(up) / quantities(down)) / (2.0 * _STEP))
        jacobian = np.stack([*by_output, np.ones_like(time), *beside])
        covariance = np.linalg.inv(jacobian @ jacobian.T)[:3, :3]
        gradient = np.array(by_quantity)
        return np.asarray(gradient.T @ covariance @ gradient)


def output(values: FloatArray, time: FloatArray, u: PiecewiseConstant) -> FloatArray:
    """Return the response of a FOPDT process of (K, tau, D)."""
    return response(TransferFunction.fopdt(*values.tolist()), time, u)


def quantities(values: FloatArray) -> FloatArray:
    """Return K, tau, D, K_u and w_u of (K, tau, D), shape (5,)."""
    point = ultimate_point(TransferFunction.fopdt(*values.tolist()))
    assert point is not None
    return np.array((*values, point.gain, point.frequency))


CASES = (
    Case("1.65 e^(-10 s)/(20 s + 1)", (1.65, 20.0, 10.0)),
    Case("e^(-2 s)/(2 s + 1)", (1.0, 2.0, 2.0)),
    Case("e^(-0.1 s)/(s + 1)", (1.0, 1.0, 0.1)),
    Case("e^(-0.1 s)/(s + 1), biased relay", (1.0, 1.0, 0.1), bias=0.3),
    Case("e^(-10 s)/(s + 1)", (1.0, 1.0, 10.0)),
)

Figures = tuple[tuple[float, float], ...]

# Median and 95th percentile of the error in % of each of QUANTITIES, by case and noise-to-signal
# ratio, of another implementation of the same fit over 30 seeds.
TARGETS: dict[tuple[int, float], Figures] = {
    (0, 0.05): ((0.97, 2.6), (1.1, 2.8), (0.12, 0.38), (0.10, 0.31), (0.05, 0.11)),
    (0, 0.1): ((2.0, 5.5), (2.2, 5.7), (0.26, 0.78), (0.21, 0.62), (0.10, 0.22)),
    (0, 0.2): ((3.7, 11.0), (4.2, 12.0), (0.55, 1.7), (0.41, 1.2), (0.20, 0.44)),
    (1, 0.1): ((0.70, 2.9), (0.85, 3.5), (0.17, 0.47), (0.20, 0.59), (0.08, 0.25)),
    (2, 0.1): ((10.0, 30.0), (10.0, 31.0), (0.30, 0.91), (0.18, 0.63), (0.11, 0.32)),
    (3, 0.1): ((4.1, 6.2), (4.1, 6.4), (0.55, 1.2), (0.48, 1.3), (0.39, 0.99)),
    (4, 0.1): ((0.22, 0.72), (0.82, 2.7), (0.07, 0.23), (0.18, 0.71), (0.05, 0.16)),
}
