# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""First tries on ordinary loops, with every default of a live tune and the truth known.

    . ./env.sh && python3 benchmarks/first_tries.py [--tries N] [--kind TEXT] [--quick]

Twenty kinds of loops as people have them, each with its nonlinearity, the steps of its sensor, its
noise, and a timer that is late. Each is tuned N times, with other numbers drawn by odd seeds, by
the experiment that `relay_node` runs: the user gives the actuator's range and the command at which
the process rests, and nothing else. The truth is the process linearised where it rests, for
branches that differ each of them, with the delay of the command and half a sample; gains are right
where Ms on all of these is at most 1.75, which is 1.25 times what is asked for. They are timid if
their integral gain is below a tenth of the largest one that a PI with Ms of 1.4 may have.

good: right, not timid, and trusted. doubtful: right, but doubtful. none: no gains. wrong: trusted,
and timid or not right.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from markdown import table
from numpy.typing import NDArray
from scipy.optimize import fsolve

from relay_autotune.analysis import analyse
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.loop.analysis import ControlLaw
from relay_autotune.process.virtual_process import Actuator
from relay_autotune.record.record import Outcome
from relay_autotune.verdict import Verdict

FloatArray = NDArray[np.float64]
# dx/dt from states and the command that acts; several where the process has branches.
Flow = Callable[[FloatArray, float], FloatArray]

RIGHT, ASKED, TIMID = 1.75, 1.4, 0.1
TRIES, MOST_SAMPLES, SUBSTEPS = 10, 40_000, 8
# A timer's lateness in periods: usual, and now and then; the time that the node takes to answer.
LATE, RARELY, VERY_LATE, ANSWER = 0.04, 0.01, 1.2, 0.05
RESULTS = ("good", "doubtful", "none", "wrong, doubtful", "wrong")


@dataclass(frozen=True)
class Loop:
    """One process with its sensor and actuator.

    :param flow: the true dx/dt.
    :param period: of the sensor [s].
    :param commands: the actuator's range [u].
    :param rest: command at which the process rests [u].
    :param start: a guess of the states there.
    :param output: number of the state that is measured.
    :param branches: smooth dx/dt that together are the truth for small moves; empty: ``flow``.
    :param noise: standard deviation of the sensor [y].
    :param step: resolution of the sensor [y].
    :param delay: dead time of the command [s].
    :param actuator: fields of ``Actuator``.
    :param outside: load that is added to the acting command, a function of time [u].
    :param velocity: True: the sensor counts steps of a position, and divides by the time between.
    """

    flow: Flow
    period: float
    commands: tuple[float, float]
    rest: float
    start: tuple[float, ...]
    output: int = -1
    branches: tuple[Flow, ...] = ()
    noise: float = 0.0
    step: float = 0.0
    delay: float = 0.0
    actuator: dict[str, float] = field(default_factory=dict)
    outside: Callable[[float], float] = lambda _: 0.0
    velocity: bool = False

    def resting(self) -> FloatArray:
        """Return the states at rest; of an integrating process those that are given."""
        smooth = (self.branches or (self.flow,))[0]
        start = np.asarray(self.start, dtype=np.float64)
        if np.allclose(smooth(start, self.rest), 0.0, atol=1e-9):
            return start
        return np.asarray(fsolve(lambda x: smooth(x, self.rest), start))

    def truths(self) -> list[Linear]:
        """Return the linearised process, of each branch."""
        rest, late = self.resting(), self.delay + (0.5 + ANSWER) * self.period
        found = []
        for smooth in self.branches or (self.flow,):
            columns = []
            for k in range(rest.size + 1):
                at = np.append(rest, self.rest)
                h = 1e-5 * max(abs(at[k]), 1e-2)
                up, down = at.copy(), at.copy()
                up[k] += h
                down[k] -= h
                columns.append((smooth(up[:-1], up[-1]) - smooth(down[:-1], down[-1])) / (2.0 * h))
            jacobian = np.stack(columns, axis=1)
            output = np.eye(rest.size)[self.output]
            found.append(Linear(jacobian[:, :-1], jacobian[:, -1], output, late))
        return found


class Linear:
    """A linear process with dead time, ``dx/dt = A x + b u(t - d)``, ``y = c x``.

    :param a: matrix of the states [1/s].
    :param b: effect of the command.
    :param c: the measurement.
    :param late: dead time [s].
    """

    def __init__(self, a: FloatArray, b: FloatArray, c: FloatArray, late: float) -> None:
        poles = np.linalg.eigvals(a)
        speeds = np.abs(poles)[np.abs(poles) > 1e-9]
        fastest = max(speeds.max(initial=0.0), 1.0 / late)
        slowest = min(speeds.min(initial=fastest), 1.0 / late)
        self.w = np.geomspace(1e-4 * slowest, 1e3 * fastest, 30_000)
        s = 1j * self.w
        parts = np.linalg.solve(
            s[:, None, None] * np.eye(len(a)) - a, np.broadcast_to(b[:, None], (len(s), len(a), 1))
        )
        self.at = (parts[..., 0] @ c) * np.exp(-late * s)
        tiny = 1e-6 * fastest
        self._integrators = int(np.sum(np.abs(poles) <= tiny))
        self._growing = int(np.sum(poles.real > tiny))

    def ms(self, controller: ControlLaw) -> float:
        """Return Ms of the loop; infinite where it is unstable, by the argument principle."""
        s = 1j * self.w
        back = 1.0 + self.at * controller(s)
        free = (s / (s + math.sqrt(self.w[0] * self.w[-1]))) ** (1 + self._integrators)
        turn = np.unwrap(np.angle(back * free))
        if abs(turn[-1] - turn[0] - self._growing * math.pi) > 0.5 * math.pi:
            return math.inf
        return float(np.max(1.0 / np.abs(back)))

    def best_integral(self) -> float:
        """Return the largest integral gain of a PI with Ms of 1.4 [u/(y s)].

        For a proportional gain the forbidden integral gains at each frequency lie between the
        roots of ``|A - j k G/w|^2 = 1/Ms^2`` with ``A = 1 + kp G``.
        """
        sign = float(np.sign(np.real(self.at[0] * (1j * self.w[0]) ** self._integrators)))
        g = sign * self.at
        phase = np.unwrap(np.angle(g))
        ultimate = 1.0 / abs(g[int(np.argmax(phase < -math.pi))])
        best = 0.0
        for gain in np.geomspace(1e-3, 1.0, 60) * ultimate:
            a = 1.0 + gain * g
            room = np.abs(a) ** 2 - ASKED**-2
            if room.min() < 0.0:
                break
            half = np.imag(np.conj(a) * g) / self.w
            square = (np.abs(g) / self.w) ** 2
            root = half**2 - square * room
            bound = (root > 0.0) & (half < 0.0)
            roots = room[bound] / (-half[bound] + np.sqrt(root[bound]))
            best = max(best, float(roots.min(initial=math.inf)) if roots.size else 0.0)
        return best


@dataclass(frozen=True)
class Try:
    """What came of one tune.

    :param result: one of ``RESULTS``.
    :param why: Ms and verdict, or why there are no gains.
    """

    result: str
    why: str


def recorded(loop: Loop, rng: np.random.Generator) -> RelayExperiment:
    """Run the experiment of the node, by a timer that is late."""
    low, high = loop.commands
    tune = RelayExperiment(ExperimentParameters(command_min=low, command_max=high), loop.rest)
    actuator = Actuator(loop.rest, minimum=low, maximum=high, **loop.actuator)
    x, now, count, before = loop.resting(), 0.0, 0.0, (0.0, 0.0)
    acting = actuator.acting
    coming: deque[tuple[float, float]] = deque()
    step = loop.period / SUBSTEPS
    for k in range(MOST_SAMPLES):
        late = rng.exponential(LATE)
        if rng.random() < RARELY:
            late += rng.uniform(0.0, VERY_LATE)
        due = max((k + min(late, 0.99)) * loop.period, now)
        while now < due - 1e-12:
            h = min(step, due - now)
            while coming and coming[0][0] <= now + 1e-12:
                acting = coming.popleft()[1]
            slope = loop.flow(x, acting + loop.outside(now))
            middle = loop.flow(x + 0.5 * h * slope, acting + loop.outside(now + 0.5 * h))
            x = x + h * middle
            count += h * float(x[loop.output])
            now += h
        y = float(x[loop.output])
        if loop.velocity:
            steps = loop.step * math.floor(count / loop.step)
            y = (steps - before[1]) / (now - before[0]) if now > before[0] else y
            before = (now, steps)
        y += loop.noise * float(rng.standard_normal())
        if loop.step and not loop.velocity:
            y = loop.step * round(y / loop.step)
        command = tune.step(now, y)
        if tune.finished:
            break
        moved = actuator.move(command)
        coming.append((now + ANSWER * loop.period + loop.delay, moved))
    return tune


def tried(loop: Loop, rng: np.random.Generator) -> Try:
    """Tune once, and judge the gains by the truth."""
    tune = recorded(loop, rng)
    if tune.outcome is not Outcome.COMPLETED:
        return Try("none", tune.reason or "no end")
    found = analyse(tune.record(), alone=True)
    gains, spoke = found.best_gains, [f.name for f in found.judgement.findings if f.result]
    model = found.model.structure if found.model else "no model"
    if gains is None:
        return Try("none", f"{model}: {found.judgement.reason or found.reason}")
    truths = loop.truths()
    ms = max(truth.ms(gains) for truth in truths)
    integral = abs(gains.kc) / gains.ti if gains.ti else 0.0
    share = integral / min(truth.best_integral() for truth in truths)
    right = ms <= RIGHT and share >= TIMID
    trusted = found.verdict is Verdict.TRUSTED
    result = ("good" if trusted else "doubtful") if right else "wrong"
    if not right and not trusted:
        result = "wrong, doubtful"
    return Try(result, f"{model}, Ms {ms:.2f}, {share:.2f} of the integral gain {' '.join(spoke)}")


def _lag(x: float, to: float, time: float) -> float:
    return (to - x) / time


def _nozzle_heater_cools_slower(rng: np.random.Generator) -> Loop:
    gain, up, slower = rng.uniform(300.0, 400.0), rng.uniform(20.0, 40.0), rng.uniform(1.4, 2.0)
    sensor = rng.uniform(1.0, 3.0)

    def nozzle(times: Callable[[float, float], float]) -> Flow:
        def flow(x: FloatArray, u: float) -> FloatArray:
            target = 25.0 + gain * u
            return np.array([_lag(x[0], target, times(target, x[0])), _lag(x[1], x[0], sensor)])

        return flow

    return Loop(
        nozzle(lambda target, x: up if target > x else up * slower), 0.25, (0.0, 1.0), 0.5,
        (25.0 + 0.5 * gain,) * 2, noise=0.1, step=0.25, delay=rng.uniform(0.5, 2.0),
        branches=(nozzle(lambda *_: up), nozzle(lambda *_: up * slower)),
    )  # fmt: skip


def _oven_radiates(rng: np.random.Generator) -> Loop:
    power, element, air = (
        rng.uniform(8.0, 12.0),
        rng.uniform(20.0, 40.0),
        rng.uniform(120.0, 240.0),
    )

    def oven(x: FloatArray, u: float) -> FloatArray:
        out = (x[1] - 293.0) / 2.0 + 2e-9 * (x[1] ** 4 - 293.0**4)
        return np.array([(100.0 * power * u - (x[0] - x[1])) / element, (x[0] - x[1] - out) / air])

    return Loop(
        oven,
        1.0,
        (0.0, 1.0),
        0.4,
        (700.0, 500.0),
        noise=0.1,
        step=0.25,
        delay=rng.uniform(1.0, 4.0),
    )


def _hot_plate_thermistor(rng: np.random.Generator) -> Loop:
    gain, one, two = rng.uniform(1.0, 2.0), rng.uniform(20.0, 60.0), rng.uniform(3.0, 8.0)

    def plate(x: FloatArray, u: float) -> FloatArray:
        return np.array([_lag(x[0], 25.0 + gain * u, one), _lag(x[1], x[0], two)])

    return Loop(
        plate, 0.5, (0.0, 255.0), 60.0, (25.0 + 60.0 * gain,) * 2, noise=0.05, step=0.05,
        delay=0.5, actuator={"stiction": 0.5},
    )  # fmt: skip


def _peltier_element(rng: np.random.Generator) -> Loop:
    bend, tau, sensor = rng.uniform(0.2, 0.4), rng.uniform(15.0, 30.0), rng.uniform(1.0, 3.0)

    def peltier(x: FloatArray, u: float) -> FloatArray:
        return np.array([_lag(x[0], 20.0 * (u + bend * u * u), tau), _lag(x[1], x[0], sensor)])

    return Loop(peltier, 0.2, (-1.0, 1.0), 0.1, (2.0, 2.0), noise=0.02, step=0.0625, delay=0.2)


def _motor_speed_encoder(rng: np.random.Generator) -> Loop:
    gain, tau, current = rng.uniform(15.0, 30.0), rng.uniform(0.08, 0.25), rng.uniform(0.003, 0.01)
    friction = rng.uniform(5.0, 20.0)

    def motor(x: FloatArray, u: float) -> FloatArray:
        return np.array(
            [_lag(x[0], gain * u, current), _lag(x[1], x[0] - friction * np.sign(x[1]), tau)]
        )

    return Loop(
        motor, 0.01, (0.0, 24.0), 12.0, (12.0 * gain, 12.0 * gain - friction), velocity=True,
        step=2.0 * math.pi / 2000.0, delay=0.002,
    )  # fmt: skip


def _servo_position_dry_friction(rng: np.random.Generator) -> Loop:
    gain, tau, friction = rng.uniform(15.0, 30.0), rng.uniform(0.03, 0.1), rng.uniform(2.0, 8.0)

    def servo(dry: float) -> Flow:
        def flow(x: FloatArray, u: float) -> FloatArray:
            drive = gain * u - x[0]
            if abs(x[0]) < 0.05 and abs(drive) <= dry:
                return np.array([-x[0] / 0.002, x[0]])
            return np.array([(drive - dry * np.sign(x[0] or drive)) / tau, x[0]])

        return flow

    return Loop(
        servo(friction), 0.005, (-12.0, 12.0), 0.0, (0.0, 0.0), branches=(servo(0.0),),
        step=2.0 * math.pi / 8000.0, delay=0.002,
    )  # fmt: skip


def _axis_by_its_speed_backlash(rng: np.random.Generator) -> Loop:
    tau = rng.uniform(0.03, 0.08)

    def axis(x: FloatArray, u: float) -> FloatArray:
        return np.array([_lag(x[0], u, tau), x[0]])

    return Loop(
        axis, 0.01, (-200.0, 200.0), 0.0, (0.0, 0.0), step=0.01, delay=rng.uniform(0.01, 0.03),
        actuator={"dead_band": 1.0},
    )  # fmt: skip


def _tank_outflow_by_a_root(rng: np.random.Generator) -> Loop:
    fill, pump, area = rng.uniform(1.5, 2.5), rng.uniform(0.5, 2.0), rng.uniform(20.0, 40.0)

    def tank(x: FloatArray, u: float) -> FloatArray:
        out = math.sqrt(max(x[1], 0.0))
        return np.array([_lag(x[0], fill * u, pump), (x[0] - out) / area])

    return Loop(
        tank, 0.5, (0.0, 1.0), 0.5, (0.5 * fill, 0.25 * fill**2), noise=0.003, step=0.001,
        delay=0.5,
    )  # fmt: skip


def _level_integrating_valve_with_play(rng: np.random.Generator) -> Loop:
    rate = rng.uniform(0.002, 0.006)

    def level(_: FloatArray, u: float) -> FloatArray:
        return np.array([rate * (u - 50.0)])

    return Loop(
        level, 0.05, (0.0, 100.0), 50.0, (3.0,), noise=0.003, delay=rng.uniform(0.5, 1.5),
        actuator={"dead_band": rng.uniform(0.5, 2.0)},
    )  # fmt: skip


def _flow_sticking_valve(rng: np.random.Generator) -> Loop:
    valve, sensor, sticks = rng.uniform(0.5, 1.5), rng.uniform(0.1, 0.4), rng.uniform(0.3, 1.0)

    def pipe(x: FloatArray, u: float) -> FloatArray:
        through = 10.0 * 30.0 ** (x[0] / 100.0 - 1.0)
        return np.array([_lag(x[0], u, valve), _lag(x[1], through, sensor)])

    return Loop(
        pipe, 0.1, (0.0, 100.0), 50.0, (50.0, 2.0), noise=0.01, delay=0.2,
        actuator={"stiction": sticks},
    )  # fmt: skip


def _gas_pressure(rng: np.random.Generator) -> Loop:
    valve, vessel, supply = rng.uniform(0.3, 1.0), rng.uniform(3.0, 8.0), rng.uniform(6.0, 8.0)

    def gas(x: FloatArray, u: float) -> FloatArray:
        into = x[0] * math.sqrt(max(supply - x[1], 1e-6))
        out = 0.4 * math.sqrt(max(x[1] - 1.0, 1e-6))
        return np.array([_lag(x[0], u, valve), (into - out) / vessel * 4.0])

    return Loop(gas, 0.1, (0.0, 1.0), 0.3, (0.3, 4.0), noise=0.003, step=0.002, delay=0.1)


def _room_weather_and_a_door(rng: np.random.Generator) -> Loop:
    radiator, air, wall = (
        rng.uniform(200.0, 400.0),
        rng.uniform(600.0, 1200.0),
        rng.uniform(2e4, 5e4),
    )
    swing, phase = rng.uniform(0.5, 1.5), rng.uniform(0.0, 6.0)
    opened, lost = rng.uniform(5000.0, 15000.0), rng.uniform(1.0, 3.0)

    def room(x: FloatArray, u: float) -> FloatArray:
        return np.array(
            [
                _lag(x[0], u, radiator),
                (0.15 * x[0] - (x[1] - x[2])) / air,
                ((x[1] - x[2]) - (x[2] - 15.0)) / wall,
            ]
        )

    def weather(t: float) -> float:
        door = -lost if opened < t < opened + 600.0 else 0.0
        return swing * math.sin(2.0 * math.pi * t / 40_000.0 + phase) + door

    return Loop(
        room, 20.0, (0.0, 100.0), 40.0, (40.0, 27.0, 21.0), output=1, noise=0.02, step=0.05,
        delay=30.0, outside=weather,
    )  # fmt: skip


def _water_heater_draws(rng: np.random.Generator) -> Loop:
    gain, tank_time, pipe_time = (
        rng.uniform(0.4, 0.8),
        rng.uniform(60.0, 120.0),
        rng.uniform(6.0, 15.0),
    )
    draws = np.random.default_rng(rng.integers(1 << 30)).normal(0.0, 0.4, 4000)
    walk = np.cumsum(draws)

    def boiler(x: FloatArray, u: float) -> FloatArray:
        return np.array([_lag(x[0], 15.0 + gain * u, tank_time), _lag(x[1], x[0], 3.0)])

    return Loop(
        boiler, 1.0, (0.0, 100.0), 50.0, (15.0 + 50.0 * gain,) * 2, noise=0.05, step=0.1,
        delay=pipe_time, outside=lambda t: 0.2 * float(walk[min(int(t / 20.0), 3999)]),
    )  # fmt: skip


def _heat_exchanger_coolant(rng: np.random.Generator) -> Loop:
    units, stage = rng.uniform(1.0, 2.0), rng.uniform(2.0, 5.0)

    def exchanger(x: FloatArray, u: float) -> FloatArray:
        to = 80.0 - 50.0 * (1.0 - math.exp(-units * max(u, 0.0) / 50.0))
        return np.array([_lag(b, a, stage) for a, b in zip((to, *x[:-1]), x, strict=True)])

    return Loop(exchanger, 0.5, (0.0, 100.0), 40.0, (50.0,) * 4, noise=0.05, step=0.05, delay=2.0)


def _belt_with_a_scale(rng: np.random.Generator) -> Loop:
    def scale(x: FloatArray, u: float) -> FloatArray:
        return np.array([_lag(x[0], 0.5 * u, 1.0)])

    return Loop(scale, 0.2, (0.0, 100.0), 50.0, (25.0,), noise=0.2, delay=rng.uniform(4.0, 8.0))


def _belt_drive_speed_of_the_load(rng: np.random.Generator) -> Loop:
    swings, damping, tau = rng.uniform(25.0, 45.0), rng.uniform(0.05, 0.2), rng.uniform(0.1, 0.3)

    def two_masses(x: FloatArray, u: float) -> FloatArray:
        # Motor, twist of the belt with its speed, and the load.
        return np.array(
            [
                _lag(x[0], 10.0 * u, tau),
                x[2],
                swings**2 * (x[0] - x[1]) - 2.0 * damping * swings * x[2],
            ]
        )

    return Loop(
        two_masses, 0.005, (0.0, 10.0), 5.0, (50.0, 50.0, 0.0), output=1, noise=0.1, step=0.05,
        delay=0.005,
    )  # fmt: skip


def _flexible_joint_position(rng: np.random.Generator) -> Loop:
    swings, damping = rng.uniform(15.0, 30.0), rng.uniform(0.1, 0.3)

    def joint(x: FloatArray, u: float) -> FloatArray:
        return np.array(
            [
                _lag(x[0], u, 0.03),
                x[0],
                x[3],
                swings**2 * (x[1] - x[2]) - 2.0 * damping * swings * (x[3] - x[0]),
            ]
        )

    return Loop(
        joint, 0.005, (-2.0, 2.0), 0.0, (0.0,) * 4, output=2, step=2.0 * math.pi / 16384.0,
        delay=0.01,
    )  # fmt: skip


def _drone_roll_rate(rng: np.random.Generator) -> Loop:
    strength, drag, rotor = (
        rng.uniform(80.0, 200.0),
        rng.uniform(0.5, 2.0),
        rng.uniform(0.03, 0.06),
    )

    def roll(x: FloatArray, u: float) -> FloatArray:
        return np.array([_lag(x[0], u, rotor), strength * x[0] - drag * x[1]])

    return Loop(roll, 0.004, (-1.0, 1.0), 0.0, (0.0, 0.0), noise=0.02, step=0.001, delay=0.008)


def _drone_climb(rng: np.random.Generator) -> Loop:
    drag, rotor = rng.uniform(0.3, 0.8), rng.uniform(0.06, 0.15)

    def climb(x: FloatArray, u: float) -> FloatArray:
        return np.array([_lag(x[0], u, rotor), 9.81 * ((x[0] / 0.5) ** 2 - 1.0) - drag * x[1]])

    return Loop(climb, 0.02, (0.0, 1.0), 0.5, (0.5, 0.0), noise=0.05, delay=0.02)


def _fan_that_cools_a_chip(rng: np.random.Generator) -> Loop:
    heat, mass = rng.uniform(60.0, 100.0), rng.uniform(60.0, 120.0)

    def chip(x: FloatArray, u: float) -> FloatArray:
        through = 0.6 + 2.0 * max(x[0], 0.0) ** 0.7
        warmer = (heat - through * (x[1] - 25.0)) / mass
        return np.array([_lag(x[0], u, 1.5), warmer, _lag(x[2], x[1], 2.0)])

    return Loop(chip, 0.5, (0.0, 1.0), 0.5, (0.5, 60.0, 60.0), noise=0.05, step=0.125, delay=0.5)


KINDS: dict[str, Callable[[np.random.Generator], Loop]] = {
    "nozzle heater, cools slower": _nozzle_heater_cools_slower,
    "oven, radiates": _oven_radiates,
    "hot plate, thermistor": _hot_plate_thermistor,
    "Peltier element": _peltier_element,
    "motor speed, encoder": _motor_speed_encoder,
    "servo position, dry friction": _servo_position_dry_friction,
    "axis by its speed, backlash": _axis_by_its_speed_backlash,
    "tank, outflow by a root": _tank_outflow_by_a_root,
    "level, integrating, valve with play": _level_integrating_valve_with_play,
    "flow, sticking valve": _flow_sticking_valve,
    "gas pressure": _gas_pressure,
    "room, weather and a door": _room_weather_and_a_door,
    "water heater, draws": _water_heater_draws,
    "heat exchanger, coolant": _heat_exchanger_coolant,
    "belt with a scale": _belt_with_a_scale,
    "belt drive, speed of the load": _belt_drive_speed_of_the_load,
    "flexible joint, position": _flexible_joint_position,
    "drone, roll rate": _drone_roll_rate,
    "drone, climb": _drone_climb,
    "fan that cools a chip": _fan_that_cools_a_chip,
}


def main() -> None:
    """Print the table of kinds, and what did not end well."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tries", type=int, default=TRIES, help="tunes of each kind")
    parser.add_argument(
        "--first", type=int, default=1, help="the first seed; every other number follows"
    )
    parser.add_argument("--kind", default="", help="only kinds whose name has this in it")
    parser.add_argument("--quick", action="store_true", help="only show that it runs")
    asked = parser.parse_args()
    names = [n for n in KINDS if asked.kind in n]
    rows, worse, all_ = [], [], Counter[str]()
    for name in names[:1] if asked.quick else names:
        counts: Counter[str] = Counter()
        for k in range(1 if asked.quick else asked.tries):
            rng = np.random.default_rng(asked.first + 2 * k)
            try_ = tried(KINDS[name](rng), rng)
            counts[try_.result] += 1
            if try_.result != "good":
                worse.append((name, asked.first + 2 * k, try_.result, try_.why.strip()))
        print(name, dict(counts), file=sys.stderr, flush=True)
        rows.append((name, *(counts[r] for r in RESULTS)))
        all_ += counts
    rows.append(("all", *(all_[r] for r in RESULTS)))
    print(table(("loop", *RESULTS), rows))
    share = 100.0 * all_["good"] / sum(all_.values())
    print(f"\ngood and trusted: {share:.1f} % (target 95 %); wrong: {all_['wrong']} (target 0)")
    if worse:
        print("\nNot good:\n")
        print(table(("loop", "seed", "result", "why"), worse))


if __name__ == "__main__":
    main()
