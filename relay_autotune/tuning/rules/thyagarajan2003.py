# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The rules of Thyagarajan and Yu, and their choice by the shape of the limit cycle.

Thyagarajan and Yu, "Improved Autotuning Using the Shape Factor from Relay Feedback", Ind. Eng.
Chem. Res. 2003: Table 4 for FOPDT, eqs 38 and 39 for second order with little dead time, eqs 40
and 41 for higher order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.identification.limit_cycle.shape import Shape, shape_of_half_cycle
from relay_autotune.identification.methods.thyagarajan import (
    FLAT_FOPDT,
    HIGHER_ORDER,
    SHARP_FOPDT,
    dead_time_ratio,
    equal_lags_row,
)
from relay_autotune.loop.gains import Controller
from relay_autotune.process.structures import FOPDT, LAG_N
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.scalar import root
from relay_autotune.tuning.rules.formulas import (
    ITAE_RANGE,
    fopdt_of,
    half_cycle,
    imc,
    itae,
    named,
    tyreus_luyben,
    wants_pid,
)
from relay_autotune.tuning.rules.luyben2003 import gain
from relay_autotune.tuning.task import DesignTask

RESONANCE = 3.0
MARGIN = math.radians(45.0)

_LEAST_LAGS = 3

_Designed = tuple[Controller, str]


def phase_margin(task: DesignTask) -> _Designed:
    r"""Return PI gains with a phase margin of 45 degrees, for second order (eqs 38 and 39).

    ``ti = 2 tau``, and with ``z = tau w`` at the crossover and ``eps = D/tau``

        pi/4 + atan(2 z) - 2 atan(z) - eps z = 0,
        kc = 2 (z^3 + z)/(K sqrt(4 z^2 + 1)).

    The left side falls with z, so that there is one root whatever eps. The paper prints
    ``z = 0.0432 tau w_u`` for eps = 0.001; 0.0374 is what gives 45 degrees, and what its own
    tables were computed with. Two unequal lags have ``ti = tau1 + tau2``, and the same holds.

    :param task: a process of two real lags without zeros.
    :raises TuningError: for any other.
    """
    model = task.process
    lags = _real_lags(model)
    if len(lags) != 2:
        raise TuningError(
            f"the rule phase_margin is for two real lags with a small dead time, found "
            f"{named(task.model)}: use thyagarajan, which takes the structure by the shape, or "
            "robust"
        )
    wants_pid("phase_margin", task, pid=False)
    ti = sum(lags)

    def excess(w: float) -> float:
        lag = sum(math.atan(w * tau) for tau in lags)
        return 0.5 * math.pi - MARGIN + math.atan(w * ti) - lag - model.dead_time * w

    high = 1.0 / ti
    while excess(high) > 0.0:
        high *= 2.0
    w = root(excess, 0.0, high)
    size = w * ti * math.prod(math.hypot(1.0, w * tau) for tau in lags) / math.hypot(1.0, w * ti)
    ratio = model.dead_time / max(lags)
    return Controller(size / model.gain, ti), (
        f"45 degrees of phase margin for second order with D/tau = {ratio:.3g}"
    )


def lcmax(task: DesignTask) -> _Designed:
    """Return PI gains with a closed-loop resonance of 3 dB, for higher order (eqs 40 and 41).

    ``ti = (n - 1) tau``, and kc so that the largest closed-loop log modulus is 3 dB. For n = 5
    that is ``kc = 1.000844/K``, which eq 41 rounds to 1/K; here it is computed for any n and with
    the dead time that the model has.

    :param task: a process of n >= 3 equal lags.
    :raises TuningError: for any other.
    """
    model = task.process
    n = model.order
    if n < _LEAST_LAGS or not LAG_N.holds(model):
        raise TuningError(
            f"the rule lcmax is for {_LEAST_LAGS} or more equal lags, found {named(task.model)}: "
            "use thyagarajan, which takes the structure by the shape, or robust"
        )
    wants_pid("lcmax", task, pid=False)
    ti = (n - 1) * model.time_constants[0].real
    size = math.copysign(gain(model, ti, RESONANCE), model.gain)
    return Controller(size, ti), (f"closed-loop resonance of 3 dB for {n} equal lags")


def thyagarajan(task: DesignTask) -> _Designed:
    """Return the gains of the rule that the shape of the limit cycle asks for.

    A FOPDT process, and any of category 1, has Table 4: Tyreus-Luyben for D/tau < 0.1, minimum
    ITAE up to 1, IMC above. Category 2 has :func:`phase_margin`, category 3 :func:`lcmax`. The
    category is that of the exact limit cycle of the model; where the model has not the structure
    of its category, the equivalent one is computed from that cycle, as the paper does.

    :param task: a stable process with a limit cycle.
    :raises TuningError: for any other.
    """
    if FOPDT.holds(task.model):
        return _table_4(task)
    model = task.process
    if not model.is_stable:
        raise TuningError(
            f"the rule thyagarajan is for stable processes, found {named(task.model)}: use "
            "luyben2003 or simc for one that integrates, unstable for one that is unstable, or "
            "robust"
        )
    wants_pid("thyagarajan", task, pid=False)
    cycle = half_cycle(model)
    if cycle is None:
        raise TuningError(
            "the rule thyagarajan needs a limit cycle and a relay makes none of this model (no "
            "gain makes it oscillate): use robust"
        )
    sign = math.copysign(1.0, model.gain)
    try:
        shape = shape_of_half_cycle(cycle)
        category = shape.category
        equivalent, rule = _equivalent(category, shape, model)
    except TuningError:
        raise
    except RelayAutotuneError as error:
        raise TuningError(
            f"the rule thyagarajan finds no model of its category in the limit cycle: {error}"
        ) from error
    if equivalent is None:
        gains, reason = rule(task)
        return gains, f"category {category}: {reason}"
    scaled = replace(equivalent, gain=sign * equivalent.gain)
    # The limit cycle was that of the loop with its own delay.
    options = replace(task.options, sample_period=0.0, loop_delay=0.0)
    gains, reason = rule(replace(task, model=scaled, simple=None, options=options))
    return gains, f"category {category}: {reason}; designed on the equivalent {named(scaled)}"


def _table_4(task: DesignTask) -> _Designed:
    process = fopdt_of("thyagarajan", task)
    low, high = ITAE_RANGE
    chosen: Callable[[DesignTask], _Designed]
    chosen = tyreus_luyben if process.ratio < low else itae if process.ratio <= high else imc
    gains, reason = chosen(task)
    return gains, f"chosen by D/tau = {process.ratio:.3g}: {reason}"


def _equivalent(
    category: str, shape: Shape, model: TransferFunction
) -> tuple[TransferFunction | None, Callable[[DesignTask], _Designed]]:
    """Return a model of the category, None where the task has one, and the category's rule."""
    if category == "2" and len(_real_lags(model)) == 2:
        return None, phase_margin
    if category == "3" and model.order >= _LEAST_LAGS and LAG_N.holds(model):
        return None, lcmax
    rows = {
        "1a": (SHARP_FOPDT, _table_4),
        "1b": (FLAT_FOPDT, _table_4),
        "2": (equal_lags_row(2, ratio=dead_time_ratio(shape.growth)), phase_margin),
        "3": (equal_lags_row(HIGHER_ORDER), lcmax),
    }
    row, rule = rows[category]
    return row.structure.build(tuple(row.solve(shape, 0.0))), rule


def _real_lags(model: TransferFunction) -> tuple[float, ...]:
    """Return the lags of a stable process that has nothing else, else none."""
    lags = model.time_constants
    if model.integrators or model.zeros or any(t.imag or t.real <= 0.0 for t in lags):
        return ()
    return tuple(t.real for t in lags)
