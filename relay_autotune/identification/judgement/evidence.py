# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the checks look at: the record, the selected model, its rivals, the gains.

A process with an inverse response (a zero in the right half plane) first answers the other way.
A relay of the wrong direction then oscillates on that first answer, and models of the relay's
direction explain the cycles well enough, with a drift or a load for what they lack. The gains of
such a model have the wrong sign, and the loop would run away. So models of the other direction are
tried as well.

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
from relay_autotune.identification.judgement.refits import Part, halves, plain_models
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.fit_covariance import NEGLIGIBLE
from relay_autotune.identification.waveform.residuals import worth
from relay_autotune.identification.waveform.separable import (
    Problem,
    Trial,
    information_criterion,
    problem_of,
)
from relay_autotune.identification.waveform.starts import (
    Starts,
    is_unseen,
    refine_best,
    start_fopdt,
    two_lags,
)
from relay_autotune.process.response import response
from relay_autotune.process.structures import FOPDT, INTEGRATOR_INVERSE, SOPDT_ZERO
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Input, Outcome, PiecewiseConstant, Record

_MOST_SAMPLES = 4096
# Least correlation of neighbours that counts, in standard errors.
_CORRELATED = 2.0
# Least share of the measurement's range that counts as estimated beside the model.
_BESIDE = 1e-6
# Slow lags at the start, relative to the fast one.
_SLOWER = (2.0, 6.0, 20.0)
# Latest turn of an inverse response, in lengths of the test: a later one is a drift.
_HORIZON = 2.0
_TRIAL = 1e-6


@dataclass(frozen=True)
class OtherDirection:
    """A model of the opposite direction to the relay's.

    :param model: the best one.
    :param lead: criterion of the relay's own direction minus this one's; a difference of 6 is
        odds of e^3.
    """

    model: TransferFunction
    lead: float


def other_direction(
    found: Identification, record: Record, *, beside: int = 0
) -> OtherDirection | None:
    """Return the best model of the other direction; None: the record does not ask for one.

    A process at rest before the relay needs neither drift nor load nor initial state in its own
    direction. So the other one is fitted without them, and only where the model of the relay's
    direction needs them or leaves something unexplained. The two are compared by the Bayesian
    information criterion.

    :param found: what was identified from all samples, in the direction of the relay.
    :param record: the relay test.
    :param beside: number of parameters that were estimated beside the model, as those of a load.
    """
    drive = record.drive()
    residual = (record.measurement - found.fitted)[np.isfinite(found.fitted)]
    moved, left_out = _moved_beside(found, record, drive), residual.size < len(record)
    if not (moved or left_out or beside or worth(residual, _CORRELATED) < 1.0):
        return None
    sign, scale = found.model.process_sign, float(np.ptp(record.measurement))
    y = (record.measurement - record.measurement[0]) / scale
    whole = problem_of([(record.time, y, drive)], FOPDT)
    problem = whole.thinned(_MOST_SAMPLES)
    horizon = _HORIZON * float(record.time[-1] - drive.times[0])
    inverse = [
        f
        for f in _inverse(problem, sign)
        if f[0].process_sign == -sign and any(-horizon < z.real < 0.0 for z in f[0].zeros)
    ]
    if not inverse:
        return None
    n = problem.time.size
    floor = n * NEGLIGIBLE**2
    model, state = min(
        inverse, key=lambda f: information_criterion(f[1].cost, n, f[1].parameters, floor)
    )
    # The worth of a sample in both criteria comes from the other direction's residual.
    each = worth(state.residual)
    parameters = len(found.parameters) + 1 + beside + moved + left_out
    left = n * float(np.mean(residual**2)) / scale**2
    told = information_criterion(left, n, parameters, floor, each)
    other = information_criterion(state.cost, n, state.parameters, floor, each)
    return OtherDirection(model, told - other)


def _moved_beside(found: Identification, record: Record, drive: Input) -> bool:
    """Return whether more than an offset was estimated beside the model."""
    stable = all(t.real > 0.0 for t in found.model.time_constants)
    if not (stable and isinstance(drive, PiecewiseConstant)):
        return True
    rest: FloatArray = found.fitted - response(found.model, record.time, drive)
    return not float(np.ptp(rest)) <= _BESIDE * float(np.ptp(record.measurement))


def _inverse(problem: Problem, sign: int) -> list[tuple[TransferFunction, Trial]]:
    """Fit structures with an inverse response; with others no oscillation lasts.

    In the direction of the relay, a FOPDT shows the fast part of an inverse response.
    """
    first = refine_best(problem, start_fopdt(problem, sign), tolerance=_TRIAL)
    starts = Starts(problem, first)
    fast, dead_time = starts.tau, starts.dead_time
    tried = (
        (SOPDT_ZERO, [two_lags(n * fast, fast, dead_time) for n in _SLOWER]),
        (INTEGRATOR_INVERSE, [np.array((math.log(fast), dead_time))]),
    )
    found = []
    for structure, thetas in tried:
        plain = replace(problem, structure=structure)
        state = refine_best(plain, thetas, tolerance=_TRIAL)
        model = structure.model_at(state.theta, state.coefficients)
        if model is not None:
            found.append((model, state))
    return found


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
# Largest residual of a rival relative to the model's, and its least share of the support.
_AS_WELL = 1.1
_WORTH_HEARING = 0.01


@dataclass(frozen=True, eq=False)
class Loop:
    """The gains that are to be judged, as far as checks need them.

    :param controller: -command per measurement at complex frequencies s [u/y].
    :param ms_of: Ms of the loops that these gains make with models; inf: unstable.
    :param ms: Ms on the selected model.
    :param ms_95: Ms that 95 % of the models within its uncertainty stay below.
    :param added_delay: dead time of the loop beside the process's own [s].
    """

    controller: Callable[[ComplexArray], ComplexArray]
    ms_of: Callable[[Sequence[TransferFunction]], FloatArray]
    ms: float
    ms_95: float
    added_delay: float = 0.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """One experiment with its results.

    :param record: the samples.
    :param found: the selected model, with its uncertainty, its fit and its limit cycle.
    :param beside: number of parameters that were estimated beside the model, as those of a load.
    :param free: True if the structure was chosen from the data, False if it was given.
    :param samples: True if the model was fitted to the samples themselves.
    :param others: other methods' models of the record, with the quality of their fit.
    :param settled: True if the record has a limit cycle whose last cycles agree.
    :param loop: the gains; None: there are none yet.
    :param driven: the record with the estimated load added to its command; None: no load.
    """

    record: Record
    found: Identification
    beside: int = 0
    free: bool = True
    samples: bool = True
    others: tuple[Identification, ...] = ()
    settled: bool = False
    loop: Loop | None = None
    driven: Record | None = None

    def with_loop(self, loop: Loop) -> Evidence:
        """Return the same experiment with some gains, and what was computed without them.

        :param loop: the gains.
        """
        found = replace(self, loop=loop)
        for name in ("visible", "rivals", "halves", "plain"):
            found.__dict__[name] = getattr(self, name)
        return found

    @cached_property
    def other(self) -> OtherDirection | None:
        """The best model of the opposite direction to the relay's; None: not needed."""
        ended_well = self.record.outcome in (Outcome.COMPLETED, Outcome.UNKNOWN)
        relay = self.record.settings is not None and ended_well
        if not (relay and self.samples and self.free):
            return None
        return other_direction(self.found, self.record, beside=self.beside)

    @cached_property
    def visible(self) -> VisibleError | None:
        """What the record shows of the model's error; None where it cannot tell."""
        try:
            return visible_error(self.found.model, self.record)
        except (ModelError, np.linalg.LinAlgError):
            return None

    @cached_property
    def rivals(self) -> tuple[TransferFunction, ...]:
        """Other models that explain the record nearly as well."""
        most = _AS_WELL * self.found.fit.residual_rms
        models = (
            *(r.model for r in self.found.rivals if r.support > _WORTH_HEARING),
            *(m.model for m in self.others if m.fit.residual_rms <= most),
        )
        interval = self.record.mean_interval
        return tuple(
            m
            for m in models
            if self.growth(m) <= MOST_GROWTH and not is_unseen(m, interval, self.record.duration)
        )

    @cached_property
    def halves(self) -> tuple[Part, ...]:
        """The models that each half of the record allows in the chosen structure; may be empty."""
        if not self.samples:
            return ()
        try:
            return halves(self.found, self.driven or self.record)
        except (ModelError, np.linalg.LinAlgError):
            return ()

    @cached_property
    def plain(self) -> tuple[TransferFunction, ...]:
        """Plain models of the whole record that explain it as well; may be empty."""
        if not self.samples:
            return ()
        try:
            return plain_models(self.found, self.driven or self.record)
        except (ModelError, np.linalg.LinAlgError):
            return ()

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
