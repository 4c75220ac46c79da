"""Which structure the data speak for: the simplest of those that explain them."""

from __future__ import annotations

import math

from relay_autotune.identification.waveform.selection import Candidate

_INDIFFERENT = 2.0
# Parts of the measurement's range: left by an exact structure, and by one that is good enough.
_EXACT = 1e-7
_ENOUGH = 4e-3


def choose(candidates: list[Candidate]) -> Candidate:
    """Return the simplest structure that the criterion cannot tell from the best.

    :param candidates: the best first, at least one.
    """
    best = candidates[0].criterion
    enough = _good_enough(candidates)
    if enough is not None:
        return enough
    rivals = [c for c in candidates if c.criterion <= best + _INDIFFERENT]
    return min(rivals, key=lambda c: (c.state.parameters, c.structure.order, c.criterion))


def _good_enough(candidates: list[Candidate]) -> Candidate | None:
    """Return a FOPDT that leaves so little that jitter or rounding explains the rest as well.

    Below that, what the criterion prefers is made of the errors of the instants, which are
    not white. Where a structure is exact, nothing is left to such errors.
    """

    def rms(candidate: Candidate) -> float:
        return math.sqrt(candidate.state.cost / candidate.problem.time.size)

    fopdt = next((c for c in candidates if c.structure.name == "fopdt"), None)
    integrator = next((c for c in candidates if c.structure.name == "ipdt"), None)
    if fopdt is None or rms(candidates[0]) < _EXACT or rms(fopdt) > _ENOUGH:
        return None
    slower = integrator is not None and integrator.criterion < fopdt.criterion
    return None if slower else fopdt


def support(candidates: list[Candidate]) -> list[float]:
    """Return the weight of each candidate, from its criterion; their sum is 1.

    :param candidates: the best first.
    """
    best = candidates[0].criterion
    weights = [math.exp(-0.5 * min(c.criterion - best, 1400.0)) for c in candidates]
    total = sum(weights)
    return [w / total for w in weights]
