# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Luyben's rules for integrating processes with inverse response and dead time.

Luyben, "Identification and Tuning of Integrating Processes with Deadtime and Inverse Response",
Ind. Eng. Chem. Res. 2003. The two integrators of process and controller start the loop's phase at
-180 degrees; the controller's lead lifts it to a peak before the lags bring it down again. The
integral time is the one whose peak is at -120 degrees, the gain the one whose closed loop
resonates by +2 dB.

Errata: eq 9 has ``+ ti/(1 + (w ti)^2)``, as the paper's program has it. The paper calls that
integral time the smallest possible; the +2 dB are feasible down to a little more than half of it.
Two gains give +2 dB, and the upper one is meant. The optimum of td is sought on a continuum here,
and not among the four values of Table 1: for half the integral time it is 0.94, not 1.15 min.

The gain at which a closed loop has a given resonance, exactly.

The closed-loop log modulus ``L_c = 20 log |k L/(1 + k L)|`` equals the logarithm of M > 1 where
k L(j w) lies on Hall's circle of M. At one frequency that is a quadratic equation for k,

    (M^2 - 1) |L|^2 k^2 + 2 M^2 Re(L) k + M^2 = 0,

so that every frequency at which it has real roots forbids the gains between them. The gains
forbidden by neighbouring frequencies join to intervals; the one that holds the ultimate gain ends
below at the largest gain of a loop of that resonance. A loop with two integrators has a second
interval that begins at zero, whose upper end is the lower solution; Luyben (2003) takes the
upper one, as here.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller, SeriesForm
from relay_autotune.process.frequencies import frequencies
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.scalar import minimum_near, root
from relay_autotune.tuning.rules.formulas import named, wants_pid
from relay_autotune.tuning.task import DesignTask


def resonant_gain(loop: TransferFunction, decibels: float) -> float:
    """Return the largest factor on a loop that gives its closed loop a resonance.

    :param loop: controller of gain 1 times process, with the sign that makes its feedback
        negative.
    :param decibels: largest closed-loop log modulus, > 0 [dB].
    :raises TuningError: if the loop is stable at every gain or at none, or if no gain has so
        small a resonance.
    """
    limit = ultimate_point(loop)
    if limit is None:
        raise TuningError(
            f"no gain gives this loop a resonance of {decibels:g} dB: it has no ultimate gain, "
            "so that its resonance either has no bound or stays small at every gain"
        )
    square = 10.0 ** (decibels / 10.0)
    w = frequencies(loop)
    low, high = _roots(loop, w, square)
    inside = np.flatnonzero(~np.isnan(low))
    # Neighbouring frequencies forbid one interval of gains; the highest one comes first, so that
    # one pass joins all that overlap with the ultimate gain.
    runs = np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1) if inside.size else []
    runs.sort(key=lambda run: -float(high[run].max()))
    upper, at = limit.gain, -1
    for run in runs:
        i = int(run[np.argmin(low[run])])
        if low[i] < upper <= high[run].max() * (1.0 + 1e-12):
            upper, at = float(low[i]), i
    if at == 0:
        # At the lowest frequency of a double integrator the interval goes on down to zero.
        raise TuningError(
            f"no gain gives this loop a resonance as small as {decibels:g} dB: its integral time "
            "is too short, or its derivative time unsuitable"
        )

    if at < 0:
        return upper

    def end(log_w: float) -> float:
        value = float(_roots(loop, np.array([math.exp(log_w)]), square)[0][0])
        return 1e3 * upper if math.isnan(value) else value

    return min(minimum_near(end, np.log(w), at, 1e-12)[1], upper)


def _roots(loop: TransferFunction, w: FloatArray, square: float) -> tuple[FloatArray, FloatArray]:
    """Return the gains between which each frequency forbids all; NaN: it forbids none."""
    value = loop(1j * w)
    size, real = np.abs(value) ** 2, value.real
    under = square * square * real * real - square * (square - 1.0) * size
    with np.errstate(invalid="ignore"):
        root = np.where((real < 0.0) & (under >= 0.0), np.sqrt(under), math.nan)
    # The product of the roots is M^2/((M^2 - 1)|L|^2); the sum of equals would lose digits.
    high = (-square * real + root) / ((square - 1.0) * size)
    low = square / ((square - 1.0) * size * high)
    return low, high


SHARES = (0.5, 0.25)

_GRID = np.geomspace(1e-6, 1e4, 600)
_LONGEST = 1e8
_TD_GRID = np.geomspace(0.01, 1.0, 18)


def luyben2003(task: DesignTask) -> tuple[Controller, str]:
    """Return the PI or PID gains of Luyben for an integrating process.

    PI: ti of :func:`integral_time`, kc of +2 dB (eqs 8 to 10). PID: series form with ti half and a
    quarter of that, td of the largest gain (eq 11, Table 1); of the two the one with the larger
    integral gain.

    :param task: a process with one integrator, and lags, dead time or inverse response; its
        ``phase_peak`` and ``resonance`` are the two figures.
    :raises TuningError: for any other, or where no gain has so small a resonance.
    """
    model = _process("luyben2003", task)
    asked = task.options
    ti = integral_time(model, asked.phase_peak)
    said = f"{math.degrees(asked.phase_peak):.4g} degrees at the peak and +{asked.resonance:g} dB"
    if not wants_pid("luyben2003", task):
        gains = Controller(model.process_sign * gain(model, ti, asked.resonance), ti)
        return gains, f"Luyben 2003: {said}"
    found = {}
    for share in SHARES:
        try:
            found[share] = derivative(model, share, ti, asked.resonance, 1.0 / asked.filter_ratio)
        except TuningError as error:
            refused = error
    if not found:
        raise refused
    tried = ", ".join(
        f"{100.0 * share:.0f} % gives ti {c.ti:.4g} s, td {c.td:.4g} s, kc {c.kc:.4g}"
        for share, c in found.items()
    )
    reason = f"Luyben 2003: {said}, series PID; of the PI's integral time {tried}"
    return max((c.isa() for c in found.values()), key=lambda c: abs(c.i)), reason


def luyben2003_p(task: DesignTask) -> tuple[Controller, str]:
    """Return the gain of proportional control for an ordinary level.

    Where a level may stand anywhere in its vessel, Luyben (2003) advises proportional action
    alone: it has no integral time to disturb the smoothing. The gain here is the largest one, of
    +2 dB; a smaller one smooths more.

    :param task: as for :func:`luyben2003`.
    :raises TuningError: for a process without integrator, or without any lag or dead time.
    """
    model = _process("luyben2003_p", task)
    if task.options.controller == "pid":
        raise TuningError("the rule luyben2003_p gives proportional action only")
    size = gain(model, 0.0, task.options.resonance)
    return Controller(model.process_sign * size, 0.0), (
        f"Luyben 2003: P only, the largest gain of +{task.options.resonance:g} dB; it leaves an "
        "offset after a load, as an ordinary level may have"
    )


def integral_time(model: TransferFunction, phase_peak: float) -> float:
    """Return the integral time whose loop has its phase peak at a given angle (eqs 8 and 9) [s].

    :param model: a process with one integrator.
    :param phase_peak: between -pi and -pi/2 [rad].
    :raises TuningError: if the phase has no peak.
    """
    scale = _lag(model)
    low, high = 0.0, math.log(_LONGEST)

    def excess(log_ti: float) -> float:
        return _peak(model, scale, scale * math.exp(log_ti)) - phase_peak

    while excess(low) > 0.0:
        low -= 5.0
        if low < -math.log(_LONGEST):
            raise TuningError("the phase of the loop is above the angle at any integral time")
    if excess(high) < 0.0:
        raise TuningError(
            f"the loop's phase never comes up to {math.degrees(phase_peak):.4g} degrees, "
            "whatever the integral time"
        )
    return scale * math.exp(root(excess, low, high, 1e-14))


def gain(model: TransferFunction, ti: float, decibels: float) -> float:
    """Return the size of kc whose P or PI loop has a closed-loop resonance, the upper one [u/y].

    :param model: the process.
    :param ti: integral time [s]; 0: proportional action alone.
    :param decibels: of the closed-loop log modulus [dB].
    :raises TuningError: if no gain has so small a resonance.
    """
    return resonant_gain(Controller(1.0, ti).loop(_direct(model)), decibels)


def derivative(
    model: TransferFunction, share: float, ti: float, decibels: float, alpha: float = 0.1
) -> SeriesForm:
    """Return the series PID controller of the largest gain (steps 1 to 4 of section 3.4).

    :param model: the process.
    :param share: of the PI controller's integral time.
    :param ti: the PI controller's integral time [s].
    :param decibels: of the closed-loop log modulus [dB].
    :param alpha: of the filter.
    :raises TuningError: if no derivative time has a gain of that resonance.
    """
    short = share * ti

    def size(td: float) -> float:
        c = SeriesForm(1.0, short, td, alpha).isa()
        try:
            return resonant_gain(c.loop(_direct(model)), decibels)
        except TuningError:
            return 0.0

    tried = short * _TD_GRID
    sizes = [size(float(td)) for td in tried]
    top = int(np.argmax(sizes))
    if sizes[top] == 0.0:
        raise TuningError(
            f"with {100.0 * share:.0f} % of the PI controller's integral time no derivative time "
            f"has a gain of +{decibels:g} dB"
        )
    td, _ = minimum_near(lambda td: -size(td), tried, top, 1e-6 * short)
    return SeriesForm(model.process_sign * size(td), short, td, alpha)


def _process(rule: str, task: DesignTask) -> TransferFunction:
    model = task.process
    if model.integrators != 1 or model.grows:
        raise TuningError(
            f"the rule {rule} is for a process with one integrator, found {named(task.model)}: "
            "use a rule for that structure, or robust"
        )
    if _lag(model) == 0.0:
        raise TuningError(
            f"the rule {rule} needs a lag, a dead time or an inverse response that limits the "
            "gain, and the integrator has none: its phase never falls below -90 degrees"
        )
    return model


def _lag(model: TransferFunction) -> float:
    constants = (*model.time_constants, *model.zeros)
    return model.dead_time + sum(abs(c) for c in constants)


def _direct(model: TransferFunction) -> TransferFunction:
    """Return a process as if it were direct-acting."""
    return replace(model, gain=model.process_sign * model.gain)


def _peak(model: TransferFunction, scale: float, ti: float) -> float:
    """Return the highest phase of the loop, after the two integrators' -180 degrees [rad]."""

    def lag(log_w: Any) -> Any:
        w = np.exp(log_w)
        return 0.5 * math.pi - model.phase(w) - np.arctan(w * ti)

    log_grid = np.log(_GRID / scale)
    top = int(np.argmin(lag(log_grid)))
    return -min(minimum_near(lag, log_grid, top, 1e-10)[1], float(lag(log_grid[top])))
