# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Messages and back, with stand-ins that have the fields of the message and nothing else."""

from __future__ import annotations

import array
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_autotune.errors import ModelError, RecordError, TuningError
from relay_autotune.exchange.messages import (
    fill_cycle,
    fill_experiment,
    fill_gains,
    fill_transfer_function,
    gains_from_message,
    record_from_cycles,
    record_from_message,
    start_nanoseconds,
    start_seconds,
    transfer_function_from_message,
    without_impossible,
)
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.limit_cycle.fourier import FrequencyPoint
from relay_autotune.identification.result import Combination, FitReport, Identification, Validation
from relay_autotune.loop.gains import Gains
from relay_autotune.process.structures import IPDT, UNSTABLE_FOPDT, GivenModel
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.reasons import Code, other
from relay_autotune.record.record import Cycle, Outcome, Record, RelaySettings

SETTINGS = RelaySettings(
    setpoint=5.0,
    baseline=1.0,
    amplitude=0.5,
    bias=0.1,
    hysteresis=0.02,
    extra_delay=0.3,
    sample_period=0.1,
    reverse_acting=True,
)


def header() -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")


def empty_message() -> SimpleNamespace:
    return SimpleNamespace(
        header=header(),
        settings=SimpleNamespace(amplitude=0.0),
        why=SimpleNamespace(),
        notes=[],
        verdict_why=SimpleNamespace(),
    )


def record(n: int = 40, **changes: Any) -> Record:
    t = np.arange(n) * 0.1
    facts: dict[str, Any] = {
        "time": t,
        "measurement": np.sin(t),
        "command": np.sign(np.cos(t)),
        "receive_time": t + 0.01,
        "command_time": t + 0.011,
        "settings": SETTINGS,
        "noise_std": 0.01,
        "cycle_start": (10, 20, 30),
        "outcome": Outcome.COMPLETED,
        "reason": "three cycles",
        "why": Code.SILENT_SENSOR(Code.NOTE_LOST(samples=2), topic="/level", silence=0.1 + 0.2),
        "experiment_id": "one",
        "start": 1.7e9 + 0.1234567,
        "lost_samples": 2,
    }
    return Record(**(facts | changes))


def assert_same(a: Record, b: Record) -> None:
    for name in ("time", "measurement", "command", "receive_time", "command_time"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    for name in ("settings", "cycle_start", "outcome", "reason", "experiment_id", "start"):
        assert getattr(a, name) == getattr(b, name), name
    # The sentence travels beside the code.
    assert (a.why.code, a.why.facts) == (b.why.code, b.why.facts)
    assert [note.code for note in a.why.notes] == [note.code for note in b.why.notes]
    assert a.lost_samples == b.lost_samples
    assert a.noise_std == b.noise_std or (math.isnan(a.noise_std) and math.isnan(b.noise_std))


def test_a_record_comes_back_to_the_last_bit() -> None:
    message = empty_message()
    fill_experiment(message, record())
    assert isinstance(message.time, array.array)
    assert_same(record_from_message(message), record())


def test_a_recording_of_before_has_the_sentence_of_its_reason_alone() -> None:
    message = empty_message()
    fill_experiment(message, record())
    # What a reader of an older recording fills in.
    message.why, message.notes = SimpleNamespace(code=0, names=(), values=()), ()
    assert record_from_message(message).why == other("three cycles")


def test_a_record_without_relay_comes_back() -> None:
    message = empty_message()
    without = record(settings=None, noise_std=math.nan, cycle_start=(), outcome=Outcome.UNKNOWN)
    fill_experiment(message, without)
    assert_same(record_from_message(message), without)


def test_a_summary_leaves_the_samples_out() -> None:
    message = empty_message()
    fill_experiment(message, record(), arrays=False)
    assert not hasattr(message, "time")
    assert message.reason == "three cycles"


def test_an_unknown_outcome_is_refused_with_the_known_ones() -> None:
    message = empty_message()
    fill_experiment(message, record())
    message.outcome = 9
    with pytest.raises(RecordError, match=r"outcome is 9.*1 \(COMPLETED\)"):
        record_from_message(message)


@given(st.floats(0.0, 4e9, allow_nan=False))
def test_a_start_survives_its_stamp(start: float) -> None:
    there = start_seconds(start_nanoseconds(start))
    # Near the epoch a double is finer than a nanosecond.
    assert there == start or (start < 2**22 and abs(there - start) <= 0.5e-9)


def cycle_messages(whole: Record, start_ns: int) -> list[SimpleNamespace]:
    messages = []
    for index, (first, last) in enumerate(
        zip(whole.cycle_start, whole.cycle_start[1:], strict=False)
    ):
        begin = 0 if index == 0 else first
        part = slice(begin, last + 1)
        message = empty_message()
        fill_cycle(
            message,
            Cycle(1.0, 0.5, 0.5, 1.0, -1.0, 0.2, 0.3, 0.0, 0.0, index, float(whole.time[first])),
            settings=SETTINGS,
            experiment_id="one",
            start_ns=start_ns,
            time=whole.time[part],
            measurement=whole.measurement[part],
            command=whole.command[part],
            lead_in=first - begin,
        )
        messages.append(message)
    return messages


def test_cycles_join_to_the_record_up_to_the_last_of_them() -> None:
    whole = record()
    start_ns = start_nanoseconds(whole.start)
    joined = record_from_cycles(reversed(cycle_messages(whole, start_ns)))
    n = whole.cycle_start[-1] + 1
    assert np.array_equal(joined.measurement, whole.measurement[:n])
    assert np.array_equal(joined.command, whole.command[:n])
    # Each cycle has a stamp of its own, in whole nanoseconds.
    assert np.allclose(joined.time, whole.time[:n], rtol=0.0, atol=2e-9)
    assert joined.cycle_start == whole.cycle_start
    assert joined.settings == SETTINGS
    assert joined.outcome == Outcome.UNKNOWN


def test_of_broken_cycles_the_newest_run_is_used() -> None:
    whole = record(n=60, cycle_start=(10, 20, 30, 40, 50))
    first, _, third, fourth = cycle_messages(whole, 0)
    joined = record_from_cycles([first, third, fourth])
    assert np.array_equal(joined.measurement, whole.measurement[30:51])
    assert joined.cycle_start == (0, 10, 20)


def test_no_cycle_is_refused() -> None:
    with pytest.raises(RecordError, match="no cycle"):
        record_from_cycles([])


def identification(model: TransferFunction) -> Identification:
    return Identification(
        method="waveform",
        estimate=Estimate(
            GivenModel.of(model, ("gain", "time_constant")),
            np.array([2.0, 3.0]),
            np.array([[0.01, 0.0], [0.0, 0.04]]),
        ),
        ci95_low=np.array([1.0, 2.0]),
        ci95_high=np.array([3.0, 4.0]),
        ultimate_gain=3.0,
        ultimate_gain_std=0.1,
        ultimate_frequency=0.2,
        ultimate_frequency_std=math.nan,
        fit=FitReport(residual_rms=0.1, noise_std=0.1, fit=0.9, whiteness_p=0.5, prediction=0.2),
        validation=Validation(shape=0.01, reason=""),
        integrated_error=0.3,
        points=(FrequencyPoint(1.5, 2.0 - 3.0j, 0.1),),
        warnings=("mind",),
        combinations=(Combination("gain/time_constant", "y/(u s)", 0.5, 0.01, 0.48, 0.52),),
        advice=("step longer",),
        support=0.8,
    )


@pytest.mark.parametrize(
    "model",
    [
        TransferFunction.fopdt(1.65, 20.0, 10.0),
        IPDT.build((0.5, 2.0)),
        UNSTABLE_FOPDT.build((2.0, 5.0, 1.0)),
        TransferFunction.from_polynomials([1.0], [4.0, 0.8, 1.0], 0.5),
    ],
)
def test_a_model_comes_back(model: TransferFunction) -> None:
    message = empty_message()
    fill_transfer_function(message, identification(model), experiment_id="one", stamp_ns=5)
    back = transfer_function_from_message(message)
    s = 1j * np.geomspace(1e-3, 1e2, 50)
    assert np.allclose(back(s), model(s), rtol=1e-12)
    assert message.covariance == array.array("d", [0.01, 0.0, 0.0, 0.04])
    assert message.header.stamp.nanosec == 5
    assert (message.prediction, message.integrated_error) == (0.2, 0.3)
    assert message.validation_shape == 0.01
    assert math.isnan(message.validation_period)
    assert list(message.point_real) == [2.0]
    assert list(message.point_imaginary) == [-3.0]


def test_a_complex_pair_is_left_to_the_polynomials() -> None:
    model = TransferFunction.from_polynomials([1.0], [4.0, 0.8, 1.0], 0.5)
    message = empty_message()
    fill_transfer_function(message, identification(model))
    assert list(message.time_constants) == []
    assert list(message.denominator) == pytest.approx([4.0, 0.8, 1.0])


MODEL = TransferFunction.fopdt(1.65, 20.0, 10.0)


def model_message(**changes: Any) -> SimpleNamespace:
    message = empty_message()
    fill_transfer_function(message, identification(MODEL), experiment_id="one")
    return SimpleNamespace(**(vars(message) | changes))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"numerator": [math.nan]}, "finite"),
        ({"denominator": []}, "finite coefficients"),
        ({"denominator": [0, 0]}, r"not all zero, found \[0(\.0)?, 0(\.0)?\]"),
        ({"denominator": [1.0] * 200}, "50 at most"),
        ({"dead_time": -1.0}, "dead time"),
        ({"dead_time": math.inf}, "finite"),
        ({"std": [0.1]}, "std of the model has 1 numbers, expected 2"),
        ({"covariance": [0.1] * 3}, "has 3 numbers, expected 4"),
        ({"ci95_low": []}, "expected 2"),
        ({"std": [0.1, -0.1]}, "negative"),
        ({"point_real": [1.0, 2.0]}, "point_frequency"),
        ({"combination_value": []}, "combinations"),
    ],
)
def test_a_model_that_cannot_be_is_refused(changes: dict[str, Any], said: str) -> None:
    assert str(transfer_function_from_message(model_message())) == str(MODEL)
    with pytest.raises(ModelError, match=said):
        transfer_function_from_message(model_message(**changes))


GAINS = Gains(
    kc=0.6, ti=15.0, td=4.0, tf=0.4, b=0.5, ms=1.4, mt=1.1, gain_margin=3.6, phase_margin=0.9,
    delay_margin=5.0, iae_load=20.0, rule="robust", ms_95=math.nan, reason="why",
)  # fmt: skip


def gains_message(**changes: Any) -> SimpleNamespace:
    message = empty_message()
    fill_gains(message, GAINS, experiment_id="one")
    return SimpleNamespace(**(vars(message) | changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"kc": math.nan},
        {"kc": 1e308},
        {"kc": 0.0},
        {"ti": math.inf},
        {"ti": -1.0},
        {"tf": -1e-9},
        # Another node's controller gets these.
        {"p": 1e308},
        {"i": -1.0},
        {"d": math.nan},
        {"ms": math.nan},
        {"gain_margin": -1.0},
    ],
)
def test_gains_that_cannot_be_are_refused(changes: dict[str, Any]) -> None:
    assert repr(gains_from_message(gains_message())) == repr(GAINS)
    with pytest.raises(TuningError):
        gains_from_message(gains_message(**changes))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("amplitude", -1.0),
        ("amplitude", math.nan),
        ("amplitude", 1e308),
        ("hysteresis", -0.1),
        ("extra_delay", math.inf),
        ("sample_period", -1.0),
        ("baseline", math.nan),
    ],
)
def test_settings_that_cannot_be_are_refused(name: str, value: float) -> None:
    message = empty_message()
    fill_experiment(message, record())
    setattr(message.settings, name, value)
    with pytest.raises(RecordError, match=f"{name} of the relay is"):
        record_from_message(message)


@pytest.mark.parametrize("name", ["time", "measurement", "command", "receive_time"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -1e308])
def test_samples_that_cannot_be_are_refused(name: str, value: float) -> None:
    message = empty_message()
    fill_experiment(message, record())
    getattr(message, name)[3] = value
    with pytest.raises(RecordError, match=rf"{name}\[3\]"):
        record_from_message(message)


@pytest.mark.parametrize(
    "change",
    [
        {"lead_in": 2**32 - 1},
        {"time": array.array("d", [0.0])},
        {"command": array.array("d")},
    ],
)
def test_a_cycle_whose_arrays_do_not_match_is_refused(change: dict[str, Any]) -> None:
    messages = cycle_messages(record(), 0)
    vars(messages[1]).update(change)
    with pytest.raises(RecordError, match="cycle 1 has"):
        record_from_cycles(messages)


def test_what_cannot_be_is_taken_out_of_a_result() -> None:
    good = SimpleNamespace(transfer_function=model_message(), gains=gains_message())
    assert without_impossible(good) == []

    class Empty(SimpleNamespace):
        experiment_id = ""

    bad = SimpleNamespace(
        transfer_function=Empty(**vars(model_message(std=[]))),
        gains=Empty(**vars(gains_message(kc=math.inf))),
    )
    said = without_impossible(bad)
    assert [s.partition(" refused")[0] for s in said] == ["transfer_function", "gains"]
    assert not vars(bad.transfer_function)
    assert not vars(bad.gains)
