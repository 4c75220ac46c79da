# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Controller design: rules by name, and what their gains do on the model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from relay_autotune.errors import ModelError, TuningError, look_up
from relay_autotune.identification.result import Identification
from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Controller, Gains, Performance
from relay_autotune.loop.laws import OWN_LAW
from relay_autotune.process.structures import FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.ensemble import ensemble_ms
from relay_autotune.tuning.robust import robust
from relay_autotune.tuning.rules import PUBLISHED, Rule
from relay_autotune.tuning.rules.formulas import describing_point_of
from relay_autotune.tuning.rules.step_response import two_point_fopdt
from relay_autotune.tuning.task import DesignOptions, DesignTask, cautions, cost_of

RULES: dict[str, Rule] = {"robust": robust, **PUBLISHED}
DEFAULT_RULE = "robust"


def rule_named(name: str) -> Rule:
    """Return a rule by its name.

    :raises TuningError: if the name is unknown; the message lists the known names.
    """
    return look_up(RULES, name, "rule", TuningError)


def tune(
    identification: Identification | TransferFunction,
    rule: str = DEFAULT_RULE,
    models: Sequence[TransferFunction] = (),
    options: DesignOptions | None = None,
) -> Gains:
    """Return the gains of a rule, judged on the model and on models within its uncertainty.

    >>> from relay_autotune import DesignOptions, TransferFunction, tune
    >>> oven = TransferFunction.fopdt(gain=1.65, time_constant=20.0, dead_time=10.0)
    >>> gains = tune(oven, rule="simc")
    >>> print(gains)
    kc = 0.6061, ti = 20 s
    >>> f"Ms {gains.ms:.2f}"
    'Ms 1.59'
    >>> print(tune(oven, options=DesignOptions(ms=1.6, controller="pi")))
    kc = 0.571, ti = 17.61 s

    :param identification: the model, as it was identified, or a transfer function.
    :param rule: one of ``RULES``.
    :param models: models within the uncertainty, from :func:`ensemble`.
    :param options: what is asked of the controller.
    :raises TuningError: if the rule does not apply, or its loop is unstable on the model or on
        more than 5 % of ``models``.
    """
    if isinstance(identification, TransferFunction):
        model = identification
    else:
        model = identification.model
    return design(replace(task_of_model(model, options), models=tuple(models)), rule)


def task_of_model(model: TransferFunction, options: DesignOptions | None = None) -> DesignTask:
    """Return the design task for a model alone; what a record would add is computed from it.

    :param model: the process.
    :param options: what is asked of the controller.
    """
    simple = None
    if not FOPDT.holds(model):
        # Without one, rules for FOPDT will say that the model is not one.
        with suppress(TuningError):
            simple = two_point_fopdt(model)
    return DesignTask(
        model=model,
        options=options or DesignOptions(),
        simple=simple,
        describing=describing_point_of(model),
    )


def design(task: DesignTask, rule: str) -> Gains:
    """Return the gains of a rule, judged on the model and on models within its uncertainty.

    They are judged on the loop as it runs, with the sampling period and the loop's own delay.

    :param task: the process and what is asked of the controller.
    :param rule: one of ``RULES``.
    :raises TuningError: as :func:`tune`.
    """
    return judged(task, designed(task, rule))


@dataclass(frozen=True)
class Designed:
    """What a rule gives, whatever the set-point weight that is asked for.

    :param rule: its name.
    :param controller: the gains, with the rule's own weight.
    :param reason: why, a sentence.
    :param own: what it gives for our own law at the same period; None: no other law was named, or
        the rule gives nothing for ours.
    """

    rule: str
    controller: Controller
    reason: str
    own: Controller | None = None


def designed(task: DesignTask, rule: str) -> Designed:
    """Return what a rule gives, before it is judged.

    :param task: the process and what is asked of the controller.
    :param rule: one of ``RULES``.
    :raises TuningError: if the rule does not apply.
    """
    controller, reason = rule_named(rule)(task)
    own = None
    if task.options.law not in ("", OWN_LAW):
        # No other rule looks at the law.
        with suppress(TuningError):
            own = robust(_with_own_law(task))[0] if rule == DEFAULT_RULE else controller
    return Designed(rule, controller, reason, own)


def _with_own_law(task: DesignTask) -> DesignTask:
    return replace(task, options=replace(task.options, law=OWN_LAW))


def judged(task: DesignTask, found: Designed) -> Gains:
    """Return what a rule's controller does, with the set-point weight that the options ask for.

    Where a law was named, it is what that law can do of the controller, with its exact loop.

    :param task: the process and what is asked of the controller.
    :param found: what the rule gives, with any weight asked for.
    :raises TuningError: if the loop is unstable on the model or on more than 5 % of those around.
    """
    options, reason = task.options, found.reason

    def weighted(controller: Controller) -> Controller:
        weight = options.setpoint_weight
        return controller if math.isnan(weight) else replace(controller, b=weight)

    law = task.law(weighted(found.controller))
    controller, performance = law.gains, Loop(law, task.held(task.model)).performance()
    bare, warnings = None, cautions(controller, performance, task)
    if options.law:
        reason += f"; for {options.law} every {options.sample_period:g} s"
        own = None
        if found.own is not None:
            with suppress(TuningError):
                own = _with_own_law(task).loop(weighted(found.own)).performance()
        warnings += cost_of(law, performance, own)
    else:
        bare, unstable = _bare(controller, task)
        warnings += unstable
        if options.sample_period:
            reason += f"; for a controller that runs every {options.sample_period:g} s"
    if 0.0 < options.sample_period == task.recorded_period:
        reason += ", the interval of the recording; --sample-period names another"
    if 0.0 < controller.ti < task.options.sample_period:
        # What it integrates in one sample is more than its proportional part.
        reason += (
            f"; in effect an integral controller, i = {controller.i:.4g} u/(y s): its ti is less "
            "than a sampling period, so that a program that takes kc and ti cannot hold it"
        )
    if task.around is None:
        reason += "; the uncertainty of the model is not known, so that Ms_95 is Ms"
        ms_95 = performance.ms
    else:
        ms_95 = max(ensemble_ms(law, task.around), performance.ms)
    return Gains(
        **vars(controller),
        **vars(performance),
        rule=found.rule,
        ms_95=ms_95,
        law=options.law,
        law_period=options.sample_period if options.law else 0.0,
        bare=bare,
        reason=reason,
        warnings=warnings,
    )


def _bare(controller: Controller, task: DesignTask) -> tuple[Performance | None, tuple[str, ...]]:
    """Return what p, i and d do without filter and set-point weight, and a warning if unstable."""
    alone = replace(controller, tf=0.0, b=1.0)
    if alone == controller:
        return None, ()
    try:
        return task.loop(alone).performance(), ()
    except (ModelError, TuningError):
        note = f"the loop needs the filter, tf = {controller.tf:.4g} s: without it, it is unstable"
        return None, (note,) if controller.tf > 0.0 else ()
