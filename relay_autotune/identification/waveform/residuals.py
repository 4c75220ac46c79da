# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Residuals: tests for whiteness, covariances that allow for correlation, the colour of noise.

The colour is an autoregression whose order the data choose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import toeplitz
from scipy.special import gammaincc

from relay_autotune.arrays import FloatArray


def autocorrelation(residual: FloatArray, lags: int) -> FloatArray:
    """Return the autocorrelation at lags 1 to ``lags``.

    :param residual: shape (n,), in the order of time.
    :param lags: less than n.
    """
    e = residual - residual.mean()
    if not bool(np.any(e)):
        return np.zeros(lags)
    # By Fourier transforms, padded so that the ends do not meet: a million samples take no longer
    # than the fit itself.
    spectrum = np.abs(np.fft.rfft(e, 2 ** math.ceil(math.log2(e.size + lags + 1)))) ** 2
    products = np.fft.irfft(spectrum)[: lags + 1]
    return np.asarray(products[1:] / products[0])


def noise_to_signal(noise: FloatArray, signal: FloatArray) -> tuple[float, float]:
    """Return the two noise-to-signal ratios of Wang, Hang and Zou 1997.

    N1 is the ratio of the mean powers, N2 that of the mean absolute values.

    :param noise: the noise [y], shape (n,).
    :param signal: deviation from the operating point [y], shape (n,).
    :return: N1 and N2; NaN where there is no signal.
    """
    power, mean = float(np.mean(signal**2)), float(np.mean(np.abs(signal)))
    if not (power > 0.0 and mean > 0.0):
        return math.nan, math.nan
    return float(np.mean(noise**2)) / power, float(np.mean(np.abs(noise))) / mean


def ljung_box(residual: FloatArray, lags: int = 20) -> float:
    """Return the probability that white noise is at least as correlated (Ljung and Box 1978).

    ``Q = n (n + 2) sum_k rho_k^2/(n - k)`` is chi-squared with as many degrees of freedom as
    lags.

    :param residual: shape (n,), in the order of time.
    :param lags: lags that are tested, at most n/5 of them.
    :return: p; nan for fewer than 10 samples.
    """
    n = residual.size
    m = min(lags, n // 5)
    if m < 2:
        return math.nan
    rho = autocorrelation(residual, m)
    q = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, m + 1))))
    return float(gammaincc(m / 2.0, q / 2.0))


# 95 % as efficient as least squares where the noise is normal.
_HUBER = 1.345
_TUKEY = 4.685


def scale_of(residual: FloatArray) -> float:
    """Return the standard deviation of the noise's bulk: 1.4826 times its median deviation.

    :param residual: shape (n,).
    """
    return 1.4826 * float(np.median(np.abs(residual - np.median(residual))))


def weights(residual: FloatArray, scale: float, loss: str) -> FloatArray:
    """Return the weight w of each sample, with which w r is the derivative of the loss at r.

    Huber 1964: ``w = min(1, c/|x|)``; Tukey's biweight (Beaton and Tukey 1974):
    ``w = (1 - (x/c)^2)^2`` within c and 0 beyond, with x = r/scale.

    :param residual: r, shape (n,).
    :param scale: standard deviation of the noise's bulk.
    :param loss: "huber" or "tukey".
    """
    if not scale > 0.0:
        return np.ones(residual.size)
    x = np.abs(residual) / scale
    if loss == "huber":
        return np.asarray(_HUBER / np.maximum(x, _HUBER))
    return np.asarray(np.maximum(1.0 - (x / _TUKEY) ** 2, 0.0) ** 2)


def mean_slope(residual: FloatArray, scale: float, loss: str) -> float:
    """Return the mean second derivative of the loss, which divides standard deviations.

    :param residual: r, shape (n,).
    :param scale: standard deviation of the noise's bulk.
    :param loss: "squares", "huber" or "tukey".
    """
    if loss == "squares" or not scale > 0.0:
        return 1.0
    x = np.abs(residual) / scale
    if loss == "huber":
        return float(np.mean(x < _HUBER))
    square = (x / _TUKEY) ** 2
    return float(np.mean(np.where(square < 1.0, (1.0 - square) * (1.0 - 5.0 * square), 0.0)))


_MOST_LAGS = 24
# Least number of samples for each further lag.
_SAMPLES_EACH = 12
# Length of a record in correlation times of a disturbance, below which it looks like a drift.
_SLOWEST = 10.0
# Twice the logarithm of the prior odds against what can imitate a drift, for which a record
# without one has no use: 150 to 1.
IMITATES_A_DRIFT = 10.0
# Largest correlation of neighbours that rounding can tell from 1.
_CERTAIN = 1.0 - 1e-12
# Samples that are whitened at once: with fewer or more, it takes longer.
_BLOCK = 16


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
        (*some, n), p = rows.shape, self.order
        whole = -(-n // _BLOCK) * _BLOCK
        padded = np.zeros((*some, p + whole))
        padded[..., p : p + n] = rows
        # Block by block, each from its samples and the p before: one product of matrices.
        each = sliding_window_view(padded, p + _BLOCK, axis=-1)[..., ::_BLOCK, :]
        white = (each.reshape(-1, p + _BLOCK) @ self._of_block).reshape(*some, whole)
        first = min(p, n)
        white[..., :first] = rows[..., :first] @ self.begin[:first, :first].T
        return white[..., :n]

    @cached_property
    def _of_block(self) -> FloatArray:
        """What a block of white samples takes of its samples and the p before, (p + b, b)."""
        taken = np.append(-self.coefficients[::-1], 1.0)
        later = np.zeros(_BLOCK - 1)
        return np.asarray(toeplitz(np.append(taken, later), np.append(taken[:1], later)))

    @cached_property
    def nearest_to_1(self) -> float:
        """Distance of the nearest pole from 1, which is that of a random walk."""
        poles = np.roots(np.append(1.0, -self.coefficients))
        return float(np.min(np.abs(1.0 - poles)))

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the noise's covariance over the variance of e."""
        return -2.0 * float(np.sum(np.log(self.begin.diagonal())))


def colour_cost(colour: Colour | None, samples: int) -> float:
    """Return what a colour adds to the score of what it whitens.

    To the Bayesian information criterion comes the prior against a pole so near 1 that the noise
    wanders like a drift.

    :param colour: None: white.
    :param samples: number of samples.
    """
    if colour is None:
        return 0.0
    wanders = colour.nearest_to_1 < _SLOWEST / samples
    return colour.log_determinant + colour.order * math.log(samples) + IMITATES_A_DRIFT * wanders


def colour_of(parts: Sequence[FloatArray]) -> Colour | None:
    """Return the colour of residuals: Burg's autoregression of the order that BIC prefers.

    Burg's recursion minimises the errors of prediction forward and backward together, which
    keeps every autoregression stable, however near to 1 a pole lies.

    :param parts: residuals of each experiment, in the order of time.
    :return: None: order 0, the noise is white.
    """
    n = sum(part.size for part in parts)
    most = min(_MOST_LAGS, n // _SAMPLES_EACH, min(part.size for part in parts) - 2)
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
        # A residual that repeats itself to rounding would leave no variance at all.
        k = max(-_CERTAIN, min(top / down, _CERTAIN))
        reflections.append(k)
        a = np.concatenate((a - k * a[::-1], [k]))
        forward = [f - k * b for f, b in zip(ahead, behind, strict=True)]
        backward = [b - k * f for f, b in zip(ahead, behind, strict=True)]
        variance *= 1.0 - k * k
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


def slow_colour(samples: int) -> Colour:
    """Return the colour of a slow disturbance, an autoregression of first order.

    :param samples: of the record, ten correlation times of it.
    """
    pole = 1.0 - _SLOWEST / samples
    return Colour(np.array([pole]), np.array([[math.sqrt(1.0 - pole**2)]]))
