"""Stability by the exact phase: ultimate point, and poles of a closed loop."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from relay_autotune.models import TransferFunction

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class UltimatePoint:
    """The proportional gain at which the closed loop oscillates.

    :param gain: K_u, with the sign of the process, so that ``K_u G(j w_u) = -1`` [u/y].
    :param frequency: w_u [rad/s].
    """

    gain: float
    frequency: float

    @property
    def period(self) -> float:
        """P_u = 2 pi/w_u [s]."""
        return 2.0 * math.pi / self.frequency


@dataclass(frozen=True)
class _Crossing:
    gain: float
    frequency: float
    roots_to_the_right: int


def ultimate_point(model: TransferFunction) -> UltimatePoint | None:
    """Return the gain that ends stability, or None where no gain does or none gives it.

    Every frequency at which the phase is an odd multiple of -180 degrees is found from the
    continuous phase, so that neither a large dead time nor a resonance hides one. Raising the
    gain through such a point moves a pair of closed-loop poles to the right where the phase
    falls with frequency, and to the left where it rises. Counting from the poles at zero gain,
    the ultimate gain is the upper end of the first range in which none is on the right; an
    unstable process has a lower end as well, which is not returned.

    :param model: the process.
    """
    crossings = sorted(_crossings(model), key=lambda c: c.gain)
    on_the_right = unstable_at_small_gain(model)
    was_stable = on_the_right == 0
    for crossing in crossings:
        on_the_right += crossing.roots_to_the_right
        if was_stable and on_the_right > 0:
            if crossing.frequency == 0.0:
                return None
            return UltimatePoint(model.process_sign * crossing.gain, crossing.frequency)
        was_stable = was_stable or on_the_right == 0
    return None


def unstable_poles(loop: TransferFunction) -> int:
    """Return how many poles of ``1/(1 + loop)`` lie in the right half plane.

    The count at zero gain is carried through every crossing of the negative real axis that the
    loop passes as its gain grows to its own value, so no frequency grid can miss one.

    :param loop: controller times process, with the sign that makes its feedback negative.
    """
    count = unstable_at_small_gain(loop)
    return count + sum(c.roots_to_the_right for c in _crossings(loop, 1.0) if c.gain < 1.0)


def phase_crossings(loop: TransferFunction) -> list[UltimatePoint]:
    """Return the points at which the loop crosses the negative real axis.

    :param loop: controller times process.
    :return: every crossing up to the first one, and every later one of magnitude 1 or more; the
        gain is the factor that would bring it to -1.
    """
    return [UltimatePoint(c.gain, c.frequency) for c in _crossings(loop, 1.0)]


def unstable_at_small_gain(model: TransferFunction) -> int:
    """Closed-loop poles in the right half plane as the gain leaves zero."""
    unstable = sum(1 for t in model.time_constants if t.real < 0.0)
    m = model.integrators
    if m < 1:
        return unstable
    # The poles at s = 0 leave along s^m = -K g; one that starts straight up goes left only if
    # the phase near zero frequency is above its limit.
    start = math.pi if model.gain * model.process_sign > 0.0 else 0.0
    w = 1e-6 / max((abs(c) for c in _constants(model)), default=1.0)
    lead = float(model.phase(w)) - float(model.phase(0.0)) > 0.0
    for k in range(m):
        cosine = math.cos((start + 2.0 * math.pi * k) / m)
        unstable += cosine > 1e-9 or (abs(cosine) <= 1e-9 and not lead)
    return unstable


def _constants(model: TransferFunction) -> tuple[complex, ...]:
    constants = (*model.time_constants, *model.zeros)
    # A dead time beyond all proportion is none.
    return (*constants, model.dead_time) if model.dead_time > 1e-30 else constants


def _crossings(model: TransferFunction, magnitude: float | None = None) -> list[_Crossing]:
    """Crossings up to the first, and later ones of at least ``magnitude`` (the first one's)."""
    found = []
    if model.integrators == 0 and model.gain * model.process_sign < 0.0:
        slope = (
            sum(z.real for z in model.zeros)
            - sum(t.real for t in model.time_constants)
            - model.dead_time
        )
        # Near s = 0 the root is eps/(K G'(0)), and G(0) is negative.
        found.append(_Crossing(1.0 / abs(model.gain), 0.0, -1 if slope > 0.0 else 1))
    first = _scan(model, _grid(model, _first_range(model)))
    found += first
    if not first or model.dead_time == 0.0:
        return found
    # Later turns of the dead time matter only where the magnitude is larger again.
    least = 1.0 / min(c.gain for c in first) if magnitude is None else magnitude
    beyond = _logarithmic(model)
    beyond = beyond[beyond > first[-1].frequency]
    higher = beyond[np.abs(model(1j * beyond)) > 0.999 * least]
    if higher.size:
        upper = float(higher[-1]) * 1.1
        found += _scan(model, _grid(model, (first[-1].frequency * (1 + 1e-9), upper)))
    return found


def _corners(model: TransferFunction) -> list[float]:
    return [1.0 / abs(c) for c in _constants(model)] or [1.0]


def _logarithmic(model: TransferFunction) -> FloatArray:
    corners = _corners(model)
    decades = (math.log10(min(corners)) - 4.0, math.log10(max(corners)) + 4.0)
    grid = np.logspace(*decades, int(40 * (decades[1] - decades[0])))
    resonances = [
        abs(1.0 / c) * (1.0 + width * c.real / abs(c))
        for c in (*model.time_constants, *model.zeros)
        if c.imag > 0.0
        for width in np.linspace(-8.0, 8.0, 65)
    ]
    return np.unique(np.concatenate((grid, [r for r in resonances if r > 0.0])))


def _first_range(model: TransferFunction) -> tuple[float, float]:
    grid = _logarithmic(model)
    if model.dead_time == 0.0:
        return float(grid[0]), float(grid[-1])
    # The rational part turns the phase by at most a quarter for each root, so that here the
    # dead time has passed -180 degrees for certain.
    roots = len(model.zeros) + len(model.time_constants) + abs(model.integrators)
    return float(grid[0]), (roots * math.pi / 2.0 + 4.0 * math.pi) / model.dead_time


def _grid(model: TransferFunction, limits: tuple[float, float]) -> FloatArray:
    low, high = limits
    grid = _logarithmic(model)
    grid = grid[(grid > low) & (grid < high)]
    parts = [np.array([low, high]), grid]
    if model.dead_time > 0.0:
        count = min(int((high - low) * model.dead_time / 0.3) + 2, 200_000)
        parts.append(np.linspace(low, high, count))
    return np.unique(np.concatenate(parts))


def _scan(model: TransferFunction, grid: FloatArray) -> list[_Crossing]:
    # Odd multiples of pi become whole numbers of turns.
    turns = (model.phase(grid) + math.pi) / (2.0 * math.pi)
    level = np.floor(turns)
    found = []
    for i in np.flatnonzero(np.diff(level) != 0.0):
        target = max(level[i], level[i + 1]) * 2.0 * math.pi - math.pi

        def excess(w: float, target: float = target) -> float:
            return float(model.phase(w)) - target

        low, high = float(grid[i]), float(grid[i + 1])
        if excess(low) * excess(high) > 0.0:
            continue
        w = float(brentq(excess, low, high, xtol=1e-300, rtol=1e-15))
        direction = 2 if turns[i + 1] < turns[i] else -2
        found.append(_Crossing(1.0 / float(np.abs(model(1j * w))), w, direction))
    return found
