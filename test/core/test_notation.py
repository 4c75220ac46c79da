# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Transfer functions as people write them."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree

import pytest

from relay_autotune.process.structures import INTEGRATOR_LAG
from relay_autotune.process.transfer_function import (
    TransferFunction,
    process_latex,
    process_mathml,
    process_text,
)
from relay_autotune.text import date_text, digits, percent

MODELS = {
    "1.650 e^(-10.00 s) / (1 + 20.00 s)": TransferFunction.fopdt(1.65, 20.0, 10.0),
    "-2.000 (1 - 3.000 s) / (1 + 2.000 s + 4.000 s^2)": TransferFunction.oscillator(
        -2.0, 0.5, 0.5, 0.0, zero=-3.0
    ),
    "0.1000 e^(-1.000e-05 s) / (s (1 + 3.000 s))": INTEGRATOR_LAG.build((0.1, 3.0, 1e-5)),
    "2.000 s / (1 - 2.000 s + 5.000 s^2)": TransferFunction(
        2.0, (), (complex(-1.0, 2.0), complex(-1.0, -2.0)), -1
    ),
    "4.000": TransferFunction(4.0),
}


@pytest.mark.parametrize(("text", "model"), MODELS.items(), ids=list(MODELS))
def test_a_model_prints_as_one_line(text, model) -> None:
    assert str(model) == text


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_latex_and_mathml_have_every_number_of_the_line(model) -> None:
    mantissas = re.findall(r"\d+\.\d+", str(model))
    latex, mathml = process_latex(model), process_mathml(model)
    assert sorted(re.findall(r"\d+\.\d+", latex)) == sorted(mantissas)
    assert latex.count("{") == latex.count("}")
    numbers = [e.text for e in ElementTree.fromstring(mathml).iter("mn") if "." in e.text]
    assert sorted(numbers) == sorted(mantissas)
    assert model._repr_latex_() == rf"$\displaystyle {latex}$"


def test_equal_lags_are_a_power() -> None:
    model = TransferFunction.lag_n(1.0, 2.0, 3, 0.5)
    assert str(model) == "1.000 e^(-0.5000 s) / (1 + 2.000 s)^3"
    assert process_latex(model) == r"\frac{1.000}{(1 + 2.000 s)^{3}} \, e^{-0.5000 s}"
    (power,) = [
        e for e in ElementTree.fromstring(process_mathml(model)).iter("msup") if e[1].text == "3"
    ]
    assert "".join(power[0].itertext()) == "(1+2.000s)"


def test_numbers_that_people_read_have_no_exponent() -> None:
    told = {
        203.0: "200",
        99.6: "100",
        160.0: "160",
        2.04: "2.0",
        12345.0: "12000",
        1e-7: "1.0e-07",
    }
    assert [digits(value, 2) for value in told] == list(told.values())
    assert [digits(-123456.0), digits(1.5e9)] == ["-123500", "1.500e+09"]
    assert [percent(x) for x in (0.157, 0.0004, 1.6, math.nan)] == ["16", "0", "160", "-"]


def test_a_lag_of_nothing_is_left_out() -> None:
    model = TransferFunction(2.0, (4e-20,), (3.0, 5e-20), dead_time=0.5)
    assert process_text(model) == "2.000 e^(-0.5000 s) / (1 + 3.000 s)"
    assert "e-" not in process_latex(model) and "10" not in process_mathml(model)
    # It is no share of what there is besides.
    assert process_text(TransferFunction(2.0, (), (5e-20,))) == "2.000 / (1 + 5.000e-20 s)"


def test_numbers_and_dates_that_are_none() -> None:
    assert digits(float("nan")) == "-"
    assert date_text(0.0) == "1970-01-01 00:00:00 UTC"
    assert date_text(1e300) == "1e+300 s after 1970"
