# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Analysis of a closed loop: stability, robustness, responses to set-point and load."""

from __future__ import annotations

import math

from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.loop.gains import ControlLaw, Performance, StepFigures
from relay_autotune.loop.margins import LoopMargins, frequencies, margins, sensitivity_peaks
from relay_autotune.loop.noise import noise_gain
from relay_autotune.loop.responses import step_figures
from relay_autotune.loop.stability import closed_loop_unstable_poles
from relay_autotune.process.transfer_function import TransferFunction

__all__ = ["analyse_loop", "frequencies", "is_stable", "ms_on", "sensitivity_peaks"]


def is_stable(controller: ControlLaw, model: TransferFunction) -> bool:
    """Return whether the closed loop is stable.

    :param controller: the gains, or any other linear controller.
    :param model: the process.
    """
    return closed_loop_unstable_poles(controller.characteristic(model)) == 0


def analyse_loop(
    controller: ControlLaw, model: TransferFunction, sample_period: float = 0.0
) -> Performance:
    """Return the performance of a controller on a model.

    :param controller: the gains, or any other linear controller.
    :param model: the process, with all dead time of the loop.
    :param sample_period: period of the measurement, for its noise [s]; 0: continuous.
    :raises TuningError: if the closed loop is unstable, or its responses do not die away.
    """
    if not is_stable(controller, model):
        raise TuningError(f"{controller} makes an unstable loop with the model: use another rule")
    terms = controller.characteristic(model)
    found = margins(lambda s: controller(s) * model(s), frequencies(*terms), _at_rest(terms))
    figures = step_figures(controller, model, found.ms_frequency)
    noise = noise_gain(controller, model, sample_period)
    return performance_of(found, figures, noise)


def performance_of(found: LoopMargins, figures: StepFigures, noise: float) -> Performance:
    """Join what was found of a loop.

    :param found: its margins.
    :param figures: of its responses.
    :param noise: gain from noise to command [u/y].
    """
    known = {name: value for name, value in vars(found).items() if name != "ms_frequency"}
    return Performance(**known, **vars(figures), noise_gain=noise)


def ms_on(controller: ControlLaw, model: TransferFunction) -> float:
    """Return Ms of a controller on any model; infinite where the loop is unstable.

    :param controller: the gains, or any other linear controller.
    :param model: the process, with all dead time of the loop.
    """
    try:
        if not is_stable(controller, model):
            return math.inf
    except RelayAutotuneError:
        # Stability could not be decided; count it as unstable.
        return math.inf
    grid = frequencies(*controller.characteristic(model))
    return sensitivity_peaks(lambda s: controller(s) * model(s), grid)[0]


def _at_rest(terms: tuple[TransferFunction, ...]) -> float | None:
    """Return the loop's gain at s = 0, for a single term without integral action; else None."""
    if len(terms) != 1 or terms[0].integrators != 0:
        return None
    return terms[0].gain
