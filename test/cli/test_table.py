# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The table for people: what must hold for any model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relay_autotune.cli.table import identification_lines
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.result import Rival, identified
from relay_autotune.process.structures import IPDT, LAG_COMPLEX, SOPDT
from relay_autotune.process.transfer_function import TransferFunction

LONG = LAG_COMPLEX.build((-0.4356, 148.123, 0.0123456, 0.345678, 15.8612))
ZERO = TransferFunction.sopdt(1234.5, (123.45, 12.345), 1.2345, -98.765)


@pytest.mark.parametrize("model", [LONG, ZERO], ids=["long", "zero"])
def test_no_model_is_wider_than_the_page(model):
    rival = Rival(Estimate.of_model(LONG), 0.123)
    found = replace(
        identified("waveform", Estimate.of_model(model)),
        rivals=(rival,),
        warnings=("a sentence " * 30,),
    )
    lines = identification_lines(found)
    assert max(map(len, lines)) < 100
    text = " ".join(" ".join(lines).split())
    assert f"({model.structure}, waveform)" in text
    assert "(lag_complex, 12 % of the support)" in text


def test_no_sensor_is_said_to_have_a_noise_of_zero():
    found = identified("waveform", Estimate.of_model(ZERO))
    for std, told in ((0.0, "noise below the sensor's resolution"), (0.25, "noise 0.250 y")):
        (fit,) = [
            line
            for line in identification_lines(replace(found, fit=replace(found.fit, noise_std=std)))
            if "noise" in line
        ]
        assert fit.split(maxsplit=1) == ["fit", told]


def test_every_parameter_has_its_own_unit():
    """A frequency and a damping are no times, and an integrator's gain is a rate."""
    values = np.array((2.0, 0.5, 0.4, 0.1))
    found = identified("waveform", Estimate.of(SOPDT.form(pair=True), values, np.eye(4)))
    lines = identification_lines(
        replace(found, ci95_low=0.9 * values, ci95_high=1.1 * values, undetermined=())
    )
    told = {" ".join(line.split()) for line in lines}
    assert {
        "gain 2.000 y/u 95 %: 1.800 to 2.200",
        "natural frequency 0.5000 rad/s 95 %: 0.4500 to 0.5500",
        "damping 0.4000 95 %: 0.3600 to 0.4400",
        "dead time 0.1000 s 95 %: 0.09000 to 0.1100",
    } <= told
    values = np.array((2.0, 0.1))
    found = identified("waveform", Estimate.of(IPDT, values, 1e-6 * np.eye(2)))
    lines = identification_lines(replace(found, ci95_low=0.95 * values, ci95_high=1.05 * values))
    assert "gain 2.000 y/(u s) 95 %: 1.900 to 2.100" in {" ".join(line.split()) for line in lines}
