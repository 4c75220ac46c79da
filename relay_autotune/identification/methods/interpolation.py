"""The ultimate point of a frequency response that is known at some points only."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_NEAREST = 3
_REACH = 3.0
_GRID = 400


def interpolated(
    model: TransferFunction, frequency: FloatArray, value: ComplexArray
) -> UltimatePoint | None:
    """Return the ultimate point of a measured response, interpolated with the help of a model.

    ``log(G/M)`` runs straight over log(w) from point to point and is constant beyond them.

    :param model: M, near the points.
    :param frequency: of the points [rad/s], increasing, shape (m,); one at zero tells nothing.
    :param value: G there [y/u], shape (m,).
    :return: None where the phase does not pass -180 degrees near the lowest points.
    """
    used = frequency > 0.0
    at = np.log(frequency[used])
    ratio = np.log(value[used] / model(1j * frequency[used]))

    def logarithm(w: FloatArray) -> tuple[FloatArray, FloatArray]:
        place = np.log(w)
        size = np.log(np.abs(model(1j * w))) + np.interp(place, at, ratio.real)
        return size, model.phase(w) + np.interp(place, at, ratio.imag)

    return _crossing(logarithm, float(frequency[used][0]), model.process_sign)


def smooth(
    model: TransferFunction, frequency: FloatArray, value: ComplexArray
) -> UltimatePoint | None:
    """Return the ultimate point of a measured response, interpolated without a structure.

    Through the lowest three points, ``log|G|`` is a parabola over log(w), and the phase has the
    form ``a + b w + c log(w)``, exact for dead time and integrators.

    :param model: tells only how many turns lie between the points.
    :param frequency: as for :func:`interpolated`, as is the next.
    """
    chosen = np.flatnonzero(frequency > 0.0)[:_NEAREST]
    w0, g = frequency[chosen], value[chosen]
    turned = model.phase(w0)
    phase = turned + np.angle(g * model.process_sign * np.exp(-1j * turned))
    first = float(w0[0])

    def terms(w: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, one = np.log(w / first), np.ones_like(w)
        rows = np.stack((one, x, x * x)), np.stack((one, x, w / first))
        return rows[0][: chosen.size].T, rows[1][: chosen.size].T

    of_size, of_phase = terms(w0)
    size = np.linalg.solve(of_size, np.log(np.abs(g)))
    turn = np.linalg.solve(of_phase, phase)

    def logarithm(w: FloatArray) -> tuple[FloatArray, FloatArray]:
        by_size, by_phase = terms(w)
        return by_size @ size, by_phase @ turn

    return _crossing(logarithm, first, model.process_sign)


Interpolation = Callable[[TransferFunction, FloatArray, ComplexArray], UltimatePoint | None]


def _crossing(
    logarithm: Callable[[FloatArray], tuple[FloatArray, FloatArray]], near: float, sign: int
) -> UltimatePoint | None:
    """Return where the phase falls through -180 degrees, next to a frequency.

    :param logarithm: from frequencies to log|G| and the phase.
    :param near: [rad/s].
    :param sign: of the process.
    """

    def excess(w: float) -> float:
        return float(logarithm(np.array([w]))[1][0]) + math.pi

    grid = near * np.geomspace(1.0 / _REACH, _REACH, _GRID)
    height = logarithm(grid)[1] + math.pi
    falls = np.flatnonzero((height[:-1] > 0.0) & (height[1:] <= 0.0))
    if falls.size == 0:
        return None
    i = int(falls[np.argmin(np.abs(np.log(grid[falls] / near)))])
    w = float(brentq(excess, grid[i], grid[i + 1], xtol=1e-300, rtol=1e-14))
    size = float(logarithm(np.array([w]))[0][0])
    return UltimatePoint(math.copysign(math.exp(-size), sign), w)
