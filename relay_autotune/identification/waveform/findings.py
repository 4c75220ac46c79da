# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The results of a waveform fit: model, covariance, rivals, quality of the fit, warnings.

The uncertainty of K_u and w_u includes the choice of the structure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, student_95
from relay_autotune.identification.result import (
    FitReport,
    Identification,
    Rival,
    identified,
    point_of,
)
from relay_autotune.identification.waveform.candidates import support
from relay_autotune.identification.waveform.determination import with_what_is_determined
from relay_autotune.identification.waveform.fit_covariance import (
    Fit,
    coarse_step,
    estimate_of,
    noise_inflation,
    raw_residual,
)
from relay_autotune.identification.waveform.posterior import posterior
from relay_autotune.identification.waveform.problem import NEGLIGIBLE, Problem, middle_of
from relay_autotune.identification.waveform.rational import unit_steps
from relay_autotune.identification.waveform.residuals import ljung_box
from relay_autotune.identification.waveform.separable import (
    TRIAL,
    Trial,
    refine,
    rms_in_simulation,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.moves import only_move
from relay_autotune.record.record import Record
from relay_autotune.text import digits

_UNEXPLAINED = 1.5
_WORTH_TELLING = 1e-3
_OPEN = 0.01


def report(records: Sequence[Record], fit: Fit) -> Identification:
    """Return the identification that a fit gives.

    :param records: what was fitted.
    :param fit: the fit.
    :raises IdentificationError: if the fit left its structure.
    """
    fit = _levelled(fit)
    problem, state, scale = fit.problem, fit.state, fit.scale
    n = problem.time.size
    residual = raw_residual(problem, state)
    rms = scale * math.sqrt(float(residual @ residual) / n)
    exact = rms <= scale * NEGLIGIBLE
    shares = support(fit.candidates)
    inflation = noise_inflation(records, rms, fit)
    allowed = posterior(fit, shares, inflation, _frequency(fit))
    estimate = estimate_of(problem, state, fit, inflation * allowed.temper)
    if estimate is None:
        raise IdentificationError(
            f"the fit of a {problem.structure.name} model left its structure; name another "
            "structure"
        )
    spread = scale * math.sqrt(
        sum(float(np.sum((problem.y[p] - problem.y[p].mean()) ** 2)) for p in problem.experiments)
        / n
    )
    quality = FitReport(
        residual_rms=rms,
        noise_std=_measured_noise(records),
        fit=1.0 - rms / spread if spread > 0.0 else math.nan,
        whiteness_p=math.nan if exact else ljung_box(residual),
        prediction=scale * _prediction(records, problem, state),
    )
    quantile = student_95(n - state.parameters)
    at = estimate.structure.names.index("gain")
    known_to = quantile * estimate.std[at] / abs(estimate.values[at])
    warnings = (*fit.warnings, *_warnings(records, quality, fit, residual, known_to))
    found = identified(
        "waveform",
        estimate,
        quantile,
        fit=quality,
        warnings=warnings,
        fitted=_fitted(records, fit, residual),
    )
    # One of each opposite pair: the other one has the same square.
    gain_std, frequency_std = point_stds(found, allowed.mixture[::2])
    if found.ultimate_frequency * min(r.interval for r in records) > math.pi:
        # Samples show nothing of what is faster than half their rate.
        gain_std = frequency_std = math.nan
        warning = (
            f"the model's ultimate frequency of {found.ultimate_frequency:.3g} rad/s is beyond "
            "half the rate of the samples: the record does not show K_u and w_u"
        )
        found = replace(found, warnings=(*found.warnings, warning))
    found = _with_rivals(found, fit, shares)
    found = replace(
        found,
        ultimate_gain_std=gain_std,
        ultimate_frequency_std=frequency_std,
        draws=allowed.models,
        parts=allowed.parts,
        opposed=fit.opposed() if fit.opposed else 0.0,
        effects=problem.effects(state.coefficients),
        middle=middle_of(problem.inputs[0]) if problem.unequal else math.nan,
        ends=problem.ends_of(state.coefficients),
        rate=problem.rate or math.inf,
        began_away=_began_away(records, fit),
        moved_before=problem.past,
        loaded=problem.load is not None,
        play=problem.play_of(state.coefficients),
        friction=problem.dry_friction(state.coefficients),
        to_explain=scale * rms_in_simulation(problem, state.coefficients, state.theta)[1],
    )
    apart = f"{math.sqrt(allowed.temper):.2g}"
    if float(apart) > 1.0:
        warning = (
            f"two {'records' if len(records) > 1 else 'parts of the record'} give models that "
            f"differ {apart} times "
            "as much as their noise explains: the process, its load or its operating point "
            "changed; intervals are widened to hold both, and gains have to hold on both"
        )
        found = replace(found, warnings=(*found.warnings, warning))
    return with_what_is_determined(found, records, allowed, quantile)


def _levelled(fit: Fit) -> Fit:
    """Return a fit with the offset and the drift with which it simulates the record best.

    A colour near a random walk says next to nothing of either.
    """
    problem, state = fit.problem, fit.state
    if problem.colour is None:
        return fit
    lines = len(problem.bounds) * (1 + problem.drift)
    columns = problem.columns(state.theta)
    rows, left = columns[-lines:], problem.y - state.coefficients @ columns
    coefficients = state.coefficients.copy()
    coefficients[-lines:] += np.linalg.lstsq(rows.T, left, rcond=None)[0]
    return replace(fit, state=replace(state, coefficients=coefficients))


def point_stds(found: Identification, mixture: Sequence[TransferFunction]) -> tuple[float, float]:
    """Return the standard deviations of K_u and w_u over all models that a record allows.

    They are the root mean squares of the logarithms of their ratios to the chosen model's: within
    each structure, and between them (Buckland, Burnham and Augustin 1997).

    :param found: the chosen model.
    :param mixture: the models.
    """
    own = np.array((found.ultimate_gain, found.ultimate_frequency))
    ratios = np.array([point_of(m) for m in mixture]).reshape(-1, 2) / own
    ratios = ratios[np.all(ratios > 0.0, axis=1)]
    if not ratios.size:
        return math.nan, math.nan
    gain_std, frequency_std = np.abs(own) * np.sqrt(np.mean(np.log(ratios) ** 2, axis=0))
    return float(gain_std), float(frequency_std)


def _frequency(fit: Fit) -> float:
    """Return about the frequency of the loop [rad/s]."""
    model = fit.problem.structure.model_at(fit.state.theta, fit.state.coefficients)
    point = None if model is None else ultimate_point(model)
    slow = unit_steps(fit.problem.structure, fit.state.theta)[-1]
    return 1.0 / float(slow) if point is None else point.frequency


def _fitted(records: Sequence[Record], fit: Fit, residual: FloatArray) -> FloatArray:
    """Return the fitted measurement of the first record; NaN where samples were left out."""
    record, problem, scale = records[0], fit.problem, fit.scale
    fitted = np.full(len(record), math.nan)
    thinned = problem.colour is not None or 2 * problem.time.size <= len(record)
    if thinned and len(records) == 1:
        # It was fitted to some of the samples only. Free motion and drift begin with the first.
        apart = np.diff(problem.index)
        step = int(np.min(apart))
        part = slice(int(problem.index[0]), int(problem.index[-1]) + step)
        time = record.time[part]
        every = replace(
            problem,
            time=time,
            y=np.zeros(time.size),
            index=np.arange(time.size),
            weight=None,
            colour=None,
        )
        answer = fit.state.coefficients @ every.columns(fit.state.theta)
        fitted[part] = record.measurement[0] + scale * answer
        for last in np.flatnonzero(apart > step):
            fitted[problem.index[last] + 1 : problem.index[last + 1]] = math.nan
        return fitted
    own = problem.index < len(record)
    used = problem.index[own]
    fitted[used] = record.measurement[used] - scale * residual[own]
    return fitted


def _with_rivals(found: Identification, fit: Fit, shares: Sequence[float]) -> Identification:
    """Add the support of the structure, and the other structures that have some."""
    chosen = fit.problem.structure
    own = 0.0
    rivals: list[Rival] = []
    for candidate, share in zip(fit.candidates, shares, strict=True):
        structure, state = candidate.structure, candidate.state
        if (structure.name, structure.order) == (chosen.name, chosen.order):
            own += share
        elif share >= _WORTH_TELLING:
            read = structure.read(state.theta, fit.scale * state.coefficients)
            if read is not None:
                rivals.append(Rival(Estimate.of(*read), share))
    found = replace(found, support=own, rivals=tuple(rivals))
    stable = [r for r in rivals if r.model.is_stable and r.support > _OPEN]
    if not (found.model.integrators and stable):
        return found
    best = stable[0]
    warning = (
        "the data do not show whether the process integrates: a stable "
        f"{best.model.structure} with gain {best.model.gain:.3g} has {100 * best.support:.0f} "
        "% of the support; a biased relay or a longer step would show it; K_u and w_u do not "
        "depend on it"
    )
    return replace(found, warnings=(*found.warnings, warning))


def _prediction(records: Sequence[Record], problem: Problem, state: Trial) -> float:
    """Return the rms error over the last cycle of a model fitted to the samples before it."""
    record = records[0]
    if len(records) > 1 or len(record.cycle_start) < 3:
        return math.nan
    split = record.time[record.cycle_start[-2]]
    end = record.time[record.cycle_start[-1]]
    before = problem.part(problem.time < split)
    last = problem.part((problem.time >= split) & (problem.time < end))
    if before.y.size < 4 * state.parameters or last.y.size == 0:
        return math.nan
    if before.relaxation or before.drift or before.structure.unstable:
        # These terms depend on where the samples begin and end.
        return math.nan
    earlier = refine(before, state.theta, tolerance=TRIAL)
    error = raw_residual(last, earlier)
    return math.sqrt(float(np.mean(error**2)))


def _measured_noise(records: Sequence[Record]) -> float:
    """Return the standard deviation of the noise measured before all tests."""
    if len(records) == 1:
        return records[0].noise_std
    squares = [r.noise_std**2 for r in records if math.isfinite(r.noise_std)]
    return math.sqrt(sum(squares) / len(squares)) if len(squares) == len(records) else math.nan


def _began_away(records: Sequence[Record], fit: Fit) -> bool:
    """Return whether a process moved though a relay test began at its baseline."""
    return (fit.problem.relaxation or fit.problem.past) and any(
        r.settings is not None and r.input().initial == r.settings.baseline for r in records
    )


def _warnings(
    records: Sequence[Record],
    quality: FitReport,
    fit: Fit,
    residual: FloatArray,
    known_to: float,
) -> list[str]:
    """Return what is to be known of a model.

    :param known_to: half the width of the gain's interval over the gain.
    """
    found = []
    if fit.problem.colour is not None:
        found.append(
            "what the model leaves is correlated: an autoregression of order "
            f"{fit.problem.colour.order} explains more of it than white noise does; it was "
            "estimated with the model, and intervals and the choice of a structure allow for it"
        )
    step = coarse_step(records, quality.residual_rms)
    if step:
        found.append(
            f"the measurement comes in steps of {step:.3g}, which are larger than the residual "
            f"({quality.residual_rms:.3g} rms): rounding is no noise, and the intervals are "
            "widened for it; a finer sensor or a larger amplitude would help"
        )
    for number, (record, part) in enumerate(
        zip(records, fit.problem.experiments, strict=True), start=1
    ):
        which = f"test {number}: " if len(records) > 1 else ""
        rms = fit.scale * math.sqrt(float(np.mean(residual[part] ** 2)))
        measured = record.noise_std
        if math.isfinite(measured) and rms > max(_UNEXPLAINED * measured, 1e-6 * fit.scale):
            found.append(
                f"{which}the residual ({rms:.3g} rms) is larger than the noise measured before "
                f"the test ({measured:.3g}): look at the residual in the report"
            )
        if record.lost_samples:
            found.append(
                f"{which}{record.lost_samples} samples were lost on the way; check the network"
            )
    effects = fit.problem.effects(fit.state.coefficients)
    above, below = (f"{effect:.2f}" for effect in effects)
    if above != below and not abs(effects[0] - 1.0) <= known_to:
        middle = middle_of(fit.problem.inputs[0])
        found.append(
            f"commands above {middle:.4g} u act {above} times as strongly as in the model, "
            f"those below it {below} times: the process is not linear, and the gains hold on "
            "both sides; the weaker direction sets how fast the loop can be"
        )
    if fit.problem.ends is not None:
        sides = zip(("above", "below"), fit.problem.ends_of(fit.state.coefficients), strict=True)
        between = " and ".join(f"{side} {end:.4g} u" for side, end in sides if math.isfinite(end))
        found.append(
            f"the process answers commands {between} alone, as an actuator with ends or a dead "
            "zone does, which was estimated with the model: record the command that the actuator "
            "gets, and let the controller end where it does"
        )
    if fit.problem.play:
        play = fit.problem.play_of(fit.state.coefficients)
        found.append(
            f"play of {play:.3g} u was estimated with the model: after each reversal of the "
            "command the process first feels nothing of it; gains are for moves beyond it, and "
            "the loop may circle slowly within it"
        )
    if fit.problem.friction:
        friction = fit.problem.dry_friction(fit.state.coefficients)
        found.append(
            f"dry friction of {friction:.3g} u was estimated with the model: gains are for the "
            "motion, and a rest may stay off the set-point by what that command cannot move"
        )
    if fit.problem.rate is not None:
        found.append(
            f"no change of the command is followed faster than {digits(fit.problem.rate, 3)} u/s, "
            "which was estimated with the model: gains are for smaller moves"
        )
    if fit.problem.load is not None:
        size = fit.problem.relative("load", fit.state.coefficients)
        once = only_move(records[0].input(), records[0].time) is not None
        found.append(
            f"a load step of {size:.3g} u at {fit.problem.load:.4g} s was estimated with the "
            "model, since no model fits the record as well without one"
            + "; it may be a part of the response, and the gains allow for both: move the command "
            "a second time" * once
        )
    if fit.problem.drift:
        found.append(
            "the measurement drifts, and the drift was fitted with the model; wait for rest"
        )
    moved = fit.problem.relaxation or fit.problem.past
    if moved and records[0].settings is None:
        found.append(
            "the process moved when the record began, which was fitted with the model: where it "
            "had rested, give the command of that rest as --command-before"
        )
    if _began_away(records, fit):
        found.append(
            "the process was not at rest at the baseline when the test began, and its way there "
            "was fitted with the model; check the baseline, or wait longer before a test"
        )
    if fit.loss != "squares":
        found.append(f"the {fit.loss} loss was minimised, as asked for, in place of the squares")
    return found
