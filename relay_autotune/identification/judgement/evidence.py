# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the checks look at: the record, the selected model, the models it allows, the gains.

The record also shows the process without any structure. The model is simulated with the recorded
command, from rest at an unknown constant command and without drift or load. Its residual is
regressed on the past command: an impulse response in bins of the lag,
``e(t) = c + sum_j g_j int u(t - lag) dlag`` over each bin. Its frequency response is the model's
error (a model-error model, Ljung 1999): where it exceeds what the loop tolerates, the gains suit
another process. A ridge keeps it at zero where the command excites nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.identification.result import Identification
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record

_BINS = 24
_MOST_COMPARED = 2000
_LEAST_SAMPLES = 60
# Share of the largest excitation below which the command excites nothing.
_RIDGE = 1e-3
# Number of standard deviations that chance explains.
_SURE = 3.0


@dataclass(frozen=True)
class VisibleError:
    """The difference between a record's response and a model's, without a structure.

    :param edges: of the bins of the lag [s], shape (m + 1,).
    :param height: impulse response of the difference in each bin [y/(u s)], shape (m,).
    :param covariance: of the heights, shape (m, m).
    :param residual: rms of what the difference does not explain either [y].
    """

    edges: FloatArray
    height: FloatArray
    covariance: FloatArray
    residual: float

    def at(self, frequency: FloatArray) -> ComplexArray:
        """Return its frequency response [y/u].

        :param frequency: rad/s, shape (k,).
        """
        return np.asarray(self._integrals(frequency) @ self.height)

    def sure(self, frequency: FloatArray) -> FloatArray:
        """Return its magnitude less what chance explains, at least zero [y/u].

        :param frequency: rad/s, shape (k,).
        """
        basis = self._integrals(frequency)
        variance = np.einsum("km,mn,kn->k", basis, self.covariance, basis.conj()).real
        chance = _SURE * np.sqrt(np.maximum(variance, 0.0))
        return np.maximum(np.abs(basis @ self.height) - chance, 0.0)

    def _integrals(self, frequency: FloatArray) -> ComplexArray:
        ends = np.exp(-1j * np.outer(frequency, self.edges))
        return np.asarray((ends[:, :-1] - ends[:, 1:]) / (1j * frequency[:, None]))


def visible_error(model: TransferFunction, record: Record) -> VisibleError | None:
    """Return what a record shows of a model's error; None where it cannot tell.

    :param model: any; an unstable one cannot be simulated in open loop.
    :param record: the record.
    """
    if model.grows or len(record) < _LEAST_SAMPLES:
        return None
    u, time, y = record.input(), record.time, record.measurement
    error = y - response(model, time, u)
    few = np.unique(np.linspace(0, time.size - 1, min(time.size, _MOST_COMPARED)).astype(np.int64))
    time, error = time[few], error[few]
    shortest = max(float(np.median(np.diff(time))), 1e-6 * record.duration)
    edges = np.concatenate(([0.0], np.geomspace(shortest, record.duration, _BINS)))
    past = _integral(u, time[:, None] - edges)
    columns = past[:, :-1] - past[:, 1:]
    # The measurement's zero and the command before the record are not known.
    before = response(model, time, PiecewiseConstant(np.array([time[0]]), np.ones(1), 0.0))
    unknown, _ = np.linalg.qr(np.stack((np.ones(time.size), before), axis=1))
    columns = columns - unknown @ (unknown.T @ columns)
    error = error - unknown @ (unknown.T @ error)
    size = np.sqrt(np.einsum("nm,nm->m", columns, columns))
    if not float(size.max()) > 0.0:
        return None
    size = np.maximum(size, _RIDGE * float(size.max()))
    scaled = columns / size
    normal = scaled.T @ scaled
    inverse = np.linalg.inv(normal + _RIDGE * np.eye(normal.shape[0]))
    height = inverse @ (scaled.T @ error)
    left = error - scaled @ height
    rms = math.sqrt(float(np.mean(left**2)))
    # A residual that is correlated from sample to sample counts as fewer samples.
    neighbours = float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-300)
    colour = (1.0 + max(neighbours, 0.0)) / max(1.0 - neighbours, 1e-3)
    covariance = rms**2 * colour * (inverse @ normal @ inverse) / np.outer(size, size)
    return VisibleError(edges, height / size, covariance, rms)


def _integral(u: PiecewiseConstant, at: FloatArray) -> FloatArray:
    """Return the integral of the command's deviation from its first value up to given times."""
    if u.times.size == 0:
        return np.zeros(at.shape)
    away = u.values - u.initial
    before = np.concatenate(([0.0], np.cumsum(away[:-1] * np.diff(u.times))))
    k = np.searchsorted(u.times, at, side="right") - 1
    value = before[k] + away[k] * (at - u.times[k])
    return np.where(k >= 0, value, 0.0)


# Number of time constants within which an unstable process leaves any rest.
MOST_GROWTH = 7.0


@dataclass(frozen=True, eq=False)
class Loop:
    """The gains that are to be judged, as far as checks need them.

    :param controller: -command per measurement at complex frequencies s [u/y].
    :param ms_of: Ms of the loops that these gains make with models; inf: unstable.
    :param asked: Ms that was asked of the gains, or theirs on the model where that is larger.
    :param added_delay: dead time of the loop beside the process's own [s].
    """

    controller: Callable[[ComplexArray], ComplexArray]
    ms_of: Callable[[Sequence[TransferFunction]], FloatArray]
    asked: float
    added_delay: float = 0.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """One experiment with its results.

    :param record: the samples.
    :param found: the selected model, with its uncertainty, its fit and its limit cycle.
    :param settled: True if the record has a limit cycle whose last cycles agree.
    :param loop: the gains; None: there are none yet.
    """

    record: Record
    found: Identification
    settled: bool = False
    loop: Loop | None = None

    def with_loop(self, loop: Loop) -> Evidence:
        """Return the same experiment with some gains, and what was computed without them.

        :param loop: the gains.
        """
        found = replace(self, loop=loop)
        found.__dict__["visible"] = self.visible
        return found

    @cached_property
    def visible(self) -> VisibleError | None:
        """What the record shows of the model's error; None where it cannot tell."""
        try:
            return visible_error(self.found.model, self.record)
        except (ModelError, np.linalg.LinAlgError):
            return None

    def growth(self, model: TransferFunction) -> float:
        """Return the longest time of a constant command in time constants of a model's growth.

        :param model: any; 0 where it does not grow by itself.
        """
        growing = [-t.real for t in model.time_constants if t.real < 0.0]
        return self.longest_stay / min(growing) if growing else 0.0

    @cached_property
    def longest_stay(self) -> float:
        """Longest time within the record for which the command stood still [s]."""
        time, changes = self.record.time, self.record.input().times
        inside = changes[(changes > time[0]) & (changes < time[-1])]
        return float(np.max(np.diff(np.concatenate((time[:1], inside, time[-1:])))))
