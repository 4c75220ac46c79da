# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a page shapes: a model, what is asked of its gains, and what these do.

Every number comes from the functions that `replay` and `tune` call, with their options.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.loop.responses import step_responses
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.report.case import Case
from relay_autotune.report.frequency import loop_frequencies, swept_parts
from relay_autotune.report.loops import shown_load, step_duration
from relay_autotune.shaping import Shaping
from relay_autotune.tuning import DEFAULT_RULE, design, judged
from relay_autotune.tuning.ensemble import ensemble_peaks
from relay_autotune.verdict import Judgement, Verdict

FloatArray = NDArray[np.floating]
ComplexArray = NDArray[np.complexfloating]

# What the slider asks for: from calm to fast.
CALM, FAST, STEP = 1.2, 2.0, 0.02
# Instants of a response that is drawn, and frequencies of the band about a Nyquist curve.
_POINTS = 512
_BAND = 60
# Beyond this distance from the origin nothing is drawn.
_FAR = 6.0


@dataclass(frozen=True)
class Asked:
    """What the page asks of the gains; everything else is as the command line says.

    :param rule: name of the rule.
    :param controller: "auto", "pi" or "pid".
    :param ms: largest Ms.
    :param setpoint_weight: b; None: the rule's own.
    """

    rule: str = DEFAULT_RULE
    controller: str = "auto"
    ms: float = 1.4
    setpoint_weight: float | None = None


@dataclass(frozen=True)
class Steps:
    """A step of the set-point, and then one of the load, as deviations.

    :param time: s, shape (n,).
    :param measurement: y on the model, shape (n,).
    :param command: u on the model, shape (n,).
    :param low: measurement that 2.5 % of the models around stay below, shape (n,) or (0,).
    :param high: that 97.5 % stay below.
    :param load_time: instant of the step of the load [s].
    """

    time: FloatArray
    measurement: FloatArray
    command: FloatArray
    low: FloatArray
    high: FloatArray
    load_time: float


@dataclass(frozen=True)
class LoopCurve:
    """The loop about the point -1.

    :param loop: its values, shape (f,).
    :param band: polygons that cover the 95 % band of the models around.
    """

    loop: ComplexArray
    band: Sequence[FloatArray]


@dataclass(frozen=True)
class Shaped:
    """Gains as they were asked for, and what they do.

    :param asked: what was asked for.
    :param gains: the gains.
    :param judgement: of the experiment with these gains.
    :param steps: responses of the closed loop.
    :param curve: the loop.
    :param unstable: number of models around on which the loop is unstable.
    """

    asked: Asked
    gains: Gains
    judgement: Judgement
    steps: Steps
    curve: LoopCurve
    unstable: int


@dataclass
class Subject:
    """One model of which a page shows all, and for which it shapes gains.

    :param case: the experiment as the report shows it.
    :param shaping: what the design of gains takes; None: there may be no gains.
    :param first: what the command line asks for.
    :param command: returns the command line that gives the same again.
    """

    case: Case
    shaping: Shaping | None
    first: Asked
    command: Callable[[Asked], str]
    _designed: dict[Asked, Gains | TuningError] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _shown: tuple[float, float] | None = None

    def positions(self) -> Iterator[Asked]:
        """Yield what the slider can ask for, first from end to end roughly, then ever finer."""
        count = round((FAST - CALM) / STEP)
        kinds = (self.first.controller, *({"auto", "pi", "pid"} - {self.first.controller}))
        for kind in kinds:
            seen: set[int] = set()
            for stride in (8, 4, 2, 1):
                for k in range(0, count + 1, stride):
                    if k not in seen:
                        seen.add(k)
                        yield Asked(DEFAULT_RULE, kind, round(CALM + k * STEP, 6))

    def trade_off(self) -> list[tuple[str, Gains]]:
        """Return the controllers of the rule robust that are known so far, by what was asked."""
        with self._lock:
            known = list(self._designed.items())
        return [
            (asked.controller, gains)
            for asked, gains in known
            if isinstance(gains, Gains) and asked.rule == DEFAULT_RULE
        ]

    def shaped(self, asked: Asked) -> Shaped:
        """Return gains and what they do.

        :param asked: what is asked for.
        :raises TuningError: if there are no such gains; the sentence says why.
        """
        if self.shaping is None:
            raise TuningError(self.case.reason or "there are no gains for this experiment")
        gains = self._gains(self.shaping, asked)
        judgement = self.shaping.judgement(gains)
        if judgement.verdict is Verdict.NONE:
            raise TuningError(f"no gains: {judgement.reason}")
        return _shaped(self.shaping, asked, gains, judgement, self._scale(gains))

    def case_with(self, shaped: Shaped) -> Case:
        """Return the experiment with other recommended gains, as the report shows it.

        :param shaped: the gains.
        """
        others = tuple(g for g in self.case.gains if g.rule != shaped.gains.rule)
        return replace(
            self.case,
            gains=(shaped.gains, *others),
            recommended=0,
            judgement=shaped.judgement,
            reason="",
            command=self.command(shaped.asked),
        )

    def _gains(self, shaping: Shaping, asked: Asked) -> Gains:
        """Return the gains; the search is not repeated for another set-point weight."""
        plain = replace(asked, setpoint_weight=None)
        with self._lock:
            found = self._designed.get(plain)
        if found is None:
            options = replace(shaping.task.options, ms=asked.ms, controller=asked.controller)
            try:
                found = design(replace(shaping.task, options=options), asked.rule)
            except TuningError as error:
                found = error
            with self._lock:
                self._designed[plain] = found
        if isinstance(found, TuningError):
            raise TuningError(str(found))
        if asked.setpoint_weight is None:
            return found
        options = replace(
            shaping.task.options,
            ms=asked.ms,
            controller=asked.controller,
            setpoint_weight=asked.setpoint_weight,
        )
        law = Controller(**{each.name: getattr(found, each.name) for each in fields(Controller)})
        return judged(replace(shaping.task, options=options), asked.rule, law, found.reason)

    def _scale(self, gains: Gains) -> tuple[float, float]:
        """Return duration and load of the steps, which stay the same while gains change."""
        with self._lock:
            if self._shown is None:
                assert self.shaping is not None
                model = self.shaping.task.in_loop(self.shaping.task.model)
                best = self.case.best_gains or gains
                self._shown = step_duration(best, model), shown_load(best, model)
            return self._shown


def _shaped(
    shaping: Shaping, asked: Asked, gains: Gains, judgement: Judgement, scale: tuple[float, float]
) -> Shaped:
    task = shaping.task
    model = task.in_loop(task.model)
    around: list[TransferFunction] = []
    unstable = 0
    if task.models:
        peaks = ensemble_peaks(gains, task.exact)
        unstable = peaks.unstable
        around = [m for m, ms in zip(task.around.models, peaks.ms, strict=True) if ms < math.inf]
    return Shaped(
        asked,
        gains,
        judgement,
        _steps(gains, model, around, *scale),
        _curve(gains, model, shaping),
        unstable,
    )


def _steps(
    gains: Gains, model: TransferFunction, around: list[TransferFunction], half: float, load: float
) -> Steps:
    def run(process: TransferFunction) -> tuple[FloatArray, FloatArray, FloatArray]:
        setpoint, loaded = step_responses(gains, process, 2.0 * half, _POINTS)
        measurement, command = setpoint.measurement.copy(), setpoint.command.copy()
        measurement[_POINTS // 2 :] += load * loaded.measurement[: _POINTS // 2]
        command[_POINTS // 2 :] += load * loaded.command[: _POINTS // 2]
        return setpoint.time, measurement, command

    time, measurement, command = run(model)
    low = high = np.empty(0)
    if around:
        runs = np.array([run(process)[1] for process in around])
        low, high = np.quantile(runs, (0.025, 0.975), axis=0)
    return Steps(time, measurement, command, low, high, half)


def _curve(gains: Gains, model: TransferFunction, shaping: Shaping) -> LoopCurve:
    loop = gains.loop(model)
    w = loop_frequencies(loop)
    values = loop(1j * w)
    near = np.abs(values) < _FAR
    w, values = w[near], values[near]
    band: Sequence[FloatArray] = ()
    if shaping.task.models and w.size > 2:
        some = w[:: max(1, w.size // _BAND)]
        around = gains(1j * some)[:, None] * shaping.task.around(some)
        band = swept_parts(around[np.all(np.abs(around) < _FAR, axis=1)].T)
    return LoopCurve(values, band)


def asked_of(fields: object, rules: tuple[str, ...]) -> Asked:
    """Return what a page asks for, from the fields of its message.

    :param fields: as JSON was read; what is missing has its default.
    :param rules: the names of the rules that it may name.
    :raises TuningError: if a value cannot be.
    """
    if not isinstance(fields, dict):
        raise TuningError("expected what is asked for as an object of names and values")
    rule, controller = fields.get("rule", DEFAULT_RULE), fields.get("controller", "auto")
    ms, weight = fields.get("ms", 1.4), fields.get("setpoint_weight")
    if rule not in rules:
        raise TuningError("expected the name of a rule")
    if controller not in ("auto", "pi", "pid"):
        raise TuningError("expected auto, pi or pid for the controller")
    for value in (ms, *(() if weight is None else (weight,))):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise TuningError("expected numbers for ms and setpoint_weight")
    if not 1.2 <= ms <= 4.0 or not (weight is None or 0.0 <= weight <= 1.0):
        raise TuningError("expected an ms from 1.2 to 4 and a setpoint_weight from 0 to 1")
    return Asked(rule, controller, float(ms), None if weight is None else float(weight))
