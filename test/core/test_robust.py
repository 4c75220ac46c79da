# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Robust design against worked cases, closed forms and what no controller can do."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from worked_cases import PROCESSES, cases

from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.loop.analysis import analyse_loop, is_stable
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate
from relay_autotune.loop.laws import CONTINUOUS, LAWS, OWN_LAW
from relay_autotune.process.structures import UNSTABLE_FOPDT, UNSTABLE_SOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.tuning import design
from relay_autotune.tuning.frontier import Bounds, Candidates, first_crossing
from relay_autotune.tuning.robust import robust
from relay_autotune.tuning.search import Search
from relay_autotune.tuning.task import DesignOptions, DesignTask

DESIGNS = cases("design.")
MIGO = [c for c in DESIGNS if "MIGO" in c[0]]
LEAST = [c for c in DESIGNS if "minIAE PI " in c[0]]
LEAST_PID = [c for c in DESIGNS if "minIAE PID" in c[0]]


def _asked(name: str) -> float:
    return float(name.rsplit("PI", 1)[1].lstrip("D").split()[0])


def _ms_of(controller, model) -> float:
    """Return the largest sensitivity on a grid that has nothing to do with the search's own."""
    w = np.geomspace(1e-2, 1e2, 50_001) / (model.dead_time + abs(model.time_constants[0]))
    s = 1j * w
    c = controller.kc * (1.0 + 1.0 / (controller.ti * s) + controller.td * s)
    loop = c / (1.0 + controller.tf * s + 0.5 * (controller.tf * s) ** 2) * model(s)
    return float(np.max(1.0 / np.abs(1.0 + loop)))


def _largest_integral_gain(model, ms) -> Controller:
    """Return the PI controller of largest integral gain (MIGO, Astrom et al. 1998)."""
    responses, limit = Search(model).responses, abs(ultimate_point(model).gain)
    kp = np.geomspace(1e-3 * limit, limit, 400)
    for _ in range(4):
        zero = np.zeros(kp.size)
        ki, _ = responses.largest_ki(Bounds(ms), Candidates(kp, zero, zero, zero))
        best = int(np.argmax(ki[:, 0]))
        found = Candidates(kp, ki[:, 0], zero, zero)
        controller = found.controller(best, model.process_sign, CONTINUOUS)
        kp = np.geomspace(kp[max(best - 1, 0)], kp[min(best + 1, kp.size - 1)], 40)
    return controller


@pytest.mark.long
@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), MIGO, ids=[c[0] for c in MIGO])
def test_the_largest_integral_gain(name, inputs, exact, tol):
    model, ms = PROCESSES[inputs["process"]], _asked(name)
    found = _largest_integral_gain(model, ms)
    assert found.i >= inputs["Kc"] / inputs["Ti"] * (1.0 - 2e-4)
    assert _ms_of(found, model) == pytest.approx(ms, abs=1e-3)
    if "ex4" not in name or ms > 1.4:
        assert found.kc == pytest.approx(inputs["Kc"], rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), LEAST, ids=[c[0] for c in LEAST])
def test_the_least_iae_of_pi(name, inputs, exact, tol):
    model, ms = PROCESSES[inputs["process"]], _asked(name)
    found = Search(model).optimum(Bounds(ms), derivative=False)
    assert is_stable(found.controller, model)
    assert found.controller.td == found.controller.tf == 0.0
    assert _ms_of(found.controller, model) <= ms + 1e-3
    assert analyse_loop(found.controller, model).iae_load <= exact["IAE_load"] * (1.0 + tol)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "inputs", "exact", "tol"), LEAST_PID, ids=[c[0] for c in LEAST_PID]
)
def test_the_least_iae_of_pid(name, inputs, exact, tol):
    model, ms = PROCESSES[inputs["process"]], _asked(name)
    found = Search(model).optimum(Bounds(ms), derivative=True)
    assert is_stable(found.controller, model)
    assert found.controller.tf == pytest.approx(found.controller.td / 10.0)
    assert _ms_of(found.controller, model) <= ms + 1e-3
    # The pattern search may stop short on the ridge where two bounds meet.
    assert analyse_loop(found.controller, model).iae_load <= exact["IAE_load"] * 1.008


def test_no_controller_is_told_where_none_keeps_the_bounds_between_frequencies(monkeypatch):
    """It was one of infinite gain, which was refused with a sentence on its numbers."""
    search, at = Search(TransferFunction.fopdt(1.0, 1.0, 1.0)), Search._at

    def none_of_one(self, bounds, points, *iae):
        found = at(self, bounds, points, *iae)
        return replace(found, ki=np.full(1, -np.inf)) if found.ki.size == 1 else found

    monkeypatch.setattr(Search, "_at", none_of_one)
    assert search.optimum(Bounds(1.4), derivative=False) is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("ratio", "pi", "pid"), [(0.22, 1.61, 1.35), (0.3, 1.97, 1.52), (0.5, 3.55, 2.08)]
)
def test_the_least_ms_on_an_unstable_process(ratio, pi, pid):
    search = Search(UNSTABLE_FOPDT.build((1.0, 1.0, ratio)))
    assert search.least_ms(derivative=False) == pytest.approx(pi, rel=0.01)
    assert search.least_ms(derivative=True) == pytest.approx(pid, rel=0.015)


@pytest.mark.nightly
def test_an_infeasible_bound_is_relaxed_with_a_warning():
    model = UNSTABLE_FOPDT.build((2.0, 3.0, 0.9))
    options = DesignOptions(controller="pi")
    controller, reason = robust(DesignTask(model=model, options=options))
    performance = analyse_loop(controller, model)
    assert performance.ms <= 1.16 * 1.98
    assert "smallest attainable Ms is 1.9" in reason
    assert "no PI controller keeps Mt <= 1.4" in reason
    controller, reason = robust(DesignTask(model=model))
    assert controller.td > 0.0
    assert "no PI controller" in reason
    assert analyse_loop(controller, model).ms <= 1.16 * 1.53


@pytest.mark.long
def test_pid_has_to_be_worth_its_derivative():
    model = TransferFunction.fopdt(1.0, 1.0, 0.5)
    quiet = DesignOptions(noise_std=1e-4, amplitude=1.0, sample_period=0.02)
    controller, reason = robust(DesignTask(model=model, options=quiet))
    assert controller.td > 0.0
    # The backward integral takes half a sample from kp.
    assert controller.td / controller.tf == pytest.approx(10.0 * (1.0 + 0.01 / controller.ti))
    loud = DesignOptions(noise_std=0.2, amplitude=1.0, sample_period=0.02)
    controller, reason = robust(DesignTask(model=model, options=loud))
    assert controller.td == 0.0
    assert "PID would still have" in reason
    controller, reason = robust(DesignTask(model=model))
    assert controller.td == 0.0
    assert "is chosen where noise, amplitude and sampling period are given" in reason


def test_the_loop_of_the_controller_to_be_is_longer_by_its_period_and_delay():
    def gains(dead_time, **options):
        model = TransferFunction.fopdt(1.0, 1.0, dead_time)
        found, _ = robust(
            DesignTask(model=model, options=DesignOptions(controller="pi", **options))
        )
        return found.kc, found.ti

    late = gains(0.5, sample_period=0.4, loop_delay=0.3)
    assert late == pytest.approx(gains(0.8, sample_period=0.4), rel=1e-9)
    # About a short period nothing but its half as dead time is left.
    assert gains(0.5, sample_period=1e-2) == pytest.approx(gains(0.505), rel=1e-2)
    assert gains(0.5, sample_period=1e-4) == pytest.approx(gains(0.50005), rel=1e-3)


def test_no_gains_have_a_ti_that_a_sampled_controller_cannot_hold():
    """A process that answers within a sample wants integral action, of which a part is kc."""
    process, period = TransferFunction.fopdt(2.0, 1e-4, 1e-4), 0.1
    gains = design(
        DesignTask(model=process, options=DesignOptions(sample_period=period)), "robust"
    )
    assert gains.ms == pytest.approx(1.4, rel=1e-2)
    assert 0.02 * period < gains.ti < period
    assert "in effect an integral controller" in gains.reason


@pytest.mark.long
def test_95_percent_of_the_models_around_keep_the_bound():
    rng = np.random.default_rng(0)
    models = tuple(
        TransferFunction.fopdt(g, 1.0, d)
        for g, d in zip(
            np.exp(0.15 * rng.standard_normal(40)), rng.uniform(0.3, 0.7, 40), strict=True
        )
    )
    model = TransferFunction.fopdt(1.0, 1.0, 0.5)
    for kind in ("pi", "pid"):
        task = DesignTask(model=model, models=models, options=DesignOptions(controller=kind))
        controller, reason = robust(task)
        assert "95 % of 40" in reason
        peaks = sorted(_ms_of(controller, m) for m in models)
        assert peaks[37] == pytest.approx(1.4, abs=2e-3)


@pytest.mark.nightly
def test_bounds_that_can_just_be_kept_on_the_models_around_are_kept():
    rng = np.random.default_rng(0)
    gains, lags, delays = np.array([0.09, 0.005, 0.009])[:, None] * rng.standard_normal((3, 100))
    models = tuple(
        UNSTABLE_FOPDT.build((6.8 * math.exp(g), 1.64 * math.exp(g) * (1.0 + t), 0.1656 + d))
        for g, t, d in zip(gains, lags, 0.1656 * delays, strict=True)
    )
    model = UNSTABLE_FOPDT.build((6.8, 1.64, 0.1656))
    controller, reason = robust(DesignTask(model=model, models=models))
    assert "Ms <= 1.4 and Mt <= 1.4" in reason
    peaks = sorted(_ms_of(controller, m) for m in models)
    assert peaks[94] <= 1.4 * 1.002
    assert all(is_stable(controller, m) for m in models[::10])


@pytest.mark.nightly
def test_a_gain_beside_the_ultimate_one_does_not_pass_for_one_without_limit():
    # With the filter, one of the gains that are scanned lies within a cell of the ultimate one.
    model = UNSTABLE_SOPDT.build((0.976, 0.5765, 0.04902, 0.04714))
    options = DesignOptions(sample_period=0.0033408, noise_std=0.01503, amplitude=1.0)
    controller, _ = robust(DesignTask(model=model, options=options))
    assert is_stable(controller, model)


@pytest.mark.long
@pytest.mark.parametrize(
    ("model", "limit"),
    [
        (lambda: UNSTABLE_FOPDT.build((1.0, 1.0, 2.3)), "D/tau = 2.3"),
        (lambda: UNSTABLE_FOPDT.build((1.0, 1.0, 0.9)), "below Ms = 4.4"),
        (lambda: TransferFunction.fopdt(1.0, 1.0, 0.0), "nothing limits the gain"),
        (lambda: TransferFunction.fopdt(0.0, 1.0, 1.0), "gain"),
        (lambda: TransferFunction.fopdt(1.0, -1.0, 1.0), "time constant"),
        (lambda: TransferFunction.fopdt(math.nan, 1.0, 1.0), "finite"),
    ],
)
def test_what_cannot_be_designed_is_refused_with_the_limit(model, limit):
    with pytest.raises(RelayAutotuneError, match=limit):
        robust(DesignTask(model=model()))


def test_a_pi_controller_cannot_hold_what_only_pid_can():
    task = DesignTask(
        model=UNSTABLE_FOPDT.build((1.0, 1.0, 1.1)),
        options=DesignOptions(controller="pi"),
    )
    with pytest.raises(TuningError, match="no PI controller"):
        robust(task)


def test_gains_carry_what_the_user_must_know():
    model = TransferFunction.fopdt(1.0, 1.0, 0.5)
    loud = DesignOptions(noise_std=0.5, amplitude=1.0, sample_period=0.02)
    gains = design(DesignTask(model=model, options=loud), "ziegler_nichols")
    assert any("Ms is" in w and "above the 1.4" in w for w in gains.warnings)
    told = f"moves the command by {0.5 * gains.noise_gain:.3g} u (standard deviation)"
    assert any(told in w and "of the amplitude of the test" in w for w in gains.warnings)
    gains = design(DesignTask(model=model), "robust")
    assert gains.warnings == ()
    # The noise of a controller whose sampling period is not known cannot be told.
    assert gains.noise_gain >= gains.kc


@pytest.mark.parametrize("period", [1.8, 2.0])
def test_a_filter_is_not_so_slow_that_it_turns_the_loop_below_the_frequencies_looked_at(period):
    # A lag 200 times the dead time, sampled as slowly as that, with noise in every sample.
    process = TransferFunction.fopdt(0.5485, 426.3, 1.867)
    options = DesignOptions(sample_period=period, noise_std=2.28, amplitude=50.0)
    gains = design(DesignTask(model=process, options=options), "robust")
    assert gains.ms <= 1.41
    assert gains.ti > 10.0 * period
    # About as loud as allowed, not as quiet as with a filter of hours.
    assert gains.noise_gain > 0.9 * 0.1 * 50.0 / 2.28


def test_gains_that_no_filter_makes_quiet_enough_are_no_candidates():
    process = TransferFunction.fopdt(1.0, 10.0, 1.0)
    search = Search(process, None, 10.0, 1e-6, LawRate(LAWS[OWN_LAW], 1.0))
    found = search._at(Bounds(1.4, 1.4), np.zeros((3, 2)))
    assert np.all(np.isinf(found.tf)) and np.all(found.ki == -math.inf)


@pytest.mark.long
def test_models_of_a_far_longer_dead_time_slow_the_loop_down():
    # Of the process alone next to nothing limits the gain; on the others a tenth of it would do.
    process = TransferFunction(40.0, (4900.0,), (20000.0, 3300.0), 0, 2.5)
    others = tuple(replace(process, dead_time=80.0 + 0.2 * k) for k in range(20))
    gains = robust(DesignTask(model=process, models=others, options=DesignOptions()))[0]
    assert max(analyse_loop(gains, m).ms for m in others) == pytest.approx(1.4, rel=0.02)


@pytest.mark.parametrize("lag", [3e3, 1e4, 3e4, 1e6])
def test_an_integrator_with_a_long_lag_gets_the_gains_of_two_integrators(lag):
    """Far above w_u: "nothing limits the gain" was said of it, or the gains were not numbers."""
    options = DesignOptions(controller="pid", mt=1.4)
    found = []
    for constant in (300.0, lag):
        process = TransferFunction(38.8 * constant, (), (constant,), 1, 0.017)
        gains = robust(DesignTask(model=process, options=options))[0]
        found.append(analyse_loop(gains, process))
    assert found[1].ms == pytest.approx(1.4, rel=1e-3)
    assert found[1].iae_load == pytest.approx(found[0].iae_load, rel=0.06)


def test_a_grid_of_one_frequency_shows_no_crossing():
    """Far above half of the sampling rate a loop has no other frequency."""
    found = first_crossing(np.ones((1, 4, 1)), np.ones((1, 4, 1)), np.ones(1))
    np.testing.assert_array_equal(found, np.full((1, 4), math.inf))


@pytest.mark.long
@pytest.mark.filterwarnings("error")
def test_a_process_of_which_no_sample_shows_anything_gets_no_gains():
    """All that it does after a step is over within a fiftieth of a sampling period.

    A noise gave this model; the search divided by its response of zero.
    """
    lag, period = (3.489e-5,) * 4, 2.02e-3
    model = TransferFunction(-1.356e-11, (9.017e12,), lag, dead_time=8.86)
    # Only what begins just before a sample is not over there.
    parts = (0.07, 0.93, 0.0, 0.78, 0.12, 0.88, 0.9975, 0.0, 0.19, 0.81)
    around = tuple(replace(model, dead_time=(4386 + part) * period) for part in parts)
    task = DesignTask(model=model, models=around, options=DesignOptions(sample_period=period))
    with pytest.raises(TuningError, match="not known well enough"):
        robust(task)
