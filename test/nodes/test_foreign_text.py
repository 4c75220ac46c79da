# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Text and numbers of other nodes: nothing of them acts on a terminal or passes for our own."""

from __future__ import annotations

import math
import os
import subprocess
import sys

import pytest

from relay_autotune.cli.tune_view import Paint, document, live_lines, log_line, result_lines
from relay_autotune.exchange.messages import (
    float64_array,
    gains_from_message,
    identification_from_message,
    made_visible,
    without_impossible,
)
from relay_autotune_msgs.action import Tune
from relay_autotune_msgs.msg import PidGains, TransferFunction

FORGED = "\x1b]0;taken\x07\x1b[2J\n[INFO] [1.0] [relay_node]: all is well\u202e"
NUMBERS = (math.nan, math.inf, -math.inf, -1.0, 1e308, -1e308, 5e-324)
TOLD = """
import sys
import rclpy
from relay_autotune.nodes.lifetime import ServedNode
rclpy.init()
node = ServedNode("told")
for text in ("first", sys.argv[1]):
    log = node.get_logger()
    log.info(text), log.warning(text), log.error(text), log.fatal(text)
"""


def is_harmless(text: str) -> bool:
    return all(char.isprintable() or char == "\n" for char in text)


def model() -> TransferFunction:
    found = TransferFunction(experiment_id=FORGED, structure=FORGED, method=FORGED, final=True)
    found.numerator, found.denominator = float64_array([2.0]), float64_array([1.0, 1.0])
    found.warnings, found.verdict_reason, found.dead_time = [FORGED, FORGED], FORGED, 0.5
    return found


def gains() -> PidGains:
    return PidGains(
        experiment_id=FORGED, rule=FORGED, reason=FORGED, warnings=[FORGED], verdict_reason=FORGED,
        kc=1.0, ti=2.0, p=1.0, i=0.5, b=1.0, ms=1.4, mt=1.2, ms_95=1.5, gain_margin=3.0,
        phase_margin=1.0, delay_margin=1.0, verdict=200,
    )  # fmt: skip


def test_what_becomes_our_own_has_no_text_that_acts() -> None:
    for found in (identification_from_message(model()), gains_from_message(gains())):
        assert "taken" in str(vars(found))
        texts = [v for v in vars(found).values() if isinstance(v, str)]
        texts += [v for held in vars(found).values() if isinstance(held, tuple) for v in held]
        assert all(is_harmless(text) and "\n" not in text for text in texts if type(text) is str)


def test_a_hostile_node_in_the_place_of_relay_node_writes_nothing_of_its_own() -> None:
    result = Tune.Result(reason=FORGED, bag=FORGED, checks=[FORGED], verdict=200)
    result.verdict_reason, result.transfer_function, result.gains = FORGED, model(), gains()
    result.experiment.experiment_id = result.experiment.reason = FORGED
    said = without_impossible(made_visible(result))
    shown = result_lines(result, False, Paint(), 99)
    assert all(is_harmless(line) and "\n" not in line for line in (*said, *shown))
    assert "[INFO]" in "".join(shown)
    assert document(result, "node", False)["verdict"] == "unknown"


@pytest.mark.parametrize("value", NUMBERS)
@pytest.mark.parametrize(
    "name",
    ["progress", "elapsed", "remaining", "period", "amplitude", "ultimate_gain",
     "ultimate_gain_std"],
)  # fmt: skip
def test_a_feedback_with_impossible_numbers_is_shown(name: str, value: float) -> None:
    feedback = Tune.Feedback(status=FORGED, cycle=2**32 - 1, state=3, transfer_function=model())
    setattr(feedback, name, value)
    without_impossible(made_visible(feedback))
    lines = [log_line(feedback), *live_lines(feedback, Paint())]
    assert all(is_harmless(line) and "\n" not in line for line in lines)


@pytest.mark.long
def test_the_log_of_a_node_has_one_line_for_each_text() -> None:
    done = subprocess.run(
        [sys.executable, "-c", TOLD, FORGED],
        env=os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"},
        capture_output=True, text=True, timeout=60.0, check=True,
    )  # fmt: skip
    lines = (done.stdout + done.stderr).splitlines()
    assert len(lines) == 8
    assert all(map(is_harmless, lines))
