"""A relay whose command takes time from level to level."""

from __future__ import annotations

import pytest

from relay_autotune.errors import IdentificationError
from relay_autotune.identification import identify
from relay_autotune.models import TransferFunction
from relay_autotune.record import Record
from relay_autotune.relay import ExperimentParameters, RelayExperiment
from relay_autotune.simulation import Plant


def _record(rate: float) -> Record:
    parameters = ExperimentParameters(amplitude=1.0, command_rate=rate, bias_ratio=0.0)
    loop = RelayExperiment(parameters, 0.0)
    plant, command = Plant(TransferFunction.fopdt(1.65, 20.0, 10.0)), 0.0
    for k in range(5_000):
        command = loop.step(0.2 * k, plant.advance(0.2 * k, command))
        if loop.finished:
            break
    return loop.record()


def test_the_command_as_it_was_gives_the_exact_process():
    found = identify(_record(0.5))
    assert found.structure == "fopdt"
    assert found.values == pytest.approx((1.65, 20.0, 10.0), rel=1e-9)


@pytest.mark.parametrize("method", ["wang_unbiased", "chang", "atv", "thyagarajan"])
def test_methods_for_an_ideal_relay_step_aside(method):
    with pytest.raises(IdentificationError, match="between its two levels"):
        identify(_record(0.5), method)
    assert identify(_record(0.0), method).model.gain > 0.0
