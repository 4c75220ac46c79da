# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a notebook shows of an analysis."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from relay_autotune.analysis import analyse
from relay_autotune.errors import RecordError
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import identified
from relay_autotune.loop.gains import Gains
from relay_autotune.process.structures import FOPDT
from relay_autotune.record.record import Record
from relay_autotune.result import Analysis
from relay_autotune.text import plus_minus

RECORD = Record(time=[0.0, 1.0], measurement=[0.0, 1.0], command=[0.0, 1.0])
GAINS = Gains(
    kc=0.67, ti=21.1, ms=1.66, ms_95=1.7, mt=1.0, gain_margin=math.inf, phase_margin=1.0,
    delay_margin=math.inf, iae_load=31.0, rule="itae", reason="",
)  # fmt: skip


def cells(analysis: Analysis) -> dict[str, str]:
    table = ElementTree.fromstring(analysis._repr_html_())
    return {row[0].text: "".join(row[1].itertext()) for row in table}


def test_model_and_gains_stand_in_a_table() -> None:
    covariance = np.diag([1e-4, 1e-2, 1e-3])
    estimate = Estimate.of(FOPDT, np.array([1.65, 20.0, 10.0]), covariance)
    found = identified("waveform", estimate)
    shown = cells(Analysis(RECORD, (found,), (GAINS,)))
    assert shown["process"] == "1.650e−10.00s(1+20.00s) fopdt, waveform"  # noqa: RUF001
    assert shown["K_u"].startswith("2.307 u/y ± ")
    assert shown["ISA form"].startswith("kc 0.6700 u/y, ti 21.10 s")
    assert shown["Ms"] == "1.66, for 95 % of the models below 1.70"
    assert "reason" not in shown


def test_a_reason_is_text_and_never_html() -> None:
    shown = cells(Analysis(RECORD, reason="<img src=x onerror=alert(1)>"))
    assert shown == {"reason": "<img src=x onerror=alert(1)>"}


def test_an_interpreter_shows_ten_lines_at_most() -> None:
    covariance = np.diag([1e-4, 1e-2, 1e-3])
    estimate = Estimate.of(FOPDT, np.array([1.65, 20.0, 10.0]), covariance)
    found = identified("waveform", estimate, warnings=("the sensor drifts",))
    shown = repr(Analysis(RECORD, (found,) * 9, (GAINS,) * 16, reason="look at it"))
    assert len(shown.splitlines()) <= 10
    assert max(map(len, shown.splitlines())) < 100
    for told in ("2 samples over 1 s", "1.650 e^(-10.00 s)", "kc 0.6700 u/y", "look at it"):
        assert told in shown
    assert "\n" not in repr(found)
    assert "1.650 e^(-10.00 s) / (1 + 20.00 s)" in repr(found)


def test_an_interval_below_the_digits_shown_is_no_number_of_its_own() -> None:
    """A model without noise had K_u +- 1.5e-15."""
    assert plus_minus(2.307, 1.5e-15) == "± less than 0.005 %"
    assert plus_minus(2.307, 0.0123) == "± 0.012"
    assert plus_minus(2.307, math.nan) == ""


@pytest.mark.parametrize("function", [analyse, identify])
def test_what_is_no_record_gets_a_sentence(function) -> None:
    with pytest.raises(RecordError, match="takes one record, found a tuple of 2: give one"):
        function((RECORD, RECORD))
    with pytest.raises(RecordError, match="found str: make one with read_records"):
        function("log.csv")
