# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Robustness of the gains that a model would give, before they are asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.errors import TuningError
from relay_autotune.tuning.ensemble import ensemble_peaks
from relay_autotune.tuning.model_set import ModelSet
from relay_autotune.tuning.rules import Rule
from relay_autotune.tuning.task import DesignTask


@dataclass(frozen=True)
class PredictedMs:
    """Largest magnitude of the sensitivity function with the gains of a rule.

    :param ms: on the model.
    :param low: lower end of its 95 % interval.
    :param high: upper end; infinite where more than 2.5 % of the loops are unstable.
    """

    ms: float
    low: float
    high: float


def predicted_ms(task: DesignTask, rule: Rule) -> PredictedMs | None:
    """Return the Ms of the gains that a rule gives for the model alone, and its interval.

    The interval holds 95 % of the Ms that the same gains have on the models within the
    uncertainty.

    :param task: the process, the models within its uncertainty, and what is asked for.
    :param rule: gives the gains, from the model alone.
    :return: None where the rule does not apply, or the uncertainty is not known.
    """
    if not task.models:
        return None
    try:
        controller, _ = rule(replace(task, models=()))
    except TuningError:
        return None
    models = ModelSet([task.in_loop(model) for model in (task.model, *task.models)])
    own, *others = ensemble_peaks(controller, models).ms
    # No interpolation: some values may be infinite.
    low, high = np.quantile(others, (0.025, 0.975), method="closest_observation")
    return PredictedMs(float(own), float(low), float(high))
