# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Rules that know the process by its ultimate point alone.

There are two such points. The model's own is where its phase is -180 degrees. The other is what
the describing function reads from the limit cycle of a relay of amplitude h, ``K_u = 4 h/(pi a)``
and ``P_u = P``; on a FOPDT process its K_u is off by -19 % (D/tau = 0.05) to +22 % (D/tau = 10).
The papers' examples take the latter, and so do the rules whose name ends in ``_cycle``.
"""

from __future__ import annotations

from relay_autotune.loop.gains import Controller
from relay_autotune.process.ultimate import UltimatePoint
from relay_autotune.tuning.rules.applicability import (
    controller,
    describing_point,
    own_point,
    wants_pid,
)
from relay_autotune.tuning.task import DesignTask

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
