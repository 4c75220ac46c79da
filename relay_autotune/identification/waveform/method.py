# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Fit of a model to every sample of one or several records, by separable least squares.

The model is

    y(t_i) = sum_k c_k r_k(t_i; theta) + offset [+ drift t_i] [+ free initial state] + noise,

with r_k the exact responses to the recorded command, the dead time any real number. Which
structure, and whether drift and initial state belong to it, is decided by the Bayesian
information criterion. Several records of one process share c and theta; each has its own offset,
drift and initial state.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import LOSSES, NOTHING, Known
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.choice import (
    ANSWERED,
    SIMPLE,
    TRIED,
    NoResponseError,
    ahead_of_command,
    chosen_fit,
    names_not_hopeless,
    odds_of_response,
)
from relay_autotune.identification.waveform.findings import report
from relay_autotune.identification.waveform.fit_covariance import (
    Fit,
    quantisation_step,
    raw_residual,
)
from relay_autotune.identification.waveform.past import MANY
from relay_autotune.identification.waveform.problem import (
    NEGLIGIBLE,
    Problem,
    motions_of,
    problem_of,
    with_terms_of,
)
from relay_autotune.identification.waveform.rational import unit_steps
from relay_autotune.identification.waveform.residuals import scale_of, slow_colour, weights
from relay_autotune.identification.waveform.separable import (
    TRIAL,
    Trial,
    evaluate,
    information_criterion,
    refine,
)
from relay_autotune.process.response import response
from relay_autotune.process.structures import FOPDT, TABLE
from relay_autotune.record.cycles import runs_of
from relay_autotune.record.excitation import MOST_AWAY, at_its_ends, jumped_away, smooth
from relay_autotune.record.moves import changes_within, moves_always
from relay_autotune.record.record import Input, PiecewiseConstant, Record, roughness
from relay_autotune.text import counted, digits

# Number of samples from which even a coarse measurement takes more than two values, and how many
# times as often as it the command moves where the two are exchanged: in 90 recordings of plants
# 1.6 times at most, and 7 times at least with exchanged columns of steps in an open loop.
_ENOUGH_FOR_TWO, _EXCHANGED = 20, 4.0
_LEAST_SAMPLES = 12
# Largest number of samples that are fitted: beyond, noise does not limit what is known.
_MOST_SAMPLES = 2_000_000
# Standard deviations of a spike, and the most samples of one.
_OUTLIER, _SPIKE = 6.0, 3
# Distance from the end of its range within which the mean of a few samples stays there, in
# standard deviations of the noise and as a share of the range; samples that show whether the model
# moves on.
_STILL_NOISE, _STILL, _FEW = 3.0, 0.02, 500
# Odds of a response, as a score, from which it is not sought a second time, which takes as long as
# the first.
_OVERWHELMING = 200.0
# Ratio of two records' noise up to which they count as equal.
_ALIKE = 1.2
_MOST_ROUNDS = 20
_STEADY = 0.02
_LEAST_NOISE = 1e-3

# Fits samples with the best of all structures, or of those that are named.
Choose = Callable[..., Fit]


def identify_waveform(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a model from all samples of a record.

    :param record: any record whose command moves; baseline samples before the test help.
    :param known: its structure is fitted; by default that of the best score. Its loss is
        minimised.
    :raises IdentificationError: if the record holds too little, or no response to the command.
    """
    return identify_waveform_jointly((record,), known)


def identify_waveform_jointly(records: Sequence[Record], known: Known = NOTHING) -> Identification:
    """Identify one model from all samples of several records of one process.

    Each record is weighted by its noise.

    :param records: at least one; the results for single samples are those of the first.
    :param known: as for :func:`identify_waveform`.
    :raises IdentificationError: if a record holds too little, the relays' directions differ, or
        there is no response to the command.
    """
    if known.structure and known.structure not in TABLE:
        raise IdentificationError(
            f"the waveform fit has no structure {known.structure!r}; it has {', '.join(TABLE)}"
        )
    inputs = [record.drive() for record in records]
    for record, u in zip(records, inputs, strict=True):
        _require_content(record, u)
    # In units of its own range, so that no unit of measurement is too large or too small.
    scale = max(
        max(float(np.ptp(y)), float(np.abs(y).max()) * 1e-6) for y in _without_jumps(records)
    )
    problem = problem_of(
        [
            (record.time, (record.measurement - record.measurement[0]) / scale, u)
            for record, u in zip(records, inputs, strict=True)
        ],
        FOPDT,
    )
    problem = replace(
        problem,
        motions=motions_of(problem.time, problem.y, inputs[0]) if len(records) == 1 else (),
    )
    samples, problem = problem.time.size, problem.thinned(_MOST_SAMPLES)
    sign = _sign(records)
    alike = list(filter(None, map(_exchanged, records)))
    try:
        fit = _best_fit(
            problem, known, sign, scale, held=any(r.settings is not None for r in records)
        )
    except IdentificationError as error:
        raise IdentificationError("; ".join([str(error), *alike])) from error
    if problem.time.size < samples:
        warning = (
            f"of {samples} samples {problem.time.size} were fitted, evenly spread: more would "
            "take memory and add nothing"
        )
        fit = replace(fit, warnings=(*fit.warnings, warning))
    fit = replace(fit, warnings=(*alike, *fit.warnings))
    found = report(records, fit)
    return found if fit.plain is None else replace(found, plain=partial(_plain_fit, records, fit))


def _plain_fit(records: Sequence[Record], fit: Fit) -> Identification | None:
    """Return the FOPDT that was fitted beside a model; None if it cannot be fitted to the end."""
    assert fit.plain is not None
    plain = fit.plain()
    return None if plain is None else report(records, replace(plain, warnings=fit.warnings))


def _best_fit(problem: Problem, known: Known, sign: int, scale: float, *, held: bool) -> Fit:
    """Return the best fit, with each experiment weighted by its noise, and without spikes.

    Where a response is not nearly certain in open loop, the search runs a second time, with the
    noise taken for a slow disturbance. The fit with the better odds of a response is returned.

    :raises NoResponseError: if neither search shows a response.
    """

    def chosen(samples: Problem, among: Sequence[str] = TRIED, before: Fit | None = None) -> Fit:
        return chosen_fit(samples, known, sign, scale, held=held, among=among, before=before)

    @cache
    def first(samples: Problem) -> Fit:
        return chosen(samples)

    problem, dropped = _without_dropouts(problem, first)
    stopped = ""
    if not sign and len(problem.bounds) == 1:
        # Under a relay it turns around.
        problem, stopped = _without_stops(problem, chosen)

    def searched(samples: Problem) -> tuple[float, Fit | None]:
        try:
            fit = _weighted_by_noise(samples, first(samples), chosen)
            fit = _without_spikes(samples, fit, known, chosen)
        except NoResponseError:
            return -math.inf, None
        return odds_of_response(fit.problem, fit.state), fit

    odds, fit = searched(problem)
    parts = zip(problem.experiments, problem.inputs, strict=True)
    open_loop = not held and all(_moves_often(problem.time[part], u) for part, u in parts)
    if odds < _OVERWHELMING and open_loop:
        # Beside a slow disturbance, what moves from sample to sample shows the response.
        slow = replace(problem, colour=slow_colour(problem.time.size))
        likelier, other = searched(slow)
        if likelier > odds + ANSWERED:
            odds, fit = likelier, other
    if fit is None or odds <= ANSWERED:
        raise NoResponseError(known)
    if not held and (ahead := ahead_of_command(fit.problem, fit.state)):
        raise IdentificationError(
            f"the measurement moves {digits(ahead, 2)} s before the recorded command, which is "
            "recorded late and hides the dead time, or is not the one that acts: record it when "
            "it is sent, on the clock of the measurement, and as the actuator gets it"
        )
    return replace(fit, warnings=(*fit.warnings, *filter(None, (dropped, stopped))))


def _moves_often(time: FloatArray, u: Input) -> bool:
    """Return whether a command moves many times, and not as a controller's does."""
    return changes_within(u, time).size >= MANY and not moves_always(time, u)


def _without_stops(problem: Problem, chosen: Choose) -> tuple[Problem, str]:
    """Return the samples before or after a stop or the end of a sensor's range, and a warning.

    At a stop the measurement stays at an end of its range, and a model of the samples before it
    moves on. The side with more moves of the command is kept, because it tells more.

    :param problem: all samples.
    :param chosen: fits samples.
    """
    u = problem.inputs[0]
    if not isinstance(u, PiecewiseConstant):
        return problem, ""
    band = max(_STILL_NOISE * roughness(problem.y), _STILL)
    for begin, stop, away in at_its_ends(smooth(problem.y), band):
        before = problem.part(slice(0, begin))
        held = problem.time[begin : (begin + stop) // 2]
        changes = changes_within(u, before.time)
        if not changes.size or changes_within(u, held).size:
            # A controller, or a further command, may have made it stay.
            continue
        earlier = (before.time < changes[-1]) & (u(before.time) == u(held)[0])
        there = np.abs(before.y[earlier] - np.median(problem.y[begin:stop])) <= band
        if 2 * np.count_nonzero(there) >= stop - begin:
            # The same command held it there before, about as long: it comes to rest.
            continue
        try:
            # Any model that follows the record tells whether it moves on.
            fit = chosen(before.thinned(_FEW), SIMPLE)
        except IdentificationError:
            continue
        model = fit.problem.structure.model_at(fit.state.theta, fit.state.coefficients)
        if model is None or model.grows:
            continue
        on = response(model, problem.time[begin:stop], u)
        if float(np.median(on[1:] - on[0])) / away > 1.0 and _is_stop(
            problem.part(slice(0, stop)), begin, fit, chosen
        ):
            after = problem.part(slice(stop, None))
            warning = (
                f"from {problem.time[begin]:.4g} s on the measurement stays at an end of its "
                "range, where the process would move on: a stop, or the sensor's end; it and all "
            )
            if changes_within(u, after.time).size <= changes.size:
                return before, f"{warning}after it were left out"
            after, more = _without_stops(after, chosen)
            return after, "; ".join(filter(None, (f"{warning}before it were left out", more)))
    return problem, ""


def _is_stop(problem: Problem, begin: int, before: Fit, chosen: Choose) -> bool:
    """Return whether no process explains a stay as well as a constant does.

    :param problem: the samples up to the end of the stay.
    :param begin: its first sample.
    :param before: a fit of those before it.
    :param chosen: fits samples.
    """
    try:
        whole = chosen(problem.thinned(_FEW), SIMPLE)
    except NoResponseError:
        return True
    from_level = np.abs(problem.y[begin:] - np.median(problem.y[begin:]))
    # On its way there it still moves.
    begin += int(np.argmax(from_level <= _STILL_NOISE * roughness(problem.y)))
    away = np.arange(problem.y.size) >= begin
    # A load that comes just there is no process that goes on.
    return whole.problem.load is not None or _has_a_level_of_its_own(problem, before, whole, away)


def _has_a_level_of_its_own(
    problem: Problem, rest: Fit, whole: Fit, away: NDArray[np.bool_]
) -> bool:
    """Return whether samples with a level of their own explain more than a process does.

    :param problem: all samples.
    :param rest: a fit of some of the others.
    :param whole: a fit of some of all.
    :param away: which samples these are, shape (n,).
    """
    n, floor = away.size, away.size * NEGLIGIBLE**2
    runs = runs_of(away)
    apart = float(np.sum(~away)) * _innovation_of(rest, problem.part(~away))
    apart += sum((stop - begin) * float(np.var(problem.y[begin:stop])) for begin, stop in runs)
    # Each level and its first and last instants are estimated; the last may be the record's.
    parameters = 3 * len(runs) - int(away[-1]) + rest.state.parameters
    together = information_criterion(
        n * _innovation_of(whole, problem), n, whole.state.parameters, floor
    )
    return together - information_criterion(apart, n, parameters, floor) > ANSWERED


def _innovation_of(fit: Fit, problem: Problem) -> float:
    """Return the mean square of what neither a model nor the colour of its noise tells of samples.

    :param fit: perhaps of some of them.
    :param problem: the samples.
    """
    # A colour is of samples at one distance.
    every = slice(None, None, int(np.median(np.diff(fit.problem.index))))
    some = with_terms_of(fit.problem, problem.part(every))
    state = evaluate(replace(some, colour=fit.problem.colour), fit.state.theta)
    return state.cost / state.residual.size


def _without_dropouts(problem: Problem, chosen: Callable[[Problem], Fit]) -> tuple[Problem, str]:
    """Return the samples without those of a sensor that dropped out, and a warning.

    A fast process jumps, too. Its samples are kept: its best model explains the jumps.

    :param problem: all samples.
    :param chosen: fits samples with the best of all structures.
    """
    away = jumped_away(problem.y)
    if len(problem.bounds) > 1 or not np.any(away):
        return problem, ""
    back = problem.time[: int(np.argmin(away)) + 1]
    if away[0] and changes_within(problem.inputs[0], back).size:
        # It may as well be the answer to a command that ends a rest.
        return problem, ""
    there = problem.part(~away)
    try:
        rest = chosen(there)
    except NoResponseError:
        return problem, ""
    with contextlib.suppress(NoResponseError):
        whole = chosen(problem)
        if not _has_a_level_of_its_own(problem, rest, whole, away):
            return problem, ""
    warning = (
        f"left out: {counted(int(away.sum()), 'sample')} beyond a jump that no process makes, "
        f"the first at {problem.time[np.argmax(away)]:.4g} s; check the sensor for dropouts"
    )
    # Smaller jumps stand out once the largest are left out.
    there, more = _without_dropouts(there, chosen)
    return there, "; ".join(filter(None, (warning, more)))


def _without_jumps(records: Sequence[Record]) -> list[FloatArray]:
    """Return what each record measures where its sensor has not dropped out."""
    return [y[~jumped_away(y)] for y in (r.measurement for r in records)]


def _sign(records: Sequence[Record]) -> int:
    """Return the direction in which the relays worked; 0: not known."""
    found = {
        -1 if record.settings.reverse_acting else 1
        for record in records
        if record.settings is not None
    }
    if len(found) > 1:
        raise IdentificationError(
            "one of the tests had a reverse-acting relay and another did not: they are not of "
            "one process"
        )
    return found.pop() if found else 0


def _weighted_by_noise(problem: Problem, fit: Fit, chosen: Choose) -> Fit:
    """Fit again with each experiment weighted by its noise, where noises differ."""
    parts = fit.problem.experiments
    if len(parts) == 1:
        return fit
    noise = _noise_of_each(fit.problem, fit.state)
    if noise.min() <= NEGLIGIBLE or noise.max() <= _ALIKE * noise.min():
        return fit
    part, state = fit.problem, fit.state
    for _ in range(_MOST_ROUNDS):
        # Noisy experiments pulled the fit, so the noise found in the others was wrong.
        earlier, part = noise, _weighted(part, noise)
        state = refine(part, state.theta, tolerance=TRIAL)
        noise = _noise_of_each(part, state)
        if float(np.abs(noise / earlier - 1.0).max()) <= _STEADY:
            break
    return chosen(_weighted(problem, noise))


def _noise_of_each(problem: Problem, state: Trial) -> FloatArray:
    residual = raw_residual(problem, state)
    noise = np.sqrt([np.mean(residual[part] ** 2) for part in problem.experiments])
    # An experiment without noise outweighs all others, but its weight stays finite.
    return np.asarray(np.maximum(noise, _LEAST_NOISE * noise.max()))


def _weighted(problem: Problem, noise: FloatArray) -> Problem:
    weight = np.empty(problem.time.size)
    for part, size in zip(problem.experiments, noise, strict=True):
        weight[part] = noise.min() / size
    return replace(problem, weight=weight)


def _without_spikes(problem: Problem, fit: Fit, known: Known, chosen: Choose) -> Fit:
    """Fit again without isolated spikes, or with the loss that was asked for."""
    base = np.ones(problem.time.size)
    if fit.problem.weight is not None:
        base[_places(problem, fit.problem)] = fit.problem.weight
    if known.loss != LOSSES[0]:
        # Outliers may have pulled the choice too: it is made again with the first weights.
        first, weight = _reweighted(problem, fit, known.loss, base), base.copy()
        weight[_places(problem, first.problem)] = first.problem.weight
        again = chosen(replace(problem, weight=weight))
        return _of_weighted_samples(_reweighted(problem, again, known.loss, base))
    outlying = _outliers(problem, fit.problem, fit.state)
    if not np.any(outlying):
        return fit
    # Spikes pull the choice of the structure as well as the fit.
    rest = replace(problem, weight=base) if len(problem.bounds) > 1 else problem
    # Spikes hide differences: a structure that was hopeless with them is hopeless without.
    again = chosen(rest.part(~outlying), names_not_hopeless(fit), fit)
    warning = (
        f"left out: {counted(int(np.sum(outlying)), 'sample')} more than {_OUTLIER:g} standard "
        "deviations off every model; check the sensor for spikes"
    )
    return replace(again, warnings=(*fit.warnings, warning))


def _reweighted(whole: Problem, fit: Fit, loss: str, base: FloatArray) -> Fit:
    """Iterate the weights of a loss to convergence, beside those of the experiments."""
    problem, state = fit.problem, fit.state
    own = base[_places(whole, problem)]
    for _ in range(_MOST_ROUNDS):
        residual = own * raw_residual(problem, state)
        scale = max(scale_of(residual), NEGLIGIBLE)
        problem = replace(problem, weight=own * np.sqrt(weights(residual, scale, loss)))
        earlier, state = state, refine(problem, state.theta, tolerance=TRIAL)
        change = np.abs(state.theta - earlier.theta) / unit_steps(problem.structure, state.theta)
        if float(change.max()) <= TRIAL:
            break
    return replace(fit, problem=problem, state=state, base=own, loss=loss, plain=None)


def _of_weighted_samples(fit: Fit) -> Fit:
    """Return a fit without the samples of which its loss takes nothing."""
    assert fit.problem.weight is not None and fit.base is not None
    some = np.flatnonzero(fit.problem.weight)
    problem = fit.problem.part(some)
    return replace(
        fit, problem=problem, state=evaluate(problem, fit.state.theta), base=fit.base[some]
    )


def _places(whole: Problem, part: Problem) -> NDArray[np.int64]:
    """Return where the samples of a part are among those of the whole."""
    return np.searchsorted(whole.index, part.index)


def _outliers(whole: Problem, problem: Problem, state: Trial) -> NDArray[np.bool_]:
    """Return which samples are spikes, which neither model nor noise explains, shape (n,).

    :param whole: all samples.
    :param problem: what was fitted of them.
    :param state: the fit.
    """
    found, white = np.zeros(whole.time.size, dtype=bool), replace(problem, colour=None)
    left, n = raw_residual(problem, state), np.arange(problem.y.size)
    error = white.seen(left)
    middle, width = float(np.median(error)), scale_of(error)
    # A coarse sensor is now and then a step off, however narrow the bulk of its errors is.
    most = max(_OUTLIER * width + quantisation_step(whole.y), NEGLIGIBLE)
    far = np.abs(error - middle) > most
    if not (width > NEGLIGIBLE and 0.0 < far.mean() <= MOST_AWAY):
        return found
    # More of them in a row, or neighbours that miss the model as well: the model lacks something.
    across = white.seen(np.interp(n, n[~far], problem.y[~far]) - problem.y + left) - middle
    longest = max(stop - begin for begin, stop in runs_of(far))
    if longest <= _SPIKE and np.abs(across[far]).max() <= most:
        found[_places(whole, problem)] = far
    return found


def _require_content(record: Record, u: Input) -> None:
    time, y = record.time, record.measurement
    if y.size < _LEAST_SAMPLES:
        raise IdentificationError(
            f"the record holds {counted(y.size, 'sample')}; a fit needs at least "
            f"{_LEAST_SAMPLES}: record longer"
        )
    if not np.ptp(time) > 0.0:
        raise IdentificationError("all samples of the record have the same time")
    if not changes_within(u, time).size:
        raise IdentificationError(
            "the command never changes within the record: nothing excites the process, "
            "so that no model can be found; record a relay test or a step"
        )
    if np.ptp(y) == 0.0:
        raise IdentificationError(
            f"the measurement is constant at {y[0]:g} although the command changes: check the "
            "sensor, the actuator and that both topics belong to one loop"
        )
    if np.all((y == y.min()) | (y == y.max())) and (problem := _exchanged(record)):
        raise IdentificationError(problem)


def _exchanged(record: Record) -> str:
    """Return what to look at where the measurement moves as commands do; empty: it does not."""
    y, u = record.measurement, record.command
    levels, (moves, changes) = np.unique(y), (np.count_nonzero(np.diff(x)) for x in (y, u))
    if y.size < _ENOUGH_FOR_TWO:
        return ""
    if levels.size == 2:
        how = f"takes two values only, {levels[0]:g} and {levels[1]:g}, as a relay's command does"
    elif changes >= _EXCHANGED * moves and np.unique(u).size > levels.size:
        how = f"moves in {moves} of {y.size} samples and the command in {changes}"
    else:
        return ""
    return (
        f"the measurement {how}: check that the two are not the wrong way round, or raise the "
        "amplitude above the sensor's step"
    )
