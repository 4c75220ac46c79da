"""The table for people: what must hold for any model."""

from __future__ import annotations

import numpy as np
import pytest

from relay_autotune.cli.table import identification_lines
from relay_autotune.identification.result import Identification, Rival
from relay_autotune.process.transfer_function import TransferFunction

LONG = TransferFunction.lag_complex(-0.4356, 148.123, 0.0123456, 0.345678, 15.8612)
ZERO = TransferFunction.sopdt(1234.5, (123.45, 12.345), 1.2345, -98.765)


@pytest.mark.parametrize("model", [LONG, ZERO], ids=["long", "zero"])
def test_no_model_is_wider_than_the_page(model):
    none = np.empty(0)
    found = Identification(
        *("waveform", model, lambda _: model, (), none, np.empty((0, 0)), none, none),
        rivals=(Rival(LONG, 0.123),),
        warnings=("a sentence " * 30,),
    )
    lines = identification_lines(found)
    assert max(map(len, lines)) < 100
    text = " ".join(" ".join(lines).split())
    assert f"({model.structure}, waveform)" in text
    assert "(lag_complex, 12 % of the support)" in text


def test_every_parameter_has_its_own_unit():
    """A frequency and a damping are no times, and an integrator's gain is a rate."""
    oscillator = TransferFunction.oscillator(2.0, 0.5, 0.4, 0.1)
    names = ("gain", "natural_frequency", "damping", "dead_time")
    values = np.array((2.0, 0.5, 0.4, 0.1))
    lines = identification_lines(
        Identification(
            *("waveform", oscillator, lambda _: oscillator, names, values, np.eye(4)),
            *(0.9 * values, 1.1 * values),
        )
    )
    told = {" ".join(line.split()) for line in lines}
    assert {
        "gain 2.000 y/u 95 %: 1.800 to 2.200",
        "natural frequency 0.5000 rad/s 95 %: 0.4500 to 0.5500",
        "damping 0.4000 95 %: 0.3600 to 0.4400",
        "dead time 0.1000 s 95 %: 0.09000 to 0.1100",
    } <= told
    tank = TransferFunction.ipdt(2.0, 0.1)
    lines = identification_lines(
        Identification(
            *("waveform", tank, lambda _: tank, ("gain",), np.array((2.0,)), np.eye(1)),
            *(np.array((1.9,)), np.array((2.1,))),
        )
    )
    assert "gain 2.000 y/(u s) 95 %: 1.900 to 2.100" in {" ".join(line.split()) for line in lines}
