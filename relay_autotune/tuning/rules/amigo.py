# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Åström and Hägglund's rules of approximate M-constrained integral gain (AMIGO).

Åström and Hägglund, "Revisiting the Ziegler-Nichols step response method for PID control",
J. Process Control 14, 2004, and "Advanced PID Control", ISA 2006. They were fitted to designs of
Ms = 1.4 on a batch of processes. With gain K, apparent time constant T and apparent delay L,

    PI:   kc = 0.15/K + (0.35 - L T/(L + T)^2) T/(K L),
          ti = 0.35 L + 13 L T^2/(T^2 + 12 L T + 7 L^2);
    PID:  kc = (0.2 + 0.45 T/L)/K,   ti = L (0.4 L + 0.8 T)/(L + 0.1 T),
          td = 0.5 L T/(0.3 L + T);

and of an integrating process ``K exp(-L s)/s``

    PI:   kc = 0.35/(K L),   ti = 13.4 L;
    PID:  kc = 0.45/(K L),   ti = 8 L,   td = 0.5 L.
"""

from __future__ import annotations

import math

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.tuning.rules.applicability import (
    controller,
    process_of,
    wants_pid,
)
from relay_autotune.tuning.rules.step_response import step_response
from relay_autotune.tuning.task import DesignTask


def amigo(task: DesignTask) -> tuple[Controller, str]:
    """Return the PI or PID gains of Åström and Hägglund.

    The set-point weight of PID is theirs: 0 where L is shorter than T, else 1.

    :param task: a process that integrates once, or is stable with a step response that rises
        without much overshoot or inverse response.
    :raises TuningError: for any other, or without delay.
    """
    step = step_response(process_of(task))
    k, t, delay = step.gain, step.lag, step.delay
    pid = wants_pid("amigo", task)
    if not delay > 0.0:
        raise TuningError(
            "the rule amigo divides by the apparent delay, and the step response has none: its L "
            "must be above 0 s; use imc, or give the loop's own delay"
        )
    said = f"L = {delay:.4g} s"
    if math.isinf(t):
        if pid:
            gains = controller(task, 0.45 / (k * delay), 8.0 * delay, 0.5 * delay, b=0.0)
        else:
            gains = controller(task, 0.35 / (k * delay), 13.4 * delay)
        return gains, f"AMIGO for an integrating process with {said}"
    if pid:
        gains = controller(
            task,
            (0.2 + 0.45 * t / delay) / k,
            delay * (0.4 * delay + 0.8 * t) / (delay + 0.1 * t),
            0.5 * delay * t / (0.3 * delay + t),
            b=0.0 if delay <= t else 1.0,
        )
    else:
        kc = 0.15 / k + (0.35 - delay * t / (delay + t) ** 2) * t / (k * delay)
        ti = 0.35 * delay + 13.0 * delay * t * t / (t * t + 12.0 * delay * t + 7.0 * delay**2)
        gains = controller(task, kc, ti)
    return gains, f"AMIGO with T = {t:.4g} s and {said}"
