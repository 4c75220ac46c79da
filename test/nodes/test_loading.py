# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a node needs during a tune is loaded before it: loading takes most of a second."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import math, sys
import relay_autotune.nodes.{node}
from relay_autotune.exchange.messages import finding_from_message
from relay_autotune.nodes.results import gains_from_message, transfer_function_from_message
from relay_autotune_msgs.msg import PidGains, TransferFunction
nan = math.nan
model = TransferFunction(final=True, numerator=[2.0], denominator=[0.4, 1.0], dead_time=0.2,
                         ms=nan, ms_low=nan, ms_high=nan)
gains = PidGains(final=True, rule="imc", form="isa", kc=0.5, ti=4.0, p=0.5, i=0.125, b=1.0,
                 ms=1.4, mt=1.1, ms_95=nan, gain_margin=3.0, phase_margin=1.0, delay_margin=1.0)
before = set(sys.modules)
transfer_function_from_message(model)
finding_from_message(model)
gains_from_message(gains)
new = set(sys.modules) - before
print(sorted(new))
sys.exit(bool(new))
"""


@pytest.mark.parametrize("node", ["relay", "controller"])
def test_a_first_model_and_first_gains_load_nothing(node: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE.format(node=node)],
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
