# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Measurement noise in the command, without feedback through the loop, and the filter for it."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.loop.laws import LawRate, Smoothing, taps_of
from relay_autotune.loop.sampled import filter_elements

# Grid of filter time constant over sampling period, for interpolation.
_RATIOS = np.geomspace(1e-3, 1e4, 141)
# Time constants of a filter on the derivative alone that are tried, in periods.
_TRIED = np.concatenate(([0.0], np.geomspace(1.05, 1e3, 80)))


@lru_cache(maxsize=1)
def _moments() -> FloatArray:
    """Return var(yf), cov(yf, h yf') and var(h yf') for each of ``_RATIOS``, shape (3, n)."""
    motion = np.array(filter_elements(_RATIOS, 1.0, np)).T
    turn, past, present = motion[:, :4].reshape(-1, 2, 2), motion[:, 4:6], motion[:, 6:]
    # Scaled to the filter's time constant, both states have one order of magnitude.
    size = np.stack((np.ones(_RATIOS.size), _RATIOS), axis=1)
    turn, past, present = turn * size[:, :, None] / size[:, None, :], past * size, present * size
    # State and next sample are correlated only by the sample before.
    shared = _outer((turn @ present[..., None])[..., 0], past)
    drive = _outer(past, past) + _outer(present, present) + shared + shared.swapaxes(1, 2)
    twice = turn[:, :, None, :, None] * turn[:, None, :, None, :]
    operator = np.eye(4) - twice.reshape(-1, 4, 4)
    covariance = np.linalg.solve(operator, drive.reshape(-1, 4, 1))
    return covariance[:, [0, 1, 3], 0].T / np.stack((size[:, 0], _RATIOS, _RATIOS**2))


def _outer(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the outer products of vectors, shape (n, 2, 2)."""
    return np.asarray(left[:, :, None] * right[:, None, :])


def open_noise_gain(td: FloatArray, tf: FloatArray, period: float) -> FloatArray:
    """Return the standard deviation of ``yf + td dyf/dt`` per that of white sampled noise.

    Multiplied by kc it is the standard deviation of the command, without the integral part and
    without feedback through the loop.

    :param td: derivative times [s], shape (k,).
    :param tf: time constants of the filter [s], shape (k,).
    :param period: period of the samples [s].
    """
    at = np.log(np.maximum(tf / period, _RATIOS[0]))
    value, mixed, slope = (np.interp(at, np.log(_RATIOS), row) for row in _moments())
    lead = td / period
    return np.sqrt(value + 2.0 * lead * mixed + lead**2 * slope)


def filter_for(td: FloatArray, largest: FloatArray, period: float) -> FloatArray:
    """Return the least time constant of the filter that keeps the noise gain within a limit.

    :param td: derivative times [s], shape (k,).
    :param largest: largest allowed :func:`open_noise_gain`, shape (k,).
    :param period: period of the samples [s].
    :return: s, shape (k,); infinite: no usable time constant is enough.
    """
    value, mixed, slope = _moments()
    lead = (td / period)[:, None]
    gains = np.sqrt(value + 2.0 * lead * mixed + lead**2 * slope)
    # Beyond some time constant the noise gain only falls.
    keeps = gains <= largest[:, None]
    first = np.where(keeps.any(axis=1), keeps.argmax(axis=1), _RATIOS.size)
    inside = np.clip(first, 1, _RATIOS.size - 1)
    rows = np.arange(td.size)
    above, below = np.log(gains[rows, inside - 1]), np.log(gains[rows, inside])
    share = np.clip((above - np.log(largest)) / np.maximum(above - below, 1e-300), 0.0, 1.0)
    steps = np.log(_RATIOS)
    found = np.exp(steps[inside - 1] + share * (steps[inside] - steps[inside - 1])) * period
    found = np.where(first == 0, 0.0, found)
    return np.where(first == _RATIOS.size, math.inf, found)


@lru_cache(maxsize=8)
def _derivative_moments(smoothing: Smoothing) -> tuple[FloatArray, FloatArray]:
    """Return first and squared sum of the derivative's impulse response for each filter tried."""
    tried = _TRIED if smoothing.adjustable else _TRIED[:1]
    taps = [taps_of(smoothing.slope(tf, 1.0), tf, 1.0) for tf in tried.tolist()]
    return np.array([t[0] for t in taps]), np.array([t @ t for t in taps])


def filters_of(
    rate: LawRate, td: FloatArray, largest: FloatArray, filter_ratio: float
) -> FloatArray:
    """Return the filter that each controller needs at a law [s], shape (k,).

    :param rate: the law and its period.
    :param td: derivative times [s], shape (k,).
    :param largest: largest standard deviation of the command per that of the noise, over the
        proportional gain, shape (k,); infinite: no limit.
    :param filter_ratio: largest td/tf.
    :return: infinite: no usable time constant is enough.
    """
    h, smoothing, least = rate.period, rate.law.smoothing, td / filter_ratio
    if smoothing.on_measurement:
        return least if np.isinf(largest).all() else np.maximum(least, filter_for(td, largest, h))
    first, power = _derivative_moments(smoothing)
    lead = (td / h)[:, None]
    keeps = np.sqrt(1.0 + lead * (2.0 * first + lead * power)) <= largest[:, None]
    tried = _TRIED[: first.size] * h
    if smoothing.adjustable:
        # A filter as fast as one period is none.
        keeps &= tried >= np.where(least > h, least, 0.0)[:, None]
    return np.where(keeps.any(axis=1), tried[keeps.argmax(axis=1)], math.inf)
