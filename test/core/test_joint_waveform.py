# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Several records of one process fitted together."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from relay_runs import simulate_relay

from relay_autotune.analysis import analyse_jointly
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify_jointly
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome, PiecewiseConstant, Record, RelaySettings

pytestmark = pytest.mark.long

FOPDT = Known(structure="fopdt")
TRUTH = (1.65, 20.0, 10.0)


def _record(
    process: tuple[float, float, float] = TRUTH,
    *,
    bias: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
    at: float = 5.0,
    samples: int = 500,
) -> Record:
    """Return three cycles about an operating point of its own."""
    model = TransferFunction.fopdt(*process)
    relay = RelaySettings(at, 40.0, 1.0, bias, 0.0)
    run = simulate_relay(model, relay, cycles=3, time=samples)
    std = noise * float(np.mean(np.abs(run.measurement - at))) * math.sqrt(math.pi / 2.0)
    return run.record(noise_std=std, rng=np.random.default_rng(seed))


@pytest.mark.nightly
def test_without_noise_records_of_different_operating_points_give_the_process_exactly():
    records = (_record(at=5.0), _record(at=-80.0, bias=0.3, samples=700))
    found = identify_jointly(records, "waveform")
    assert found.structure == "fopdt"
    assert found.values == pytest.approx(TRUTH, rel=1e-9)
    assert found.warnings == ()
    assert found.fitted.size == len(records[0])
    np.testing.assert_allclose(found.fitted, records[0].measurement, atol=1e-9)


def test_a_drift_of_each_record_and_a_start_in_motion_are_its_own():
    one, two = _record(samples=600), _record(bias=0.3, at=9.0, samples=600)
    moving = two.measurement + 0.4 * np.exp(-(two.time - two.time[0]) / 20.0)
    drifting = one.measurement + 0.01 * one.time
    records = (replace(one, measurement=drifting), replace(two, measurement=moving))
    found = identify_jointly(records, "waveform", FOPDT)
    assert found.values == pytest.approx(TRUTH, rel=1e-6)


@pytest.mark.nightly
def test_two_short_noisy_records_halve_the_variance():
    records = [_record(noise=0.1, seed=s) for s in range(24)]
    single = [identify_jointly((r,), "waveform", FOPDT) for r in records]
    pairs = [identify_jointly(records[k : k + 2], "waveform", FOPDT) for k in range(0, 24, 2)]

    def rms(models: list) -> float:
        pulls = [(m.values / TRUTH - 1.0) for m in models]
        return math.sqrt(float(np.mean(np.square(pulls))))

    stated = np.mean([m.std for m in single], axis=0) / np.mean([m.std for m in pairs], axis=0)
    assert stated == pytest.approx(math.sqrt(2.0), rel=0.05)
    # Three standard errors of the ratio of 12 pairs to 24 records.
    assert 1.0 < rms(single) / rms(pairs) < 2.1


def test_a_biased_and_an_unbiased_test_together_determine_the_gain():
    slow = (1.0, 1.0, 0.05)
    unbiased = _record(slow, noise=0.1)
    biased = _record(slow, bias=0.3, noise=0.1, seed=1)
    alone = identify_jointly((unbiased,), "waveform", FOPDT)
    together = identify_jointly((unbiased, biased), "waveform", FOPDT)
    assert "gain" in alone.undetermined
    assert alone.advice
    assert together.undetermined == ()
    assert abs(together.values[0] - 1.0) < 3.0 * together.std[0] < 0.2


def test_each_record_counts_by_its_noise():
    quiet, loud = _record(noise=0.02), _record(noise=0.4, seed=1)
    best = identify_jointly((quiet,), "waveform", FOPDT)
    both = identify_jointly((quiet, loud), "waveform", FOPDT)
    # The loud one adds 1/400 of what the quiet one tells, and takes nothing away.
    assert both.std == pytest.approx(best.std, rel=0.1)
    assert np.all(np.abs(both.values - best.values) < 0.5 * best.std)


def test_records_of_opposite_direction_are_refused():
    one = _record()
    two = replace(one, settings=replace(one.settings, reverse_acting=True))
    with pytest.raises(IdentificationError, match="not of one process"):
        identify_jointly((one, two), "waveform")


def test_a_joint_model_gets_gains():
    records = [
        replace(r, outcome=Outcome.COMPLETED) for r in (_record(), _record(bias=0.3, seed=1))
    ]
    analysis = analyse_jointly(records, method="waveform", known=FOPDT)
    assert analysis.model is not None
    assert analysis.best_gains is not None


def _pulsed(gain: float, dead_time: float, seed: int) -> Record:
    time = np.arange(0.0, 120.0, 0.2)
    u = PiecewiseConstant(np.array([10.0, 60.0, 80.0]), np.array([1.0, 0.0, 0.5]), 0.0)
    y = response(TransferFunction.fopdt(gain, 5.0, dead_time), time, u)
    y += 0.04 * np.random.default_rng(seed).standard_normal(time.size)
    return Record(time, y, u(time), held_input=u)


@pytest.mark.parametrize(("gain", "dead_time"), [(2.0, 2.0), (2.0, 5.0), (4.0, 1.0)])
def test_gains_hold_on_the_processes_of_all_records(gain, dead_time):
    """Of two dead times, one model in the middle had been trusted, whatever they were."""
    records = [_pulsed(2.0, 1.0, 0), _pulsed(gain, dead_time, 1)]
    alike = analyse_jointly([records[0], _pulsed(2.0, 1.0, 1)])
    found = analyse_jointly(records)
    assert not any("two records" in each for each in alike.model.warnings)
    assert any("two records give models that differ" in each for each in found.model.warnings)
    for process in (2.0, 1.0), (gain, dead_time):
        truth = TransferFunction.fopdt(process[0], 5.0, process[1])
        assert analyse_loop(found.best_gains, truth).ms < 1.75


def test_records_of_opposite_directions_are_refused(recwarn):
    with pytest.raises(IdentificationError, match="records 1 and 2 go in opposite directions"):
        identify_jointly([_pulsed(2.0, 1.0, 0), _pulsed(-2.0, 1.0, 1)], "waveform")
    assert not recwarn.list
