"""Models within the uncertainty of an identification, and gains judged on all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from relay_autotune.errors import TuningError
from relay_autotune.identification.result import Identification, is_logarithmic
from relay_autotune.models import TransferFunction
from relay_autotune.tuning.analysis import frequencies, is_stable, sensitivity_on
from relay_autotune.tuning.gains import Controller

_MODELS = 100
_SHARE = 0.95


def ensemble(
    identification: Identification, count: int = _MODELS, *, rng: np.random.Generator
) -> tuple[TransferFunction, ...]:
    """Draw models from the uncertainty of an identification.

    Gains and time constants are drawn as logarithms, so that none changes sign; a dead time is
    drawn as it is and cut at zero. Correlations are kept, which matters: a gain and a time
    constant that are each uncertain often have a ratio that is not.

    :param identification: with a covariance; without one the ensemble is empty.
    :param count: models to draw.
    :param rng: the source.
    """
    covariance, values = identification.covariance, identification.values
    if not bool(np.all(np.isfinite(covariance))):
        return ()
    logarithmic = np.array([is_logarithmic(n) for n in identification.parameters])
    delays = np.array([n == "dead_time" for n in identification.parameters])
    scale = np.where(logarithmic, values, 1.0)
    draws = rng.multivariate_normal(
        np.zeros(values.size), covariance / np.outer(scale, scale), count, method="eigh"
    )
    models = []
    for draw in draws:
        with np.errstate(over="ignore"):
            factors = np.exp(np.clip(draw, -20.0, 20.0))
        drawn = np.where(logarithmic, values * factors, values + draw)
        drawn[delays] = np.maximum(drawn[delays], 0.0)
        models.append(identification.build(drawn))
    return tuple(models)


def ensemble_ms(controller: Controller, models: Sequence[TransferFunction]) -> float:
    """Return the Ms below which 95 % of the models stay with one controller.

    :param controller: the gains.
    :param models: at least one.
    :raises TuningError: if more than 5 % of the loops are unstable.
    """
    peaks = []
    for model in models:
        if not is_stable(controller, model):
            peaks.append(math.inf)
            continue
        loop = controller.loop(model)
        peaks.append(float(sensitivity_on(loop, frequencies(loop)).max()))
    rank = math.ceil(_SHARE * len(peaks)) - 1
    value = sorted(peaks)[rank]
    if math.isinf(value):
        unstable = sum(1 for p in peaks if math.isinf(p)) / len(peaks)
        raise TuningError(
            f"the model is too uncertain for these gains: {100 * unstable:.0f} % of the models "
            "within its uncertainty would be unstable; run more cycles or a larger amplitude"
        )
    return value
