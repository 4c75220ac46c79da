# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Two tests, one with a dead time added: exact limit cycles and records."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from relay_runs import simulate_relay
from sampled_relay import exact_limit_cycle

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.methods import JOINT_METHODS, identify, identify_jointly
from relay_autotune.identification.methods.li import (
    describing_function_point,
    fit_jointly,
    fits_jointly,
    li_from_numbers,
)
from relay_autotune.process.structures import FOPDT, SOPDT, TWO_EQUAL_ONE, equal_lags
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record, RelaySettings

CASES = [
    (FOPDT, (2.0, 3.0, 1.0)),
    (FOPDT, (1.65, 20.0, 10.0)),
    (equal_lags(2), (2.0, 3.0, 1.0)),
    (equal_lags(3), (2.0, 3.0, 1.0)),
    (SOPDT, (2.0, 3.0, 1.0, 0.5)),
    (TWO_EQUAL_ONE, (2.0, 1.0, 5.0, 0.5)),
]


def _tests(process: TransferFunction, epsilon: float = 0.0) -> list[SymmetricCycle]:
    found = []
    added = 0.0
    for _ in range(2):
        relay = RelaySettings(0.0, 0.0, 0.7, 0.0, epsilon, added)
        cycle = exact_limit_cycle(process, relay)
        found.append(SymmetricCycle(cycle.period, cycle.peak_max, 0.7, epsilon, added))
        added = 0.25 * cycle.period
    return found


@pytest.mark.long
@pytest.mark.parametrize("epsilon", [0.0, 0.1])
@pytest.mark.parametrize(("model", "values"), CASES, ids=str)
def test_two_exact_limit_cycles_give_all_parameters(model, values, epsilon):
    tests = _tests(model.build(np.array(values)), epsilon)
    for dead_time in (values[-1], math.nan):
        fit = fit_jointly(model, tests, dead_time)
        assert fit.misfit < 1e-8
        if model == TWO_EQUAL_ONE and math.isnan(dead_time):
            # Either of two mirrored solutions may be found; both have these limit cycles.
            continue
        assert fit.values == pytest.approx(values, rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(("model", "values"), CASES[:4], ids=str)
def test_the_simplest_model_that_agrees_comes_first(model, values):
    tests = _tests(model.build(np.array(values)))
    fit = fits_jointly(tests, Known(dead_time=values[-1]))[0]
    assert fit.model == model
    assert fit.misfit < 1e-8


def test_points_of_the_describing_function():
    process = TransferFunction.lag_n(2.0, 3.0, 3, 1.0)
    for test in _tests(process, 0.1):
        w, value = describing_function_point(test)
        # Three lags leave little but the fundamental.
        assert value == pytest.approx(complex(process(1j * w)), rel=0.06)
    literal = fit_jointly(equal_lags(3), _tests(process), exact=False)
    assert literal.values[0] == pytest.approx(2.0, rel=0.05)
    assert abs(literal.values[0] - 2.0) > 1e-3
    assert literal.values[-1] == pytest.approx(1.0, rel=0.1)


def test_a_point_of_a_pure_delay_has_the_phase_of_what_was_added():
    test = SymmetricCycle(8.0, 1.0, 1.0, 0.0, 1.0)
    w, value = describing_function_point(test)
    assert w == pytest.approx(math.pi / 4.0)
    assert cmath.phase(-value) == pytest.approx(math.pi / 4.0)
    assert abs(value) == pytest.approx(math.pi / 4.0)


def _records(
    process: TransferFunction, epsilon: float, noise: float, bias: float = 0.0
) -> list[Record]:
    found = []
    for number, added in enumerate((0.0, 1.5)):
        reverse = process.gain < 0.0
        relay = RelaySettings(5.0, 1.0, 0.7, bias, epsilon, added, reverse_acting=reverse)
        run = simulate_relay(process, relay, cycles=8, time=3200)
        rng = np.random.default_rng(number)
        found.append(run.record(noise_std=noise, rng=rng))
    return found


@pytest.mark.long
@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.nightly), 0.01])
@pytest.mark.parametrize("epsilon", [pytest.param(0.0, marks=pytest.mark.nightly), 0.2])
@pytest.mark.parametrize(
    "process",
    [
        TransferFunction.fopdt(-2.0, 3.0, 1.0),
        TransferFunction.lag_n(2.0, 3.0, 2, 1.0),
        TransferFunction.sopdt(2.0, (3.0, 1.0), 0.5),
    ],
    ids=str,
)
def test_records(process, epsilon, noise):
    found = identify_jointly(_records(process, epsilon, noise), "li")
    assert found.method == "li"
    assert found.structure == process.structure
    lags = list(dict.fromkeys(t.real for t in process.time_constants))
    wanted = np.array([process.gain, *lags, process.dead_time])
    assert found.values == pytest.approx(wanted, rel=0.15 if noise else 0.02)
    assert found.ultimate_gain == pytest.approx(
        ultimate_point(process).gain, rel=0.03 if noise else 0.005
    )
    assert np.all(np.abs(found.values - wanted) < 4.0 * found.std)
    assert any("equations of the describing function" in w for w in found.warnings)


@pytest.mark.long
def test_a_known_dead_time_is_kept():
    process = TransferFunction.lag_n(2.0, 3.0, 2, 1.0)
    known = Known(dead_time=1.0, structure="lag_n", order=2)
    found = identify_jointly(_records(process, 0.1, 0.0), "li", known)
    assert found.values[-1] == 1.0
    assert found.std[-1] == 0.0


def test_one_record_is_refused_with_what_to_do():
    records = _records(TransferFunction.fopdt(2.0, 3.0, 1.0), 0.0, 0.0)
    for attempt in (
        lambda: identify(records[0], "li"),
        lambda: identify_jointly(records[:1], "li"),
    ):
        with pytest.raises(IdentificationError, match=r"two relay tests.*extra_delay"):
            attempt()
    with pytest.raises(IdentificationError, match="same dead time added"):
        identify_jointly((records[0], records[0]), "li")
    with pytest.raises(IdentificationError, match=f"these do: {', '.join(JOINT_METHODS)}"):
        identify_jointly(records, "chang")


@pytest.mark.long
def test_records_that_do_not_belong_together_are_refused():
    process = TransferFunction.fopdt(2.0, 3.0, 1.0)
    first = _records(process, 0.0, 0.0)[0]
    turned = _records(TransferFunction.fopdt(-2.0, 3.0, 1.0), 0.0, 0.0)[1]
    with pytest.raises(IdentificationError, match="not of one process"):
        identify_jointly((first, turned), "li")
    biased = _records(process, 0.0, 0.0, bias=0.2)[1]
    with pytest.raises(IdentificationError, match="bias"):
        identify_jointly((first, biased), "li")


@pytest.mark.long
def test_a_structure_that_disagrees_is_said_to():
    tests = _tests(TransferFunction.lag_n(2.0, 3.0, 3, 0.5))
    found = li_from_numbers(tests, Known(dead_time=0.5, structure="sopdt"))
    assert any("do not agree with sopdt" in w for w in found.warnings)
    with pytest.raises(IdentificationError, match="below"):
        li_from_numbers(tests, Known(dead_time=50.0))
