"""What a controller does on a model: stability, robustness, responses to set-point and load."""

from __future__ import annotations

import math

from relay_autotune.control.gains import Performance
from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.loop.control_law import ControlLaw
from relay_autotune.tuning.loop.margins import frequencies, margins, sensitivity_peaks
from relay_autotune.tuning.loop.noise import noise_gain
from relay_autotune.tuning.loop.responses import step_figures
from relay_autotune.tuning.loop.stability import closed_loop_unstable_poles
from relay_autotune.tuning.task import DesignTask

# What was asked for may be missed by so little without a word.
_HELD = 1.01

__all__ = ["analyse_loop", "cautions", "frequencies", "is_stable", "ms_on", "sensitivity_peaks"]


def is_stable(controller: ControlLaw, model: TransferFunction) -> bool:
    """Return whether the closed loop is stable.

    :param controller: the gains, or any other linear controller.
    :param model: the process.
    """
    return closed_loop_unstable_poles(controller.characteristic(model)) == 0


def analyse_loop(
    controller: ControlLaw, model: TransferFunction, sample_period: float = 0.0
) -> Performance:
    """Return what a controller does on a model.

    :param controller: the gains, or any other linear controller.
    :param model: the process, with all dead time of the loop.
    :param sample_period: of the measurement, for its noise [s]; 0: continuous.
    :raises TuningError: if the closed loop is unstable, or so slow that nothing can be told.
    """
    if not is_stable(controller, model):
        raise TuningError(f"{controller} makes an unstable loop with the model: use another rule")
    terms = controller.characteristic(model)
    found = margins(lambda s: controller(s) * model(s), frequencies(*terms), _at_rest(terms))
    figures = step_figures(controller, model, found.ms_frequency)
    return Performance(
        ms=found.ms,
        mt=found.mt,
        gain_margin=found.gain_margin,
        phase_margin=found.phase_margin,
        delay_margin=found.delay_margin,
        gain_margin_low=found.gain_margin_low,
        iae_load=figures.iae_load,
        iae_setpoint=figures.iae_setpoint,
        overshoot=figures.overshoot,
        settling_time=figures.settling_time,
        effort_setpoint=figures.effort_setpoint,
        effort_load=figures.effort_load,
        noise_gain=noise_gain(controller, model, sample_period),
    )


def ms_on(controller: ControlLaw, model: TransferFunction) -> float:
    """Return Ms of a controller on any model; infinite where the loop is unstable.

    :param controller: the gains, or any other linear controller.
    :param model: the process, with all dead time of the loop.
    """
    try:
        if not is_stable(controller, model):
            return math.inf
    except RelayAutotuneError:
        # Nobody can tell, which is no better.
        return math.inf
    grid = frequencies(*controller.characteristic(model))
    return sensitivity_peaks(lambda s: controller(s) * model(s), grid)[0]


def cautions(performance: Performance, task: DesignTask) -> tuple[str, ...]:
    """Return what the user must know before using gains, a sentence each.

    :param performance: of the gains on the model.
    :param task: what was asked for.
    """
    options, found = task.options, []
    bounds = {
        "Ms": (performance.ms, options.ms),
        "Mt": (performance.mt, options.largest_mt(task.model)),
    }
    for name, (value, asked) in bounds.items():
        if value > _HELD * asked:
            found.append(f"{name} is {value:.3g}, above the {asked:g} that was asked for")
    noise = performance.noise_gain * options.noise_std
    known = options.sample_period > 0.0 and options.amplitude > 0.0
    if known and noise > _HELD * options.noise_share * options.amplitude:
        found.append(
            f"the noise alone moves the command by {noise:.3g} (standard deviation), "
            f"{100.0 * noise / options.amplitude:.0f} % of the relay's amplitude"
        )
    return tuple(found)


def _at_rest(terms: tuple[TransferFunction, ...]) -> float | None:
    """Return the loop's gain at s = 0 where it is a single term without integral action."""
    if len(terms) != 1 or terms[0].integrators != 0:
        return None
    return terms[0].gain
