# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The colour of noise: an autoregression whose order the data choose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray

_MOST_LAGS = 24
# Least number of samples for each further lag.
_SAMPLES_EACH = 12


@dataclass(frozen=True)
class Colour:
    """Noise ``v_i = sum_k a_k v_(i-k) + e_i`` with white e.

    :param coefficients: a, shape (p,), of a stable autoregression, p >= 1.
    :param begin: rows that make the first p samples white: the inverse root of their covariance
        over the variance of e, shape (p, p).
    """

    coefficients: FloatArray
    begin: FloatArray

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return int(self.coefficients.size)

    def whitened(self, rows: FloatArray) -> FloatArray:
        """Return rows of samples in the order of time with the colour taken out.

        :param rows: shape (..., n).
        """
        p = min(self.order, rows.shape[-1])
        # Lag by lag: that is quicker than a filter's routine for each row.
        white = rows.copy()
        for lag, a in enumerate(self.coefficients[:p].tolist(), start=1):
            white[..., lag:] -= a * rows[..., :-lag]
        white[..., :p] = rows[..., :p] @ self.begin[:p, :p].T
        return white

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the noise's covariance over the variance of e."""
        return -2.0 * float(np.sum(np.log(self.begin.diagonal())))


def slow_colour(pole: float) -> Colour:
    """Return the colour of a slow disturbance, an autoregression of first order.

    :param pole: just below 1.
    """
    return Colour(np.array([pole]), np.array([[math.sqrt(1.0 - pole**2)]]))


def colour_of(parts: Sequence[FloatArray], most: int = _MOST_LAGS) -> Colour | None:
    """Return the colour of residuals: Burg's autoregression of the order that BIC prefers.

    Burg's recursion minimises the errors of prediction forward and backward together, which
    keeps every autoregression stable, however near to 1 a pole lies.

    :param parts: residuals of each experiment, in the order of time.
    :param most: largest order.
    :return: None: order 0, the noise is white.
    """
    n = sum(part.size for part in parts)
    most = min(most, n // _SAMPLES_EACH, min(part.size for part in parts) - 2)
    forward = [part.copy() for part in parts]
    backward = [part.copy() for part in parts]
    power = sum(float(part @ part) for part in parts) / n
    if not power > 0.0:
        return None
    best, chosen = n * math.log(power), np.empty(0)
    a, reflections = np.empty(0), []
    variance = power
    for order in range(1, most + 1):
        ahead = [f[1:] for f in forward]
        behind = [b[:-1] for b in backward]
        top = sum(2.0 * float(f @ b) for f, b in zip(ahead, behind, strict=True))
        down = sum(float(f @ f + b @ b) for f, b in zip(ahead, behind, strict=True))
        if not down > 0.0:
            break
        k = top / down
        reflections.append(k)
        a = np.concatenate((a - k * a[::-1], [k]))
        forward = [f - k * b for f, b in zip(ahead, behind, strict=True)]
        backward = [b - k * f for f, b in zip(ahead, behind, strict=True)]
        variance *= max(1.0 - k * k, 1e-300)
        criterion = n * math.log(variance) + order * math.log(n)
        if criterion < best:
            best, chosen = criterion, a
    return None if chosen.size == 0 else _colour(chosen, np.array(reflections[: chosen.size]))


def _colour(coefficients: FloatArray, reflections: FloatArray) -> Colour:
    """Return the colour of given coefficients, with the predictors of all lower orders.

    A row of ``begin`` predicts one of the first samples from those before it, by the
    autoregression of the order that these allow (Durbin and Levinson), over the root of the
    variance that it leaves, in units of that of e.
    """
    p = coefficients.size
    begin = np.zeros((p, p))
    a: FloatArray = np.empty(0)
    # Variance left by each order, in units of that of e.
    left = 1.0 / np.cumprod(1.0 - reflections[::-1] ** 2)[::-1]
    for order in range(p):
        row = np.concatenate((-a[::-1], [1.0]))
        begin[order, : order + 1] = row / math.sqrt(left[order])
        k = reflections[order]
        a = np.concatenate((a - k * a[::-1], [k]))
    return Colour(coefficients, begin)
