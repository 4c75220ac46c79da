# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a notebook shows of an analysis."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import numpy as np

from relay_autotune.analysis import Analysis
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.result import identified
from relay_autotune.loop.gains import Gains
from relay_autotune.process.structures import FOPDT
from relay_autotune.record.record import Record

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
    shown = cells(Analysis(RECORD, (), (found,), 0, (GAINS,), 0))
    assert shown["process"] == "1.650e−10.00s(1+20.00s) fopdt, waveform"  # noqa: RUF001
    assert shown["K_u"].startswith("2.307 ± ")
    assert shown["ISA form"].startswith("kc 0.6700 u/y, ti 21.10 s")
    assert shown["Ms"] == "1.66, for 95 % of the models below 1.70"
    assert "reason" not in shown


def test_a_reason_is_text_and_never_html() -> None:
    shown = cells(Analysis(RECORD, reason="<img src=x onerror=alert(1)>"))
    assert shown == {"reason": "<img src=x onerror=alert(1)>"}
