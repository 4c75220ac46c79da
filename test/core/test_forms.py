# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The forms of a PID controller are one controller."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller, SeriesForm, series_form

S = 1j * np.geomspace(1e-3, 1e3, 25)


def filtered(tf: float) -> np.ndarray:
    return 1.0 / (1.0 + tf * S + 0.5 * (tf * S) ** 2)


sizes = st.floats(1e-3, 1e3)


@given(kc=sizes, ti=sizes, td=sizes, alpha=st.floats(0.01, 1.0))
def test_series_there_and_back(kc, ti, td, alpha):
    isa = SeriesForm(kc, ti, td, alpha).isa()
    law = kc * (1.0 + 1.0 / (ti * S)) * (1.0 + td * S)
    np.testing.assert_allclose(isa.transfer_function()(S), law * filtered(alpha * td), rtol=1e-6)
    back = series_form(isa)
    # The two times are told apart by their size alone.
    assert (back.ti, back.td) == pytest.approx((max(ti, td), min(ti, td)), rel=1e-5)


@given(kc=sizes | st.floats(-1e3, -1e-3), ti=sizes, td=sizes, tf=sizes)
def test_the_gains_of_the_parallel_form(kc, ti, td, tf):
    isa = Controller(kc, ti, td, tf)
    law = isa.p + isa.i / S + isa.d * S
    np.testing.assert_allclose(isa.transfer_function()(S), law * filtered(tf), rtol=1e-6)


def test_actions_that_are_not_there_stay_away():
    assert series_form(Controller(2.0, 4.0)) == SeriesForm(2.0, 4.0, 0.0, 0.0)
    assert series_form(Controller(2.0, 0.0, 0.5, 0.05)) == SeriesForm(2.0, 0.0, 0.5, 0.1)
    assert SeriesForm(2.0, 0.0, 0.5).isa() == Controller(2.0, 0.0, 0.5, 0.05)
    assert Controller(2.0, 0.0).i == 0.0


def test_double_zeros_still_have_a_series_form():
    found = series_form(Controller(2.0, 4.0, 1.0))
    assert (found.kc, found.ti, found.td) == pytest.approx((1.0, 2.0, 2.0))


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        (Controller(1.0, 4.0, 1.001), "complex zeros"),
        (Controller(1.0, 4.0, 0.0, 0.1), "filter only with derivative"),
    ],
)
def test_no_series_form(gains, message):
    with pytest.raises(TuningError, match=message):
        series_form(gains)
