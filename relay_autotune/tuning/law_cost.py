# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a law that cannot do all that our own can costs, in words."""

from __future__ import annotations

import math

from relay_autotune.loop.gains import Performance
from relay_autotune.loop.laws import OWN_LAW, SampledLaw, Slope

# Less than this is not worth a sentence: factors, and a difference of overshoots.
_ERROR, _NOISE, _OVERSHOOT = 1.05, 1.2, 0.03
_MS = 1.01


def cost_of(law: SampledLaw, found: Performance, own: Performance | None) -> tuple[str, ...]:
    """Return a sentence on what a law costs beside controller_node; none if that is little.

    :param law: with its gains.
    :param found: what it does on the model.
    :param own: what controller_node does there with gains of the same rule; None: not known.
    """
    name = law.law.name
    if own is None or name == OWN_LAW:
        return ()
    costs = []
    if found.ms > _MS * own.ms:
        costs.append(f"Ms {found.ms:.3g} instead of {own.ms:.3g}")
    if math.isfinite(own.iae_load) and found.iae_load > _ERROR * own.iae_load:
        costs.append(
            f"{found.iae_load / own.iae_load:.2f} times the error after a step of the load"
        )
    if found.noise_gain > _NOISE * own.noise_gain > 0.0:
        costs.append(f"{found.noise_gain / own.noise_gain:.1f} times the noise in the command")
    if found.overshoot > own.overshoot + _OVERSHOOT:
        costs.append(
            f"an overshoot of {100.0 * found.overshoot:.0f} % instead of "
            f"{100.0 * own.overshoot:.0f} % after a step of the set-point"
        )
    if not costs:
        return ()
    return (f"{name} costs, beside {OWN_LAW}: {', '.join(costs)}; {_lacking(law)}",)


def _lacking(law: SampledLaw) -> str:
    """Return what the law cannot do."""
    row = law.law
    lacks = []
    if row.slope is Slope.NONE:
        lacks.append("no derivative")
    elif not row.smoothing.adjustable:
        lacks.append("no filter to set")
    elif not row.smoothing.on_measurement:
        lacks.append("a filter on the derivative alone")
    if row.weights:
        lacks.append(f"a set-point weight of {' or '.join(f'{w:g}' for w in row.weights)} only")
    if row.delay:
        lacks.append(f"a command that acts {row.delay} sample later")
    return f"it has {', '.join(lacks)}"
