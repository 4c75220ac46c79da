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

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import LOSSES, NOTHING, Known
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.coloured import (
    in_colour,
    is_an_event,
    is_clearly_coloured,
    is_coloured,
)
from relay_autotune.identification.waveform.findings import report
from relay_autotune.identification.waveform.fit_covariance import NEGLIGIBLE, Fit, raw_residual
from relay_autotune.identification.waveform.rational import unit_steps
from relay_autotune.identification.waveform.residuals import scale_of, weights
from relay_autotune.identification.waveform.selection import (
    Candidate,
    Ground,
    after_the_unknown,
    choose,
    fit_all,
    fit_one,
    of_shown_direction,
)
from relay_autotune.identification.waveform.separable import (
    Problem,
    Trial,
    information_criterion,
    left_of,
    problem_of,
    refine,
)
from relay_autotune.identification.waveform.starts import changes_within
from relay_autotune.process.structures import FOPDT, TABLE
from relay_autotune.record.record import Input, Record

# Number of samples from which even a coarse measurement takes more than two values.
_ENOUGH_FOR_TWO = 20
_LEAST_SAMPLES = 12
_MOST_FOR_CHOICE = 16_384
# Largest number of samples that are fitted: beyond, noise does not limit what is known.
_MOST_SAMPLES = 2_000_000
_OUTLIER = 6.0
_MOST_OUTLIERS = 0.02
# Ratio of two records' noise up to which they count as equal.
_ALIKE = 1.2
# Gain in the criterion that the best of all dead times and structures reaches on noise alone.
_SEARCHED = 10.0
_MOST_ROUNDS = 20
_SETTLED = 1e-6
_STEADY = 0.02
_LEAST_NOISE = 1e-3
_NO_RESPONSE = (
    "the measurement shows no response to the command beyond its noise: raise the amplitude, or "
    "check that both topics belong to one loop"
)
_SEEN = "a response that the samples show (it is over between two of them)"


def identify_waveform(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a model from all samples of a record.

    :param record: any record whose command moves; baseline samples before the test help.
    :param known: its structure is fitted; by default the simplest that explains the data. Its
        loss is minimised.
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
        _require_content(record.time, record.measurement, u)
    # In units of its own range, so that no unit of measurement is too large or too small.
    scale = max(max(float(np.ptp(y)), float(np.abs(y).max()) * 1e-6) for y in _measured(records))
    problem = problem_of(
        [
            (record.time, (record.measurement - record.measurement[0]) / scale, u)
            for record, u in zip(records, inputs, strict=True)
        ],
        FOPDT,
    )
    problem = replace(problem, averaged=any(r.unthinned is not None for r in records))
    samples, problem = problem.time.size, problem.thinned(_MOST_SAMPLES)
    sign = _sign(records)
    fit = _explained(
        problem, known, sign, scale, held=any(r.settings is not None for r in records)
    )
    _require_response(fit.problem, fit.state)
    if problem.time.size < samples:
        told = (
            f"of {samples} samples {problem.time.size} were fitted, evenly spread: more would "
            "take memory and add nothing"
        )
        fit = replace(fit, warnings=(*fit.warnings, told))
    return report(records, fit)


def _explained(problem: Problem, known: Known, sign: int, scale: float, *, held: bool) -> Fit:
    """Fit by least squares, or in the colour of the noise where that is not white."""
    # The choice among all structures takes longest on such data; one alone is soon fitted.
    free = not held and known.loss == LOSSES[0] and not known.structure
    clear = free and is_clearly_coloured(problem, sign)
    if clear:
        coloured = in_colour(problem, scale, known, sign, held=held)
        if coloured is not None and _responds(coloured.problem, coloured.state, _SEARCHED):
            return coloured
    fit = _fit(problem, known, sign, scale)
    fit = _by_noise(problem, fit, known, sign)
    fit = _spared_of_outliers(problem, fit, known, sign)
    if clear or not is_coloured(fit) or (held and is_an_event(fit)):
        return fit
    rest = replace(fit.problem, structure=FOPDT)
    coloured = in_colour(rest, scale, known, sign, held=held)
    if coloured is None or not _responds(coloured.problem, coloured.state, _SEARCHED):
        return fit
    return replace(coloured, warnings=fit.warnings)


def _measured(records: Sequence[Record]) -> list[FloatArray]:
    return [record.measurement for record in records]


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


def _fit(problem: Problem, known: Known, sign: int, scale: float) -> Fit:
    # The choice on some thousand samples is the same as on a million.
    part = problem.thinned(_MOST_FOR_CHOICE)
    ground = Ground.of(part, part.time.size * NEGLIGIBLE**2, sign)
    candidates = _candidates(ground, known)
    rest = candidates if sign or known.structure else of_shown_direction(candidates)
    while rest:
        picked = choose(rest)
        chosen = ground.with_nuisances(picked)
        nuisances = chosen.problem
        whole = replace(
            problem,
            structure=nuisances.structure,
            drift=nuisances.drift,
            relaxation=nuisances.relaxation,
            past=nuisances.past,
        )
        whole = after_the_unknown(whole, chosen.state)
        state = refine(whole, chosen.state.theta)
        # With a drift, a fit may still run off to a model that is no process; and where no
        # structure explains a disturbance, the simplest may explain nothing at all.
        if ground.candidate(whole, state) is not None and (
            known.structure or len(rest) == 1 or _responds(whole, state)
        ):
            return Fit(whole, state, (chosen,) if known.structure else tuple(rest), scale)
        rest = [c for c in rest if c is not picked]
    raise _without_a_model(
        ground,
        candidates,
        "no structure fits the record with a process that the samples can show: record longer, or "
        "check that command and measurement belong to one loop",
    )


def _by_noise(problem: Problem, fit: Fit, known: Known, sign: int) -> Fit:
    """Fit again with each experiment weighted by its noise, where noises differ."""
    parts = fit.problem.experiments
    if len(parts) == 1:
        return fit
    noise = _noise_of_each(fit.problem, fit.state)
    if noise.min() <= NEGLIGIBLE or noise.max() <= _ALIKE * noise.min():
        return fit
    part, state = fit.problem, fit.state
    for _ in range(_MOST_ROUNDS):
        # The noisy experiments pulled the fit, which changed the noise found in the others.
        earlier, part = noise, _weighted(part, noise)
        state = refine(part, state.theta, tolerance=_SETTLED)
        noise = _noise_of_each(part, state)
        if float(np.abs(noise / earlier - 1.0).max()) <= _STEADY:
            break
    return _fit(_weighted(problem, noise), known, sign, fit.scale)


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


def _spared_of_outliers(problem: Problem, fit: Fit, known: Known, sign: int) -> Fit:
    """Fit again without isolated spikes, or with the loss that was asked for."""
    base = np.ones(problem.time.size)
    if fit.problem.weight is not None:
        base[_places(problem, fit.problem)] = fit.problem.weight
    if known.loss != LOSSES[0]:
        # Outliers may have pulled the choice too: it is made again with the first weights.
        first, weight = _reweighted(problem, fit, known.loss, base), base.copy()
        weight[_places(problem, first.problem)] = first.problem.weight
        again = _fit(replace(problem, weight=weight), known, sign, fit.scale)
        return _reweighted(problem, again, known.loss, base)
    outlying = _outliers(problem, fit.problem, fit.state)
    if not np.any(outlying):
        return fit
    # They would pull both the choice and the fit.
    rest = replace(problem, weight=base) if len(problem.bounds) > 1 else problem
    again = _fit(rest.part(~outlying), known, sign, fit.scale)
    told = (
        f"{int(np.sum(outlying))} of the samples lie more than {_OUTLIER:g} standard deviations "
        "off every model and were left out: check the sensor for spikes"
    )
    return replace(again, warnings=(told,))


def _reweighted(whole: Problem, fit: Fit, loss: str, base: FloatArray) -> Fit:
    """Iterate the weights of a loss to convergence, beside those of the experiments."""
    problem, state = fit.problem, fit.state
    own = base[_places(whole, problem)]
    for _ in range(_MOST_ROUNDS):
        residual = own * raw_residual(problem, state)
        scale = max(scale_of(residual), NEGLIGIBLE)
        problem = replace(problem, weight=own * np.sqrt(weights(residual, scale, loss)))
        earlier, state = state, refine(problem, state.theta, tolerance=_SETTLED)
        change = np.abs(state.theta - earlier.theta) / unit_steps(problem.structure, state.theta)
        if float(change.max()) <= _SETTLED:
            break
    return replace(fit, problem=problem, state=state, base=own, loss=loss)


def _places(whole: Problem, part: Problem) -> NDArray[np.int64]:
    """Return where the samples of a part are among those of the whole."""
    return np.searchsorted(whole.index, part.index)


def _outliers(whole: Problem, problem: Problem, state: Trial) -> NDArray[np.bool_]:
    """Return which samples no noise of the residual's own width explains, shape (n,).

    :param whole: all samples.
    :param problem: what was fitted of them.
    :param state: the fit.
    """
    found = np.zeros(whole.time.size, dtype=bool)
    error = np.abs(state.residual - np.median(state.residual))
    width = scale_of(state.residual)
    far = error > max(_OUTLIER * width, NEGLIGIBLE)
    # Many of them, or several in a row, are not spikes but something that the model lacks.
    alone = far & ~np.roll(far, 1) & ~np.roll(far, -1)
    if width > NEGLIGIBLE and np.sum(far) == np.sum(alone) <= _MOST_OUTLIERS * found.size:
        found[_places(whole, problem)] = far
    return found


def _candidates(ground: Ground, known: Known) -> list[Candidate]:
    if not known.structure:
        candidates = fit_all(ground)
        if not candidates:
            raise _without_a_model(
                ground,
                (),
                "no structure explains the record with "
                + ("a gain in the direction of the relay" if ground.sign else _SEEN)
                + ": check that command and measurement belong to one loop",
            )
        return candidates
    found = fit_one(ground, known.structure, known.order)
    if found is None:
        raise _without_a_model(
            ground,
            (),
            f"no {known.structure} model explains the record; leave the structure open to have "
            "it chosen",
        )
    return [found]


def _without_a_model(
    ground: Ground, candidates: Sequence[Candidate], why: str
) -> IdentificationError:
    """Return the reason why a record gives no model.

    Which fits to noise run off, and so whether one is left to be asked for its response, turns on
    the last digit. So all fits are asked.

    :param ground: what was fitted.
    :param candidates: the structures that could be read as a process.
    :param why: no model is left, where there is a response.
    """
    fits = [(ground.problem, ground.fopdt), *((c.problem, c.state) for c in candidates)]
    if any(_responds(problem, state, _SEARCHED) for problem, state in fits):
        return IdentificationError(why)
    return IdentificationError(_NO_RESPONSE)


def _require_content(time: FloatArray, y: FloatArray, u: Input) -> None:
    if y.size < _LEAST_SAMPLES:
        raise IdentificationError(
            f"the record holds {y.size} samples; a fit needs at least {_LEAST_SAMPLES}: "
            "record longer"
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
    if y.size >= _ENOUGH_FOR_TWO and np.all((y == y.min()) | (y == y.max())):
        raise IdentificationError(
            f"the measurement takes two values only, {y.min():g} and {y.max():g}, as a relay's "
            "command does: check that the two are not the wrong way round, or raise the amplitude "
            "above the sensor's step"
        )


def _responds(problem: Problem, state: Trial, evidence: float = 0.0) -> bool:
    """Return whether a fit explains more than its parameters cost, beside drift and the like.

    :param problem: what was fitted.
    :param state: its fit.
    :param evidence: by how much more, in units of the criterion.
    """
    n, floor = problem.y.size, problem.y.size * NEGLIGIBLE**2
    nuisance = state.columns[len(problem.structure.powers) :]
    y = problem.seen(problem.y)
    left = left_of(y, nuisance)
    without = information_criterion(float(left @ left), n, nuisance.shape[0], floor)
    return information_criterion(state.cost, n, state.parameters, floor) < without - evidence


def _require_response(problem: Problem, state: Trial) -> None:
    if not _responds(problem, state, _SEARCHED):
        raise IdentificationError(_NO_RESPONSE)
