# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Rules for a process ``K exp(-D s)/(tau s + 1)``, or ``K exp(-D s)/(tau s - 1)``, by its model.

The unstable one: internal model control by Rotstein and Lewin, "Simple PI and PID Tuning for
Open-Loop Unstable Systems", Ind. Eng. Chem. Res. 30, 1991. With ``T = lambda (lambda/tau + 2)``

    PI:   kc = tau T/(K lambda^2),           ti = T;
    PID:  kc = tau (T + D/2)/(K lambda^2),   ti = T + D/2,   td = T (D/2)/(T + D/2).

The paper reads lambda from charts. Here it is the fastest one that keeps to the Ms that is asked
for, on the exact loop. Where none does, it is the fastest within 1.15 times the smallest Ms that
the rule attains. Of the published rules for this process it is the sound one: on the exact loop
its smallest Ms is 4 to 10 % above that of any PI or PID for D/tau up to 0.5, whereas De Paor and
O'Malley's PI (1989) and Visioli's PID (2001) have an Ms of 6 and more at any D/tau.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.rules.applicability import (
    Fopdt,
    controller,
    fopdt_of,
    named,
    process_of,
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


RELAXED = 1.15

_LAMBDAS = np.geomspace(0.3, 100.0, 30)
_UNSTABLE = 1e3


def unstable(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of Rotstein and Lewin for an unstable process.

    A second, stable lag counts as dead time in the formulas, not in the choice of lambda. The
    set-point weight is 0, which for PI is the prefilter 1/(ti s + 1) that the authors advise. With
    ``controller`` "auto" it is PI where PI attains the Ms asked for, else PID.

    :param task: an unstable process of one or two real lags; its ``closed_loop_time`` is lambda.
    :raises TuningError: for any other, or where no lambda makes the loop stable.
    """
    model = process_of(task)
    lags = sorted((t for t in model.time_constants), key=lambda t: t.real)
    first_order = len(lags) == 1 and lags[0].real < 0.0
    second_order = len(lags) == 2 and lags[0].real < 0.0 < lags[1].real
    if model.integrators or model.zeros or not (first_order or second_order):
        raise TuningError(
            "the rule unstable is for K e^(-D s)/(tau s - 1), with one more stable lag at most; "
            f"found {named(task.model)}: use a rule for that structure, or robust"
        )
    tau = -lags[0].real
    late = model.dead_time + sum(t.real for t in lags[1:])
    given = task.options.given_closed_loop_time
    if not late > 0.0 and given is None:
        raise TuningError(
            "the rule unstable has no bound on the gain of a process without dead time: give the "
            "closed-loop time constant lambda, or the loop's own delay"
        )
    if given is not None:
        pid = wants_pid("unstable", task)
        return _gains(task, model, tau, late, given, pid), (
            f"Rotstein-Lewin with lambda = {given:.4g} s, as given"
        )
    kinds = {"pi": (False,), "pid": (True,), "auto": (False, True)}[task.options.controller]
    tried = [(*_choose(task, model, tau, late, pid), pid) for pid in kinds]
    closed, least, pid = next((t for t in tried if t[1] <= task.options.ms), tried[-1])
    if least >= _UNSTABLE:
        raise TuningError(
            f"no {'PID' if pid else 'PI'} gains of Rotstein and Lewin hold this process: its dead "
            f"time over its unstable time constant is {late / tau:.3g}, and "
            f"{'2' if pid else '1'} is the limit of any"
        )
    reason = f"Rotstein-Lewin with lambda = {closed:.4g} s, the fastest "
    if least <= task.options.ms:
        reason += f"with Ms <= {task.options.ms:g}"
    else:
        reason += (
            f"with Ms <= {RELAXED * least:.3g}, {RELAXED:g} times the least that the rule "
            f"attains: {task.options.ms:g} is out of its reach at D/tau = {late / tau:.3g}"
        )
    return _gains(task, model, tau, late, closed, pid), reason


def _gains(
    task: DesignTask, model: TransferFunction, tau: float, late: float, closed: float, pid: bool
) -> Controller:
    size = abs(model.gain) * model.process_sign
    t = closed * (closed / tau + 2.0)
    half = 0.5 * late if pid else 0.0
    kc = tau * (t + half) / (size * closed * closed)
    return controller(task, kc, t + half, t * half / (t + half), b=0.0)


def _choose(
    task: DesignTask, model: TransferFunction, tau: float, late: float, pid: bool
) -> tuple[float, float]:
    """Return the fastest lambda within the bound on Ms, and the least Ms of any."""

    def peak(log_lambda: float) -> float:
        loop = task.loop(_gains(task, model, tau, late, math.exp(log_lambda), pid))
        return min(loop.ms(), _UNSTABLE)

    grid = np.log(late * _LAMBDAS)
    peaks = [peak(float(x)) for x in grid]
    top = int(np.argmin(peaks))
    bounds = (float(grid[max(top - 1, 0)]), float(grid[min(top + 1, grid.size - 1)]))
    best = minimize_scalar(peak, bounds=bounds, method="bounded", options={"xatol": 1e-5})
    least, at = min((float(best.fun), float(best.x)), (peaks[top], float(grid[top])))
    bound = task.options.ms if least <= task.options.ms else RELAXED * least
    before = [float(x) for x, p in zip(grid, peaks, strict=True) if x < at and p > bound]
    if not before or least >= _UNSTABLE:
        return math.exp(at), least
    x = float(brentq(lambda x: peak(x) - bound, before[-1], at, xtol=1e-9))
    return math.exp(x), least
