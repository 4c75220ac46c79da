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


@pytest.mark.long
@pytest.mark.parametrize("node", ["relay", "controller"])
def test_a_first_model_and_first_gains_load_nothing(node: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE.format(node=node)],
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def test_tune_loop_says_that_it_loads_and_does_not_load_what_it_needs_later() -> None:
    code = (
        "import sys; from relay_autotune import start; load = start.import_module\n"
        "def told(name): print('LOADING', file=sys.stderr); return load(name)\n"
        "start.import_module = told; sys.argv = ['tune_loop', '--measurement', 'y', '--help']\n"
        "import atexit; atexit.register(lambda: print('scipy' in sys.modules, file=sys.stderr))\n"
        "start.tune_loop()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip
    said = ["tune_loop is loading; nothing is commanded yet", "LOADING", "False"]
    assert done.stderr.splitlines() == said
