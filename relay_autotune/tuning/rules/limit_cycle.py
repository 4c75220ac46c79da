# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Rules for the ultimate point, by the model's phase or by the limit cycle of a relay.

The model's own point is where its phase is -180 degrees. The other is what the describing function
reads from the limit cycle of a relay of amplitude h, ``K_u = 4 h/(pi a)`` and ``P_u = P``; on a
FOPDT process its K_u is off by -19 % (D/tau = 0.05) to +22 % (D/tau = 10). The papers' examples
take the latter, and so do the rules whose name ends in ``_cycle``.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy.optimize import brentq

from relay_autotune.errors import ModelError
from relay_autotune.identification.limit_cycle.shape import shape_of_half_cycle
from relay_autotune.loop.gains import Controller
from relay_autotune.process.simulation import HalfCycle
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint, ultimate_point
from relay_autotune.tuning.rules.applicability import (
    controller,
    describing_point,
    own_point,
    wants_pid,
)
from relay_autotune.tuning.task import DesignTask

_REACH = np.geomspace(1.0, 4.0, 60)
_AT_SWITCH = np.zeros(1)


def half_cycle(model: TransferFunction) -> HalfCycle | None:
    """Return half a period of the limit cycle under an ideal relay of amplitude 1.

    The half period is the one nearest to ``pi/w_u`` at which the output passes zero upward at the
    switch.

    :param model: the process.
    :return: None if it has no ultimate point or no such oscillation.
    """
    point = ultimate_point(model)
    if point is None:
        return None
    middle = math.pi / point.frequency
    for low, high in itertools.pairwise(_REACH):
        for a, b in ((middle * low, middle * high), (middle / high, middle / low)):
            found = _between(model, a, b)
            if found is not None:
                return found
    return None


def _between(model: TransferFunction, low: float, high: float) -> HalfCycle | None:
    low = max(low, model.dead_time * (1.0 + 1e-9))
    if not low < high:
        return None

    def level(half_period: float) -> float:
        return float(HalfCycle(model, half_period)(_AT_SWITCH)[0])

    try:
        if level(low) * level(high) > 0.0:
            return None
        cycle = HalfCycle(model, float(brentq(level, low, high, rtol=1e-14, xtol=1e-300)))
    except (ModelError, np.linalg.LinAlgError):
        return None
    return cycle if cycle.slope(_AT_SWITCH)[0] > 0.0 else None


def describing_point_of(model: TransferFunction) -> UltimatePoint | None:
    """Return K_u and w_u that an ideal relay test of a model would give.

    ``K_u = 4 h/(pi a)``, ``w_u = 2 pi/P`` (Chang, Shen and Yu 1992, eqs 1 and 2), with the exact
    amplitude and period of the limit cycle.

    :param model: the process.
    :return: None if it has no limit cycle.
    """
    cycle = half_cycle(model)
    if cycle is None:
        return None
    a = shape_of_half_cycle(cycle).amplitude
    return UltimatePoint(model.process_sign * 4.0 / (math.pi * a), math.pi / cycle.half_period)


def describing_point_of_cycle(
    period: float, period_high: float, amplitude: float, relay: float, sign: float
) -> UltimatePoint:
    """Return K_u and w_u that the describing function reads from a limit cycle that was recorded.

    ``K_u = 4 h/(pi a) sin(pi T_high/P)``: the first harmonic of the relay's wave over the
    amplitude; the sine is 1 for an unbiased relay.

    :param period: P [s].
    :param period_high: time with the command high [s].
    :param amplitude: half of peak to peak of the measurement, a [y].
    :param relay: h [u].
    :param sign: of the process.
    """
    gain = 4.0 * relay / (math.pi * amplitude) * math.sin(math.pi * period_high / period)
    return UltimatePoint(math.copysign(gain, sign), 2.0 * math.pi / period)


_OWN = "of the model itself"
_CYCLE = "of the limit cycle by the describing function"


def ziegler_nichols(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of Ziegler and Nichols, with the model's own ultimate point.

    PI: ``kc = 0.45 K_u``, ``ti = P_u/1.2``. PID: ``kc = 0.6 K_u``, ``ti = P_u/2``,
    ``td = P_u/8``. Source: Ziegler and Nichols, "Optimum Settings for Automatic Controllers",
    Trans. ASME 64, 1942.

    :param task: a stable or integrating process with an ultimate point.
    :raises TuningError: for any other.
    """
    return _ziegler_nichols("ziegler_nichols", task, own_point("ziegler_nichols", task), _OWN)


def ziegler_nichols_cycle(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of Ziegler and Nichols, with the ultimate point of the limit cycle.

    :param task: a stable or integrating process whose limit cycle is known.
    :raises TuningError: for any other.
    """
    name = "ziegler_nichols_cycle"
    return _ziegler_nichols(name, task, describing_point(name, task), _CYCLE)


def tyreus_luyben(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of Tyreus and Luyben, with the model's own ultimate point.

    PI: ``kc = K_u/3.2``, ``ti = 2.2 P_u`` (Tyreus and Luyben, Ind. Eng. Chem. Res. 31, 1992;
    Thyagarajan and Yu 2003, eqs 31 and 32). PID: ``kc = K_u/2.2``, ``ti = 2.2 P_u``,
    ``td = P_u/6.3`` (Luyben and Luyben, "Essentials of Process Control", 1997).

    :param task: a stable or integrating process with an ultimate point.
    :raises TuningError: for any other.
    """
    return _tyreus_luyben("tyreus_luyben", task, own_point("tyreus_luyben", task), _OWN)


def tyreus_luyben_cycle(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of Tyreus and Luyben, with the ultimate point of the limit cycle.

    :param task: a stable or integrating process whose limit cycle is known.
    :raises TuningError: for any other.
    """
    name = "tyreus_luyben_cycle"
    return _tyreus_luyben(name, task, describing_point(name, task), _CYCLE)


def _ziegler_nichols(
    name: str, task: DesignTask, point: UltimatePoint, whose: str
) -> tuple[Controller, str]:
    k, p = point.gain, point.period
    if wants_pid(name, task):
        gains, formula = controller(task, 0.6 * k, 0.5 * p, 0.125 * p), "0.6 K_u, P_u/2 and P_u/8"
    else:
        gains, formula = controller(task, 0.45 * k, p / 1.2), "0.45 K_u and P_u/1.2"
    return gains, f"Ziegler-Nichols: {formula} with {_said(point)} {whose}"


def _tyreus_luyben(
    name: str, task: DesignTask, point: UltimatePoint, whose: str
) -> tuple[Controller, str]:
    k, p = point.gain, point.period
    if wants_pid(name, task):
        gains = controller(task, k / 2.2, 2.2 * p, p / 6.3)
        formula = "K_u/2.2, 2.2 P_u and P_u/6.3"
    else:
        gains, formula = controller(task, k / 3.2, 2.2 * p), "K_u/3.2 and 2.2 P_u"
    return gains, f"Tyreus-Luyben: {formula} with {_said(point)} {whose}"


def _said(point: UltimatePoint) -> str:
    return f"K_u = {point.gain:.4g} and P_u = {point.period:.4g} s"
