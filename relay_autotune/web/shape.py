# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a page shapes: a model, what is asked of its gains, and what these do.

Every number comes from the functions that `replay` and `tune` call, with their options.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.exchange.export import Target
from relay_autotune.loop.analysis import Loop, abscissae, inverted
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.quantities import Quantity, declared
from relay_autotune.report.case import Case
from relay_autotune.report.frequency import (
    loop_frequencies,
    shown_load,
    step_duration,
    swept_parts,
)
from relay_autotune.result import Shaping
from relay_autotune.tuning import DEFAULT_RULE, RULES, Designed, designed, judged
from relay_autotune.tuning.ensemble import ms_on_each
from relay_autotune.tuning.task import DesignOptions, DesignTask
from relay_autotune.verdict import NOT_JUDGED, Judgement, Verdict

# What the slider asks for: from calm to fast.
CALM, FAST, STEP = 1.2, 2.0, 0.02
# Each eighth position is computed first; between them gains are sketched.
_ROUGH = 8
# Gains known for an Ms farther away than this say too little of those that are asked for.
_NEAR = 0.2
# Instants of a response that is drawn, and frequencies of the band about a Nyquist curve.
_POINTS = 512
_BAND = 60
# Beyond this distance from the origin nothing is drawn.
_FAR = 6.0


@dataclass(frozen=True)
class DesignRequest:
    """What the page asks of the gains; everything else is as the command line says.

    The fields but the rule are those of `DesignOptions`.

    :param rule: name of the rule.
    :param controller: "auto", "pi" or "pid".
    :param ms: largest Ms.
    :param setpoint_weight: b; None: the rule's own.
    :param noise_share: largest noise in the command, as a fraction of the amplitude; None: as the
        command line says.
    :param law: name of the law that the gains are for; empty: none in particular; None: likewise.
    :param sample_period: at which it runs [s]; 0: not known; None: likewise.
    """

    rule: str = DEFAULT_RULE
    controller: str = "auto"
    ms: float = 1.4
    setpoint_weight: float | None = None
    noise_share: float | None = None
    law: str | None = None
    sample_period: float | None = None

    @classmethod
    def of(cls, rule: str, options: DesignOptions) -> DesignRequest:
        """Return what some options ask for.

        :param rule: name of the rule.
        :param options: what is asked of the controller.
        """
        values = {name: getattr(options, name) for name in _OPTIONS}
        weight = options.setpoint_weight
        return cls(rule, **values | {"setpoint_weight": None if math.isnan(weight) else weight})

    def options(self, others: DesignOptions) -> DesignOptions:
        """Return the options of a design.

        :param others: those that the page does not ask for.
        :raises TuningError: if a value is out of its range.
        """
        values = {name: getattr(self, name) for name in _OPTIONS}
        given = {name: value for name, value in values.items() if value is not None}
        return replace(others, **{"setpoint_weight": math.nan} | given)

    @property
    def apart_from_ms(self) -> DesignRequest:
        """The same for all positions of the slider; the weight changes no other gain."""
        return replace(self, ms=FAST, setpoint_weight=None)

    def changed_from(self, first: DesignRequest) -> dict[str, Any]:
        """Return what differs from what was asked for first, by name.

        :param first: as the command line asks.
        """
        names = (each.name for each in fields(DesignRequest))
        return {n: getattr(self, n) for n in names if getattr(self, n) != getattr(first, n)}


_OPTIONS = tuple(each.name for each in fields(DesignRequest) if each.name != "rule")


@dataclass(frozen=True)
class Steps:
    """A step of the set-point, and then one of the load, as deviations.

    :param time: s, shape (n,).
    :param measurement: y on the model, shape (n,).
    :param command: u on the model, shape (n,).
    :param low: measurement that 2.5 % of the models around stay below, shape (n,) or (0,).
    :param high: that 97.5 % stay below.
    :param load: height of the step of the load [u].
    :param load_time: its instant [s].
    """

    time: FloatArray
    measurement: FloatArray
    command: FloatArray
    low: FloatArray
    high: FloatArray
    load: float
    load_time: float


@dataclass(frozen=True)
class DesignResult:
    """Gains as they were asked for, and what they do.

    :param asked: what was asked for.
    :param gains: the gains.
    :param judgement: of the experiment with these gains.
    :param steps: responses of the closed loop.
    :param loop: values of the loop about the point -1, shape (f,).
    :param band: polygons that cover the 95 % band of the models around.
    :param unstable: number of models around on which the loop is unstable.
    :param options: with which they were designed.
    """

    asked: DesignRequest
    gains: Gains
    judgement: Judgement
    steps: Steps
    loop: ComplexArray
    band: Sequence[FloatArray]
    unstable: int
    options: DesignOptions


@dataclass
class PageModel:
    """One model of which a page shows all, and for which it shapes gains.

    :param case: the experiment as the report shows it.
    :param shaping: what the design of gains takes; None: there may be no gains.
    :param first: what the command line asks for.
    :param command: returns the command line that gives the same again.
    :param loop: number of the loop that it is of, on a page that watches some.
    :param target: where gains go that are written to a file.
    :param when: time of the day at which its tune began; empty: it is of no tune of this page.
    """

    case: Case
    shaping: Shaping | None
    first: DesignRequest
    command: Callable[[DesignRequest], str]
    loop: int = 0
    target: Target = field(default_factory=Target)
    when: str = ""
    _found: dict[DesignRequest, tuple[Designed, Gains] | TuningError] = field(
        default_factory=dict, repr=False
    )
    _shown: tuple[float, float] | None = None

    def positions(self, near: DesignRequest) -> Iterator[DesignRequest]:
        """Yield what the slider can ask for: from end to end roughly, then what is near first.

        :param near: what was asked for last.
        """
        count = round((FAST - CALM) / STEP)
        steps = sorted(range(count + 1), key=lambda k: (k % _ROUGH != 0, abs(_ms(k) - near.ms)))
        others = {"auto", "pi", "pid"} - {near.controller}
        for kind in (near.controller, *sorted(others)):
            for k in steps:
                yield replace(
                    near, rule=DEFAULT_RULE, controller=kind, ms=_ms(k), setpoint_weight=None
                )

    def trade_off(self, of: DesignRequest) -> list[Gains]:
        """Return the controllers of the rule robust that are known so far.

        :param of: for the same law, rate and noise.
        """
        # In one call, since other threads add some.
        known = list(self._found.items())
        wanted = replace(of.apart_from_ms, rule=DEFAULT_RULE, controller="")
        return [
            found[1]
            for asked, found in known
            if not isinstance(found, TuningError)
            and replace(asked.apart_from_ms, controller="") == wanted
        ]

    def shaped(self, asked: DesignRequest) -> DesignResult:
        """Return gains and what they do.

        :param asked: what is asked for.
        :raises TuningError: if there are no such gains; the sentence says why.
        """
        if self.shaping is None:
            raise TuningError(self.case.reason or "there are no gains for this experiment")
        shaping = self.shaping.asking(asked.options(self.shaping.task.options))
        gains = self._gains(shaping, asked)
        judgement = shaping.judgement(gains)
        if judgement.verdict is Verdict.NONE:
            raise TuningError(f"no gains: {judgement.reason}")
        return _shaped(shaping, asked, gains, judgement, self._scale(gains))

    def sketched(self, asked: DesignRequest) -> DesignResult | None:
        """Return gains between those that are known for Ms nearby, while the exact ones are found.

        They are judged on the model alone, and carry no verdict.

        :param asked: what is asked for.
        :return: None: too little is known.
        """
        if self.shaping is None or asked.rule != DEFAULT_RULE:
            return None
        base = asked.apart_from_ms
        near = sorted(
            (abs(each.ms - asked.ms), each.ms, found[0].controller)
            for each, found in list(self._found.items())
            if not isinstance(found, TuningError) and each.apart_from_ms == base
        )[:2]
        if near and near[0][0] == 0.0:
            # The gains themselves are known, and what they do on all models is not.
            near = [near[0], (0.0, asked.ms + STEP, near[0][2])]
        if len(near) < 2 or near[1][0] > _NEAR:
            return None
        (_, low, one), (_, high, other) = near
        if (one.td > 0.0) != (other.td > 0.0):
            return None
        part = (asked.ms - low) / (high - low)
        names = [each.name for each in fields(Controller)]
        between = {n: (1.0 - part) * getattr(one, n) + part * getattr(other, n) for n in names}
        # Outside of the two known ones a straight line may give a time below 0.
        between |= {n: max(between[n], 0.0) for n in ("ti", "td", "tf")}
        between["b"] = min(max(between["b"], 0.0), 1.0)
        shaping = self.shaping.asking(asked.options(self.shaping.task.options))
        alone = replace(shaping, task=replace(shaping.task, models=()), evidence=None)
        sketch = Designed(asked.rule, Controller(**between), "the exact gains are being computed")
        try:
            gains = judged(alone.task, sketch)
        except TuningError:
            return None
        return _shaped(alone, asked, gains, NOT_JUDGED, self._scale(gains))

    def before(self) -> Steps | None:
        """Return both steps with the present gains; None: they are not known, or unstable."""
        case, shaping = self.case, self.shaping
        if case.present is None or case.present_does is None or shaping is None:
            return None
        loop = Loop(case.present, shaping.task.process)
        return _steps(loop, shaping.task, np.empty(0, dtype=bool), *self._scale(case.present))

    def case_with(self, shaped: DesignResult) -> Case:
        """Return the experiment with other recommended gains, as the report shows it.

        :param shaped: the gains.
        """
        others = tuple(g for g in self.case.gains if g.rule != shaped.gains.rule)
        return replace(
            self.case,
            gains=(shaped.gains, *others),
            best_gains=shaped.gains,
            judgement=shaped.judgement,
            reason="",
            added_delay=shaped.options.added_delay,
            command=self.command(shaped.asked),
        )

    def _gains(self, shaping: Shaping, asked: DesignRequest) -> Gains:
        """Return the gains; the search is not repeated for another set-point weight."""
        plain = replace(asked, setpoint_weight=None)
        found = self._found.get(plain)
        if found is None:
            task = shaping.asking(plain.options(shaping.task.options)).task
            try:
                design = designed(task, asked.rule)
                found = design, judged(task, design)
            except TuningError as error:
                found = error
            self._found[plain] = found
        if isinstance(found, TuningError):
            raise TuningError(str(found))
        design, gains = found
        return gains if asked == plain else judged(shaping.task, design)

    def _scale(self, gains: Controller) -> tuple[float, float]:
        """Return duration and load of the steps, which stay the same while gains change."""
        if self._shown is None:
            assert self.shaping is not None
            model = self.shaping.task.process
            best = self.case.best_gains or gains
            self._shown = step_duration(best, model), shown_load(best, model)
        return self._shown


def _shaped(
    shaping: Shaping,
    asked: DesignRequest,
    gains: Gains,
    judgement: Judgement,
    scale: tuple[float, float],
) -> DesignResult:
    task = shaping.task
    loop, steady = task.loop(gains), np.empty(0, dtype=bool)
    unstable = 0
    if task.around is not None:
        steady = np.isfinite(ms_on_each(loop.law, task.around))
        unstable = int(np.sum(~steady))
    return DesignResult(
        asked,
        gains,
        judgement,
        _steps(loop, task, steady, *scale),
        *_curve(loop, gains, task),
        unstable,
        task.options,
    )


def _ms(k: int) -> float:
    return round(CALM + k * STEP, 6)


def _steps(
    loop: Loop, task: DesignTask, steady: NDArray[np.bool_], half: float, load: float
) -> Steps:
    duration, law = 2.0 * half, loop.law
    setpoint, loaded = loop.step_responses(duration, _POINTS)
    measurement, command = setpoint.measurement.copy(), setpoint.command.copy()
    measurement[_POINTS // 2 :] += load * loaded.measurement[: _POINTS // 2]
    command[_POINTS // 2 :] += load * loaded.command[: _POINTS // 2]
    low = high = np.empty(0)
    if task.around is not None and np.any(steady):
        # All models at once, each with both steps in one transform.
        s = abscissae(duration, _POINTS)
        steps = (law.from_setpoint(s) + load * np.exp(-half * s)) / s
        moving = task.around.sampled(0.0)(s).T[steady]
        runs = inverted(moving / (1.0 + law(s) * task.around(s).T[steady]) * steps, duration)
        low, high = np.quantile(runs, (0.025, 0.975), axis=0)
    return Steps(setpoint.time, measurement, command, low, high, load, half)


def _curve(
    loop: Loop, gains: Gains, task: DesignTask
) -> tuple[ComplexArray, Sequence[FloatArray]]:
    """Return a loop about the point -1, and its band."""
    w = loop_frequencies(gains.loop(task.process))
    if loop.law.period > 0.0:
        w = w[w * loop.law.period < math.pi]
    values = loop(1j * w)
    near = np.abs(values) < _FAR
    w, values = w[near], values[near]
    band: Sequence[FloatArray] = ()
    if task.around is not None and w.size > 2:
        some = w[:: max(1, w.size // _BAND)]
        around = loop.law(1j * some)[:, None] * task.around.at(some)
        band = swept_parts(around[np.all(np.abs(around) < _FAR, axis=1)].T)
    return values, band


def asked_of(given: object) -> DesignRequest:
    """Return what a page asks for, from the fields of its message.

    :param given: as JSON was read; what is missing has its default.
    :raises TuningError: if a value cannot be.
    """
    if not isinstance(given, dict):
        raise TuningError("expected what is asked for as an object of names and values")
    values = {each.name: given.get(each.name, each.default) for each in fields(DesignRequest)}
    known = {each.name: each for each in declared(DesignOptions)}
    known["rule"] = Quantity("rule", DEFAULT_RULE, choices=tuple(RULES))
    for each in fields(DesignRequest):
        value = values[each.name]
        if value is None and each.default is None:
            continue
        problem = known[each.name].problem(value)
        if problem is not None:
            raise TuningError(problem)
        if known[each.name].is_number:
            values[each.name] = float(value)
    return DesignRequest(**values)
