# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Robust design: the PI or PID controller with the smallest IAE within bounds on Ms and Mt."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop, abscissae, inverted
from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.frontier import Bounds
from relay_autotune.tuning.search import Optimum, Search
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
        found, why = _chosen(search, bounds)
    else:
        derivative = options.controller == "pid" and search.differentiates
        found, why = _best(search, bounds, derivative), ""
        if options.controller != "pi" and not derivative:
            why = f"{search.rate.law.name} has no derivative"
    controller = found.controller
    # Where a double cannot count the samples of a response, the integral is as good as zero.
    duration = _duration(controller, search.model, search.frequency)
    endless = duration * math.ulp(1.0) > search.rate.period > 0.0
    if endless or not (math.isfinite(controller.i) and math.isfinite(duration)):
        raise TuningError(
            "no controller with a gain above zero keeps the bounds on the model and those around "
            "it: it is not known well enough; record a longer or larger test"
        )
    reason = "; ".join(filter(None, (_promise(found, search), why)))
    return with_setpoint_weight(controller, task.loop(controller), search.frequency), reason


def _search(task: DesignTask) -> Search:
    """Return the search on the process in its loop."""
    options, model = task.options, task.held(task.model)
    noise = math.inf
    if options.noise_std > 0.0 and options.amplitude > 0.0 and options.sample_period > 0.0:
        noise = options.noise_share * options.amplitude / options.noise_std
    return Search(model, task.around, options.filter_ratio, noise, options.rate)


def _chosen(search: Search, bounds: Bounds) -> tuple[Optimum, str]:
    """Return PI unless PID is worth it, and what is to be known of that."""
    pi, pid = search.optimum(bounds, derivative=False), None
    if pi is None:
        why = "no PI controller keeps the bounds that were asked for"
        return _best(search, bounds, True), why
    # Nothing may limit the gain of a PID on a model without dead time.
    with suppress(TuningError):
        pid = search.optimum(bounds, derivative=True)
    # On so uncertain a model the cost of one of them may be beyond numbers.
    if pid is None or not (pi.iae > 0.0 and math.isfinite(pid.iae / pi.iae)):
        return pi, ""
    share = 100.0 * pid.iae / pi.iae
    if share > 100.0 * WORTH:
        return pi, f"PID would still have {share:.0f} % of its IAE"
    if math.isinf(search.noise):
        return pi, (
            f"PID would have {share:.0f} % of its IAE, and is chosen where noise, amplitude and "
            "sampling period are given, as by a recording"
        )
    return pid, f"its IAE is {share:.0f} % of that of PI"


def _best(search: Search, asked: Bounds, derivative: bool) -> Optimum:
    """Return the best controller within bounds, or the tightest that leave room for one.

    :raises TuningError: if none holds the process.
    """
    found = search.optimum(asked, derivative=derivative)
    if found is not None:
        return found
    if math.isfinite(search.noise):
        found = _best(replace(search, noise=math.inf), asked, derivative)
        warning = (
            "no controller keeps both the bounds and the limit of the noise in the command: the "
            "noise is not limited; a smaller noise_std, a larger noise_share or a slower sensor "
            "filter would"
        )
        return replace(found, warnings=(warning, *found.warnings))
    kind, warnings = _KINDS[derivative], []
    least_ms = search.least_ms(derivative=derivative)
    if least_ms > MS_RANGE[1]:
        raise TuningError(_cannot_hold(search, kind, least_ms))
    ms = _RELAXED * least_ms if least_ms > asked.ms else asked.ms
    least_mt = search.least_mt(ms, derivative=derivative)
    mt = _RELAXED * least_mt if least_mt > asked.mt else asked.mt
    found = search.optimum(Bounds(ms, mt), derivative=derivative)
    if found is None:
        # Some controllers keep the bounds, but too few for the scan to find one.
        ms, mt = max(ms, _RELAXED * least_ms), max(mt, _RELAXED * least_mt)
        found = search.optimum(Bounds(ms, mt), derivative=derivative)
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


def _promise(found: Optimum, search: Search) -> str:
    bounds, around = found.bounds, search.models
    where = "on the model"
    if around:
        where += f" and on 95 % of {len(around)} models within its uncertainty"
    promise = (
        f"{_KINDS[found.derivative]} with the smallest IAE after a load step, with Ms <= "
        f"{bounds.ms:.3g} and Mt <= {bounds.mt:.3g} {where}"
    )
    return "; ".join((promise, *found.warnings))


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
