"""Models within the uncertainty of an identification, and controllers judged on all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import TuningError
from relay_autotune.identification.result import Identification, is_logarithmic
from relay_autotune.models import TransferFunction
from relay_autotune.tuning.control_law import ControlLaw
from relay_autotune.tuning.margins import frequencies
from relay_autotune.tuning.search import allowed_outside
from relay_autotune.tuning.stability import closed_loop_unstable_poles, winding

FloatArray = NDArray[np.floating[Any]]

_MODELS = 100


def ensemble(
    identification: Identification, count: int = _MODELS, *, rng: np.random.Generator
) -> tuple[TransferFunction, ...]:
    """Draw models from the uncertainty of an identification.

    Gains and time constants are drawn as logarithms, so that none changes sign; a dead time is
    drawn as it is and cut at zero. Correlations are kept, which matters: a gain and a time
    constant that are each uncertain often have a ratio that is not. Other structures that the
    data do not rule out are there by their support.

    :param identification: with a covariance; without one the ensemble is empty.
    :param count: models to draw.
    :param rng: the source.
    """
    covariance, values = identification.covariance, identification.values
    if not bool(np.all(np.isfinite(covariance))):
        return ()
    rivals = [
        rival.model
        for rival in identification.rivals
        for _ in range(round(count * rival.support))
        if rival.model.process_sign == identification.model.process_sign
    ][: count // 2]
    logarithmic = np.array([is_logarithmic(n) for n in identification.parameters])
    delays = np.array([n == "dead_time" for n in identification.parameters])
    scale = np.where(logarithmic, values, 1.0)
    draws = rng.multivariate_normal(
        np.zeros(values.size),
        covariance / np.outer(scale, scale),
        count - len(rivals),
        method="eigh",
    )
    models = []
    for draw in draws:
        with np.errstate(over="ignore"):
            factors = np.exp(np.clip(draw, -20.0, 20.0))
        drawn = np.where(logarithmic, values * factors, values + draw)
        drawn[delays] = np.maximum(drawn[delays], 0.0)
        models.append(identification.build(drawn))
    return (*models, *rivals)


@dataclass(frozen=True)
class Peaks:
    """Robustness of one controller on many models.

    :param ms: largest magnitude of the sensitivity function on each, infinite where the loop is
        unstable, shape (m,).
    :param mt: of the complementary sensitivity function, shape (m,).
    """

    ms: FloatArray
    mt: FloatArray

    @property
    def unstable(self) -> int:
        """How many of the loops are unstable."""
        return int(np.isinf(self.ms).sum())


def ensemble_peaks(controller: ControlLaw, models: Sequence[TransferFunction]) -> Peaks:
    """Return the robustness of a controller on each of many models.

    Stability is read off how often each loop turns on the grid; where two points are too far
    apart for that, the argument principle decides.

    :param controller: the gains, or any other linear controller.
    :param models: at least one.
    """
    terms = [controller.characteristic(model) for model in models]
    grid = frequencies(*terms[0])
    s = 1j * grid
    law = controller(s)
    ms, mt = np.empty(len(models)), np.empty(len(models))
    for k, model in enumerate(models):
        loop = law * model(s)
        sensitivity = 1.0 / np.abs(1.0 + loop)
        count = winding(terms[k], grid)
        stable = (closed_loop_unstable_poles(terms[k]) if count is None else count) == 0
        ms[k] = sensitivity.max() if stable else math.inf
        mt[k] = (sensitivity * np.abs(loop)).max() if stable else math.inf
    return Peaks(ms, mt)


def ensemble_ms(controller: ControlLaw, models: Sequence[TransferFunction]) -> float:
    """Return the Ms below which 95 % of the models stay with one controller.

    :param controller: the gains, or any other linear controller.
    :param models: at least one.
    :raises TuningError: if more than 5 % of the loops are unstable.
    """
    peaks = ensemble_peaks(controller, models)
    value = float(np.sort(peaks.ms)[len(models) - 1 - allowed_outside(len(models))])
    if math.isinf(value):
        raise TuningError(
            "the model is too uncertain for these gains: "
            f"{100 * peaks.unstable / len(models):.0f} % of the models within its uncertainty "
            "would be unstable; run more cycles or a larger amplitude"
        )
    return value
