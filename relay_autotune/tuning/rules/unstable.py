# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Internal model control of an unstable FOPDT process, ``K exp(-D s)/(tau s - 1)``.

Rotstein and Lewin, "Simple PI and PID Tuning for Open-Loop Unstable Systems", Ind. Eng. Chem.
Res. 30, 1991. With ``T = lambda (lambda/tau + 2)``

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
from relay_autotune.loop.analysis import frequencies, is_stable, sensitivity_peaks
from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.rules.applicability import controller, named, process_of, wants_pid
from relay_autotune.tuning.task import DesignTask

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
    task: DesignTask,
    model: TransferFunction,
    tau: float,
    late: float,
    closed: float,
    pid: bool,
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
        c = _gains(task, model, tau, late, math.exp(log_lambda), pid)
        if not is_stable(c, model):
            return _UNSTABLE
        loop = c.loop(model)
        return min(sensitivity_peaks(loop, frequencies(loop))[0], _UNSTABLE)

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
