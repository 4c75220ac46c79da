# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How often each check fails on right and on wrong models, over records of many kinds.

    . ./env.sh && python3 benchmarks/verdicts.py [--runs N] [--quick]

Each kind is recorded N times, with another seed for the noise: by steps from rest, or by a relay
experiment. A result is right where its gains, on the true process, make a stable
loop with Ms of at most 1.75 (1.25 times what is asked for); of a nonlinear process the truth is
its linearisation where it rests.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from markdown import table
from numpy.typing import NDArray

from relay_autotune.analysis import analyse
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.judgement.table import CHECKS
from relay_autotune.loop.gains import Gains
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Actuator, VirtualProcess
from relay_autotune.record.record import PiecewiseConstant, Record
from relay_autotune.verdict import Result, Verdict

FloatArray = NDArray[np.float64]
Noise = Callable[[np.random.Generator, int], FloatArray]

_PERIOD, _LENGTH, _LIMIT = 0.25, 240.0, 1.75
_MOST_SAMPLES, _SETTLED_TURN = 4000, 0.1
_STEPS = PiecewiseConstant(
    np.array([20.0, 80.0, 110.0, 150.0, 200.0]), np.array([1.0, -0.5, 0.5, -1.0, 0.0]), 0.0
)
_FREQUENCIES = np.geomspace(1e-5, 1e3, 40_000)


def white(rng: np.random.Generator, n: int) -> FloatArray:
    """Return white noise of a hundredth."""
    return rng.normal(0.0, 0.01, n)


def coloured(rng: np.random.Generator, n: int) -> FloatArray:
    """Return noise of a twentieth with the pole 0.98."""
    e, y = rng.normal(0.0, 0.05 * np.sqrt(1.0 - 0.98**2), n), np.zeros(n)
    for k in range(1, n):
        y[k] = 0.98 * y[k - 1] + e[k]
    return y


def wandering(rng: np.random.Generator, n: int) -> FloatArray:
    """Return a random walk that ends about one unit away after the steps."""
    return np.cumsum(rng.normal(0.0, math.sqrt(_PERIOD / _LENGTH), n))


def loaded(rng: np.random.Generator, n: int) -> FloatArray:
    """Return white noise, and the response to a load step in the fourth cycle of a relay test."""
    past = np.maximum(_PERIOD * np.arange(n) - 42.0, 0.0)
    return white(rng, n) - 0.15 * -np.expm1(-past / 8.0)


class Outflow:
    """A tank with an outflow by the root of its level, ``4 h' = 1 + q - sqrt(1 + h)``.

    :param inflow: what q follows the command with.
    """

    def __init__(self, inflow: TransferFunction) -> None:
        self._inflow = VirtualProcess(inflow)
        self._time, self._level = 0.0, 0.0

    def command(self, value: float) -> None:
        """Give a command."""
        self._inflow.command(value)

    def measure(self, time: float) -> float:
        """Return the level at a time [s]."""
        steps = max(1, round((time - self._time) / 0.025))
        h = (time - self._time) / steps
        for _ in range(steps):
            self._time += h
            q = self._inflow.measure(self._time)
            self._level += h / 4.0 * (1.0 + q - math.sqrt(max(1.0 + self._level, 0.0)))
        return self._level


@dataclass(frozen=True)
class Kind:
    """One kind of record.

    :param name: for the table.
    :param processes: the truth, which is their sum.
    :param noise: noise that is added to its response.
    :param bend: nonlinearity of the sensor.
    :param actuator: limits and stiction of the actuator, as fields of ``Actuator``.
    :param outflow: transfer function from command to inflow of a tank; None: no tank.
    """

    name: str
    processes: tuple[TransferFunction, ...]
    noise: Noise = white
    bend: Callable[[float], float] = field(default=lambda y: y)
    actuator: dict[str, float] = field(default_factory=dict)
    outflow: TransferFunction | None = None

    def ms(self, gains: Gains) -> float:
        """Return Ms of the loop with the true process; infinite where it is unstable.

        Of a stable process and a controller with an integrator, ``1 + L`` turns by a quarter
        from the lowest frequency to the highest where the loop is stable (Nyquist).
        """
        s = 1j * _FREQUENCIES
        back = 1.0 + sum(p(s) for p in self.processes) * gains(s)
        turn = np.unwrap(np.angle(back))
        if abs(turn[-1] - turn[0] - 0.5 * math.pi) > _SETTLED_TURN:
            return math.inf
        return float(np.max(1.0 / np.abs(back)))


_FOPDT = TransferFunction.fopdt(1.0, 8.0, 3.0)
_LAGS = TransferFunction(1.0, (), (0.8,) * 20, 0, 0.5)
# Heat conduction through a wall, 1/cosh(sqrt(20 s)): its first eight lags.
_WALL = TransferFunction(
    1.0, (), tuple(80.0 / (np.pi * (2 * k + 1)) ** 2 for k in range(8)), 0, 0.0
)
# (1 - e^-4s)/(4 s) e^-0.5s/(3 s + 1), by sixteen equal parts of the delay.
_SPREAD = tuple(TransferFunction.fopdt(1.0 / 16, 3.0, 0.5 + (k + 0.5) / 4) for k in range(16))
_TANK = TransferFunction(2.0, (), (8.0, 1.0), 0, 1.0)
KINDS = (
    Kind("FOPDT", (_FOPDT,)),
    Kind("two lags", (TransferFunction(1.0, (), (8.0, 3.0), 0, 1.0),)),
    Kind("inverse response", (TransferFunction(1.0, (-3.0,), (8.0, 3.0), 0, 1.0),)),
    Kind("twenty lags", (_LAGS,)),
    Kind("heat conduction", (_WALL,)),
    Kind("distributed delay", _SPREAD),
    Kind("FOPDT, noise with pole 0.98", (_FOPDT,), coloured),
    Kind("FOPDT, random walk", (_FOPDT,), wandering),
    Kind("FOPDT, load step", (_FOPDT,), loaded),
    Kind("distributed delay, load step", _SPREAD, loaded),
    Kind("FOPDT, saturated sensor", (_FOPDT,), bend=lambda y: min(max(y, -0.3), 0.3)),
    Kind("FOPDT, saturated actuator", (_FOPDT,), actuator={"minimum": -0.1, "maximum": 0.6}),
    Kind("FOPDT, stiction", (_FOPDT,), actuator={"stiction": 0.6}),
    Kind("square-root outflow", (_TANK,), outflow=TransferFunction.fopdt(1.0, 1.0, 1.0)),
    Kind("square of the response", (_FOPDT,), bend=lambda y: y + 1.5 * y**2),
    Kind("no process, random walk", (TransferFunction.fopdt(1e-6, 8.0, 3.0),), wandering),
)


def record_of(kind: Kind, seed: int, *, relay: bool) -> Record | None:
    """Return one record of a kind; None: the relay experiment came to no end.

    :param kind: which.
    :param seed: of its noise.
    :param relay: True: of a relay experiment; False: of steps.
    """
    plants: list[VirtualProcess | Outflow] = [VirtualProcess(p) for p in kind.processes]
    if kind.outflow is not None:
        plants = [Outflow(kind.outflow)]
    actuator = Actuator(0.0, **kind.actuator)
    samples = _MOST_SAMPLES if relay else round(_LENGTH / _PERIOD)
    noise = kind.noise(np.random.default_rng(seed), samples)
    tune = RelayExperiment(ExperimentParameters(setpoint=0.0, amplitude=0.5, max_cycles=6), 0.0)
    time: FloatArray = _PERIOD * np.arange(samples, dtype=np.float64)
    steps, y = _STEPS(time), np.zeros(samples)
    for k in range(samples):
        y[k] = kind.bend(sum(p.measure(float(time[k])) for p in plants)) + noise[k]
        command = tune.step(float(time[k]), float(y[k])) if relay else float(steps[k])
        for plant in plants:
            plant.command(actuator.move(command))
        if relay and tune.finished:
            break
    if not relay:
        return Record(time=time, measurement=y, command=steps)
    return tune.record() if tune.finished else None


@dataclass
class Tally:
    """What was counted of one kind of record.

    :param verdicts: how often each was given.
    :param wrong: how often with gains that are wrong.
    """

    verdicts: Counter[Verdict] = field(default_factory=Counter)
    wrong: Counter[Verdict] = field(default_factory=Counter)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20, help="records of each kind and test")
    parser.add_argument("--quick", action="store_true", help="only show that it runs")
    asked = parser.parse_args()
    kinds, runs = (KINDS[:1], 1) if asked.quick else (KINDS, asked.runs)
    tallies = [(kind, relay, Tally()) for kind in kinds for relay in (False, True)]
    spoke: dict[bool, Counter[str]] = {True: Counter(), False: Counter()}
    count: Counter[bool] = Counter()
    refused: Counter[str] = Counter()
    for kind, relay, tally in tallies:
        for seed in range(runs):
            record = record_of(kind, seed, relay=relay)
            if record is None:
                tally.verdicts[Verdict.NONE] += 1
                continue
            found = analyse(record, alone=True)
            tally.verdicts[found.verdict] += 1
            gains, findings = found.best_gains, found.judgement.findings
            if gains is None:
                refused.update(f.name for f in findings if f.result is Result.FAILED)
                continue
            right = kind.ms(gains) <= _LIMIT
            count[right] += 1
            tally.wrong[found.verdict] += not right
            spoke[right].update(f.name for f in findings if f.result is not Result.PASSED)
    rows = [
        (
            kind.name,
            "relay" if relay else "steps",
            *(tally.verdicts[v] for v in (Verdict.TRUSTED, Verdict.DOUBTFUL, Verdict.NONE)),
            *(tally.wrong[v] for v in (Verdict.TRUSTED, Verdict.DOUBTFUL)),
        )
        for kind, relay, tally in tallies
    ]
    head = ("record", "test", "trusted", "doubtful", "none", "wrong trusted", "wrong doubtful")
    print(table(head, rows), end="\n\n")
    shares = [
        (
            f"`{check.name}`",
            *(f"{spoke[right][check.name]} of {count[right]}" for right in (True, False)),
            refused[check.name],
        )
        for check in CHECKS
    ]
    print(table(("check", "spoke on right gains", "spoke on wrong gains", "refused"), shares))


if __name__ == "__main__":
    main()
