# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the figures show is what was recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analysed import SETTINGS, completed
from matplotlib.path import Path
from report_cases import fruitless

from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record
from relay_autotune.report import draw
from relay_autotune.report.case import case_of, in_loop
from relay_autotune.report.figures import PLATES, rate_of, switches_of
from relay_autotune.report.frequency import distinct_gains, simulated, swept_area
from relay_autotune.report.style import in_steps, inline, save, thinned
from relay_autotune.tuning import tune
from relay_autotune.tuning.task import DesignOptions


def levels(names: str) -> Record:
    """Return a record whose command goes through levels: b(aseline), h(igh), l(ow)."""
    value = {"b": SETTINGS.baseline, "h": SETTINGS.high, "l": SETTINGS.low}
    command = np.array([value[name] for name in names])
    time = np.arange(float(len(names)))
    return Record(time=time, measurement=np.zeros(time.size), command=command)


def test_a_kick_is_no_switch_and_neither_is_the_end() -> None:
    kicks, switches, released = switches_of(levels("bbhhblllhhlb"), SETTINGS)
    np.testing.assert_array_equal(kicks, [2.0, 5.0])
    np.testing.assert_array_equal(switches, [8.0, 10.0])
    np.testing.assert_array_equal(released, [4.0, 11.0])


def test_a_closed_loop_with_a_law_shows_that_law_sample_by_sample() -> None:
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    options = DesignOptions(law="klipper_heater", sample_period=2.0, controller="pi")
    gains = tune(model, options=options)
    # Half a period for the hold, and one until the power follows.
    run = simulated(gains, replace(model, dead_time=13.0), 200.0)
    assert run is not None
    assert run.time[1] == 2.0
    p, i = gains.p, gains.i * 2.0
    np.testing.assert_allclose(run.command[:4], [0.0, p + i, p + 2.0 * i, p + 3.0 * i])
    # The command of 2 s arrives at 12 s.
    assert np.flatnonzero(run.measurement > 1e-9)[0] == 7


def test_labels_are_in_the_units_of_the_recording() -> None:
    case = replace(case_of(completed(), "tank"), units={"y": "bar", "u": "%"})
    plate = next(each for each in PLATES if each.key == "experiment")
    labels = [axes.get_ylabel() for axes in plate.figure(case).axes]
    assert labels == ["measurement [bar]", "command [%]"]


def test_a_fit_is_drawn_in_the_range_of_what_was_fitted() -> None:
    case = case_of(completed(), "tank")
    assert case.record is not None and case.model is not None
    away = np.arange(len(case.record)) // 5 == 40
    record = replace(case.record, measurement=np.where(away, 9999.0, case.record.measurement))
    model = replace(case.model, fitted=np.where(away, np.nan, case.model.fitted))
    plate = next(each for each in PLATES if each.key == "fit")
    whole, parts = (
        plate.figure(each).axes[0].get_ylim()
        for each in (case, replace(case, record=record, model=model))
    )
    assert parts == pytest.approx(whole, rel=0.05)


def test_thinning_keeps_every_extreme_of_a_long_signal() -> None:
    rng = np.random.default_rng(1)
    time, values = np.arange(50_000.0), rng.normal(size=50_000)
    values[31_415] = 9.0
    few_times, few = thinned(time, values)
    assert few.size < 1500
    assert few.max() == 9.0
    assert few.min() == values.min()
    assert np.all(np.diff(few_times) > 0.0)
    assert set(zip(few_times, few, strict=True)) <= set(zip(time, values, strict=True))


def test_thinning_leaves_gaps_where_nothing_was_fitted() -> None:
    values = np.full(50_000, np.nan)
    values[20_000:] = 1.0
    _, few = thinned(np.arange(50_000.0), values)
    assert np.isnan(few[0])
    assert np.nanmin(few) == 1.0


def test_steps_have_a_corner_at_each_change() -> None:
    times, values = in_steps(np.array([0.0, 1.0, 2.0, 5.0]), np.array([3.0, 3.0, 1.0, 1.0]))
    np.testing.assert_array_equal(times, [0.0, 2.0, 2.0, 5.0, 5.0])
    np.testing.assert_array_equal(values, [3.0, 3.0, 1.0, 1.0, 1.0])


def test_the_rate_is_that_of_a_known_curve() -> None:
    time = np.arange(0.0, 40.0, 0.05)
    record = Record(time=time, measurement=np.sin(time), command=np.zeros(time.size))
    grid, values, rate = rate_of(record, record.measurement, 2.0 * np.pi)
    np.testing.assert_allclose(values, np.sin(grid), atol=0.01)
    np.testing.assert_allclose(rate, np.cos(grid), atol=0.03)


def test_the_band_of_the_nyquist_curve_holds_95_percent_of_its_models() -> None:
    rng = np.random.default_rng(2)
    centres = np.array([0.0, 1.0 + 1.0j, 3.0])
    spread = rng.normal(size=(4000, 3)) + 0.3j * rng.normal(size=(4000, 3))
    area = swept_area(centres + spread)
    fresh = rng.normal(size=4000) + 0.3j * rng.normal(size=4000)
    parts = [Path(polygon) for polygon in area.to_polygons()]

    def share(centre: complex) -> float:
        at = np.column_stack(((centre + fresh).real, (centre + fresh).imag))
        return float(np.mean(np.any([part.contains_points(at) for part in parts], axis=0)))

    inside = [share(centre) for centre in centres]
    # Its neighbours' part adds to what each ellipse holds.
    assert min(inside) > 0.94
    assert inside[0] < 0.985


def test_the_circle_of_ms_touches_the_loop_that_is_drawn() -> None:
    case = case_of(completed(), "tank")
    assert case.added_delay > 0.0
    loop = case.best_gains.loop(in_loop(case, case.model.model))
    nearest = np.abs(1.0 + loop(1j * np.geomspace(1e-3, 1.0, 20_000))).min()
    # The hold of the sampled loop, for which Ms is exact, is drawn as half a period of dead time.
    assert 1.0 / nearest == pytest.approx(case.best_gains.ms, rel=3e-3)


def test_rules_that_give_the_same_gains_are_drawn_once() -> None:
    case = case_of(completed(), "tank")
    best = case.best_gains
    twin = replace(best, rule="twin")
    assert distinct_gains(replace(case, gains=(best, twin))) == (best,)


@pytest.mark.long
def test_the_picture_holds_what_there_is(tmp_path) -> None:
    draw(fruitless(), tmp_path / "figure.png", title="a test")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
@pytest.mark.parametrize(
    ("ending", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")]
)
def test_a_file_is_what_its_ending_says_and_the_same_every_time(
    tmp_path, ending: str, start: bytes
) -> None:
    case = case_of(completed(), "tank")
    (plate,) = (p for p in PLATES if p.key == "uncertainty")
    written = []
    for name in ("one", "two"):
        save(plate.figure(case), str(tmp_path / f"{name}.{ending}"))
        written.append((tmp_path / f"{name}.{ending}").read_bytes())
    assert written[0].startswith(start)
    assert written[0] == written[1]


@pytest.mark.long
@pytest.mark.parametrize("key", ["nyquist", "closed_loop"])
def test_the_same_case_gives_the_same_bytes(key: str) -> None:
    case = case_of(completed(), "tank")
    (plate,) = (p for p in PLATES if p.key == key)
    first = inline(plate.figure(case, narrow=True), "a", "label")
    assert inline(plate.figure(case, narrow=True), "a", "label") == first
