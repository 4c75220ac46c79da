"""Experiments on random processes with noise, disturbances and faults, without DDS.

    python3 benchmarks/simulated_experiments.py [--experiments N] [--quick]

Each draws a process of a known structure, a sample period, a noise, and what happens: nothing,
a disturbance (load, drift, coarse sensor, sticking or limited valve, lost samples), or a fault
(NaN, silence, a frozen sensor, a limit, a clock that goes backwards, a wrong sign, an actuator
that is stuck, an abort). The silent sensor's watchdog is the node's and is played here.
The exit status is 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import math
import sys
import time as wall
from collections import Counter
from dataclasses import dataclass

from markdown import table

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np

from relay_autotune.actuator import Actuator
from relay_autotune.autotune import analyse
from relay_autotune.cycles import cycles_of
from relay_autotune.disturbance import without_disturbance
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification import Identification, identify
from relay_autotune.models import TransferFunction
from relay_autotune.record import Outcome, Record, RelaySettings
from relay_autotune.relay import ExperimentParameters, RelayExperiment, SafePolicy
from relay_autotune.simulation import exact_limit_cycle
from relay_autotune.tuning import DesignOptions, DesignTask, Gains, design, ensemble
from relay_autotune.tuning.analysis import is_stable
from relay_autotune.ultimate import ultimate_point
from relay_autotune.virtual_process import Disturbances, VirtualProcess

EXPERIMENTS = 10_000
SAFE = -0.125
MOST_REFUSED = 5.0
PER_CYCLE = (40, 200)
LARGEST_RATIO = 0.2
SAMPLES = 30_000

NOTHING = ("undisturbed",)
DISTURBANCES = ("load", "drift", "coarse sensor", "sticking valve", "lost samples")
FAULTS = (
    "not a number",
    "silent sensor",
    "frozen sensor",
    "measurement limit",
    "deviation",
    "time backwards",
    "wrong sign",
    "stuck actuator",
    "abort",
    "time over",
)


@dataclass
class Counts:
    """What came of the experiments with one thing that happened."""

    run: int = 0
    completed: int = 0
    ended: int = 0
    refused: int = 0
    gains_without_completion: int = 0
    late: int = 0
    unstable: int = 0
    no_cause: int = 0


def random_process(rng: np.random.Generator) -> TransferFunction:
    """Return a process of a known structure, its slowest time constant about 1 s."""
    kind = rng.integers(6)
    gain = float(np.exp(rng.uniform(-2.0, 2.0))) * (1.0 if rng.uniform() < 0.7 else -1.0)
    tau = float(np.exp(rng.uniform(-0.7, 0.7)))
    dead = float(np.exp(rng.uniform(math.log(0.05), math.log(3.0))))
    build = TransferFunction.from_structure
    if kind == 0:
        return build("fopdt", gain=gain, time_constants=[tau], dead_time=dead)
    if kind == 1:
        return build(
            "sopdt", gain=gain, time_constants=[tau, tau * rng.uniform(0.1, 0.9)], dead_time=dead
        )
    if kind == 2:
        return build(
            "lag_n", gain=gain, time_constants=[tau], order=int(rng.integers(2, 6)), dead_time=dead
        )
    if kind == 3:
        lags = [tau, tau * rng.uniform(0.2, 0.8), tau * rng.uniform(0.05, 0.2)]
        return build("three_lags", gain=gain, time_constants=lags, dead_time=dead)
    if kind == 4:
        return build("ipdt", gain=gain, dead_time=dead)
    return build("integrator_lag", gain=gain, time_constants=[tau], dead_time=dead)


class Experiment:
    """One experiment and what happens in it.

    :param happening: one of the names above.
    :param seed: of everything random.
    """

    def __init__(self, happening: str, seed: int) -> None:
        rng = self.rng = np.random.default_rng((seed, 7))
        self.happening = happening
        self.model = random_process(rng)
        settings = RelaySettings(0.0, 0.0, 1.0, reverse_acting=self.model.gain < 0.0)
        cycle = exact_limit_cycle(self.model, settings, tolerance=1e-4)
        self.period = cycle.period / int(rng.integers(*PER_CYCLE))
        self.swing = 0.5 * (cycle.peak_max - cycle.peak_min)
        # N2 of Wang et al.: mean absolute noise over mean absolute signal.
        ratio = rng.uniform(0.0, LARGEST_RATIO)
        self.noise = ratio * 0.6 * self.swing / math.sqrt(2.0 / math.pi)
        self.kick = 60 * self.period
        self.cause_at = math.inf
        acting: dict[str, float] = {"noise_std": self.noise}
        begin = 75 * self.period + 2.0 * cycle.period
        end = begin + 2.0 * cycle.period
        self.moment = float(rng.uniform(60 * self.period if happening in FAULTS else begin, end))
        if happening == "load":
            acting |= {"load_time": self.moment, "load_size": float(rng.uniform(-0.5, 0.5))}
        if happening == "drift":
            acting["drift"] = float(rng.uniform(-0.1, 0.1)) * self.swing / cycle.period
        if happening == "coarse sensor":
            acting["quantisation"] = float(rng.uniform(0.02, 0.25)) * self.swing
        band = float(rng.uniform(0.02, 0.15)) if happening == "sticking valve" else 0.0
        self.plant = VirtualProcess(
            self.model,
            actuator=Actuator(0.0, stiction=band, dead_band=band),
            disturbances=Disturbances(**acting),
            seed=seed,
        )
        given: dict[str, float | int] = {}
        if happening == "measurement limit":
            given = {
                "measurement_min": -0.5 * self.swing - 3 * self.noise,
                "measurement_max": 0.5 * self.swing + 3 * self.noise,
            }
        if happening == "deviation":
            given = {"max_deviation": 0.5 * self.swing + 3.0 * self.noise}
        if happening == "wrong sign":
            given = {"process_gain_sign": -1 if self.model.gain > 0.0 else 1}
        if happening == "time over":
            given = {"max_duration": self.moment}
        self.tune = RelayExperiment(
            ExperimentParameters(amplitude=1.0, **given),  # type: ignore[arg-type]
            0.0,
            policy=SafePolicy(command=SAFE),
        )
        self.late = False

    def run(self) -> None:
        """Run it to its end; notes whether the safe command came within one sample."""
        tune, plant, period = self.tune, self.plant, self.period
        frozen = stuck = math.nan
        happening, lost = self.happening, self.rng.uniform(0.05, 0.3)
        for k in range(SAMPLES):
            t = k * period
            y = plant.measure(t)
            now = t >= self.moment
            if happening == "lost samples" and self.rng.uniform() < lost:
                continue
            if now and happening == "silent sensor":
                # The watchdog of the node, on its steady clock.
                command = tune.abort("no measurement", t)
                self.late = command != SAFE
                return
            if now and happening == "abort":
                self.late = tune.abort("on request", t) != SAFE
                return
            if now and happening == "frozen sensor":
                frozen = y if math.isnan(frozen) else frozen
                y = frozen
            if now and happening == "not a number":
                y = math.nan if self.rng.uniform() < 0.5 else math.inf
            if now and happening == "time backwards" and k > 0:
                t -= 1.5 * period
            command = tune.step(t, y)
            if tune.finished:
                expected = 0.0 if tune.outcome is Outcome.COMPLETED else SAFE
                self.late = command != expected
                return
            bad = not math.isfinite(y) or not (
                tune.parameters.measurement_min <= y <= tune.parameters.measurement_max
            )
            if bad or (now and happening in ("time backwards", "time over")):
                # The cause was there, and the tune went on.
                self.late = True
            if now and happening == "stuck actuator":
                stuck = command if math.isnan(stuck) else stuck
                command = stuck
            plant.command(command)


def main() -> int:
    """Run the experiments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiments", type=int, default=EXPERIMENTS)
    parser.add_argument("--quick", action="store_true", help="a few experiments, never fails")
    asked = parser.parse_args()
    total = 4 if asked.quick else asked.experiments
    happenings = (*NOTHING * 8, *DISTURBANCES, *FAULTS)
    counts: dict[str, Counts] = {}
    reasons: Counter[str] = Counter()
    began = wall.monotonic()
    for seed in range(total):
        happening = happenings[seed % len(happenings)]
        count = counts.setdefault(happening, Counts())
        experiment = Experiment(happening, seed)
        experiment.run()
        judge(experiment, count, reasons)
    rows = [
        (
            name,
            c.run,
            c.completed,
            c.ended,
            c.refused,
            c.gains_without_completion,
            c.late,
            c.unstable,
        )
        for name, c in sorted(counts.items(), key=lambda item: happenings.index(item[0]))
    ]
    headings = (
        *("what happens", "experiments", "completed", "aborted or failed"),
        *(
            "completed, no gains",
            "gains without completion",
            "safe command late",
            "unstable loops",
        ),
    )
    print(table(headings, rows))
    quiet = counts.get("undisturbed", Counts())
    not_served = 100.0 * (quiet.run - quiet.completed + quiet.refused) / max(quiet.run, 1)
    late = sum(c.late for c in counts.values())
    unstable = sum(c.unstable for c in counts.values())
    gains = sum(c.gains_without_completion for c in counts.values())
    print(
        f"\n{total} experiments in {wall.monotonic() - began:.0f} s. Gains from an experiment "
        f"that was not completed: {gains} (target 0). Safe command later than one sample: {late} "
        f"(target 0). Recommended loops unstable on the true process: {unstable} (target 0). "
        f"Undisturbed experiments without gains: {not_served:.1f} % (target {MOST_REFUSED:g} %)."
    )
    for reason, number in reasons.most_common(8):
        print(f"{number} x {reason}", file=sys.stderr)
    missed = gains or late or unstable or not_served > MOST_REFUSED
    return 1 if missed and not asked.quick else 0


def judge(experiment: Experiment, count: Counts, reasons: Counter[str]) -> None:
    """Count what came of an experiment."""
    tune = experiment.tune
    count.run += 1
    count.late += experiment.late
    if tune.outcome is Outcome.COMPLETED:
        count.completed += 1
    else:
        count.ended += 1
        if experiment.happening not in FAULTS:
            reasons[
                f"{experiment.happening}, {experiment.model.structure}: {tune.reason[:150]}"
            ] += 1
    if not tune.sample_count:
        return
    if tune.outcome is not Outcome.COMPLETED:
        # What identifier_node would publish.
        count.gains_without_completion += analyse(tune.record()).best_gains is not None
        return
    try:
        gains, found = recommended(tune.record())
    except (RelayAutotuneError, ValueError, np.linalg.LinAlgError) as error:
        count.refused += 1
        reasons[f"{experiment.model.structure} refused: {str(error)[:150]}"] += 1
        return
    if not is_stable(gains, experiment.model):
        count.unstable += 1
        true = ultimate_point(experiment.model).gain
        reasons[
            f"unstable: {experiment.happening}, {experiment.model.structure}, K_u {true:.3g}, "
            f"found {found.structure} with {found.ultimate_gain:.3g}"
        ] += 1


def recommended(record: Record) -> tuple[Gains, Identification]:
    """Return the gains of the rule `robust` and the model, without all other methods and rules.

    :param record: a completed experiment.
    :raises RelayAutotuneError: if there is no model, or no gains.
    """

    def fit(part: Record) -> Identification:
        return identify(part, "waveform")

    found = without_disturbance(fit(record), record, cycles_of(record), fit)
    models = ensemble(found, rng=np.random.default_rng(0))
    task = DesignTask(model=found.model, options=DesignOptions(), models=models)
    return design(task, "robust"), found


if __name__ == "__main__":
    sys.exit(main())
