# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Transfer functions as people write them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import pytest

from relay_autotune.process.structures import INTEGRATOR_LAG
from relay_autotune.process.transfer_function import (
    TransferFunction,
    process_latex,
    process_mathml,
)
from relay_autotune.text import date_text, digits

MODELS = {
    "1.650 e^(-10.00 s) / (1 + 20.00 s)": TransferFunction.fopdt(1.65, 20.0, 10.0),
    "-2.000 (1 - 3.000 s) / (1 + 2.000 s + 4.000 s^2)": TransferFunction.oscillator(
        -2.0, 0.5, 0.5, 0.0, zero=-3.0
    ),
    "0.1000 e^(-1.000e-05 s) / (s (1 + 3.000 s))": INTEGRATOR_LAG.build((0.1, 3.0, 1e-5)),
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
    assert process_latex(model) == r"\frac{1.000}{(1 + 2.000 s)^{3}} \, e^{-0.5000 s}"
    (power,) = [
        e for e in ElementTree.fromstring(process_mathml(model)).iter("msup") if e[1].text == "3"
    ]
    assert "".join(power[0].itertext()) == "(1+2.000s)"


def test_numbers_and_dates_that_are_none() -> None:
    assert digits(float("nan")) == "-"
    assert date_text(0.0) == "1970-01-01 00:00:00 UTC"
    assert date_text(1e300) == "1e+300 s after 1970"
