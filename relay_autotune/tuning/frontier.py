r"""The largest integral gain that bounds on the sensitivities leave, in closed form.

With a filter F, ``L = (kp (1 + td s) + ki/s) F G``. A bound on the sensitivity keeps L(jw) out of
a circle around -1, one on the complementary sensitivity out of a circle around a point further
left (Astrom and Hagglund 1998): ``|L + c| >= r`` with

    Ms: c = 1, r = 1/Ms;    Mt: c = Mt^2/(Mt^2 - 1), r = Mt/(Mt^2 - 1).

Divided by FG, with ``1/(F G) = x + j y``, this forbids at each frequency the inside of an ellipse
in the plane of kp and ki,

    (kp + c x)^2 + (kp w td + c y - ki/w)^2 < r^2 (x^2 + y^2).

So for given kp, td and tf the integral gain may grow from zero to

    ki = min over w of w (kp w td + c y - sqrt(r^2 (x^2 + y^2) - (kp + c x)^2)),

over those frequencies at which the root is real, which is the envelope of the ellipses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.models import TransferFunction

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_NEIGHBOURS = np.array([0.995, 1.0, 1.005])


@dataclass(frozen=True)
class Bounds:
    """Largest magnitudes of sensitivity and complementary sensitivity that are allowed.

    :param ms: above 1.
    :param mt: above 1; infinite: none.
    """

    ms: float
    mt: float = math.inf

    @property
    def circles(self) -> tuple[tuple[float, float], ...]:
        """Centres -c and radii r of the circles that the loop must not enter, as (c, r)."""
        sensitivity = (1.0, 1.0 / self.ms)
        if math.isinf(self.mt):
            return (sensitivity,)
        square = self.mt**2
        return (sensitivity, (square / (square - 1.0), self.mt / (square - 1.0)))


class Responses:
    """Frequency responses of models on one grid, with the sign that makes feedback negative.

    :param models: m of them, all with the sign of the first.
    :param grid: rad/s, shape (n,), increasing.
    """

    def __init__(self, models: Sequence[TransferFunction], grid: FloatArray) -> None:
        self._models = tuple(models)
        self.grid = grid
        self.inverse = self._evaluate(grid)

    def _evaluate(self, grid: FloatArray) -> ComplexArray:
        sign = self._models[0].process_sign
        return np.array([sign / m(1j * grid) for m in self._models])

    def add(self, frequencies: FloatArray) -> None:
        """Add frequencies to the grid, with neighbours on either side.

        :param frequencies: rad/s, shape (k,).
        """
        near = np.unique(frequencies[:, None] * _NEIGHBOURS)
        near = near[~np.isin(near, self.grid)]
        grid = np.concatenate((self.grid, near))
        order = np.argsort(grid)
        inverse = np.concatenate((self.inverse, self._evaluate(near)), axis=1)
        self.grid, self.inverse = grid[order], inverse[:, order]

    def largest_ki(
        self, bounds: Bounds, kp: FloatArray, td: FloatArray, tf: FloatArray
    ) -> FloatArray:
        """Return the largest integral gains that the bounds leave.

        :param bounds: on the sensitivities.
        :param kp: proportional gains, positive, shape (k,).
        :param td: derivative times [s], shape (k,).
        :param tf: time constants of the filter [s], shape (k,).
        :return: shape (k, m), of the controllers in each model; not positive: none is allowed;
            infinite: any is.
        """
        if not np.any(tf):
            return self._envelope(bounds, kp, td, self.inverse[None])
        s = 1j * self.grid * tf[:, None]
        filtered = (1.0 + s + 0.5 * s * s)[:, None, :] * self.inverse
        return self._envelope(bounds, kp, td, filtered)

    def _envelope(
        self, bounds: Bounds, kp: FloatArray, td: FloatArray, inverse: ComplexArray
    ) -> FloatArray:
        w = self.grid
        x, y = inverse.real, inverse.imag
        square = x * x + y * y
        p = kp[:, None, None]
        lead = (kp * td)[:, None, None] * w
        lowest = np.full((kp.size, inverse.shape[1]), math.inf)
        for c, r in bounds.circles:
            room = r * r * square - (p + c * x) ** 2
            root = np.sqrt(np.maximum(room, 0.0))
            middle = lead + c * y
            # An ellipse that lies below ki = 0 forbids nothing.
            forbidden = (room > 0.0) & (middle + root > 0.0)
            limit = np.where(forbidden, w * (middle - root), math.inf)
            lowest = np.minimum(lowest, _least(limit, np.log(w)))
        return lowest


def _least(values: FloatArray, x: FloatArray) -> FloatArray:
    """Return the least value along the last axis, of the parabola through it and its neighbours.

    :param values: shape (k, m, n).
    :param x: abscissae, shape (n,), increasing.
    """
    i = np.clip(np.argmin(values, axis=-1), 1, x.size - 2)
    a, b, c = (np.take_along_axis(values, (i + d)[..., None], -1)[..., 0] for d in (-1, 0, 1))
    least = np.minimum(np.minimum(a, b), c)
    left, right = x[i] - x[i - 1], x[i + 1] - x[i]
    with np.errstate(invalid="ignore", divide="ignore"):
        slope_left, slope_right = (b - a) / left, (c - b) / right
        curvature = (slope_right - slope_left) / (left + right)
        slope = slope_left + curvature * left
        bottom = b - 0.25 * slope**2 / curvature
        inside = (slope_left < 0.0) & (slope_right > 0.0) & np.isfinite(bottom)
    return np.where(inside, np.minimum(bottom, least), least)
