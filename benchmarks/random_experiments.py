# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Relay experiments on random processes, with noise, disturbances and faults, without DDS."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np

from relay_autotune.errors import ModelError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.faults import SafePolicy
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import State
from relay_autotune.process.simulation import simulate_relay
from relay_autotune.process.structures import structure_named
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Actuator, Disturbances, VirtualProcess
from relay_autotune.record.record import Cycle, Outcome, RelaySettings

STRUCTURES = (
    *("fopdt",) * 4,
    *("sopdt", "sopdt", "oscillator", "lag_n", "lag_n", "three_lags", "two_equal_one"),
    *("lag_complex", "lag_n_zero", "sopdt_zero"),
    *("ipdt", "ipdt", "integrator_lag", "integrator_lag", "integrator_inverse"),
    *("unstable_fopdt", "unstable_fopdt", "unstable_sopdt"),
)
NOTHING = "undisturbed"
DISTURBANCES = ("load", "drift", "coarse sensor", "sticking valve", "lost samples")
FAULTS = (
    *("not a number", "silent sensor", "frozen sensor", "measurement limit", "deviation"),
    *("time backwards", "wrong sign", "stuck actuator", "abort", "time over"),
)
HAPPENINGS = (*(NOTHING,) * 8, *DISTURBANCES, *FAULTS)
# After these, sensor and actuator still work, so that a process can be held.
HOLDABLE = ("measurement limit", "deviation", "abort", "time over")

PER_CYCLE = (40, 200)
IDEAL_CYCLES = 5
# In standard deviations of the noise, as the node chooses it.
HYSTERESIS = 3.0
LARGEST_RATIO = 0.2
FOUND_SHARE = 0.2
GIVEN_SIGN_SHARE = 0.3
SAMPLES = 100_000
SETTLING = 60
BELOW_BASELINE = 0.125
HELD_SAMPLES = 5
HELD_CYCLES = 3.0
HELD_SWINGS = 3.0
# Mean magnitude of a Gaussian number of standard deviation 1.
MEAN_NOISE = math.sqrt(2.0 / math.pi)


def random_process(rng: np.random.Generator) -> TransferFunction:
    """Return a process of a known structure, its slowest time constant about 1 s."""
    kind = STRUCTURES[rng.integers(len(STRUCTURES))]
    gain = float(np.exp(rng.uniform(-2.0, 2.0))) * (1.0 if rng.uniform() < 0.7 else -1.0)
    tau = float(np.exp(rng.uniform(-0.7, 0.7)))
    dead = float(np.exp(rng.uniform(math.log(0.05), math.log(3.0))))
    small = tau * float(rng.uniform(0.1, 0.9))
    smaller = small * float(rng.uniform(0.1, 0.6))
    zero = -tau * float(rng.uniform(0.1, 1.0))
    order = int(rng.integers(2, 6))
    swing = {"natural_frequency": 1.0 / tau, "damping": float(rng.uniform(0.3, 0.9))}
    # For an unstable process D/tau must stay below the value that a biased relay can hold.
    short = tau * float(np.exp(rng.uniform(math.log(0.03), math.log(0.4))))

    def build(structure: str, **fields: Any) -> TransferFunction:
        return structure_named(structure).of_fields(**fields)

    match kind:
        case "fopdt" | "integrator_lag":
            return build(kind, gain=gain, time_constants=[tau], dead_time=dead)
        case "sopdt" | "two_equal_one":
            return build(kind, gain=gain, time_constants=[tau, small], dead_time=dead)
        case "oscillator":
            return build("sopdt", gain=gain, dead_time=dead, **swing)
        case "lag_n":
            return build(kind, gain=gain, time_constants=[tau], order=order, dead_time=dead)
        case "three_lags":
            return build(kind, gain=gain, time_constants=[tau, small, smaller], dead_time=dead)
        case "lag_complex":
            return build(kind, gain=gain, time_constants=[small], dead_time=dead, **swing)
        case "lag_n_zero":
            return build(
                kind,
                gain=gain,
                time_constants=[tau],
                order=min(order, 4),
                zeros=[zero],
                dead_time=dead,
            )
        case "sopdt_zero":
            return build(
                kind, gain=gain, time_constants=[tau, small], zeros=[zero], dead_time=dead
            )
        case "integrator_inverse":
            return build(
                kind, gain=gain, time_constants=[tau], zeros=[-0.5 * small], dead_time=dead
            )
        case "unstable_fopdt":
            return build(kind, gain=gain, time_constants=[tau], dead_time=short)
        case "unstable_sopdt":
            return build(kind, gain=gain, time_constants=[tau, 0.5 * short], dead_time=0.5 * short)
    return build("ipdt", gain=gain, dead_time=dead)


@dataclass(frozen=True)
class Oscillation:
    """The oscillation of a process under a relay that sees the noise.

    :param cycle: the last cycle, without noise.
    :param noise_std: of the sensor [y].
    :param ratio: mean magnitude of the noise over that of the noise-free oscillation about its
        operating point, N2 of Wang, Hang & Zou (1997).
    """

    cycle: Cycle
    noise_std: float
    ratio: float

    @property
    def swing(self) -> float:
        """Half the distance of the peaks [y]."""
        return _half_swing(self.cycle)


def oscillation(model: TransferFunction, ratio: float) -> Oscillation:
    """Return how a process oscillates under the node's own relay, of amplitude 1.

    :param model: the process.
    :param ratio: the wanted noise-to-signal ratio.
    :raises ModelError: if there is no limit cycle with the hysteresis that the noise asks for.
    """
    # The noise asks for hysteresis, and that makes the swing larger, but leaves its shape.
    free = _ideal(model, 0.0)
    share = ratio / MEAN_NOISE * _mean(model, 0.0, free) / _half_swing(free)
    noise = share * _half_swing(_ideal(model, share * _half_swing(free)))
    cycle = _ideal(model, noise)
    return Oscillation(cycle, noise, MEAN_NOISE * noise / _mean(model, noise, cycle))


def _ideal(model: TransferFunction, noise: float) -> Cycle:
    return simulate_relay(model, _settings(model, noise), cycles=IDEAL_CYCLES).cycles[-1]


def _mean(model: TransferFunction, noise: float, cycle: Cycle) -> float:
    time = cycle.start + cycle.period * np.arange(200) / 200
    run = simulate_relay(model, _settings(model, noise), cycles=IDEAL_CYCLES)
    return float(np.mean(np.abs(run.output(time))))


def _settings(model: TransferFunction, noise: float) -> RelaySettings:
    bias = ExperimentParameters(amplitude=1.0).relay_bias
    reverse = model.process_sign < 0
    return RelaySettings(0.0, 0.0, 1.0, bias, HYSTERESIS * noise, reverse_acting=reverse)


def _half_swing(cycle: Cycle) -> float:
    return 0.5 * (cycle.peak_max - cycle.peak_min)


class Experiment:
    """One experiment and what happens in it.

    :param seed: of everything random; what happens goes round with it.
    """

    def __init__(self, seed: int) -> None:
        rng = self.rng = np.random.default_rng((seed, 7))
        self.happening = HAPPENINGS[seed % len(HAPPENINGS)]
        self.model, self.expected = self._drawn()
        cycle, swing = self.expected.cycle, self.expected.swing
        noise = self.expected.noise_std
        self.per_cycle = int(rng.integers(*PER_CYCLE))
        self.period = cycle.period / self.per_cycle
        self.baseline, rest = (float(v) for v in rng.uniform(-5.0, 5.0, 2))
        self.safe = self.baseline - BELOW_BASELINE
        self.finds_amplitude = bool(rng.uniform() < FOUND_SHARE)
        faulty = self.happening in FAULTS
        begin = SETTLING * self.period + (0.0 if faulty else 2.5 * cycle.period)
        self.moment = float(rng.uniform(begin, SETTLING * self.period + 4.5 * cycle.period))
        self.lost = float(rng.uniform(0.05, 0.3))
        acting: dict[str, float] = {"noise_std": noise}
        if self.happening == "load":
            acting |= {"load_time": self.moment, "load_size": float(rng.uniform(-0.5, 0.5))}
        if self.happening == "drift":
            acting["drift"] = float(rng.uniform(-0.1, 0.1)) * swing / cycle.period
        if self.happening == "coarse sensor":
            acting["quantisation"] = float(rng.uniform(0.02, 0.25)) * swing
        band = float(rng.uniform(0.02, 0.15)) if self.happening == "sticking valve" else 0.0
        self.plant = VirtualProcess(
            self.model,
            rest_measurement=rest,
            rest_command=self.baseline,
            actuator=Actuator(self.baseline, stiction=band, dead_band=band),
            disturbances=Disturbances(**acting),
            seed=seed,
        )
        self.tune = RelayExperiment(
            ExperimentParameters(**self._given(rest)),  # type: ignore[arg-type]
            self.baseline,
            policy=SafePolicy(command=self.safe, hold=not self.model.is_stable),
        )
        self.caused_at = self.ended_at = -1
        """Sample before which the cause was there, and at which the safe command went out."""
        self.late = False
        """True if the safe command was not the answer to the sample that carried the cause."""
        self.unsafe = False
        """True if the command after the end was not the safe one, or the process ran away."""

    def _drawn(self) -> tuple[TransferFunction, Oscillation]:
        while True:
            model = random_process(self.rng)
            try:
                return model, oscillation(model, float(self.rng.uniform(0.0, LARGEST_RATIO)))
            except ModelError:
                # A relay of this kind cannot hold this process, so it is left out.
                continue

    def _given(self, rest: float) -> dict[str, float | int]:
        noise, swing = self.expected.noise_std, self.expected.swing
        given: dict[str, float | int] = {"amplitude": 1.0}
        if self.finds_amplitude:
            given = {"command_min": self.baseline - 3.0, "command_max": self.baseline + 3.0}
        # The direction of an unstable process has to be given, as the guide says.
        unstable = any(t.real < 0.0 for t in self.model.time_constants)
        if unstable or self.rng.uniform() < GIVEN_SIGN_SHARE:
            given["process_gain_sign"] = self.model.process_sign
        if self.happening == "measurement limit":
            given |= {
                "measurement_min": rest - 0.5 * swing - 3.0 * noise,
                "measurement_max": rest + 0.5 * swing + 3.0 * noise,
            }
        if self.happening == "deviation":
            given["max_deviation"] = 0.5 * swing + 3.0 * noise
        if self.happening == "wrong sign":
            given["process_gain_sign"] = -self.model.process_sign
        if self.happening == "time over":
            given["max_duration"] = self.moment
        return given

    def run(self) -> None:
        """Run it to its end and a little on; notes when the cause came and when it was heeded."""
        tune, plant, period = self.tune, self.plant, self.period
        frozen = stuck = math.nan
        for k in range(SAMPLES):
            t = k * period
            y = plant.measure(t)
            now = t >= self.moment and self.happening in FAULTS
            if self.happening == "lost samples" and self.rng.uniform() < self.lost:
                continue
            if now and self.caused_at < 0:
                self.caused_at = k
            if now and self.happening in ("silent sensor", "abort"):
                # The watchdog on a silent sensor is the node's, on its steady clock.
                why = "on request" if self.happening == "abort" else "no measurement"
                command = tune.abort(why, t)
                self._after(k, y, command, expected=tune.outcome is Outcome.ABORTED)
                return
            if now and self.happening == "frozen sensor":
                frozen = y if math.isnan(frozen) else frozen
                y = frozen
            if now and self.happening == "not a number":
                y = math.nan if self.rng.uniform() < 0.5 else math.inf
            at = t - 1.5 * period if now and self.happening == "time backwards" else t
            command = tune.step(at, y)
            if tune.finished:
                self._after(k, y, command, expected=True)
                return
            if self._is_over(t, y) or (now and self.happening == "time backwards"):
                # The cause was there, and the tune went on.
                self.late = True
            if now and self.happening == "stuck actuator":
                stuck = command if math.isnan(stuck) else stuck
                command = stuck
            plant.command(command)

    def _is_over(self, t: float, y: float) -> bool:
        """Return whether a sample is one on which the tune has to end."""
        p, settings = self.tune.parameters, self.tune.settings
        if not math.isfinite(y) or not p.measurement_min <= y <= p.measurement_max:
            return True
        if 0.0 < p.max_duration < t:
            return True
        if settings is None or self.tune.state is State.SETTLING or p.max_deviation == 0.0:
            return False
        return abs(y - settings.setpoint) > p.max_deviation

    def _after(self, k: int, y: float, command: float, *, expected: bool) -> None:
        """Judge the last command, and those that answer the samples after it."""
        tune = self.tune
        self.ended_at = k
        self.late = self.late or not expected or not self._is_safe(command)
        if self.happening not in FAULTS:
            return
        for y_after in (y, math.nan, math.inf, y)[:HELD_SAMPLES]:
            self.unsafe |= not self._is_safe(tune.step((k + 1) * self.period, y_after))
        if self.happening in HOLDABLE and not self.model.is_stable and tune.cycle_count > 0:
            self.unsafe |= self._runs_away(k, command)

    def _is_safe(self, command: float) -> bool:
        settings, outcome = self.tune.settings, self.tune.outcome
        if settings is None or self.model.is_stable:
            # Nothing is held.
            return command == (self.baseline if outcome is Outcome.COMPLETED else self.safe)
        # Held within the levels of the relay, which may have been shifted since the last cycle.
        given = self.tune.record().command
        levels = min(settings.low, *given), max(settings.high, *given)
        return command == self.safe or levels[0] <= command <= levels[1]

    def _runs_away(self, k: int, command: float) -> bool:
        """Go on with the safe command; return whether the process leaves where it was."""
        tune, settings = self.tune, self.tune.settings
        assert settings is not None
        cycles = tune.cycles
        swing = max(c.peak_max - c.peak_min for c in cycles)
        count = int(HELD_CYCLES * cycles[-1].period / self.period)
        for j in range(k + 1, k + 1 + count):
            self.plant.command(command)
            y = self.plant.measure(j * self.period)
            if abs(y - settings.setpoint) > HELD_SWINGS * swing:
                return True
            command = tune.after_end(y)
        return False


def with_delay(model: TransferFunction, delay: float) -> TransferFunction:
    """Return a process with more dead time [s]."""
    return replace(model, dead_time=model.dead_time + delay)
