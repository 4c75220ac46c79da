# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Relay tests under coloured noise: errors and intervals beside a fit that knows the colour.

A FOPDT under a biased relay, sampled 20 times in each dead time, with noise of one colour or a
load that walks at random. The fit that knows the colour is told the structure and the covariance
of the noise, and minimises ``r' S^-1 r``: no estimate has less variance.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from markdown import table
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular, toeplitz
from scipy.optimize import least_squares
from scipy.signal import lfilter

from relay_autotune.identification.waveform.method import identify_waveform
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record, RelaySettings

FloatArray = NDArray[np.float64]

GAIN, TAU, DEAD_TIME, PERIOD = 2.0, 5.0, 2.0, 0.1
PROCESS = TransferFunction.fopdt(GAIN, TAU, DEAD_TIME)
SAMPLES, REST, CYCLES = 1400, 60, 8
# A tenth of the measurement's mean deviation.
NOISE = 0.09
LOAD, SENSOR = 0.01, 0.005
DECAY = math.exp(-PERIOD / TAU)


@dataclass(frozen=True)
class Disturbance:
    """What comes beside the response.

    :param title: as people say it.
    :param pole: of the noise; 0: white; 1: a load that walks at random.
    """

    title: str
    pole: float

    def drawn(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return noise of the measurement [y] and load at the input [u], each of shape (n,)."""
        white = rng.standard_normal(SAMPLES + 2000)
        if self.pole == 1.0:
            return SENSOR * white[:SAMPLES], LOAD * np.cumsum(rng.standard_normal(SAMPLES))
        scale = NOISE * math.sqrt(1.0 - self.pole**2)
        noise = lfilter([scale], [1.0, -self.pole], white)[2000:]
        return np.asarray(noise), np.zeros(SAMPLES)

    def covariance(self, n: int) -> FloatArray:
        """Return the covariance of what it adds to n samples [y^2]."""
        if self.pole < 1.0:
            return np.asarray(NOISE**2 * toeplitz(self.pole ** np.arange(n)))
        impulse = np.zeros(n)
        impulse[1:] = (1.0 - DECAY) * GAIN * DECAY ** np.arange(n - 1)
        walk = toeplitz(np.cumsum(impulse), np.zeros(n))
        return np.asarray(LOAD**2 * walk @ walk.T + SENSOR**2 * np.eye(n))


CASES = (
    Disturbance("white noise", 0.0),
    Disturbance("pole 0.9", 0.9),
    Disturbance("pole 0.98", 0.98),
    Disturbance("load that walks at random", 1.0),
)


def relay_test(noise: FloatArray, load: FloatArray) -> Record:
    """Run a biased relay on the process, sample by sample."""
    late = round(DEAD_TIME / PERIOD)
    x, high = 0.0, True
    y: list[float] = []
    u: list[float] = []
    starts: list[int] = []
    for i in range(SAMPLES):
        y.append(x + float(noise[i]))
        if i >= REST and high and y[-1] > 0.3:
            high = False
        elif i >= REST and not high and y[-1] < -0.3:
            high = True
            starts.append(i)
        u.append(0.2 + (1.0 if high else -1.0) if i >= REST else 0.0)
        if len(starts) > CYCLES:
            break
        acting = (u[i - late] if i >= late else 0.0) + float(load[i])
        x = DECAY * x + (1.0 - DECAY) * GAIN * acting
    return Record(
        time=PERIOD * np.arange(len(y), dtype=np.float64),
        measurement=np.array(y),
        command=np.array(u),
        settings=RelaySettings(0.0, 0.0, 1.0, 0.2, 0.3),
        cycle_start=tuple(starts),
        noise_std=float(np.std(y[:REST])),
    )


def gain_of_known_colour(record: Record, disturbance: Disturbance) -> float:
    """Return K_u by the fit that knows structure and colour [u/y]."""
    root = cholesky(disturbance.covariance(len(record)), lower=True)
    u = record.input()

    def left(x: FloatArray) -> FloatArray:
        model = TransferFunction.fopdt(*np.exp(x[:3]))
        error = record.measurement - x[3] - response(model, record.time, u)
        return np.asarray(solve_triangular(root, error, lower=True))

    start = np.append(np.log([GAIN, TAU, DEAD_TIME]), 0.0)
    found = least_squares(left, start)
    point = ultimate_point(TransferFunction.fopdt(*np.exp(found.x[:3])))
    return math.nan if point is None else point.gain


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=300)
    runs = parser.parse_args().runs
    true = ultimate_point(PROCESS)
    assert true is not None
    rows = []
    for case in CASES:
        errors, best, held, held_gain = [], [], 0, 0
        for seed in range(runs):
            record = relay_test(*case.drawn(np.random.default_rng(seed)))
            found = identify_waveform(record)
            errors.append(found.ultimate_gain / true.gain - 1.0)
            best.append(gain_of_known_colour(record, case) / true.gain - 1.0)
            deviation = abs(found.ultimate_gain - true.gain)
            held += deviation <= 1.96 * found.ultimate_gain_std
            held_gain += bool(found.ci95_low[0] <= GAIN <= found.ci95_high[0])
        rms, least = (100.0 * math.sqrt(float(np.mean(np.square(e)))) for e in (errors, best))
        shares = (f"{100.0 * count / runs:.0f} %" for count in (held, held_gain))
        rows.append((case.title, f"{rms:.2f} %", f"{least:.2f} %", *shares))
    head = ("noise", "K_u, rms", "where the colour is known", "K_u within", "K within")
    print(table(head, rows))


if __name__ == "__main__":
    main()
