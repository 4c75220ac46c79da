# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a record lets one expect of a model and of gains, and what it does not let pass."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from relay_runs import simulate_relay

from relay_autotune.errors import ModelError, ParameterError, TuningError
from relay_autotune.exchange.evidence import ExperimentFacts, check_finding
from relay_autotune.experiment.early_end import FitProgress
from relay_autotune.loop.gains import Controller
from relay_autotune.process.structures import INTEGRATOR_INVERSE, IPDT, UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Outcome, Record, RelaySettings

FOPDT = TransferFunction.fopdt(2.0, 1.0, 0.5)
PROCESSES = {
    "fopdt": FOPDT,
    "reverse": TransferFunction.fopdt(-2.0, 1.0, 0.5),
    "dead time": TransferFunction.fopdt(1.0, 0.05, 1.0),
    "lags": TransferFunction.lag_n(3.0, 1.0, 4, 0.2),
    "integrator": IPDT.build((0.5, 1.0)),
    "unstable": UNSTABLE_FOPDT.build((1.0, 3.0, 0.5)),
    "inverse response": INTEGRATOR_INVERSE.build((0.5, 0.4, 1.5, 0.5)),
    "resonance": TransferFunction.oscillator(1.0, 1.0, 0.3, 0.5),
}


def record_of(
    process: TransferFunction,
    *,
    samples: int = 600,
    cycles: int = 5,
    bias: float = 0.1,
    outcome: Outcome = Outcome.COMPLETED,
) -> Record:
    relay = RelaySettings(5.0, 1.0, 0.5, bias, 0.02, reverse_acting=process.process_sign < 0)
    run = simulate_relay(process, relay, cycles=cycles, time=samples)
    return replace(run.record(), outcome=outcome, experiment_id="one")


def gains_of(process: TransferFunction) -> Controller:
    point = ultimate_point(process)
    assert point is not None
    return Controller(0.4 * point.gain, 2.0 * point.period)


@pytest.mark.long
@pytest.mark.parametrize("name", PROCESSES)
@pytest.mark.parametrize("samples", [60, 2000])
def test_the_process_itself_and_its_gains_pass(name: str, samples: int) -> None:
    process = PROCESSES[name]
    evidence = ExperimentFacts.of(record_of(process, samples=samples))
    # The truth is G at the frequency of the oscillation; few samples tell it less well.
    truth = complex(process(1j * evidence.frequency))
    assert abs(evidence.answer / truth - 1.0) < (0.9 if samples < 100 else 0.1)
    evidence.check_model(process)
    evidence.check_gains(gains_of(process), process)


@pytest.mark.parametrize("name", PROCESSES)
def test_a_model_of_another_process_is_refused(name: str) -> None:
    process = PROCESSES[name]
    evidence = ExperimentFacts.of(record_of(process))
    for factor in (-1.0, 50.0, 0.02, 1e300, -1e-300):
        wrong = replace(process, gain=factor * process.gain)
        with pytest.raises(ModelError, match=r"sign|answers|turned"):
            evidence.check_model(wrong)
    with pytest.raises(ModelError, match="dead time"):
        evidence.check_model(replace(process, dead_time=1e9))


def test_gains_that_cannot_be_are_refused() -> None:
    evidence, good = ExperimentFacts.of(record_of(FOPDT)), gains_of(FOPDT)
    for change, said in (
        ({"kc": -good.kc}, "the sign of the process"),
        ({"kc": 1e308}, "loop gain"),
        ({"kc": 1e-308}, "loop gain"),
        ({"ti": 1e-300}, "ti is"),
        ({"ti": 1e300}, "ti is"),
        ({"td": 1e308}, "td is"),
        ({"tf": 1e308}, "tf is"),
        ({"b": 1e6}, "weight"),
    ):
        with pytest.raises(TuningError, match=said):
            evidence.check_gains(replace(good, **change), FOPDT)


@pytest.mark.parametrize("outcome", [Outcome.ABORTED, Outcome.FAILED, Outcome.UNKNOWN])
def test_gains_of_an_experiment_that_was_not_completed_are_refused(outcome: Outcome) -> None:
    evidence = ExperimentFacts.of(record_of(FOPDT, outcome=outcome))
    with pytest.raises(TuningError, match="completed ones alone"):
        evidence.check_gains(gains_of(FOPDT), FOPDT)


def test_half_cycles_tell_the_size_and_the_sign() -> None:
    whole = record_of(FOPDT)
    n = whole.cycle_start[1]
    columns = ("time", "measurement", "command", "receive_time", "command_time")
    parts = {name: getattr(whole, name)[:n] for name in columns}
    evidence = ExperimentFacts.of(replace(whole, **parts, cycle_start=(), held_input=None))
    assert not evidence.whole
    evidence.check_model(FOPDT)
    evidence.check_gains(gains_of(FOPDT), FOPDT)
    with pytest.raises(ModelError, match="other sign"):
        evidence.check_model(replace(FOPDT, gain=-2.0))
    with pytest.raises(ModelError, match="answers"):
        evidence.check_model(replace(FOPDT, gain=500.0))


def test_a_record_at_rest_tells_nothing_that_gains_could_be_compared_with() -> None:
    still = Record(np.arange(5.0), np.ones(5), np.ones(5), outcome=Outcome.COMPLETED)
    with pytest.raises(TuningError, match="no oscillation"):
        ExperimentFacts.of(still).check_gains(gains_of(FOPDT), FOPDT)


def test_a_finding_has_the_sign_and_the_size_of_the_oscillation() -> None:
    facts = {"sign": 1, "amplitude": 0.2, "relay": 0.5}
    # 4 mu/(pi a) is 3.18.
    check_finding(FitProgress(3.0, 0.1), **facts)
    check_finding(FitProgress(math.nan, math.nan, 1.4, 1.3, 1.5), **facts)
    with pytest.raises(ParameterError, match="other sign"):
        check_finding(FitProgress(-3.0, 0.1), **facts)
    for gain in (1e308, 1e-308, 200.0):
        with pytest.raises(ParameterError, match=r"oscillation shows about 3\.18"):
            check_finding(FitProgress(gain, 0.0), **facts)
    # Without a whole cycle the sign alone is known, on a set-point not even that.
    check_finding(FitProgress(200.0, 0.0), sign=1)
    check_finding(FitProgress(-200.0, 0.0), sign=0)
    for wrong in ((math.inf, 1.0), (1.0, -1.0), (1.0, 0.1, 0.5), (1.0, 0.1, 1.4, 1.6, 1.2)):
        with pytest.raises(ParameterError, match="nothing is concluded"):
            FitProgress(*wrong)
