# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Published tuning rules, each with its source and where it applies."""

from __future__ import annotations

from collections.abc import Callable

from relay_autotune.loop.gains import Controller
from relay_autotune.tuning.rules.formulas import (
    imc,
    imc_chang,
    itae,
    tyreus_luyben,
    tyreus_luyben_cycle,
    unstable,
    ziegler_nichols,
    ziegler_nichols_cycle,
)
from relay_autotune.tuning.rules.luyben2003 import luyben2003, luyben2003_p
from relay_autotune.tuning.rules.step_response import amigo, simc
from relay_autotune.tuning.rules.thyagarajan2003 import lcmax, phase_margin, thyagarajan
from relay_autotune.tuning.task import DesignTask

Rule = Callable[[DesignTask], tuple[Controller, str]]

PUBLISHED: dict[str, Rule] = {
    "thyagarajan": thyagarajan,
    "tyreus_luyben": tyreus_luyben,
    "tyreus_luyben_cycle": tyreus_luyben_cycle,
    "ziegler_nichols": ziegler_nichols,
    "ziegler_nichols_cycle": ziegler_nichols_cycle,
    "itae": itae,
    "imc": imc,
    "imc_chang": imc_chang,
    "phase_margin": phase_margin,
    "lcmax": lcmax,
    "luyben2003": luyben2003,
    "luyben2003_p": luyben2003_p,
    "simc": simc,
    "amigo": amigo,
    "unstable": unstable,
}
