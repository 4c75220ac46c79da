# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Verdicts on what is outside the structures and the noise of the fit, with the truth known.

    . ./env.sh && python3 benchmarks/unmodelled.py [--count N] [--quick]

A record is drawn by its number: a process (of other structures, or nonlinear), noise (white, with
a pole at 0.5 to 0.98, a sine near or far from w_u, a random walk at the process's input), a test
(steps, levels at random, or a relay experiment), and how it is sampled: 8 to 200 times a time
constant, late and jittered stamps, a coarse sensor, a record that begins with its step. The truth
is the linearised process at the middle of the test. Gains are right where their Ms on it is at
most 1.75, which is 1.25 times what is asked for; unstable where it is infinite.
"""

from __future__ import annotations

import argparse
import math
import sys
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from markdown import table
from numpy.typing import NDArray
from scipy.optimize import least_squares

from relay_autotune.analysis import analyse
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.loop.analysis import ControlLaw
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Actuator, VirtualProcess
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record
from relay_autotune.tuning import design
from relay_autotune.tuning.task import DesignOptions, DesignTask
from relay_autotune.verdict import Verdict

FloatArray = NDArray[np.float64]

# Largest Ms that is right; phase of the last frequency from that of the first.
_RIGHT, _SETTLED_TURN = 1.75, 0.1
_FREQUENCIES = np.geomspace(1e-4, 1e3, 20_000)
_TESTS = ("steps", "levels", "relay")
_NOISES = ("white", "pole 0.5", "pole 0.9", "pole 0.98", "sine near w_u", "sine far", "walk")
_POLES = {"white": 0.0, "pole 0.5": 0.5, "pole 0.9": 0.9, "pole 0.98": 0.98}
# Time constants that a record lasts.
_LENGTH = 24.0


@dataclass(frozen=True)
class Process:
    """A process whose longest time is about 1 s.

    :param name: for the table.
    :param truth: its linearisation, the sum of these.
    :param bend: static nonlinearity behind the linear process.
    :param valve: static nonlinearity before it.
    :param actuator: fields of ``Actuator``.
    :param linear: False: the truth holds for small moves alone.
    """

    name: str
    truth: tuple[TransferFunction, ...]
    bend: Callable[[float], float] = lambda y: y
    valve: Callable[[float], float] = lambda u: u
    actuator: tuple[tuple[str, float], ...] = ()
    linear: bool = True

    def at(self, s: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
        """Return the response of the linearised process."""
        return np.asarray(sum(p(s) for p in self.truth))

    def ms(self, controller: ControlLaw) -> float:
        """Return Ms of the loop; infinite where it is unstable (Nyquist, a stable process)."""
        s = 1j * _FREQUENCIES
        back = 1.0 + self.at(s) * controller(s)
        turn = np.unwrap(np.angle(back))
        if abs(turn[-1] - turn[0] - 0.5 * math.pi) > _SETTLED_TURN:
            return math.inf
        return float(np.max(1.0 / np.abs(back)))

    @property
    def ultimate(self) -> tuple[float, float]:
        """K_u and w_u."""
        at = self.at(1j * _FREQUENCIES)
        phase = np.unwrap(np.angle(at))
        k = int(np.argmax(phase < -math.pi))
        return (1.0 / abs(at[k]), float(_FREQUENCIES[k])) if k else (math.inf, math.nan)


def processes(rng: np.random.Generator) -> tuple[Process, ...]:
    """Return one process of each kind, with numbers drawn at random."""
    late = float(rng.uniform(0.05, 0.5))
    one = TransferFunction.fopdt(1.0, 1.0, late)
    wall = tuple(4.0 / (np.pi * (2 * k + 1)) ** 2 * 2.5 for k in range(8))
    spread = float(rng.uniform(0.3, 1.0))
    parts = tuple(
        TransferFunction.fopdt(1.0 / 16, 1.0, late + spread * (k + 0.5) / 16) for k in range(16)
    )
    damping, share = float(rng.uniform(0.1, 0.4)), float(rng.uniform(0.1, 0.4))
    swing = 0.15
    mode = swing * complex(damping, math.sqrt(1.0 - damping**2))
    masses = TransferFunction(1.0, (), (1.0, mode, mode.conjugate()), 0, 0.3 * late)
    slow = (
        TransferFunction.fopdt(1.0 - share, 0.4, 0.5 * late),
        TransferFunction.fopdt(share, 4.0, 0.5 * late),
    )
    curve = float(rng.uniform(0.1, 0.4))
    return (
        Process("FOPDT", (one,)),
        Process("twenty lags", (TransferFunction(1.0, (), (0.08,) * 20, 0, 0.1 * late),)),
        Process("heat conduction", (TransferFunction(1.0, (), wall, 0, 0.0),)),
        Process("distributed delay", parts),
        Process("two masses", (masses,)),
        Process("fast and slow wall", slow),
        Process("valve characteristic", (one,), valve=lambda u: u + curve * u**2, linear=False),
        Process("radiation, outflow by a root", (one,), lambda y: y - curve * y**2, linear=False),
        Process("stiction", (one,), actuator=(("stiction", 0.3),), linear=False),
        Process("backlash", (one,), actuator=(("dead_band", 0.2),), linear=False),
        Process("saturation", (one,), actuator=(("maximum", 0.5),), linear=False),
    )


@dataclass(frozen=True)
class Drawn:
    """One record with its truth.

    :param process: the truth.
    :param noise: its kind.
    :param test: its kind.
    :param record: the record; None: the relay experiment failed.
    """

    process: Process
    noise: str
    test: str
    record: Record | None


def drawn(number: int) -> Drawn:
    """Return a record by its number."""
    rng = np.random.default_rng(number)
    kinds = processes(rng)
    process = kinds[number % len(kinds)]
    noise, test = str(rng.choice(_NOISES)), str(rng.choice(_TESTS))
    period = float(1.0 / rng.choice([8.0, 20.0, 50.0, 200.0], p=[0.2, 0.4, 0.3, 0.1]))
    n = round(_LENGTH / period)
    time = period * np.arange(n, dtype=np.float64)
    size = float(rng.choice([0.005, 0.02, 0.05]))
    beside, load = disturbance(noise, process, time, size, rng)
    rest = 0.0 if rng.random() < 0.2 else 2.0
    parameters = ExperimentParameters(setpoint=0.0, amplitude=0.5, max_cycles=6)
    tune = RelayExperiment(parameters, 0.0)
    plants = [VirtualProcess(p) for p in process.truth]
    actuator = Actuator(0.0, **dict(process.actuator))
    wanted = commands(test, time, rest, rng)
    step = float(rng.choice([0.0, 0.0, 0.02]))
    u, y = np.zeros(n), np.zeros(n)
    used = n
    for k in range(n):
        y[k] = process.bend(sum(p.measure(float(time[k])) for p in plants)) + beside[k]
        if step:
            y[k] = step * round(y[k] / step)
        u[k] = tune.step(float(time[k]), float(y[k])) if test == "relay" else wanted[k]
        for plant in plants:
            plant.command(process.valve(actuator.move(float(u[k]))) + float(load[k]))
        if test == "relay" and tune.finished:
            used = k + 1
            break
    if test == "relay":
        record = tune.record() if tune.finished else None
        return Drawn(process, noise, test, record)
    stamps = time
    if rng.random() < 0.3:
        stamps = np.sort(time + rng.uniform(0.0, 0.4 * period, n))
    return Drawn(
        process, noise, test, Record(time=stamps[:used], measurement=y[:used], command=u[:used])
    )


def commands(test: str, time: FloatArray, rest: float, rng: np.random.Generator) -> FloatArray:
    """Return the commands of a test that is no relay's [u], shape (n,)."""
    if test == "steps":
        after = rest + np.cumsum(rng.uniform(4.0, 8.0, 3))
        levels = rng.choice([-0.7, -0.4, 0.4, 0.7], 3)
        found = np.zeros(time.size)
        # A step at the first sample: what came before is not in the record.
        for begin, level in zip((rest, *after), (0.6, *levels), strict=False):
            found[time >= begin] = level
        return found
    hold = float(rng.uniform(0.3, 1.5))
    levels = rng.choice([-0.6, 0.0, 0.6], int(time[-1] / hold) + 2)
    return np.where(time < rest, 0.0, levels[(time / hold).astype(int)])


def disturbance(
    noise: str, process: Process, time: FloatArray, size: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return noise of the measurement [y] and load at the input [u], shapes (n,)."""
    n = time.size
    white, none = rng.standard_normal(n), np.zeros(n)
    if noise == "walk":
        return 0.2 * size * white, np.cumsum(rng.normal(0.0, 4.0 * size / math.sqrt(n), n))
    if noise in _POLES:
        pole = _POLES[noise]
        found = np.zeros(n)
        before = float(rng.standard_normal())
        for k in range(n):
            before = pole * before + math.sqrt(1.0 - pole**2) * float(white[k])
            found[k] = before
        return size * found, none
    w = process.ultimate[1] * (0.9 if noise == "sine near w_u" else 0.1)
    return size * (0.3 * white + 1.4 * np.sin(w * time + rng.uniform(0.0, 6.0))), none


def plain_is_good(process: Process, record: Record) -> bool:
    """Return whether gains of the FOPDT that anyone would fit by least squares are right."""
    u, y = record.input(), record.measurement
    span = float(np.ptp(u.values)) or 1.0
    gain = float(np.ptp(y)) / span

    def left(x: FloatArray) -> FloatArray:
        unit = TransferFunction.fopdt(1.0, math.exp(x[1]), abs(x[2]))
        return np.asarray(y - x[3] - gain * x[0] * response(unit, record.time, u))

    try:
        fits = [
            least_squares(left, [1.0, math.log(tau), late, float(y[0])], max_nfev=40)
            for tau, late in ((0.5, 0.3), (2.0, 0.1))
        ]
        x = min(fits, key=lambda fit: float(fit.cost)).x
        model = TransferFunction.fopdt(gain * x[0], math.exp(x[1]), abs(x[2]))
        task = DesignTask(model=model, options=DesignOptions(sample_period=record.interval))
        return process.ms(design(task, "robust")) <= _RIGHT
    except RelayAutotuneError:
        return False


@dataclass(frozen=True)
class Outcome:
    """What came of one record.

    :param drawn: without its record.
    :param verdict: of the analysis.
    :param ms: of the gains on the truth; NaN: no gains.
    :param held: whether the interval of K_u holds the truth's; None: it has none.
    :param plain: whether the plain fit's gains are right.
    :param seconds: that the analysis took.
    """

    drawn: Drawn
    verdict: Verdict
    ms: float
    held: bool | None
    plain: bool
    seconds: float


def outcome(number: int) -> Outcome | None:
    """Analyse a record; None: its relay experiment failed."""
    made = drawn(number)
    if made.record is None:
        return None
    begin = clock.process_time()
    found = analyse(made.record, alone=True)
    seconds = clock.process_time() - begin
    gains, model = found.best_gains, found.model
    held = None
    if model is not None and math.isfinite(model.ultimate_gain_std):
        true = made.process.ultimate[0]
        held = abs(model.ultimate_gain - true) <= NORMAL_95 * model.ultimate_gain_std
    ms = math.nan if gains is None else made.process.ms(gains)
    plain = plain_is_good(made.process, made.record)
    return Outcome(replace(made, record=None), found.verdict, ms, held, plain, seconds)


def _share(held: Sequence[bool]) -> str:
    return f"{sum(held)} of {len(held)}"


def _rows(
    title: str, names: Sequence[str], of: Callable[[Outcome], str], all_: list[Outcome]
) -> str:
    head = [title, "records", "trusted", "right of trusted", "unstable, trusted"]
    head += ["unstable, doubtful", "K_u within", "plain fit right", "trusted of these"]
    rows = []
    for name in (*names, "all"):
        found = [o for o in all_ if name in (of(o), "all")]
        trusted = [o for o in found if o.verdict is Verdict.TRUSTED]
        doubtful = [o for o in found if o.verdict is Verdict.DOUBTFUL]
        rows.append(
            [
                name,
                str(len(found)),
                str(len(trusted)),
                _share([o.ms <= _RIGHT for o in trusted]),
                str(sum(math.isinf(o.ms) for o in trusted)),
                str(sum(math.isinf(o.ms) for o in doubtful)),
                _share([o.held for o in found if o.held is not None]),
                str(sum(o.plain for o in found)),
                _share([o.verdict is Verdict.TRUSTED for o in found if o.plain]),
            ]
        )
    return table(head, rows)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="records")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--quick", action="store_true", help="only show that it runs")
    asked = parser.parse_args()
    found = []
    for number in range(asked.first, asked.first + (1 if asked.quick else asked.count)):
        result = outcome(number)
        if result is None:
            continue
        found.append(result)
        made = result.drawn
        wrong = result.verdict is Verdict.TRUSTED and not result.ms <= _RIGHT
        print(
            number, made.process.name, made.noise, made.test, result.verdict.name,
            f"Ms {result.ms:.2f} plain {result.plain} {result.seconds:.1f} s",
            "WRONG" if wrong else "", file=sys.stderr, flush=True,
        )  # fmt: skip
    kinds = [p.name for p in processes(np.random.default_rng(0))]
    print(_rows("process", kinds, lambda o: o.drawn.process.name, found), end="\n\n")
    print(_rows("noise", _NOISES, lambda o: o.drawn.noise, found), end="\n\n")
    print(_rows("test", _TESTS, lambda o: o.drawn.test, found))


if __name__ == "__main__":
    main()
