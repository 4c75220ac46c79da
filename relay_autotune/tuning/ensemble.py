# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Models within the uncertainty of an identification, and controllers judged on all of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.posterior import DRAWS
from relay_autotune.loop.analysis import ControlLaw, Loop
from relay_autotune.loop.stability import at_infinity, winding
from relay_autotune.process.model_set import ModelSet
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.candidates import allowed_outside
from relay_autotune.tuning.rules import Rule
from relay_autotune.tuning.task import DesignTask


def ensemble(
    identification: Identification, count: int = DRAWS, *, rng: np.random.Generator
) -> tuple[TransferFunction, ...]:
    """Return models within the uncertainty of an identification, of its direction.

    They are those that the record allows, or drawn from the covariance of the parameters where the
    method knows no more.

    :param identification: with draws or a covariance; without both the ensemble is empty.
    :param count: models to draw from a covariance.
    :param rng: source of the random numbers.
    """
    if identification.draws:
        sign = identification.model.process_sign
        return tuple(m for m in identification.draws if m.process_sign == sign)
    if not identification.estimate.known:
        return ()
    return tuple(identification.estimate.draws(count, rng))


def ms_on_each(law: ControlLaw, models: ModelSet) -> FloatArray:
    """Return the Ms of a controller on each of many models, infinite where the loop is unstable.

    Stability follows from the number of turns of each loop on the grid; where two points are too
    far apart to count them, the argument principle decides.

    :param law: with its gains.
    :param models: at least one, as the law meets them.
    :return: shape (m,).
    """
    grid = Loop(law, models.models[0]).grid
    # At the first frequency all dynamics except integrators are at rest.
    w = np.concatenate(([1e-6 * grid[0]], grid))
    moved = 1.0 + law(1j * w)[:, None] * models.at(w)
    if law.period > 0.0:
        end = np.array([1j * math.pi / law.period])
        limits = (law(end) * models(end))[0].real
    else:
        limits = np.array(
            [0.0 if m.dead_time else at_infinity(law.characteristic(m)[-1]) for m in models.models]
        )
    integrators = models.integrators + (1 if law.i else 0)
    count = winding(moved, w, models.unstable_poles, integrators, limits, law.period)
    for k in np.flatnonzero(np.isnan(count)):
        loop = Loop(law, models.models[k], models.of(int(k)))
        # Of a continuous loop the argument principle knows the model alone.
        known = models.errors is None or law.period > 0.0
        count[k] = loop.unstable_poles if known else math.inf
    return np.where(count == 0.0, 1.0 / np.abs(moved[1:]).min(axis=0), math.inf)


def ensemble_ms(law: ControlLaw, models: ModelSet) -> float:
    """Return the Ms that 95 % of the models do not exceed with one controller.

    :param law: with its gains.
    :param models: at least one, as the law meets them.
    :raises TuningError: if more than 5 % of the loops are unstable.
    """
    ms = ms_on_each(law, models)
    value = float(np.sort(ms)[ms.size - 1 - allowed_outside(ms.size)])
    if math.isinf(value):
        raise TuningError(
            "the model is too uncertain for these gains: "
            f"{100 * np.isinf(ms).mean():.0f} % of the models within its uncertainty "
            "would be unstable; run more cycles or a larger amplitude"
        )
    return value


def predicted_ms(task: DesignTask, rule: Rule) -> tuple[float, ...]:
    """Return the Ms of the gains that a rule gives for the model alone, and its 95 % interval.

    The interval holds 95 % of the Ms that the same gains have on the models within the
    uncertainty; its upper end is infinite where more than 2.5 % of the loops are unstable.

    :param task: the process, the models within its uncertainty, and what is asked for.
    :param rule: gives the gains, from the model alone.
    :return: empty where the rule does not apply, or the uncertainty is not known.
    """
    if not task.models:
        return ()
    try:
        controller, _ = rule(replace(task, models=()))
    except TuningError:
        return ()
    models = task.set_of((task.model, *task.models))
    own, *others = ms_on_each(task.law(controller), models)
    # No interpolation: some values may be infinite.
    ends = np.quantile(others, (0.025, 0.975), method="closest_observation")
    return float(own), *map(float, ends)
