"""How often each check fails on right and on wrong models, over records of many kinds.

    . ./env.sh && python3 -m benchmarks.verdicts [RUNS]

Each kind is recorded RUNS times (default 20) by steps from rest, with another seed for the noise.
A result is right where its gains, on the true process, make a stable loop with Ms of at most 1.75
(1.25 times what is asked for); of a nonlinear process the truth is its linearisation.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.markdown import table
from relay_autotune.analysis import analyse_alone
from relay_autotune.identification.judgement.table import CHECKS
from relay_autotune.loop.analysis import ms_on
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record
from relay_autotune.verdict import Result, Verdict

FloatArray = NDArray[np.float64]
Noise = Callable[[np.random.Generator, int], FloatArray]

_PERIOD, _LENGTH, _LIMIT = 0.25, 240.0, 1.75
_STEPS = PiecewiseConstant(
    np.array([20.0, 80.0, 110.0, 150.0, 200.0]), np.array([1.0, -0.5, 0.5, -1.0, 0.0]), 0.0
)


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
    """Return a random walk that ends about one unit away."""
    return np.cumsum(rng.normal(0.0, 1.0 / np.sqrt(n), n))


@dataclass(frozen=True)
class Kind:
    """One kind of record.

    :param name: for the table.
    :param process: the truth.
    :param noise: noise that is added to its response.
    :param bend: nonlinearity of the sensor or the process.
    """

    name: str
    process: TransferFunction
    noise: Noise = white
    bend: Callable[[FloatArray], FloatArray] = field(default=lambda y: y)


_FOPDT = TransferFunction.fopdt(1.0, 8.0, 3.0)
_LAGS = TransferFunction(1.0, (), (0.8,) * 20, 0, 0.5)
# Heat conduction through a wall, 1/cosh(sqrt(20 s)): its first eight lags.
_WALL = TransferFunction(
    1.0, (), tuple(80.0 / (np.pi * (2 * k + 1)) ** 2 for k in range(8)), 0, 0.0
)
KINDS = (
    Kind("FOPDT, white noise", _FOPDT),
    Kind("two lags, white noise", TransferFunction(1.0, (), (8.0, 3.0), 0, 1.0)),
    Kind("inverse response, white noise", TransferFunction(1.0, (-3.0,), (8.0, 3.0), 0, 1.0)),
    Kind("twenty lags", _LAGS),
    Kind("heat conduction", _WALL),
    Kind("FOPDT, noise with pole 0.98", _FOPDT, coloured),
    Kind("FOPDT, random walk", _FOPDT, wandering),
    Kind("FOPDT, saturated sensor", _FOPDT, bend=lambda y: np.clip(y, -0.3, 0.3)),
    Kind("square of the response", _FOPDT, bend=lambda y: y + 1.5 * y**2),
    Kind("no process, random walk", TransferFunction.fopdt(1e-6, 8.0, 3.0), wandering),
)


def record_of(kind: Kind, seed: int) -> Record:
    """Return one record of a kind.

    :param kind: which.
    :param seed: of its noise.
    """
    time = np.arange(0.0, _LENGTH, _PERIOD)
    y = kind.bend(response(kind.process, time, _STEPS))
    y = y + kind.noise(np.random.default_rng(seed), time.size)
    return Record(time=time, measurement=y, command=_STEPS(time), held_input=_STEPS)


def main(runs: int = 20) -> None:
    """Print both tables."""
    spoke: dict[bool, Counter[str]] = {True: Counter(), False: Counter()}
    count: Counter[bool] = Counter()
    rows = []
    for kind in KINDS:
        verdicts: Counter[Verdict] = Counter()
        wrong: Counter[Verdict] = Counter()
        for seed in range(runs):
            found = analyse_alone(record_of(kind, seed))
            verdicts[found.verdict] += 1
            gains = found.best_gains
            if gains is None:
                continue
            right = ms_on(gains, kind.process) <= _LIMIT
            count[right] += 1
            wrong[found.verdict] += not right
            spoke[right].update(
                f.name for f in found.judgement.findings if f.result is not Result.PASSED
            )
        rows.append(
            [
                kind.name,
                *(str(verdicts[v]) for v in (Verdict.TRUSTED, Verdict.DOUBTFUL, Verdict.NONE)),
                *(str(wrong[v]) for v in (Verdict.TRUSTED, Verdict.DOUBTFUL)),
            ]
        )
        print(rows[-1], file=sys.stderr, flush=True)
    head = ["record", "trusted", "doubtful", "none", "wrong trusted", "wrong doubtful"]
    print(table(head, rows))
    print()
    shares = [
        [f"`{c.name}`", *(f"{spoke[r][c.name]} of {count[r]}" for r in (True, False))]
        for c in CHECKS
    ]
    print(table(["check", "spoke on right gains", "spoke on wrong gains"], shares))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
