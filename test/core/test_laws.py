# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The laws of other programs, each beside the loop of its source, written out here again."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from fopdt_plant import FopdtPlant

from relay_autotune.control.controller import (
    Control,
    LawController,
    PidController,
    PredictedLoop,
    Step,
    simulate_closed_loop,
)
from relay_autotune.control.verification import compare, plan
from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate
from relay_autotune.loop.laws import LAWS
from relay_autotune.loop.sampled import Limits
from relay_autotune.process.structures import INTEGRATOR_LAG
from relay_autotune.process.transfer_function import TransferFunction

PERIOD = 0.25
WANTED = Controller(kc=1.3, ti=2.0, td=0.6, tf=0.7, b=0.4)
PROCESS = TransferFunction.fopdt(0.9, 2.0, 0.8)


def toolbox(s, h, has_velocity=False):
    """control_toolbox::Pid: u first, then the integral; legacy the other way round."""
    integral = last = 0.0
    while True:
        r, y = yield
        e = r - y
        seen = -y if has_velocity else e
        d, last = (seen - last) / h, seen
        if s["antiwindup_strategy"] == "legacy":
            integral += s["i"] * h * e
        u = s["p"] * e + integral + s["d"] * d
        if s["antiwindup_strategy"] != "legacy":
            integral += h * s["i"] * e
        yield u


def sum_and_clamp(names):
    """Arduino's PID_v1 and simple-pid: a sum that may hold the proportional part too."""

    def law(s, h):
        kp, ki, kd = (s[n] for n in names)
        if s.get("ControllerDirection") == "REVERSE":
            kp, ki, kd = -kp, -ki, -kd
        on_measurement = "P_ON_M" in s.values() or "True" in s.values()
        total = last = 0.0
        while True:
            r, y = yield
            total += ki * h * (r - y)
            if on_measurement:
                total -= kp * (y - last)
            u = total - kd * (y - last) / h + (0.0 if on_measurement else kp * (r - y))
            last = y
            yield u

    return law


def esphome(s, h):
    total = last_error = last_setpoint = 0.0
    seen = [0.0] * int(s["derivative_averaging_samples"])
    while True:
        r, y = yield
        e = r - y
        total += e * h * s["ki"]
        last_error -= last_setpoint - r
        seen = [(e - last_error) / h, *seen[:-1]]
        last_error, last_setpoint = e, r
        yield s["kp"] * e + total + s["kd"] * sum(seen) / len(seen)


def klipper(s, h):
    p, i, d = (s[f"pid_K{n}"] / 255.0 for n in "pid")
    total = last = slope = waiting = 0.0
    while True:
        r, y = yield
        t = s["smooth_time"]
        slope = (y - last) / h if h >= t else (slope * (t - h) + y - last) / t
        total += (r - y) * h
        now, waiting = waiting, p * (r - y) + i * total - d * slope
        last = y
        yield now


def marlin(s, h):
    total = last = work = 0.0
    ki, kd = s["DEFAULT_Ki"] * h, s["DEFAULT_Kd"] / h
    while True:
        r, y = yield
        total += r - y
        work += (1.0 - s["PID_K1"]) * (kd * (last - y) - work)
        last = y
        yield (s["DEFAULT_Kp"] * (r - y) + ki * total + work) / 255.0


def px4(s, h):
    total = 0.0
    while True:
        r, y = yield
        u = s["MC_ROLLRATE_P"] * (r - y) + total
        total += s["MC_ROLLRATE_I"] * (r - y) * h
        yield u


def ardupilot(s, h):
    total = error = slope = 0.0
    cutoff = s["ATC_RAT_RLL_FLTD"]
    alpha = h / (h + 1.0 / (2.0 * math.pi * cutoff)) if cutoff else 1.0
    while True:
        r, y = yield
        last, error = error, r - y
        slope += alpha * ((error - last) / h - slope)
        total += error * s["ATC_RAT_RLL_I"] * h
        yield s["ATC_RAT_RLL_P"] * error + total + s["ATC_RAT_RLL_D"] * slope


def iec(s, h):
    total = x1 = x2 = x3 = 0.0
    while True:
        r, y = yield
        error = y - r
        total += error * h
        slope = (3.0 * (error - x3) + x1 - x2) / (10.0 * h)
        x3, x2, x1 = x2, x1, error
        yield s["KP"] * (error + total / s["TR"] + slope * s["TD"])


def oscat(s, h):
    total = last = 0.0
    while True:
        r, y = yield
        e = r - y
        total += (e + last) * 0.5 * h / s["TN"]
        slope, last = (e - last) / h * s["TV"], e
        yield s["KP"] * (total + slope + e)


def our_own(s, h):
    gains = Controller(**s)
    node = PidController(gains, 0.0)
    node.step(-h, 0.0, 0.0)
    for k in itertools.count():
        r, y = yield
        yield node.step(k * h, r, y)


STRATEGIES = ("none", "legacy", "back_calculation", "conditional_integration")
SOURCES = {
    "controller_node": our_own,
    **{f"control_toolbox_{s}": toolbox for s in STRATEGIES},
    **{f"control_toolbox_{s}_velocity": partial(toolbox, has_velocity=True) for s in STRATEGIES},
    "pid_controller": toolbox,
    "arduino_pid_v1": sum_and_clamp(("Kp", "Ki", "Kd")),
    "simple_pid": sum_and_clamp(("Kp", "Ki", "Kd")),
    "esphome_pid": esphome,
    "klipper_heater": klipper,
    "marlin_heater": marlin,
    "px4_rate": px4,
    "ardupilot_rate": ardupilot,
    "iec_61131_3_pid": iec,
    "oscat_ft_pid": oscat,
}


class Source:
    """A law as its source has it, with the parameters that are exported for it."""

    def __init__(self, name, gains, period=PERIOD):
        self.period = period
        law = LAWS[name].at(gains, period)
        settings = {s.name: s.of(law) for s in law.law.settings}
        self._law = SOURCES[name](settings, period)
        next(self._law)

    def step(self, setpoint, measurement):
        command = self._law.send((setpoint, measurement))
        next(self._law)
        return command


def test_every_law_has_its_source_here():
    assert set(SOURCES) == set(LAWS)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("name", LAWS)
def test_a_law_does_what_its_source_does(name, sign):
    law = LAWS[name]
    wanted = Controller(sign * WANTED.kc, WANTED.ti, WANTED.td, WANTED.tf, WANTED.b)
    if sign < 0.0 and law.only_positive:
        with pytest.raises(TuningError, match="positive gains only"):
            law.best(wanted, PERIOD)
        return
    gains = law.best(wanted, PERIOD)
    rng = np.random.default_rng(4)
    source, running = Source(name, gains), law.at(gains, PERIOD).running()
    for r, y in rng.standard_normal((50, 2)):
        assert running.step(r, y) == pytest.approx(source.step(r, y), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", LAWS)
def test_a_step_of_the_set_point_moves_the_command_at_once_as_its_source_does(name):
    law = LAWS[name]
    gains = law.best(WANTED, PERIOD)
    source = Source(name, gains)
    # Its derivative has 3, 4 and 3 of 10 in three samples, that of all others is over after one.
    first = 2 if name == "iec_61131_3_pid" else 1
    answers = [source.step(1.0, 0.0) for _ in range(first + law.delay)]
    assert law.at(gains, PERIOD).jump == pytest.approx(max(answers), rel=1e-9)


@pytest.mark.parametrize("tf", [0.0, 0.7])
@pytest.mark.parametrize("name", LAWS)
def test_its_transfer_functions_are_those_of_its_source(name, tf):
    law = LAWS[name]
    gains = law.best(Controller(1.3, 2.0, 0.6, tf, 1.0), PERIOD)
    sampled = law.at(gains, PERIOD)
    # Outside of the unit circle the sum over an impulse's response ends soon.
    z = 1.15 * np.exp(1j * np.linspace(0.0, math.pi, 7))
    powers = z[:, None] ** -np.arange(400.0)
    for function, impulse, sign in (
        (sampled, (0.0, 1.0), -1.0),
        (sampled.from_setpoint, (1.0, 0.0), 1.0),
    ):
        source = Source(name, gains)
        answers = [source.step(*impulse), *(source.step(0.0, 0.0) for _ in range(399))]
        assert function(np.log(z) / PERIOD) == pytest.approx(sign * powers @ answers, rel=1e-9)


@pytest.mark.parametrize("name", LAWS)
def test_its_ms_is_that_of_a_sinusoidal_test_of_its_source(name):
    law = LAWS[name]
    gains = law.best(WANTED, PERIOD)
    loop = Loop(law.at(gains, PERIOD), PROCESS)
    found, frequency = loop.margins()
    plant, source, command = FopdtPlant(0.9, 2.0, 0.8), Source(name, gains), 0.0
    turns, count = frequency * PERIOD, 1200
    seen = np.empty(count)
    for k in range(count):
        seen[k] = plant.advance(k * PERIOD, command) + math.sin(turns * k)
        command = source.step(0.0, seen[k])
    k = np.arange(count // 2, count)
    waves = np.column_stack((np.sin(turns * k), np.cos(turns * k)))
    (a, b), *_ = np.linalg.lstsq(waves, seen[k], rcond=None)
    assert math.hypot(a, b) == pytest.approx(found.ms, rel=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("period", [0.3, 1.7])
@pytest.mark.parametrize(
    ("model", "ti"),
    [
        (PROCESS, 2.0),
        (TransferFunction(1.0, (-0.3,), (1.0, 1.0, 1.0)), 2.0),
        (INTEGRATOR_LAG.build((0.3, 0.5, 0.7)), 20.0),
        (TransferFunction.oscillator(1.0, 2.0, 0.3, 0.5), 2.0),
    ],
    ids=["fopdt", "inverse", "integrating", "oscillating"],
)
def test_responses_and_figures_are_those_of_a_simulation(model, ti, period):
    law = LAWS["arduino_pid_v1"]
    sampled = law.at(Controller(0.25, ti, 0.3, 0.0, 1.0), period)
    found = Loop(sampled, model).performance()
    count = int(200.0 / period)
    setpoint, load = (
        simulate_closed_loop(sampled, model, period=period, duration=count * period, **step)
        for step in ({"setpoint": 1.0}, {"load": 1.0, "load_time": -1.0})
    )
    responses = Loop(sampled, model).step_responses(2 * count * period, 2 * count)
    for run, response in zip((setpoint, load), responses, strict=True):
        assert run.command[:count] == pytest.approx(response.command[:count], abs=1e-6)
    errors = period * np.abs(1.0 - setpoint.measurement).sum()
    assert found.iae_setpoint == pytest.approx(errors, rel=2e-3)
    assert found.overshoot == pytest.approx(max(setpoint.measurement.max() - 1.0, 0.0), abs=1e-4)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["pid_controller", "ardupilot_rate"])
def test_a_law_far_faster_than_its_loop_has_the_effort_of_its_simulation(name):
    """So many samples are not computed one by one, and the derivative kicks in a few of them."""
    period = 1e-3
    law = LAWS[name].at(LAWS[name].best(Controller(1.0, 2.5, 0.1, 0.02), period), period)
    run = simulate_closed_loop(law, PROCESS, period=period, duration=20.0, setpoint=1.0)
    effort = abs(run.command[0]) + np.abs(np.diff(run.command)).sum()
    figures = Loop(law, PROCESS).performance()
    # What comes back of a plain derivative's kick lasts one sample, too, and is not resolved.
    assert figures.effort_setpoint == pytest.approx(effort, rel=0.05)
    assert figures.overshoot == pytest.approx(max(run.measurement.max() - 1.0, 0.0), abs=2e-3)


@pytest.mark.long
def test_noise_reaches_the_command_as_said():
    law = LAWS["marlin_heater"]
    gains = law.best(WANTED, PERIOD)
    sampled = law.at(gains, PERIOD)
    noise = np.random.default_rng(1).standard_normal(6000)
    run = simulate_closed_loop(
        sampled, PROCESS, period=PERIOD, duration=5999 * PERIOD, noise=noise
    )
    said = Loop(sampled, PROCESS).noise_gain()
    assert np.std(run.command) == pytest.approx(said, rel=0.04)


def test_stability_is_that_of_the_roots_of_the_characteristic_polynomial():
    rng = np.random.default_rng(7)
    decided = []
    for _ in range(60):
        pole, wait = math.exp(-PERIOD / 2.0), int(rng.integers(1, 8))
        model = TransferFunction.fopdt(1.0, 2.0, (wait - 1) * PERIOD)
        gains = Controller(float(rng.uniform(0.1, 12.0)), float(rng.uniform(0.3, 5.0)))
        loop = Loop(LAWS["control_toolbox_none"].at(gains, PERIOD), model)
        # (z - 1)(z - a) z^(wait - 1) + (1 - a)(p (z - 1) + i h) = 0
        roots = np.roots(
            np.polyadd(
                np.convolve(np.poly([1.0, pole]), [1.0, *[0.0] * (wait - 1)]),
                (1.0 - pole) * np.array([gains.p, gains.i * PERIOD - gains.p]),
            )
        )
        assert loop.unstable_poles == np.sum(np.abs(roots) > 1.0)
        decided.append(loop.unstable_poles)
    assert 10 < sum(n == 0 for n in decided) < 50


def test_gains_that_a_law_cannot_run_are_refused():
    with pytest.raises(TuningError, match="without integral action"):
        LAWS["iec_61131_3_pid"].best(Controller(1.0, 0.0), PERIOD)
    wild = LAWS["simple_pid"].at(Controller(30.0, 1.0), PERIOD)
    with pytest.raises(TuningError, match="simple_pid runs it every"):
        Loop(wild, PROCESS).performance()
    # exp(-s h) is 1 to the last digit at the frequencies of so slow a loop.
    faint = LAWS["simple_pid"].at(Controller(1e-9, 50.0), 1e-5)
    with pytest.raises(TuningError, match="does next to nothing"):
        Loop(faint, PROCESS).performance()


@pytest.mark.parametrize("name", LAWS)
def test_the_controller_that_runs_a_law_does_what_its_source_does_about_a_rest(name):
    rate = LawRate(LAWS[name], PERIOD)
    gains = rate.of(WANTED)
    source, controller = Source(name, gains.gains), LawController(rate, WANTED, 2.0)
    assert controller.step(7.0, 40.0, 40.0) == 2.0
    rng = np.random.default_rng(4)
    for k, (r, y) in enumerate(rng.standard_normal((40, 2)), start=1):
        late = k + 0.2 * rng.uniform(-1.0, 1.0)
        found = controller.step(7.0 + late * PERIOD, 40.0 + r, 40.0 + y)
        assert found == pytest.approx(2.0 + source.step(r, y), rel=1e-9, abs=1e-9)
        # A sample between two runs is not answered.
        assert controller.step(7.0 + (late + 0.4) * PERIOD, 40.0, 30.0) == found


@pytest.mark.parametrize("name", ["pid_controller", "klipper_heater", "iec_61131_3_pid"])
def test_a_step_of_a_law_is_predicted_as_its_source_makes_it(name):
    rate = LawRate(LAWS[name], PERIOD)
    gains, step = Controller(kc=0.9, ti=2.0, td=0.2), Step(setpoint=0.5)
    loop = PredictedLoop(Control(gains, rate), PROCESS)
    wanted = plan(loop, step, PERIOD)
    plant, source = FopdtPlant(0.9, 2.0, 0.8), Source(name, rate.of(gains).gains)
    time, command = np.arange(int(wanted.duration / PERIOD)) * PERIOD, 0.0
    seen = np.empty(time.size)
    for k, t in enumerate(time):
        seen[k] = plant.advance(t, command)
        command = source.step(step.setpoint, seen[k])
    found = compare(loop, step, time, seen)
    assert found.passed, found.reason
    assert found.predicted == pytest.approx(seen, abs=1e-6)
    assert found.ms_predicted == Loop(rate.of(gains), PROCESS).ms()
    with pytest.raises(TuningError, match=f"{name} runs every 0.25 s"):
        plan(loop, step, 2.0 * PERIOD)
    # A program that runs by itself does not wait for samples: every third is heard, and one lost.
    there = np.delete(np.arange(0, time.size, 3), 4)
    elsewhere = replace(loop, control=replace(loop.control, elsewhere=True))
    plan(elsewhere, step, 3.0 * PERIOD)
    heard = elsewhere.run(time[there], step)
    assert heard.measurement == pytest.approx(seen[there], abs=1e-6)


def test_at_a_limit_the_integral_of_a_law_stops():
    rate = LawRate(LAWS["control_toolbox_none"], PERIOD)
    controller = LawController(rate, Controller(0.5, 2.0), 0.9, limits=Limits(0.0, 1.0))
    commands = [controller.step(k * PERIOD, 41.0, 40.0) for k in range(200)]
    assert commands[0] == 0.9
    assert set(commands[5:]) == {1.0}
    # Without the windup of 50 s the command leaves the limit as soon as the error turns.
    assert controller.step(200 * PERIOD, 40.0, 40.0) < 0.6
