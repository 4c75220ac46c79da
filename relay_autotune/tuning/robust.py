# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Robust design: the PI or PID controller with the smallest IAE within bounds on Ms and Mt."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop, abscissae, inverted
from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.candidates import (
    Optimum,
)
from relay_autotune.tuning.frontier import Bounds
from relay_autotune.tuning.search import Search
from relay_autotune.tuning.task import MS_RANGE, DesignTask

# PID has to lower the IAE at least this far to be worth its derivative.
WORTH = 0.75
# A bound that cannot be kept is relaxed to this factor above the least that any attains.
_RELAXED = 1.15
_KINDS = {False: "PI", True: "PID"}

# The set-point weights that are compared, on responses of this length and this many points.
_WEIGHTS = np.linspace(0.0, 1.0, 101)
_POINTS = 2048
_RESETS, _TURNS = 8.0, 6.0
# Allowed overshoot, and what is allowed beyond the least overshoot if that is larger: to avoid the
# last part with b = 0 would make the response much slower.
_OVERSHOOT, _SPARE = 0.05, 0.02


@dataclass(frozen=True)
class _Attempt:
    """The best controller of one kind, and what had to be given up for it."""

    optimum: Optimum
    bounds: Bounds
    derivative: bool
    warnings: tuple[str, ...] = ()


def robust(task: DesignTask) -> tuple[Controller, str]:
    """Return the controller with the smallest IAE after a load step, with bounds on Ms and Mt.

    The bounds hold on the model and on 95 % of the models within its uncertainty, for the law that
    will run and its sampling period, with the loop's own delay. The optimisation follows
    Astrom, Panagopoulos and Hagglund (1998) in its bounds and Garpinger and Hagglund (2015) in
    its cost. PI is preferred; PID is chosen if its IAE is lower by 25 % or more, or if no PI
    controller keeps the bounds. If no controller keeps a bound, it is raised to 15 % above the
    least that any attains.

    :param task: the process and what is asked for.
    :return: the controller, and the reason, which says what could not be kept.
    :raises TuningError: if no controller of the kind asked for holds the process, or nothing
        limits the gain.
    """
    options = task.options
    bounds = Bounds(options.ms, options.largest_mt(task.model))
    search = _search(task)
    if options.controller == "auto" and search.differentiates:
        controller, reason = _chosen(search, bounds)
    else:
        derivative = options.controller == "pid" and search.differentiates
        found = _within(search, bounds, derivative) or _relaxed(search, bounds, derivative)
        controller, reason = found.optimum.controller, _promise(found, search)
    # Where a double cannot count the samples of a response, the integral is as good as zero.
    duration = _duration(controller, search.model, search.frequency)
    endless = duration * math.ulp(1.0) > search.rate.period > 0.0
    if endless or not (math.isfinite(controller.i) and math.isfinite(duration)):
        raise TuningError(
            "no controller with a gain above zero keeps the bounds on the model and those around "
            "it: it is not known well enough; record a longer or larger test"
        )
    return with_setpoint_weight(controller, task.loop(controller), search.frequency), reason


def _search(task: DesignTask) -> Search:
    """Return the search on the process in its loop."""
    options, model = task.options, task.held(task.model)
    noise = math.inf
    if options.noise_std > 0.0 and options.amplitude > 0.0 and options.sample_period > 0.0:
        noise = options.noise_share * options.amplitude / options.noise_std
    return Search(model, task.around, options.filter_ratio, noise, options.rate)


def _chosen(search: Search, bounds: Bounds) -> tuple[Controller, str]:
    """Return PI unless PID is worth it."""
    pi = _within(search, bounds, False)
    if pi is None:
        pid = _within(search, bounds, True) or _relaxed(search, bounds, True)
        reason = f"{_promise(pid, search)}; no PI controller keeps the bounds that were asked for"
        return pid.optimum.controller, reason
    try:
        other = _within(search, bounds, True)
    except TuningError:
        # Nothing limits the gain of a PID on a model without dead time; the PI is taken.
        other = None
    if other is None:
        return pi.optimum.controller, _promise(pi, search)
    share = other.optimum.iae / pi.optimum.iae if pi.optimum.iae > 0.0 else math.inf
    if not math.isfinite(share):
        # On so uncertain a model the cost of one of them is beyond numbers.
        return pi.optimum.controller, _promise(pi, search)
    if share > WORTH:
        reason = f"PID would still have {100.0 * share:.0f} % of its IAE"
    elif math.isinf(search.noise):
        reason = (
            f"PID would have {100.0 * share:.0f} % of its IAE, and is chosen where noise, "
            "amplitude and sampling period are given, as by a recording"
        )
    else:
        reason = f"{_promise(other, search)}; its IAE is {100.0 * share:.0f} % of that of PI"
        return other.optimum.controller, reason
    return pi.optimum.controller, f"{_promise(pi, search)}; {reason}"


def _within(search: Search, bounds: Bounds, derivative: bool) -> _Attempt | None:
    """Return the best controller that keeps all limits, None where none does."""
    optimum = search.optimum(bounds, derivative=derivative)
    return None if optimum is None else _Attempt(optimum, bounds, derivative)


def _relaxed(search: Search, asked: Bounds, derivative: bool) -> _Attempt:
    """Return the best controller within the tightest bounds that leave room for one.

    :raises TuningError: if none holds the process.
    """
    kind, warnings = _KINDS[derivative], []
    if math.isfinite(search.noise):
        quiet = replace(search, noise=math.inf)
        found = _within(quiet, asked, derivative)
        warning = (
            "no controller keeps both the bounds and the limit of the noise in the command: the "
            "noise is not limited; a smaller noise_std, a larger noise_share or a slower sensor "
            "filter would"
        )
        if found is not None:
            return replace(found, warnings=(warning,))
        search, warnings = quiet, [warning]
    least_ms = search.least_ms(derivative=derivative)
    if least_ms > MS_RANGE[1]:
        raise TuningError(_cannot_hold(search, kind, least_ms))
    ms = _RELAXED * least_ms if least_ms > asked.ms else asked.ms
    least_mt = search.least_mt(ms, derivative=derivative)
    mt = _RELAXED * least_mt if least_mt > asked.mt else asked.mt
    found = _within(search, Bounds(ms, mt), derivative)
    if found is None:
        # Some controllers keep the bounds, but too few for the scan to find one.
        ms, mt = max(ms, _RELAXED * least_ms), max(mt, _RELAXED * least_mt)
        found = _within(search, Bounds(ms, mt), derivative)
    if found is None:
        raise TuningError(_cannot_hold(search, kind, math.inf))
    if ms > asked.ms:
        warnings.append(_relaxation(kind, "Ms", asked.ms, least_ms, ms))
    if mt > asked.mt:
        warnings.append(_relaxation(kind, "Mt", asked.mt, least_mt, mt))
    return replace(found, warnings=tuple(warnings))


def _relaxation(kind: str, name: str, asked: float, least: float, used: float) -> str:
    few = "no" if least > asked else "hardly any"
    return (
        f"{few} {kind} controller keeps {name} <= {asked:g} on this process, whose smallest "
        f"attainable {name} is {least:.3g}: designed for {name} <= {used:.3g}"
    )


def _cannot_hold(search: Search, kind: str, least: float) -> str:
    """Return a sentence that names the limit which was crossed."""
    model = search.late
    if model.structure == "unstable_fopdt":
        ratio = model.dead_time / abs(model.time_constants[0].real)
        limit = f"an unstable process with D/tau = {ratio:.3g} (PI needs less than 1, PID than 2)"
    elif search.models:
        limit = f"the process on 95 % of the {len(search.models)} models around it"
    else:
        limit = "the process"
    attains = f" below Ms = {least:.3g}" if math.isfinite(least) else ""
    return (
        f"no {kind} controller holds {limit}{attains}, at most {MS_RANGE[1]:g} is allowed: "
        "shorten the dead time, or identify it more accurately"
    )


def _promise(attempt: _Attempt, search: Search) -> str:
    bounds, around = attempt.bounds, search.models
    where = "on the model"
    if around:
        where += f" and on 95 % of {len(around)} models within its uncertainty"
    promise = (
        f"{_KINDS[attempt.derivative]} with the smallest IAE after a load step, with Ms <= "
        f"{bounds.ms:.3g} and Mt <= {bounds.mt:.3g} {where}"
    )
    return "; ".join((promise, *attempt.warnings))


def _duration(controller: Controller, model: TransferFunction, frequency: float) -> float:
    """Return the time in which a loop answers to its set-point [s]; infinite: never."""
    if controller.i == 0.0:
        return math.inf
    reset = controller.ti
    if model.is_stable:
        reset += 1.0 / abs(controller.i) / abs(model.gain)
    return _RESETS * reset + _TURNS * 2.0 * math.pi / frequency


def with_setpoint_weight(controller: Controller, loop: Loop, frequency: float) -> Controller:
    """Return the controller with the largest weight b without unnecessary overshoot.

    The response is ``y_i + b y_p``, with one part from the integral and one from the proportional
    action, so all weights are compared at the cost of one simulation. The largest b is taken
    whose overshoot is at most 5 %, or at most 2 % more than the least.

    :param controller: PI or PID, of a stable loop.
    :param loop: its loop with the process.
    :param frequency: about which the loop is closed [rad/s].
    """
    model, duration = loop.model, _duration(controller, loop.model, frequency)
    at = abscissae(duration, _POINTS)
    through = model(at) / (at * (1.0 + loop(at)))
    proportional = inverted(controller.kc * through, duration)
    integral = inverted(controller.i * through / at, duration)
    highest = np.array([float((integral + b * proportional).max()) for b in _WEIGHTS])
    overshoot = np.maximum(highest - 1.0, 0.0)
    allowed = max(_OVERSHOOT, float(overshoot.min()) + _SPARE)
    best = int(np.flatnonzero(overshoot <= allowed)[-1])
    return replace(controller, b=float(_WEIGHTS[best]))
