# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What is known of the process, and several tests for one model, in `replay`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from made_bags import START, definition, experiment_message, serialize, write_samples
from sampled_relay import simulate_sampled_relay

from relay_autotune.analysis import analyse_jointly
from relay_autotune.bag.definitions import EXPERIMENT, Definition
from relay_autotune.bag.writer import BagWriter, Topic
from relay_autotune.cli import replay
from relay_autotune.errors import IdentificationError, RelayAutotuneError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods import METHODS, USED_BY, identify
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome, Record, RelaySettings

MODEL = TransferFunction.fopdt(1.65, 20.0, 10.0)


def unbiased(extra_delay: float = 0.0) -> Record:
    relay = RelaySettings(50.0, 30.0, 3.0, 0.0, 0.1, extra_delay)
    noise = np.random.default_rng(5).normal(0.0, 0.01, 700)
    record = simulate_sampled_relay(MODEL, relay, period=0.4, noise=noise)
    return replace(record, noise_std=0.01, experiment_id=f"run-{extra_delay:g}", start=START / 1e9)


def write_bag(path, folder, *records):
    text = definition(EXPERIMENT, folder).text
    experiments = Topic("/relay_experiment", EXPERIMENT, definition=Definition(text))
    topics = [Topic("/measurement"), Topic("/command"), experiments]
    with BagWriter(path, topics, start_ns=START) as bag:
        for record in records:
            write_samples(bag, record)
            data = serialize(EXPERIMENT, text, experiment_message(record))
            bag.write("/relay_experiment", START, START, data)
    return path


def run(capsys, *arguments) -> tuple[int, list[dict], str]:
    status = replay.main([str(a) for a in ("--json", *arguments)])
    out, err = capsys.readouterr()
    return status, [json.loads(line) for line in out.splitlines()], err


@pytest.mark.long
def test_known_facts_reach_the_method(tmp_path, capsys):
    record = unbiased()
    bag = write_bag(tmp_path / "bag", tmp_path, record)
    known = ("--gain", "1.65", "--dead-time", "10", "--structure", "fopdt")
    status, (found,), _ = run(capsys, "--method", "chang", "--rule", "imc", *known, bag)
    assert status == 0
    model = found["experiments"][0]["models"][0]
    assert (model["method"], model["gain"], model["dead_time"]) == ("chang", 1.65, 10.0)
    expected = identify(record, "chang", Known(1.65, 10.0, "fopdt"))
    assert model["time_constants"] == [t.real for t in expected.model.time_constants]
    assert model["time_constants"] == pytest.approx([20.0], rel=0.05)


@pytest.mark.parametrize(
    ("fact", "told"),
    [
        ("--dead-time -1", "--dead-time is -1, expected at least 0 s"),
        ("--gain 0", "--gain is 0, expected any number [y/u] but 0"),
    ],
)
def test_a_fact_that_cannot_be_is_one_line(fact, told, tmp_path, capsys):
    status, found, err = run(capsys, *fact.split(), tmp_path / "none")
    assert (status, found) == (2, [])
    assert err == f"replay: {told}\n"


@pytest.mark.parametrize(
    ("fact", "method", "uses"),
    [
        ("--gain 5", "waveform", "wang_biased, wang_unbiased, chang, atv, fourier"),
        ("--dead-time 60", "waveform", "chang, atv, li, thyagarajan, luyben_step, fourier"),
        ("--loss huber", "chang", "waveform"),
        ("--gain 5", "li", "wang_biased, wang_unbiased, chang, atv, fourier"),
    ],
)
def test_a_fact_that_the_method_does_not_use_is_refused(tmp_path, capsys, fact, method, uses):
    status, found, err = run(capsys, *fact.split(), "--method", method, tmp_path / "none")
    name = fact.split()[0].removeprefix("--").replace("-", "_")
    assert (status, found) == (2, [])
    assert err == (
        f"replay: {name} is not used by the method {method}: leave it out, or name a method that "
        f"uses it: {uses}\n"
    )


@pytest.mark.parametrize("method", ["chang", "wang_unbiased"])
def test_what_a_method_is_declared_not_to_use_changes_nothing(method):
    record, given = unbiased(), Known(3.0, 4.0, "lag_n", 3, "huber")
    first = METHODS[method](record, NOTHING).values
    for name in (name for name, methods in USED_BY.items() if method not in methods):
        known = replace(NOTHING, **{name: getattr(given, name)})
        np.testing.assert_array_equal(METHODS[method](record, known).values, first)
        with pytest.raises(IdentificationError, match=f"{name} is not used by the method"):
            identify(record, method, known)


@pytest.mark.long
@pytest.mark.parametrize("one_bag", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_two_tests_give_one_model(tmp_path, capsys, one_bag):
    records = unbiased(), unbiased(8.0)
    if one_bag:
        bags = [write_bag(tmp_path / "both", tmp_path, *records)]
    else:
        bags = [write_bag(tmp_path / str(k), tmp_path, r) for k, r in enumerate(records)]
    status, (found,), _ = run(capsys, "--method", "li", *bags)
    assert status == 0
    assert found["bag"] == ", ".join(map(str, bags))
    (experiment,) = found["experiments"]
    (model,) = experiment["models"]
    assert (model["method"], model["structure"]) == ("li", "fopdt")
    assert model["ultimate_gain"] == pytest.approx(2.3072, rel=0.03)
    assert experiment["gains"][0]["rule"] == "robust"


def test_one_test_is_not_enough(tmp_path, capsys):
    bag = write_bag(tmp_path / "bag", tmp_path, unbiased())
    status, (found,), err = run(capsys, "--method", "li", bag)
    assert status == 1
    assert found["experiments"][0]["models"] == []
    assert "extra_delay" in err
    status, (found,), err = run(capsys, "--method", "li", bag, tmp_path / "none")
    assert status == 1
    assert "none" in found["error"]


@pytest.mark.long
def test_tests_that_were_aborted_give_no_gains():
    records = unbiased(), replace(unbiased(8.0), outcome=Outcome.ABORTED, reason="a hand did it")
    found = analyse_jointly(records, method="li")
    assert found.model is not None
    assert found.gains == ()
    assert found.reason == "the experiment was aborted: no gains. a hand did it"


@pytest.mark.nightly
def test_rules_for_fopdt_take_that_of_the_method():
    known = Known(structure="fopdt")
    found = analyse_jointly((unbiased(), unbiased(8.0)), method="li", rule="simc", known=known)
    assert found.shaping.task.simple == found.model.model


def test_unknown_names_are_refused():
    with pytest.raises(RelayAutotuneError, match="unknown rule"):
        analyse_jointly([unbiased()], method="li", rule="none")
    assert "these do: li" in analyse_jointly([unbiased()], method="chang").reason
