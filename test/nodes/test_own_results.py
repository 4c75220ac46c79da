# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What relay_node accepts of a running experiment, of which no cycle is whole yet."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from fopdt_plant import FopdtPlant

from relay_autotune.exchange.messages import float64_array
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.nodes.results import OwnResults
from relay_autotune.nodes.session import Session
from relay_autotune.process.transfer_function import TransferFunction as Process
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune_msgs.msg import TransferFunction

PROCESS = Process.fopdt(2.0, 1.0, 0.5)


@pytest.fixture(scope="module")
def session() -> Session:
    """Return an experiment whose relay has switched twice."""
    parameters = ExperimentParameters(amplitude=1.0, settle_time=0.1, hysteresis=0.01)
    session = Session(
        RelayExperiment(parameters, 0.0, "own"),
        SimpleNamespace(sample=lambda _: None),
        one_clock=True,
    )
    plant, command, count = FopdtPlant(2.0, 1.0, 0.5), 0.0, 0
    while session.experiment.switches < 2:
        stamp = 10**18 + 10_000_000 * count
        command = session.answer(plant.advance(0.01 * count, command), stamp, stamp) or 0.0
        session.answered()
        count += 1
    assert not session.experiment.cycles
    return session


def taken(session: Session, process: Process, **finding: float) -> bool:
    """Return whether a model is accepted."""
    point = ultimate_point(process)
    assert point is not None
    known = {"ultimate_gain": point.gain, "ultimate_gain_std": 0.0}
    known |= dict.fromkeys(("ms", "ms_low", "ms_high"), math.nan) | finding
    message = TransferFunction(experiment_id="own", dead_time=process.dead_time, **known)
    message.numerator = float64_array(process.numerator)
    message.denominator = float64_array(process.denominator)
    node: Any = SimpleNamespace(get_logger=lambda: SimpleNamespace(error=lambda _: None))
    results = OwnResults(node, on_setpoint=False)
    return bool(results.take("transfer_function", message, session))


def test_a_model_of_the_process_is_accepted(session: Session) -> None:
    assert taken(session, PROCESS)
    assert taken(session, PROCESS, ultimate_gain=math.nan, ms=1.4, ms_low=1.3, ms_high=1.5)


@pytest.mark.parametrize(
    ("process", "finding"),
    [
        (PROCESS, {"ultimate_gain": 1e3}),
        (PROCESS, {"ultimate_gain": 1e-3}),
        (Process.fopdt(2e4, 1.0, 0.5), {}),
        (Process.fopdt(-2.0, 1.0, 0.5), {}),
        (Process.fopdt(2.0, 1.0, 50.0), {}),
        # What ends a test by the predicted Ms needs no ultimate point.
        (Process.fopdt(2e4, 1.0, 0.5),
         {"ultimate_gain": math.nan, "ms": 1.4, "ms_low": 1.4, "ms_high": 1.4}),
    ],
)  # fmt: skip
def test_one_that_the_samples_contradict_is_not(
    session: Session, process: Process, finding: dict[str, float]
) -> None:
    assert not taken(session, process, **finding)
