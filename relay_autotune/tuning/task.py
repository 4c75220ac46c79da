# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a design rule is given: the process, its uncertainty, and the options."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller, Performance
from relay_autotune.loop.laws import LAWS, OWN_LAW, Law, SampledLaw
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint
from relay_autotune.quantities import check, quantity
from relay_autotune.tuning.model_set import HeldSet, ModelSet

CONTROLLERS = ("auto", "pi", "pid")
MS_RANGE = (1.2, 4.0)
# A bound may be exceeded by this factor without a warning.
_HELD = 1.01
# +2 dB is Luyben's bound on the resonance of the level of a vessel (2003).
MT_SELF_REGULATING, MT_INTEGRATING = 1.4, 1.26


@dataclass(frozen=True, kw_only=True)
class DesignOptions:
    """Options of a design, the same for every rule; each rule reads what it needs.

    >>> from relay_autotune import DesignOptions
    >>> options = DesignOptions(controller="pi", ms=1.6, sample_period=0.1)
    >>> options.ms, options.added_delay
    (1.6, 0.05)

    :raises TuningError: if a value is out of its range.
    """

    controller: str = quantity(
        "auto",
        "",
        "What is designed; auto: PI, unless the rule finds PID worth it.",
        choices=CONTROLLERS,
    )
    ms: float = quantity(1.4, "", "Largest Ms, for robust and unstable.", *MS_RANGE)
    mt: float = quantity(
        math.nan,
        "",
        "Largest Mt, above 1, for robust; NaN: 1.4, of an integrating process 1.26.",
        lower=1.0,
        open_ended=True,
    )
    setpoint_weight: float = quantity(
        math.nan, "", "Set-point weight b; NaN: the rule's own.", lower=0.0, upper=1.0
    )
    sample_period: float = quantity(
        0.0,
        "s",
        "Sampling period of the controller, half of which counts as dead time; 0: the "
        "recording's, or continuous where there is no recording.",
        lower=0.0,
    )
    loop_delay: float = quantity(
        0.0,
        "s",
        "Dead time that the controller's loop adds to the process.",
        lower=0.0,
    )
    noise_std: float = quantity(
        math.nan,
        "y",
        "Standard deviation of the measurement noise; NaN: the recording's, or not known.",
        lower=0.0,
    )
    amplitude: float = quantity(
        math.nan,
        "u",
        "How far the command may move; NaN: the relay's amplitude, or not known.",
        lower=0.0,
    )
    noise_share: float = quantity(
        0.1,
        "",
        "Largest standard deviation of the noise in the command that derivative action may cause, "
        "as a fraction of the amplitude.",
        lower=0.0,
        open_ended=True,
    )
    filter_ratio: float = quantity(10.0, "", "Largest td/tf.", lower=0.0, open_ended=True)
    closed_loop_time: float = quantity(
        math.nan,
        "s",
        "Lambda of imc, simc and unstable; NaN: the rule's own.",
        lower=0.0,
        open_ended=True,
        flag="lambda",
    )
    phase_peak: float = quantity(
        math.radians(-120.0),
        "rad",
        "Phase of the loop at its peak, for luyben2003.",
        lower=-math.pi,
        upper=-0.5 * math.pi,
        open_ended=True,
    )
    resonance: float = quantity(
        2.0, "dB", "Closed-loop resonance, for luyben2003.", lower=0.0, open_ended=True
    )
    law: str = quantity(
        "",
        "",
        "Law that the gains are for, exact at the sampling period, such as pid_controller; not "
        "given: controller_node's, with half a period as dead time.",
        choices=("", *LAWS),
    )

    def __post_init__(self) -> None:
        check(self, TuningError)

    @property
    def given_closed_loop_time(self) -> float | None:
        """Lambda as it was given [s]; None: the rule decides."""
        return None if math.isnan(self.closed_loop_time) else self.closed_loop_time

    @property
    def added_delay(self) -> float:
        """Dead time that the loop adds to the process: half a period of the hold, and its own [s].

        A sample that is held for a period lags by half of it on average.
        """
        held = LAWS[self.law or OWN_LAW].lag(self.sample_period)
        return held + self.loop_delay

    @property
    def runs(self) -> Law | None:
        """The law that the gains are for; None: none was named.

        :raises TuningError: if it was named without a sampling period.
        """
        if self.law == "":
            return None
        if self.sample_period == 0.0:
            raise TuningError(
                f"{self.law} runs at a sampling period, and none is known: give sample_period"
            )
        return LAWS[self.law]

    def largest_mt(self, model: TransferFunction) -> float:
        """Return the bound on Mt for a process.

        :param model: the process; integrating processes have their own default.
        """
        if not math.isnan(self.mt):
            return self.mt
        return MT_INTEGRATING if model.integrators > 0 else MT_SELF_REGULATING


@dataclass(frozen=True, kw_only=True)
class DesignTask:
    """A process for which a controller is to be designed.

    :param model: the process.
    :param options: what is asked for.
    :param simple: the FOPDT that fits best, for rules that need one; None: not known.
    :param models: models within the uncertainty; empty: the uncertainty is not known.
    :param describing: K_u and w_u by the describing function from the limit cycle; None: not
        known.
    """

    model: TransferFunction
    options: DesignOptions = field(default_factory=DesignOptions)
    simple: TransferFunction | None = None
    models: tuple[TransferFunction, ...] = ()
    describing: UltimatePoint | None = None

    def in_loop(self, model: TransferFunction) -> TransferFunction:
        """Return a process with the dead time that the loop adds to it.

        :param model: the process, or a model within its uncertainty.
        """
        return replace(model, dead_time=model.dead_time + self.options.added_delay)

    def held(self, model: TransferFunction) -> TransferFunction:
        """Return a process with the loop's own delay, but no dead time for the hold.

        :param model: the process, or a model within its uncertainty.
        """
        return replace(model, dead_time=model.dead_time + self.options.loop_delay)

    def runs(self, controller: Controller) -> SampledLaw | None:
        """Return the law that will run, with what it can do of a controller; None: not named.

        :param controller: the gains that a rule gives.
        """
        law, period = self.options.runs, self.options.sample_period
        return None if law is None else law.at(law.best(controller, period), period)

    def set_of(self, models: Sequence[TransferFunction]) -> ModelSet | HeldSet:
        """Return models as the loop has them.

        :param models: such as those within the uncertainty.
        """
        law = self.options.runs
        if law is None:
            return ModelSet([self.in_loop(model) for model in models])
        held = tuple(self.held(model) for model in models)
        return HeldSet(held, law, self.options.sample_period)

    @cached_property
    def around(self) -> ModelSet:
        """The models within the uncertainty, with the dead time that the loop adds to them."""
        return ModelSet([self.in_loop(model) for model in self.models])

    @cached_property
    def exact(self) -> ModelSet | HeldSet:
        """The models within the uncertainty, as the law that was named has them."""
        return self.around if self.options.runs is None else self.set_of(self.models)


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
            found.append(
                f"{name} is {value:.3g}, above the {asked:g} asked for; choose another rule, or "
                f"allow more by {name.lower()}"
            )
    noise = performance.noise_gain * options.noise_std
    known = options.sample_period > 0.0 and options.amplitude > 0.0
    if known and noise > _HELD * options.noise_share * options.amplitude:
        found.append(
            f"the noise alone moves the command by {noise:.3g} (standard deviation), "
            f"{100.0 * noise / options.amplitude:.0f} % of the relay's amplitude; filter the "
            "measurement, or ask for PI"
        )
    return tuple(found)
