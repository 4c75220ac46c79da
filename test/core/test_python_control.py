# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Export to python-control, compared by frequency response where it is installed."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from relay_autotune.errors import MissingPackageError, ModelError
from relay_autotune.exchange.models import to_control
from relay_autotune.loop.gains import Controller
from relay_autotune.process.structures import INTEGRATOR_LAG, UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction

MODELS = [
    TransferFunction.fopdt(1.65, 20.0, 10.0),
    TransferFunction.oscillator(-2.0, 0.3, 0.4, 0.0, zero=-1.5),
    INTEGRATOR_LAG.build((0.1, 3.0, 1.0)),
    UNSTABLE_FOPDT.build((2.0, 5.0, 0.5)),
]


@pytest.mark.long
@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.structure)
def test_the_exported_model_has_the_same_frequency_response(model) -> None:
    pytest.importorskip("control")
    s = 1j * np.geomspace(1e-3, 5.0 / model.dead_time if model.dead_time else 10.0)
    np.testing.assert_allclose(to_control(model, pade_order=5)(s), model(s), rtol=3e-3)


def test_the_exported_controller_is_the_loop_with_the_model() -> None:
    pytest.importorskip("control")
    gains = Controller(kc=0.7, ti=21.0, td=4.0, tf=0.8)
    s = 1j * np.geomspace(1e-3, 0.5, 20)
    loop = to_control(gains) * to_control(MODELS[0])
    np.testing.assert_allclose(loop(s), gains.loop(MODELS[0])(s), rtol=3e-3)


def test_a_higher_order_follows_the_dead_time_further() -> None:
    pytest.importorskip("control")
    model = MODELS[0]
    s = np.array([1j * 0.4])
    errors = [abs(to_control(model, pade_order=n)(s) / model(s) - 1.0) for n in (2, 4, 8)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-5


def test_it_is_refused_in_a_sentence_where_control_is_missing(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(MissingPackageError, match="pip install control"):
        to_control(MODELS[0])


def test_an_order_that_is_none_is_refused() -> None:
    with pytest.raises(ModelError, match="at least 1, found 0"):
        to_control(MODELS[0], pade_order=0)
