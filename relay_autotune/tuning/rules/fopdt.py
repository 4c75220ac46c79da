# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Rules for a stable FOPDT process, ``K exp(-D s)/(tau s + 1)``."""

from __future__ import annotations

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.tuning.rules.applicability import (
    Fopdt,
    controller,
    fopdt_of,
    wants_pid,
)
from relay_autotune.tuning.task import DesignTask

ITAE_RANGE = (0.1, 1.0)
_ROUNDING = 1e-9


def itae(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of minimum ITAE after a set-point step, by Rovira.

    PI: ``kc = 0.586/K (D/tau)^-0.916``, ``ti = tau/(1.03 - 0.165 D/tau)`` (Thyagarajan and Yu
    2003, eqs 33 and 34). PID: ``kc = 0.965/K (D/tau)^-0.85``, ``ti = tau/(0.796 - 0.147 D/tau)``,
    ``td = 0.308 tau (D/tau)^0.929``. Source: Rovira, Murrill and Smith, Instruments and Control
    Systems 42, 1969; Smith and Corripio, "Principles and Practice of Automatic Process Control".

    :param task: a stable FOPDT process with 0.1 <= D/tau <= 1.
    :raises TuningError: for any other.
    """
    process = fopdt_of("itae", task)
    ratio, tau = process.ratio, process.time_constant
    low, high = ITAE_RANGE
    if not low * (1.0 - _ROUNDING) <= ratio <= high * (1.0 + _ROUNDING):
        raise TuningError(
            f"the ITAE rule holds for 0.1 <= D/tau <= 1, found {ratio:.3g}: use tyreus_luyben "
            "below, imc above, or thyagarajan to have it chosen"
        )
    if wants_pid("itae", task):
        gains = controller(
            task,
            0.965 / process.gain * ratio**-0.85,
            tau / (0.796 - 0.147 * ratio),
            0.308 * tau * ratio**0.929,
        )
    else:
        gains = controller(
            task, 0.586 / process.gain * ratio**-0.916, tau / (1.03 - 0.165 * ratio)
        )
    return gains, f"minimum ITAE (Rovira) for D/tau = {ratio:.3g}{process.note}"


def imc(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of internal model control, with lambda free.

    PI: ``kc = (tau + D/2)/(K lambda)``, ``ti = tau + D/2``, by default
    ``lambda = max(1.7 D, 0.2 tau)`` (Thyagarajan and Yu 2003, eqs 35 to 37; their Table 4 prints
    ``tau + D`` in kc, which is wrong). PID: ``kc = (tau + D/2)/(K (lambda + D/2))``, the same
    ti, ``td = tau D/(2 tau + D)``, by default ``lambda = max(0.8 D, 0.2 tau)``. Source: Rivera,
    Morari and Skogestad, Ind. Eng. Chem. Process Des. Dev. 25, 1986.

    :param task: a stable FOPDT process; its ``closed_loop_time`` is lambda.
    :raises TuningError: for any other.
    """
    process = fopdt_of("imc", task)
    share = 0.8 if wants_pid("imc", task) else 1.7
    default = max(share * process.dead_time, 0.2 * process.time_constant)
    given = task.options.given_closed_loop_time
    closed = default if given is None else given
    why = f"lambda = {closed:.4g} s" + (", as given" if given is not None else "")
    return _imc("imc", task, process, closed, why)


def imc_chang(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of internal model control with the process's own time constant as lambda.

    Chang, Shen and Yu (1992, Fig 5) ask of 1.65 exp(-10 s)/(20 s + 1) a closed loop with a time
    constant of 20 s, that of the process.

    :param task: a stable FOPDT process.
    :raises TuningError: for any other.
    """
    process = fopdt_of("imc_chang", task)
    closed = process.time_constant
    why = f"lambda = tau = {closed:.4g} s (Chang, Shen and Yu)"
    return _imc("imc_chang", task, process, closed, why)


def _imc(
    name: str, task: DesignTask, process: Fopdt, closed: float, why: str
) -> tuple[Controller, str]:
    tau, dead_time = process.time_constant, process.dead_time
    ti = tau + 0.5 * dead_time
    if wants_pid(name, task):
        kc = ti / (process.gain * (closed + 0.5 * dead_time))
        gains = controller(task, kc, ti, tau * dead_time / (2.0 * tau + dead_time))
    else:
        gains = controller(task, ti / (process.gain * closed), ti)
    return gains, f"IMC with {why}{process.note}"
