# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a design rule is given: the process, the models within its uncertainty, and the options.

:func:`cost_of` says what a law costs that cannot do all that our own can.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Controller, Performance
from relay_autotune.loop.law import LawRate, SampledLaw, Slope
from relay_autotune.loop.laws import LAWS, OWN_LAW
from relay_autotune.process.model_set import ModelErrors, ModelSet
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint
from relay_autotune.quantities import check, quantity
from relay_autotune.text import digits

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

    controller: str = quantity("auto", choices=CONTROLLERS).means(
        "What is designed; auto: PI, unless the rule finds PID worth it."
    )
    ms: float = quantity(1.4, "", *MS_RANGE).means("Largest Ms, for robust and unstable.")
    mt: float = quantity(math.nan, lower=1.0, open_ended=True).means(
        "Largest Mt, above 1, for robust; NaN: 1.4, of an integrating process 1.26."
    )
    setpoint_weight: float = quantity(math.nan, lower=0.0, upper=1.0).means(
        "Set-point weight b; NaN: the rule's own."
    )
    sample_period: float = quantity(0.0, "s", lower=0.0).means(
        "Sampling period of the controller; 0: the recording's, or continuous where there is no "
        "recording."
    )
    loop_delay: float = quantity(0.0, "s", lower=0.0).means(
        "Dead time that the controller's loop adds to the process."
    )
    noise_std: float = quantity(math.nan, "y", lower=0.0).means(
        "Standard deviation of the measurement noise; NaN: the recording's, or not known."
    )
    amplitude: float = quantity(math.nan, "u", lower=0.0).means(
        "How far the command may move; NaN: the relay's amplitude, or not known."
    )
    noise_share: float = quantity(0.1, lower=0.0, open_ended=True).means(
        "Largest standard deviation of the noise in the command that derivative action may cause, "
        "as a fraction of the amplitude."
    )
    filter_ratio: float = quantity(10.0, lower=0.0, open_ended=True).means(
        "Largest td/tf, to within half a sampling period over ti."
    )
    closed_loop_time: float = quantity(
        math.nan, "s", lower=0.0, open_ended=True, flag="lambda"
    ).means("Lambda of imc, simc and unstable; NaN: the rule's own.")
    phase_peak: float = quantity(
        math.radians(-120.0), "rad", lower=-math.pi, upper=-0.5 * math.pi, open_ended=True
    ).means("Phase of the loop at its peak, for luyben2003.")
    resonance: float = quantity(2.0, "dB", lower=0.0, open_ended=True).means(
        "Closed-loop resonance, for luyben2003."
    )
    law: str = quantity("", choices=("", *LAWS)).means(
        "Law that the gains are for, exact at the sampling period, such as pid_controller; not "
        "given: controller_node's."
    )

    def __post_init__(self) -> None:
        check(self, TuningError)

    def closed_loop(self, default: float) -> tuple[float, str]:
        """Return lambda, and what a reason says of it; nothing where it was not given.

        :param default: that of the rule [s].
        """
        if math.isnan(self.closed_loop_time):
            return default, ""
        return self.closed_loop_time, ", as given"

    @property
    def added_delay(self) -> float:
        """Dead time that the loop adds to the process: half a period of the hold, and its own [s].

        A sample that is held for a period lags by half of it on average. Rules that are formulas
        for a dead time take it; loops that are judged have no such approximation.
        """
        return LAWS[self.law or OWN_LAW].lag(self.sample_period) + self.loop_delay

    @property
    def rate(self) -> LawRate:
        """The law that the gains are for, controller_node's unless another was named.

        :raises TuningError: if another was named without a sampling period.
        """
        law = LAWS[self.law or OWN_LAW]
        if self.sample_period == 0.0 and self.law:
            raise TuningError(
                f"{self.law} runs at a sampling period, and none is known: give sample_period"
            )
        return LawRate(law, self.sample_period)

    def largest_mt(self, model: TransferFunction) -> float:
        """Return the bound on Mt for a process.

        :param model: the process; integrating processes have their own default.
        """
        if not math.isnan(self.mt):
            return self.mt
        return MT_INTEGRATING if model.integrators > 0 else MT_SELF_REGULATING


@dataclass(frozen=True, kw_only=True, eq=False)
class DesignTask:
    """A process for which a controller is to be designed.

    :param model: the process.
    :param options: what is asked for.
    :param simple: the FOPDT that fits best, for rules that need one; None: not known.
    :param models: models within the uncertainty; empty: the uncertainty is not known.
    :param errors: what the process shows beside each of these; None: nothing.
    :param describing: K_u and w_u by the describing function from the limit cycle; None: not
        known.
    :param recorded_period: interval of the recording [s]; 0: there is none.
    """

    model: TransferFunction
    options: DesignOptions = field(default_factory=DesignOptions)
    simple: TransferFunction | None = None
    models: tuple[TransferFunction, ...] = ()
    errors: ModelErrors | None = None
    describing: UltimatePoint | None = None
    recorded_period: float = 0.0

    @property
    def too_slow(self) -> str:
        """A question about a controller that runs less often than the process answers, or ""."""
        model, period, recorded = self.model, self.options.sample_period, self.recorded_period
        if model.integrators or not 0.0 < model.response_time < period:
            return ""
        rows = f", the recording has a sample every {recorded:g} s" * (recorded > 0.0)
        return (
            f"the controller runs every {digits(period, 3)} s{rows}, and the process answers "
            f"within {digits(model.response_time, 3)} s: is the sampling period in seconds?"
        )

    @property
    def process(self) -> TransferFunction:
        """The process as a continuous controller meets it, with the delay that the loop adds."""
        return replace(self.model, dead_time=self.model.dead_time + self.options.added_delay)

    def held(self, model: TransferFunction) -> TransferFunction:
        """Return a process with the loop's own delay, but no dead time for the hold.

        :param model: the process, or a model within its uncertainty.
        """
        return replace(model, dead_time=model.dead_time + self.options.loop_delay)

    def law(self, controller: Controller) -> SampledLaw:
        """Return the law that will run, with what it can do of a controller.

        :param controller: the gains that a rule gives.
        """
        return self.options.rate.of(controller)

    def loop(self, controller: Controller) -> Loop:
        """Return the loop of a controller and the process, as the law runs it.

        :param controller: the gains that a rule gives.
        """
        return Loop(self.law(controller), self.held(self.model))

    def set_of(
        self, models: Sequence[TransferFunction], errors: ModelErrors | None = None
    ) -> ModelSet:
        """Return processes as the loop meets them.

        :param models: such as those within the uncertainty.
        :param errors: what the processes show beside these; None: nothing.
        """
        held = [self.held(model) for model in models]
        errors = None if errors is None else errors.later(self.options.loop_delay)
        return ModelSet(held, self.options.rate.period, errors=errors)

    @cached_property
    def around(self) -> ModelSet | None:
        """The processes within the uncertainty, as the loop meets them; None: it is not known."""
        return self.set_of(self.models, self.errors) if self.models else None


def cautions(
    controller: Controller, performance: Performance, task: DesignTask
) -> tuple[str, ...]:
    """Return what the user must know before using gains, a sentence each.

    :param controller: the gains.
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
                f"a larger --{name.lower()}"
            )
    noise = performance.noise_gain * options.noise_std
    known = options.sample_period > 0.0 and options.amplitude > 0.0
    if known and noise > _HELD * options.noise_share * options.amplitude:
        found.append(
            f"the noise alone moves the command by {noise:.3g} u (standard deviation), "
            f"{100.0 * noise / options.amplitude:.0f} % of the amplitude of the test; filter "
            f"the measurement{', or ask for controller pi' if controller.td else ''}"
        )
    return (*found, task.too_slow) if task.too_slow else tuple(found)


# Less than this is not worth a sentence: factors, and a difference of overshoots.
_ERROR, _NOISE, _OVERSHOOT = 1.05, 1.2, 0.03
_MS = 1.01


def cost_of(law: SampledLaw, found: Performance, own: Performance | None) -> tuple[str, ...]:
    """Return a sentence on what a law costs against controller_node; none if that is little.

    :param law: with its gains.
    :param found: what it does on the model.
    :param own: what controller_node does there with gains of the same rule; None: not known.
    """
    name = law.law.name
    if own is None or name == OWN_LAW:
        return ()
    costs = []
    if found.ms > _MS * own.ms:
        costs.append(f"Ms {found.ms:.3g} instead of {own.ms:.3g}")
    if math.isfinite(own.iae_load) and found.iae_load > _ERROR * own.iae_load:
        costs.append(
            f"{found.iae_load / own.iae_load:.2f} times the error after a step of the load"
        )
    if found.noise_gain > _NOISE * own.noise_gain > 0.0:
        costs.append(f"{found.noise_gain / own.noise_gain:.1f} times the noise in the command")
    if found.overshoot > own.overshoot + _OVERSHOOT:
        costs.append(
            f"an overshoot of {100.0 * found.overshoot:.0f} % instead of "
            f"{100.0 * own.overshoot:.0f} % after a step of the set-point"
        )
    if not costs:
        return ()
    return (
        f"{name} does worse than a controller with filter and set-point weight, {OWN_LAW}: "
        f"{', '.join(costs)}; {_lacking(law)}",
    )


def _lacking(law: SampledLaw) -> str:
    """Return what the law cannot do."""
    row = law.law
    lacks = []
    if row.slope is Slope.NONE:
        lacks.append("no derivative")
    elif not row.smoothing.adjustable:
        lacks.append("no filter to set")
    elif not row.smoothing.on_measurement:
        lacks.append("a filter on the derivative alone")
    if row.weights:
        lacks.append(f"a set-point weight of {' or '.join(f'{w:g}' for w in row.weights)} only")
    if row.delay:
        lacks.append(f"a command that acts {row.delay} sample later")
    return f"it has {', '.join(lacks)}"
