# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Whether the experiments in one recording agree: they are tests of one process."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

from relay_autotune.identification.result import Identification
from relay_autotune.quantities import NORMAL_95
from relay_autotune.result import Analysis
from relay_autotune.text import digits
from relay_autotune.verdict import Finding, Result


def agreed(analyses: Sequence[Analysis]) -> tuple[Analysis, ...]:
    """Return the analyses of the parts of one recording, with a doubt where two contradict.

    One process has one sign and one ultimate gain. Where two parts with gains differ in the sign,
    or the intervals of the ultimate gain do not meet, at least one of them is wrong, or the
    process changed; nothing tells which part shows how it is now.

    :param analyses: of all parts, in order.
    """
    given = [
        (number, analysis.model)
        for number, analysis in enumerate(analyses, start=1)
        if analysis.best_gains is not None and analysis.model is not None
    ]
    pairs = itertools.combinations(given, 2)
    apart = [(_apart(a[1], b[1]), a, b) for a, b in pairs]
    value, *two = max(apart, key=lambda pair: pair[0], default=(0.0,))
    if not value > 0.0:
        return tuple(analyses)
    said = " and ".join(f"{_gain(model)} in part {number}" for number, model in two)
    doubt = Finding(
        name="parts",
        title="Other parts",
        what="distance of the intervals of the ultimate gain in two parts of the recording",
        value=value,
        unit="u/y",
        limit=0.0,
        result=Result.DOUBTFUL,
        sentence=f"the parts of this recording contradict each other: the ultimate gain is {said}",
        remedy="take the part that shows the process as it is, with --start and --end, or test "
        "again",
    )
    return tuple(
        replace(
            each,
            judgement=replace(each.judgement, findings=(*each.judgement.findings, doubt)),
        )
        for each in analyses
    )


def _gain(found: Identification) -> str:
    if math.isfinite(found.ultimate_gain):
        return f"{digits(found.ultimate_gain, 3)} u/y"
    return "positive" if found.model.process_sign > 0 else "negative"


def _apart(a: Identification, b: Identification) -> float:
    """Return how far the intervals of the ultimate gains are apart [u/y]; inf: the sign differs.

    An unknown interval meets every other.
    """
    if a.model.process_sign != b.model.process_sign:
        return math.inf
    width = NORMAL_95 * (a.ultimate_gain_std + b.ultimate_gain_std)
    apart = abs(a.ultimate_gain - b.ultimate_gain) - width
    return apart if math.isfinite(apart) else 0.0
