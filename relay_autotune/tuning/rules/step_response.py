# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Rules for a step response: AMIGO of Åström and Hägglund, and SIMC of Skogestad.

Åström and Hägglund, "Revisiting the Ziegler-Nichols step response method for PID control",
J. Process Control 14, 2004, and "Advanced PID Control", ISA 2006: approximate M-constrained
integral gain, fitted to designs of Ms = 1.4 on a batch of processes. With gain K, apparent time
constant T and apparent delay L,

    PI:   kc = 0.15/K + (0.35 - L T/(L + T)^2) T/(K L),
          ti = 0.35 L + 13 L T^2/(T^2 + 12 L T + 7 L^2);
    PID:  kc = (0.2 + 0.45 T/L)/K,   ti = L (0.4 L + 0.8 T)/(L + 0.1 T),
          td = 0.5 L T/(0.3 L + T);

and of an integrating process ``K exp(-L s)/s``

    PI:   kc = 0.35/(K L),   ti = 13.4 L;
    PID:  kc = 0.45/(K L),   ti = 8 L,   td = 0.5 L.

Skogestad, "Simple analytic rules for model reduction and PID controller tuning", J. Process
Control 13, 2003: Table 1 for the gains, eqs 10 and 11 for the half rule, rules T1 to T3 for
positive zeros. With theta the effective delay and tau_c the closed-loop time constant, by default
theta,

    PI of first order:         kc = tau1/(K (tau_c + theta)),   ti = min(tau1, 4 (tau_c + theta));
    series PID, second order:  the same, and td = tau2;
    integrating:               kc = 1/(K (tau_c + theta)),      ti = 4 (tau_c + theta).
"""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller, SeriesForm
from relay_autotune.process.response import response
from relay_autotune.process.structures import FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant
from relay_autotune.scalar import root
from relay_autotune.tuning.rules.formulas import (
    Reduced,
    controller,
    named,
    wants_pid,
)
from relay_autotune.tuning.task import DesignTask

_POINTS = 4000
# One and a third of a time constant of a first-order rise.
_THIRD, _WHOLE = 1.0 - math.exp(-1.0 / 3.0), 1.0 - math.exp(-1.0)
_SETTLED = 1e-3
_MONOTONE = 0.02


def step_response(model: TransferFunction) -> Reduced:
    """Return K, T and L of a process, from its own exact step response.

    :param model: a process with one integrator at most.
    :raises TuningError: if it is unstable, integrates twice, or does not rise steadily.
    """
    if model.grows or model.integrators not in (0, 1):
        raise TuningError(
            "a step response is told by its gain, lag and delay where the process is stable or "
            f"integrates once; found {named(model)}: use robust"
        )
    if model.integrators:
        # The tangent in the long run begins to rise after all delays and lags.
        shift = sum(t.real for t in model.time_constants) - sum(z.real for z in model.zeros)
        return Reduced(model.gain, math.inf, model.dead_time + shift)
    if FOPDT.holds(model):
        return Reduced(model.gain, model.time_constants[0].real, model.dead_time)
    rise = _Rise(model)
    slopes = np.gradient(rise.y, rise.time)
    top = int(np.argmax(slopes))
    delay = float(rise.time[top] - rise.y[top] / slopes[top])
    return Reduced(model.gain, rise.time_of(_WHOLE) - delay, max(delay, 0.0))


def two_point_fopdt(model: TransferFunction) -> TransferFunction:
    """Return the FOPDT process through 28 and 63 % of a step response.

    ``tau = 1.5 (t63 - t28)``, ``D = t63 - tau`` (Smith and Corripio, "Principles and Practice of
    Automatic Process Control", 1997), for models that come without a record to be fitted.

    :param model: a stable process whose step response rises steadily.
    :raises TuningError: for any other.
    """
    if not model.is_stable or not model.time_constants:
        raise TuningError(
            f"only a stable process with a lag has a FOPDT for it, found {named(model)}"
        )
    rise = _Rise(model)
    late = rise.time_of(_WHOLE)
    tau = 1.5 * (late - rise.time_of(_THIRD))
    return TransferFunction.fopdt(model.gain, tau, max(late - tau, 0.0))


class _Rise:
    """A step response that rises steadily."""

    def __init__(self, model: TransferFunction) -> None:
        self._model = model
        self._step = PiecewiseConstant(np.zeros(1), np.ones(1), 0.0)
        end = model.dead_time + 12.0 * sum(abs(t) for t in model.time_constants)
        self.time = np.linspace(0.0, end, _POINTS)
        self.y = y = response(model, self.time, self._step) / model.gain
        if abs(y[-1] - 1.0) > _SETTLED or y.min() < -_MONOTONE or y.max() > 1.0 + _MONOTONE:
            raise TuningError(
                "a step response must rise steadily for this; that of the model, "
                f"{named(model)}, goes from {100.0 * y.min():.3g} to {100.0 * y.max():.3g} % of "
                "its final value, and 2 % beyond either end is the limit: use robust"
            )

    def time_of(self, share: float) -> float:
        """Return when the response reaches a share of its final value [s]."""

        def missing(t: float) -> float:
            y = response(self._model, np.array([t]), self._step)
            return float(y[0]) / self._model.gain - share

        first = int(np.flatnonzero(self.y >= share)[0])
        return root(missing, float(self.time[first - 1]), float(self.time[first]))


def amigo(task: DesignTask) -> tuple[Controller, str]:
    """Return the PI or PID gains of Åström and Hägglund.

    The set-point weight of PID is theirs: 0 where L is shorter than T, else 1.

    :param task: a process that integrates once, or is stable with a step response that rises
        without much overshoot or inverse response.
    :raises TuningError: for any other, or without delay.
    """
    step = step_response(task.process)
    k, t, delay = step.gain, step.lag, step.delay
    pid = wants_pid("amigo", task)
    if not delay > 0.0:
        raise TuningError(
            "the rule amigo divides by the apparent delay, and the step response has none: its L "
            "must be above 0 s; use imc, or give the loop's own delay"
        )
    if math.isinf(t):
        what, b = f"for an integrating process with L = {delay:.4g} s", 0.0
        kc, ti, td = (0.45, 8.0 * delay, 0.5 * delay) if pid else (0.35, 13.4 * delay, 0.0)
        kc /= k * delay
    else:
        what, b = f"with T = {t:.4g} s and L = {delay:.4g} s", 0.0 if delay <= t else 1.0
        if pid:
            kc, td = (0.2 + 0.45 * t / delay) / k, 0.5 * delay * t / (0.3 * delay + t)
            ti = delay * (0.4 * delay + 0.8 * t) / (delay + 0.1 * t)
        else:
            kc, td = 0.15 / k + (0.35 - delay * t / (delay + t) ** 2) * t / (k * delay), 0.0
            ti = 0.35 * delay + 13.0 * delay * t * t / (t * t + 12.0 * delay * t + 7.0 * delay**2)
    return controller(task, kc, ti, td, b if pid else 1.0), f"AMIGO {what}"


_MOST_ROUNDS = 50
# A smaller lag this close to the zero is cancelled rather than a larger one.
_CLOSE = 1.6
_ROUNDING = 1e-9


def simc(task: DesignTask) -> tuple[Controller, str]:
    """Return the PI or PID gains of Skogestad, with tau_c free.

    :param task: a process of real lags, with one integrator at most, and any real zeros; its
        ``closed_loop_time`` is tau_c.
    :raises TuningError: for any other, or without delay where tau_c is not given.
    """
    model = task.process
    pid = wants_pid("simc", task)
    tau_c, given = task.options.closed_loop(math.nan)
    process = half_rule(model, 2 if pid else 1, tau_c)
    if pid and process.second == 0.0:
        raise TuningError(
            "the rule simc gives a first-order process no derivative action: ask for pi, or use "
            "another rule"
        )
    closed = tau_c if given else process.delay
    if not (given or closed > 0.0):
        raise TuningError(
            "the rule simc takes its closed-loop time constant from the effective delay, and the "
            "model has none: give tau_c, or the loop's own delay"
        )
    total = closed + process.delay
    kc, ti = 1.0 / (process.gain * total), 4.0 * total
    if not math.isinf(process.lag):
        kc, ti = process.lag / (process.gain * total), min(process.lag, ti)
    ideal = SeriesForm(kc, ti, process.second, 0.0).isa()
    return controller(task, ideal.kc, ideal.ti, ideal.td), (
        f"SIMC with tau_c = {closed:.4g} s{given + ',' * bool(given)} and an effective delay of "
        f"{process.delay:.4g} s"
    )


def half_rule(model: TransferFunction, order: int, closed: float = math.nan) -> Reduced:
    """Reduce a process to first or second order (Skogestad 2003, eqs 10 and 11).

    The largest neglected lag goes half to the delay and half to the smallest lag that is kept;
    all smaller lags and every inverse response go to the delay. Positive zeros are first
    cancelled against a lag of about their size (rules T1 to T3).

    :param model: a process of real lags and zeros, with one integrator at most.
    :param order: 1 or 2.
    :param closed: tau_c, of which the rules for positive zeros make use [s]; NaN: the delay.
    :raises TuningError: for any other.
    """
    constants = (*model.time_constants, *model.zeros)
    real = not any(c.imag for c in constants)
    if not real or any(t.real <= 0.0 for t in model.time_constants) or model.integrators > 1:
        raise TuningError(
            "the half rule is for real lags, with one integrator at most; found "
            f"{named(model)}: use robust"
        )
    if not model.time_constants and not model.integrators:
        raise TuningError("the half rule needs a lag or an integrator, found neither: use robust")
    unknown = math.isnan(closed)
    found = _reduced(model, model.dead_time if unknown else closed, order)
    if unknown and any(z.real > 0.0 for z in model.zeros):
        # The delay that the rules for zeros ask for is the one that comes of them.
        for _ in range(_MOST_ROUNDS):
            before, found = found, _reduced(model, found.delay, order)
            if found == before:
                break
    return found


def _reduced(model: TransferFunction, closed: float, order: int) -> Reduced:
    lags = sorted((t.real for t in model.time_constants), reverse=True)
    if model.integrators:
        lags.insert(0, math.inf)
    gain = model.gain
    for lead in sorted((z.real for z in model.zeros if z.real > 0.0), reverse=True):
        gain *= _cancel(lags, lead, closed)
    delay = model.dead_time + sum(-z.real for z in model.zeros if z.real < 0.0)
    kept, rest = lags[:order], lags[order:]
    if rest:
        delay += 0.5 * rest[0] + sum(rest[1:])
        kept[-1] += 0.5 * rest[0]
    if not kept:
        raise TuningError("the half rule leaves no lag beside the zeros: use robust")
    return Reduced(gain, kept[0], delay, sum(kept[1:]))


def _cancel(lags: list[float], lead: float, closed: float) -> float:
    """Take a lag away against ``lead s + 1`` (rules T1 to T3); return the factor on the gain."""
    larger = [t for t in lags if lead <= t < math.inf]
    smaller = [t for t in lags if t < lead]
    if not larger and not smaller:
        raise TuningError("a process with a zero and no lag has no SIMC gains: use robust")
    lag = min(larger) if larger else max(smaller)
    if larger and smaller:
        ratio = lead / max(smaller)
        lag = max(smaller) if ratio < min(lag / lead, _CLOSE) - _ROUNDING else lag
    lags.remove(lag)
    if lag >= lead:
        if lead >= 5.0 * closed:
            return lead / lag
        nearest = min(lag, 5.0 * closed)
        if nearest > lead:
            lags.append(nearest - lead)
            lags.sort(reverse=True)
        return nearest / lag
    return lead / max(lag, closed) if lead >= closed else 1.0
