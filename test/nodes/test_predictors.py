# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which model predicts the step that proves gains, and what a sensor lets one judge."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from relay_autotune.control.controller import Control, GainBounds, PredictedLoop, Step
from relay_autotune.control.gains_history import GainSet
from relay_autotune.control.verification import plan
from relay_autotune.errors import NotReadyError, TuningError
from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.laws import LAWS
from relay_autotune.loop.sampled import UNLIMITED
from relay_autotune.nodes.gains_place import RemoteController
from relay_autotune.nodes.live_types import CommandMessage
from relay_autotune.nodes.results import keep
from relay_autotune.nodes.verifier import Predictors, Rest, Trial, Verifiable, judged
from relay_autotune.process.transfer_function import TransferFunction

GOOD, WILD, BY_HAND = (GainSet.of({"kc": kc, "ti": 0.3}) for kc in (0.5, 0.9, 0.7))
TRUE, WRONG = (TransferFunction.fopdt(gain, 0.5, 0.2) for gain in (2.0, 0.7))


def test_gains_are_proved_on_the_model_of_their_own_experiment() -> None:
    known: dict[str, tuple[TransferFunction, str]] = {}
    models = Predictors(known)
    with pytest.raises(NotReadyError, match="no model has come"):
        models.of(GOOD)
    keep(known, "first", (TRUE, ""))
    models.applied(GOOD, "first")
    models.applied(WILD, "second")
    # The model of the second is late: with that of the first, any gains do what is predicted.
    with pytest.raises(NotReadyError, match=r"of the experiment second.*newest one is of first"):
        models.of(WILD)
    keep(known, "second", (WRONG, "doubtful"))
    assert models.of(WILD) == (WRONG, "doubtful")
    assert models.of(GOOD) == (TRUE, "")
    # A message that is repeated changes nothing.
    keep(known, "first", (TRUE, ""))
    assert models.of(WILD) == (WRONG, "doubtful")


def test_gains_without_an_experiment_take_the_newest_model() -> None:
    known = {"first": (TRUE, ""), "second": (WRONG, "")}
    models = Predictors(known)
    assert models.of(BY_HAND) == (WRONG, "")
    # So do those of an experiment where the newest model names none.
    keep(known, "", (TRUE, ""))
    models.applied(GOOD, "third")
    assert models.of(GOOD) == (TRUE, "")


def test_gains_of_another_node_are_predicted_by_its_law_and_its_feed_forward() -> None:
    """A tune told Ms 1.39, and the proof of the same gains by our own law 1.32."""
    nothing = lambda *_, **__: None  # noqa: E731
    node: Any = SimpleNamespace(
        create_client=nothing,
        create_publisher=lambda *_, **__: SimpleNamespace(topic_name="/setpoint", publish=nothing),
        create_subscription=nothing,
    )
    values = {"apply_to": "/pid", "apply_parameters": "p:p,i:i,d:d", "apply_feedforward": 0.8}
    values["initial_setpoint"] = math.nan
    place = RemoteController(node, values, CommandMessage(), nothing)
    gains = Controller(0.5, 0.6, 0.1)
    assert place.control(gains).rate is None
    designed: Any = SimpleNamespace(law="control_toolbox_legacy", law_period=0.01)
    place.require_law(designed)
    found = place.control(gains)
    wanted = Loop(LAWS["control_toolbox_legacy"].at(gains, 0.01), TRUE).ms()
    assert Loop(found.law, TRUE).ms() == wanted != Loop(gains, TRUE).ms()
    assert found.elsewhere and found.law.gains.b == 1.0 + 0.8 / 0.5
    # Such a weight is none of the gains: those of before could not come back with it.
    GainBounds().require(place.controller_of(place.set_of(gains)))


def test_a_sensor_that_is_too_coarse_for_a_step_gives_no_verdict() -> None:
    """The loop stands on one of its values, so that its rest shows no noise."""
    gains, step = Controller(0.5, 0.6), Step(setpoint=0.01)
    model = TransferFunction.fopdt(2.0, 0.5, 0.2)
    loop = PredictedLoop(Control(gains), model)
    tried = Verifiable([step], None, math.nan, loop, UNLIMITED, math.nan)
    planned, rest = plan(loop, step, 0.05), Rest(5.0, 1.0, 0.0)
    time = np.arange(0.0, planned.duration, 0.05)
    exact = 5.0 + loop.run(time, Step(setpoint=0.01)).measurement

    def seen(resolution: float) -> Any:
        y = np.round(exact / resolution) * resolution
        samples = tuple(zip(time, y, np.ones(time.size), strict=True))
        return judged(tried, Trial(1, 1, step, planned, rest, math.inf, made=samples))

    assert seen(1e-4).passed
    with pytest.raises(TuningError, match="cannot be judged"):
        seen(0.01)
    with pytest.raises(NotReadyError, match="did not change at all"):
        seen(0.5)
