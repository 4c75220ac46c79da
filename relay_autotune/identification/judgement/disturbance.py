# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Disturbances of a test: a load step, estimated with the model; parts that are left out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.estimate import Estimate, jacobian
from relay_autotune.identification.judgement.assessment import is_contradicted, misfit
from relay_autotune.identification.result import Identification
from relay_autotune.process.response import response
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Cycle, PiecewiseConstant, Record

# Numbers of instants at which a load is tried, and of the best ones that are followed up.
_INSTANTS = 60
_FOLLOWED = 6
# Largest share of the sum of squares that the best guess leaves; a load leaves next to nothing.
_PROMISE = 0.7
# Number of samples that is enough to find a load.
_SAMPLES = 1500
# Step for derivatives, relative to the parameter.
_STEP = 1e-5


@dataclass(frozen=True)
class LoadStep:
    """A step that entered before the process, with the command.

    :param time: when [s from the first sample].
    :param size: how much [u].
    """

    time: float
    size: float

    def added_to(self, u: PiecewiseConstant) -> PiecewiseConstant:
        """Return the command with the load [u]."""
        times = np.union1d(u.times, [self.time])
        return PiecewiseConstant(times, u(times) + self.size * (times >= self.time), u.initial)


def with_load(record: Record, load: LoadStep) -> Record:
    """Return a record whose process was driven by command and load.

    :param record: the record.
    :param load: what came during it.
    """
    return replace(record, held_input=load.added_to(record.input()))


def identify_with_load(
    found: Identification, record: Record, identify: Callable[[Record], Identification]
) -> tuple[Identification, Record] | None:
    """Identify a record together with a step of the load that came during it.

    :param found: the model that was found without a load; its structure is kept.
    :param record: the record, of which the command was held between samples.
    :param identify: identifies a record by the method that fits samples.
    :return: the identification, whose intervals include the uncertainty of the load, and the
        record with the load; None where no load is found.
    """
    load = find_load(found, record)
    if load is None:
        return None
    loaded = with_load(record, load)
    return _Fit(identify(loaded), record).with_doubt(load), loaded


def find_load(found: Identification, record: Record) -> LoadStep | None:
    """Estimate when a load came and how large it was, in the structure that was identified.

    The model's parameters theta, an offset c, and instant t1 and size d of the load minimise the
    sum of squares of ``y - c - G(theta) (u + d 1(t - t1))``. The starts come from the residual of
    the model without a load: it is linear in d and c, and nearly so in the change of theta, so
    that one linear fit gives the sum of squares for each t1.

    :param found: the model that was found without a load.
    :param record: the record, of which the command was held between samples.
    :return: the load; None where none is found.
    """
    fit = _Fit(found, record)
    best: tuple[float, LoadStep] | None = None
    for start in fit.starts():
        solution = least_squares(fit.residual, start, x_scale=fit.scale(start), max_nfev=40)
        if best is None or solution.cost < best[0]:
            best = float(solution.cost), LoadStep(float(solution.x[-3]), float(solution.x[-2]))
    return best[1] if best is not None and best[1].size != 0.0 else None


class _Fit:
    """The sum of squares; unknown: a model's parameters, a load's time and size, an offset."""

    def __init__(self, found: Identification, record: Record) -> None:
        every = max(1, len(record) // _SAMPLES)
        self._share = len(record) / len(record.time[::every])
        self._time = record.time[::every]
        self._measurement = record.measurement[::every]
        self._u = record.input()
        self._found = found
        self._build = found.estimate.structure.build
        self._values = np.array(found.values, dtype=np.float64)
        self._span = record.duration
        self._begin = float(self._u.times[0]) if self._u.times.size else 0.0
        levels = np.append(self._u.values, self._u.initial)
        self._height = float(levels.max() - levels.min())
        self._spread = float(np.std(record.measurement))

    def _output(self, values: FloatArray, u: PiecewiseConstant) -> FloatArray:
        return response(self._build(values), self._time, u)

    def residual(self, unknown: FloatArray) -> FloatArray:
        """Return measurement minus model [y]."""
        *values, time, size, offset = unknown.tolist()
        if not 0.0 < time < self._span:
            return np.full(self._time.size, 10.0 * self._spread)
        u = LoadStep(time, size).added_to(self._u)
        try:
            with np.errstate(all="ignore"):
                left = self._measurement - offset - self._output(np.array(values), u)
        except RelayAutotuneError:
            left = np.full(self._time.size, math.inf)
        # A model that runs away, or that cannot be built, must not stop the search.
        far = 10.0 * self._spread
        return np.clip(np.nan_to_num(left, nan=far, posinf=far, neginf=-far), -far, far)

    def scale(self, start: FloatArray) -> FloatArray:
        """Return the size of each unknown."""
        values = np.abs(start[:-3])
        return np.append(
            np.where(values > 0.0, values, max(0.01 * self._span, 1e-9)),
            [0.05 * self._span, 0.1 * self._height or 1.0, self._spread or 1.0],
        )

    def starts(self) -> list[FloatArray]:
        """Return the best few guesses; empty where a load explains too little at any instant."""
        now = self._output(self._values, self._u)
        left = self._measurement - now

        def output(values: FloatArray) -> FloatArray:
            try:
                return self._output(values, self._u)
            except RelayAutotuneError:
                # A value at its upper bound cannot be increased.
                return now

        columns = [np.ones(self._time.size), *_slopes(output, self._values).T]
        model = self._build(self._values)
        guesses: list[tuple[float, FloatArray]] = []
        for instant in np.linspace(self._begin, self._span, _INSTANTS + 2)[1:-1]:
            unit = PiecewiseConstant(np.array([instant]), np.array([1.0]), 0.0)
            matrix = np.column_stack([*columns, response(model, self._time, unit)])
            answer, *_ = np.linalg.lstsq(matrix, left, rcond=1e-10)
            sum_of_squares = float(np.sum((left - matrix @ answer) ** 2))
            guess = np.concatenate((self._values, [instant, answer[-1], answer[0]]))
            guesses.append((sum_of_squares, guess))
        guesses.sort(key=lambda guess: guess[0])
        if guesses[0][0] > _PROMISE * float(np.sum((left - left.mean()) ** 2)):
            return []
        return [guess for _, guess in guesses[:_FOLLOWED]]

    def with_doubt(self, load: LoadStep) -> Identification:
        """Add the uncertainty of the load to the covariance, and a warning that there was one.

        With J the derivatives of the output by all unknowns, it is ``sigma^2`` times the part of
        ``(J'J)^-1`` that belongs to the model's parameters, less the same without the load.
        """
        found = self._found
        warning = (
            f"a load step of {load.size:.3g} u at {load.time:.4g} s was estimated with the model, "
            f"since no model fits the record without one"
        )
        point = np.append(self._values, [load.time, load.size, 0.0])
        slopes = _slopes(self.residual, point)
        count = self._values.size
        known = np.linalg.pinv(np.delete(slopes, [count, count + 1], axis=1))[:count]
        open_ = np.linalg.pinv(slopes)[:count]
        noise = found.fit.residual_rms**2
        more = noise * (open_ @ open_.T - known @ known.T)
        # The samples that were left out here would reduce it further.
        more /= self._share
        variance = np.diag(found.covariance)
        ratio = np.zeros(count)
        np.divide(np.diag(more).clip(0.0), variance, out=ratio, where=variance > 0.0)
        wider = np.sqrt(1.0 + ratio)
        gradients = _slopes(self._ultimate, self._values)
        gain, frequency = np.einsum("ik,kl,il->i", gradients, more, gradients).clip(0.0)
        return replace(
            found,
            estimate=Estimate(found.estimate.structure, found.values, found.covariance + more),
            ci95_low=found.values - wider * (found.values - found.ci95_low),
            ci95_high=found.values + wider * (found.ci95_high - found.values),
            ultimate_gain_std=math.hypot(found.ultimate_gain_std, math.sqrt(gain)),
            ultimate_frequency_std=math.hypot(found.ultimate_frequency_std, math.sqrt(frequency)),
            warnings=(*found.warnings, warning),
        )

    def _ultimate(self, values: FloatArray) -> FloatArray:
        point = ultimate_point(self._build(values))
        return np.full(2, math.nan) if point is None else np.array([point.gain, point.frequency])


def _slopes(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Return derivatives to the upper side, shape (n, p)."""
    steps = np.where(at == 0.0, _STEP, _STEP * np.abs(at))
    return jacobian(function, at, steps, np.zeros(at.size))


# Ratio of residuals beyond the noise below which the end of a record alone is better.
_BETTER = 0.5

# Structures in which a load is searched for; empty: the one that was found without a load.
_SIMPLE = ("sopdt", "", "fopdt")

# Number of last cycles that are kept.
KEPT_CYCLES = 3


def _unexplained(found: Identification, record: Record) -> float:
    """Return a model's residual beyond the noise, as a root mean square [y]."""
    noise = 0.0 if math.isnan(record.noise_std) else record.noise_std
    return math.sqrt(max(found.fit.residual_rms**2 - noise**2, 0.0))


def last_cycles(record: Record, cycles: tuple[Cycle, ...]) -> Record | None:
    """Return the end of a record, from the begin of its last cycles on.

    A load that came before them is then part of the offset.

    :param record: the record.
    :param cycles: its whole cycles.
    :return: the end; None where nothing would be left out.
    """
    starts = record.cycle_start
    if len(cycles) < KEPT_CYCLES + 1 or len(starts) < len(cycles) + 1:
        return None
    first = starts[-(KEPT_CYCLES + 1)]
    return record.part(first, len(record))


def without_disturbance(
    found: Identification,
    record: Record,
    cycles: tuple[Cycle, ...],
    identify: Callable[[Record], Identification],
) -> Identification:
    """Identify the end of a record alone where that fits much better than the whole.

    :param found: what was identified from the whole record.
    :param record: the record.
    :param cycles: its whole cycles.
    :param identify: identifies a record by the same method.
    :return: the better identification; a warning tells what it left out, and ``fitted`` is NaN
        there.
    """
    end = last_cycles(record, cycles) if misfit(found, record) > 1.0 else None
    if end is None:
        return found
    try:
        alone = identify(end)
    except RelayAutotuneError:
        return found
    if not _unexplained(alone, record) < _BETTER * _unexplained(found, record):
        return found
    left_out = len(record) - len(end)
    fitted = alone.fitted
    if len(fitted) == len(end):
        fitted = np.concatenate((np.full(left_out, math.nan), fitted))
    warning = (
        f"all before {record.time[left_out]:.4g} s is left out, since no model fits it together "
        f"with the last {KEPT_CYCLES} cycles: a load or another disturbance came"
    )
    return replace(alone, fitted=fitted, warnings=(*alone.warnings, warning))


def with_its_load(
    found: Identification,
    record: Record,
    cycles: tuple[Cycle, ...],
    identify: Callable[[Record, str], Identification],
) -> tuple[Identification, Record]:
    """Estimate a load step together with the model, where no model fits without one.

    It is searched for in a simple structure first: a model that was fitted without the load has
    adapted to it.

    :param found: what was identified.
    :param record: the record.
    :param cycles: its whole cycles.
    :param identify: identifies a record in a structure by the method that fits samples; "": it
        chooses the structure.
    :return: the identification, and the record with the load added to its command; those given,
        where a load does not explain the misfit.
    """
    relay = record.settings is not None and bool(cycles)
    samples = relay and len(found.fitted) == len(record)
    if not samples or record.continuous_command or not is_contradicted(found, record):
        return found, record
    for structure in _SIMPLE:
        try:
            start = identify(record, structure) if structure else found
            chosen = identify_with_load(start, record, lambda part: identify(part, ""))
        except RelayAutotuneError:
            continue
        if chosen is not None and not is_contradicted(chosen[0], record):
            return chosen
    return found, record
