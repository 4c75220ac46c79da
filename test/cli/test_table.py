"""The table for people: what must hold for any model."""

from __future__ import annotations

import numpy as np
import pytest

from relay_autotune.cli.table import identification_lines
from relay_autotune.identification.result import Identification, Rival
from relay_autotune.models import TransferFunction

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
