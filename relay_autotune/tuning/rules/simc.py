# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Skogestad's rules (SIMC), with the half rule.

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
from dataclasses import dataclass

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.forms import SeriesForm
from relay_autotune.tuning.rules.applicability import (
    controller,
    named,
    process_of,
    wants_pid,
)
from relay_autotune.tuning.task import DesignTask

_MOST_ROUNDS = 50
# A smaller lag this close to the zero is cancelled rather than a larger one.
_CLOSE = 1.6
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Reduced:
    """A process of first or second order with an effective delay.

    :param gain: K; of an integrating process k' [y/u, y/(u s)].
    :param lag: tau1 [s]; inf: it integrates.
    :param second: tau2 [s]; 0: first order.
    :param delay: theta [s].
    """

    gain: float
    lag: float
    second: float
    delay: float


def simc(task: DesignTask) -> tuple[Controller, str]:
    """Return the PI or PID gains of Skogestad, with tau_c free.

    :param task: a process of real lags, with one integrator at most, and any real zeros; its
        ``closed_loop_time`` is tau_c.
    :raises TuningError: for any other, or without delay where tau_c is not given.
    """
    model = process_of(task)
    pid = wants_pid("simc", task)
    given = task.options.given_closed_loop_time
    process = half_rule(model, 2 if pid else 1, given)
    if pid and process.second == 0.0:
        raise TuningError(
            "the rule simc gives a first-order process no derivative action: ask for pi, or use "
            "another rule"
        )
    if given is None and not process.delay > 0.0:
        raise TuningError(
            "the rule simc takes its closed-loop time constant from the effective delay, and the "
            "model has none: give tau_c, or the loop's own delay"
        )
    closed = process.delay if given is None else given
    total = closed + process.delay
    if math.isinf(process.lag):
        kc, ti = 1.0 / (process.gain * total), 4.0 * total
    else:
        kc = process.lag / (process.gain * total)
        ti = min(process.lag, 4.0 * total)
    ideal = SeriesForm(kc, ti, process.second, 0.0).isa()
    chosen = "" if given is None else ", as given,"
    reason = (
        f"SIMC with tau_c = {closed:.4g} s{chosen} and an effective delay of {process.delay:.4g} s"
    )
    return controller(task, ideal.kc, ideal.ti, ideal.td), reason


def half_rule(model: TransferFunction, order: int, closed: float | None = None) -> Reduced:
    """Reduce a process to first or second order (Skogestad 2003, eqs 10 and 11).

    The largest neglected lag goes half to the delay and half to the smallest lag that is kept;
    all smaller lags and every inverse response go to the delay. Positive zeros are first
    cancelled against a lag of about their size (rules T1 to T3).

    :param model: a process of real lags and zeros, with one integrator at most.
    :param order: 1 or 2.
    :param closed: tau_c, of which the rules for positive zeros make use [s]; None: the delay.
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
    found = _reduced(model, model.dead_time if closed is None else closed, order)
    if closed is None and any(z.real > 0.0 for z in model.zeros):
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
    return Reduced(gain, kept[0], kept[1] if len(kept) > 1 else 0.0, delay)


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
