# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The action ~/verify of controller_node: make steps, compare, pass or fail."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import partial
from typing import Any

import numpy as np
from rclpy.task import Future

from relay_autotune.control.controller import LONGEST_TIME, Control
from relay_autotune.control.gains_history import GainSet
from relay_autotune.control.verification import Plan, Step, compare, plan
from relay_autotune.errors import NotReadyError, RelayAutotuneError
from relay_autotune.exchange.fields import float64_array
from relay_autotune.exchange.messages import fill_reason, reason_from_message, set_stamp
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes import quality
from relay_autotune.nodes.goals import Narrator, OneGoal, conclude
from relay_autotune.nodes.lifetime import STEADY, ServedNode
from relay_autotune.nodes.results import keep
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.reasons import NONE, Code, Reason, other, reason_of
from relay_autotune.text import duration
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import Verification

# Number of samples before a step, for the loop's rest and noise.
_BEFORE = 50
_LEAST_BEFORE = 10
# Longest silence of the measurement: a time [s], or a number of usual intervals if that is longer.
_SILENCE = 2.0
_SILENT_INTERVALS = 20.0
_LOOK_EVERY = 0.2
# This many samples in a row beyond the limit are no outliers of the sensor.
_IN_A_ROW = 2
# A gap in the samples of this part of a step leaves too little to judge.
_LARGEST_HOLE = 0.25
# Steps whose samples are kept for late subscribers: those of a verification.
_STEPS_KEPT = 2
# Limits on the steady clock: the preparation [s]; the steps as a multiple of the planned time,
# plus a reserve [s].
_PREPARED_WITHIN = 60.0
_TIMES_PLANNED = 4.0
_MORE_THAN_PLANNED = 10.0

_Sample = tuple[float, float, float]


@dataclass(frozen=True)
class Verifiable:
    """What is to be verified.

    :param steps: to be made.
    :param new: the gains that are put in force for it; None: those in force are tried.
    :param settles: how long the loop takes to settle with new gains [s]; NaN: not known.
    :param control: the controller to be tried.
    :param model: the process as identified.
    :param limits: range of the command.
    """

    steps: Sequence[Step]
    new: GainSet | None
    settles: float
    control: Control
    model: TransferFunction
    limits: Limits


class Predictors:
    """The models that can predict a step, and the experiments of the gains that were applied.

    Gains are proved on the model of their own experiment. Messages of several experiments may
    arrive late and out of order, and a prediction by another one's model proves nothing.

    :param models: `ResultCheck.models`.
    """

    def __init__(self, models: Mapping[str, tuple[TransferFunction, str]]) -> None:
        self._models = models
        self._experiments: dict[GainSet, str] = {}

    def applied(self, gains: GainSet, experiment_id: str) -> None:
        """Remember of which experiment gains are."""
        keep(self._experiments, gains, experiment_id)

    def require_any(self) -> None:
        """Refuse a verification without any model.

        :raises NotReadyError: if no model has come.
        """
        if not self._models:
            raise NotReadyError(Code.NO_MODEL_YET())

    def of(self, gains: GainSet) -> tuple[TransferFunction, str]:
        """Return the model that predicts a step with some gains, and why it is doubtful.

        Gains without a known experiment, such as those of the parameters, take the newest model.

        :param gains: the gains in force.
        :raises NotReadyError: if there are only models of other experiments.
        """
        self.require_any()
        name = next((n for known, n in self._experiments.items() if known.is_near(gains)), "")
        newest = list(self._models)[-1]
        if name not in self._models and name and newest:
            raise NotReadyError(Code.OTHER_EXPERIMENT(experiment=name, newest=newest))
        return self._models[name if name in self._models else newest]


@dataclass(frozen=True)
class Rest:
    """A loop before a step.

    :param measurement: its mean [y].
    :param command: its mean [u].
    :param noise_std: standard deviation of the measurement about its trend [y].
    """

    measurement: float
    command: float
    noise_std: float


class _Phase(Enum):
    IDLE = auto()
    PREPARING = auto()
    SETTLING = auto()
    STEPPING = auto()
    RETURNING = auto()
    ENDING = auto()


class Verifier:
    """Make steps on a running loop and compare each with the prediction.

    The predictions take up to seconds, so they are computed in another thread.

    :param node: the node.
    :param prepare: takes a request and returns what is to be verified; raises RelayAutotuneError
        with the reason if the loop is not ready.
    :param begin: begins the proof of what is to be verified; raises RelayAutotuneError if it
        cannot. Nothing has changed before, and whatever comes after, `ended` is called.
    :param move: adds a step to the set-point [y] and one to the command [u]; 0: no step.
    :param ended: called with True if all steps passed, False if one failed, None without a
        verdict, and a sentence; returns the sentence for the client.
    """

    def __init__(
        self,
        node: ServedNode,
        *,
        prepare: Callable[[Any], Awaitable[Verifiable]],
        begin: Callable[[Verifiable], Awaitable[None]],
        move: Callable[[float, float], None],
        ended: Callable[[bool | None, str], Awaitable[str]],
    ) -> None:
        self._node = node
        self._verifiable = prepare
        self._on_trial = begin
        self._move = move
        self._ended = ended
        self._phase = _Phase.IDLE
        # What ends the proof: verdict, reason, and whether the action succeeded.
        self._outcome: Future = Future()
        # Done at the next look.
        self._next_look: Future = Future()
        self._waits_for = ""
        self._recent: deque[_Sample] = deque(maxlen=_BEFORE)
        self._arrivals: deque[float] = deque(maxlen=_BEFORE)
        self._tried: Verifiable
        self._plans: list[Plan] = []
        self._found: list[Any] = []
        self._number = 0
        self._samples: list[_Sample] = []
        self._rest: Rest
        self._begun = 0.0
        # On the steady clock: the deadline, and the last advance of the samples' time.
        self._until = self._advanced = 0.0
        self._period = 0.0
        self._beyond = 0
        self._watch = node.create_timer(_LOOK_EVERY, self._look, clock=STEADY, autostart=False)
        self._narrator = Narrator(node, self._words, self._tell)
        self._full = quality.publisher(
            node, Verification, "verification", quality.latched(_STEPS_KEPT)
        )
        self._action = OneGoal(
            node, Verify, "~/verify", self._accept, partial(self.interrupt, Code.CANCELLED())
        )

    @property
    def is_running(self) -> bool:
        """True from the acceptance of a goal to its end."""
        return self._action.running is not None

    @property
    def rested_at(self) -> float:
        """Command at rest before the present step [u]; NaN without a step."""
        moved = self._phase in (_Phase.STEPPING, _Phase.RETURNING)
        return self._rest.command if moved else math.nan

    # Beginning.

    def require_samples(self) -> None:
        """Refuse a loop without samples.

        :raises NotReadyError: if there are too few samples to know the loop's rest.
        """
        if len(self._recent) < _LEAST_BEFORE:
            raise NotReadyError(Code.FEW_SAMPLES(samples=len(self._recent), needed=_LEAST_BEFORE))

    def _accept(self, goal: Any) -> None:
        patience, why = goal.request.patience, NONE
        if self._action.running is not None:
            why = Code.VERIFYING()
        elif not 0.0 <= patience <= LONGEST_TIME:
            why = other(f"patience is {patience:g} s, expected 0 to {LONGEST_TIME:g} s")
        if why:
            conclude(goal, _result(False, why, str(why)), succeeded=False)
            return
        self._action.running, self._phase, self._found = goal, _Phase.PREPARING, []
        self._outcome, self._waits_for = Future(), ""
        self._until = time.monotonic() + _PREPARED_WITHIN + patience
        self._watch.reset()
        self._node.defer(self._narrator.now)
        self._node.executor.create_task(self._prove, goal)

    async def _prove(self, goal: Any) -> None:
        """Make a proof from its begin to its end; there is no other way out of it."""
        try:
            await self._begin(goal.request)
        except Exception as error:  # noqa: BLE001  the loop goes on, and the client is told
            self._end(None, _why(error), succeeded=False)
        passed, why, succeeded = await self._outcome
        reason = str(why)
        try:
            reason = await self._ended(passed, reason)
        except Exception as error:  # noqa: BLE001
            reason = f"{reason}; {_why(error)}"
        self._watch.cancel()
        self._action.running, self._phase = None, _Phase.IDLE
        steps = [without_arrays(message) for message in self._found]
        result = _result(passed is True, why, reason, steps)
        self._found = []
        conclude(goal, result, succeeded=succeeded)

    async def _begin(self, request: Any) -> None:
        """Put the gains on trial and begin the first step, unless the proof has ended before."""
        tried = await self._verifiable(request)
        until = time.monotonic() + request.patience
        if tried.new is not None and self._is_preparing():
            await self._on_trial(tried)
            if self._is_preparing():
                shown = self._recent[-1][0] - self._recent[0][0]
                await self._settled(tried.settles if math.isfinite(tried.settles) else shown)
                until = time.monotonic() + request.patience
        rest, period = await self._rested(tried.steps, until)
        if not self._is_preparing():
            return
        loop = tried.control, tried.model
        plans = await self._node.computed(
            lambda: [plan(*loop, s, period, rest.noise_std) for s in tried.steps]
        )
        for step, planned in zip(tried.steps, plans, strict=True):
            planned.require_visible(step, rest.noise_std)
        if tried.new is None and self._is_preparing():
            await self._on_trial(tried)
        if not self._is_preparing():
            return
        self._tried, self._rest, self._period = tried, rest, period
        self._plans, self._number, self._beyond = plans, 0, 0
        self._begun = self._recent[-1][0]
        planned_time = 2.0 * sum(p.duration for p in plans)
        self._until = (
            time.monotonic() + _TIMES_PLANNED * self._pace() * planned_time + _MORE_THAN_PLANNED
        )
        self._begin_step()

    def _is_preparing(self) -> bool:
        return self._phase is _Phase.PREPARING

    async def _settled(self, seconds: float) -> None:
        """Wait until the loop has run for a time with its new gains, or the proof has ended.

        :param seconds: by the time of the samples [s].
        """
        self._phase = _Phase.SETTLING
        self._until += _TIMES_PLANNED * self._pace() * seconds + _MORE_THAN_PLANNED
        begun, self._advanced = self._recent[-1][0], time.monotonic()
        # The first sample with the new gains aligns them without a bump: a step before it would be
        # taken for part of that.
        while (
            self._phase is _Phase.SETTLING
            and not 0.0 < (done := self._recent[-1][0] - begun) >= seconds
        ):
            self._waits_for = (
                f"the loop settles with the new gains, {duration(done)} of {duration(seconds)}"
            )
            await self._look_again()
        if self._phase is _Phase.SETTLING:
            self._phase = _Phase.PREPARING

    async def _rested(self, steps: Sequence[Step], until: float) -> tuple[Rest, float]:
        """Return the loop's state of rest and its sample period [s], as soon as it is at rest.

        :param steps: that are to be made.
        :param until: how long to wait, on the steady clock [s].
        :raises NotReadyError: if it does not come to rest.
        """
        while True:
            try:
                self.require_samples()
                found = self._at_rest(steps)
            except NotReadyError as error:
                if self._phase is not _Phase.PREPARING or time.monotonic() >= until:
                    raise
                self._waits_for = str(error)
            else:
                self._waits_for = ""
                return found
            await self._look_again()

    async def _look_again(self) -> None:
        self._next_look = Future()
        await self._next_look

    def _pace(self) -> float:
        """Return the steady time for one second of the samples' time."""
        ours = self._arrivals[-1] - self._arrivals[0]
        theirs = self._recent[-1][0] - self._recent[0][0]
        return ours / theirs if theirs > 0.0 else 1.0

    def _at_rest(self, steps: Sequence[Step]) -> tuple[Rest, float]:
        """Return the loop's state of rest and its sample period [s]."""
        t, y, u = (np.array(column) for column in zip(*self._recent, strict=True))
        period = float(np.median(np.diff(t)))
        if not period > 0.0:
            raise NotReadyError(Code.STEP_TIME_STANDS())
        line = np.polyfit(t - t[0], y, 1)
        noise = float(np.std(y - np.polyval(line, t - t[0]), ddof=2))
        drift = abs(float(line[0])) * float(t[-1] - t[0])
        smallest = min((abs(s.setpoint) for s in steps if s.setpoint), default=math.inf)
        if drift > 4.0 * noise and drift > 0.1 * smallest:
            raise NotReadyError(Code.NOT_AT_REST(drift=drift, samples=len(self._recent)))
        return Rest(float(y.mean()), float(u.mean()), noise), period

    def _begin_step(self) -> None:
        self._phase, self._samples = _Phase.STEPPING, []
        step = self._tried.steps[self._number]
        self._move(step.setpoint, step.load)
        self._node.defer(self._narrator.now)

    # While it runs.

    def sample(self, at: float, measurement: float, command: float) -> None:
        """Take a sample of the loop, after it was answered.

        :param at: its time [s].
        :param measurement: y.
        :param command: the controller's answer, without the load [u].
        """
        since = at - self._recent[-1][0] if self._recent else 0.0
        if since < 0.0:
            # Time went backwards: earlier samples do not count.
            self._recent.clear()
            self._arrivals.clear()
        now = time.monotonic()
        if since != 0.0:
            self._advanced = now
        sample = (at, measurement, command)
        self._recent.append(sample)
        self._arrivals.append(now)
        if self._phase not in (_Phase.STEPPING, _Phase.RETURNING):
            self._beyond = 0
            return
        wanted = self._plans[self._number]
        hole = max(_SILENT_INTERVALS * self._period, _LARGEST_HOLE * wanted.duration)
        if since < 0.0:
            self.interrupt(Code.STEP_TIME_BACKWARDS(by=-since))
            return
        if since > hole:
            self.interrupt(Code.STEP_GAP(by=since))
            return
        self._samples.append(sample)
        over = at - self._samples[0][0] >= wanted.duration
        if self._phase is _Phase.RETURNING:
            # Go on only when the judgement of the last step has also arrived.
            if over and len(self._found) > self._number:
                self._go_on()
            return
        away = abs(measurement - self._rest.measurement)
        self._beyond = self._beyond + 1 if away > wanted.runaway else 0
        if self._beyond >= _IN_A_ROW:
            self._end(False, Code.STEP_RAN_AWAY(away=away, most=wanted.runaway))
        elif over:
            self._return()

    def out_of_range(self, measurement: float) -> None:
        """Take a measurement outside its range [y], which the controller did not answer."""
        self._beyond += 1
        tried = self._phase in (_Phase.SETTLING, _Phase.STEPPING)
        if tried and self._beyond >= _IN_A_ROW:
            self._end(False, Code.STEP_OUT_OF_RANGE(value=measurement))

    def _return(self) -> None:
        """Remove the step, and judge it meanwhile."""
        judge = partial(
            judged,
            self._tried,
            self._tried.steps[self._number],
            self._plans[self._number],
            tuple(self._samples),
            self._rest,
        )
        self._node.compute(judge, partial(self._judged, self._action.running))
        self._phase, self._samples = _Phase.RETURNING, []
        self._move(0.0, 0.0)

    def _judged(self, goal: Any, message: Any) -> None:
        if goal is not self._action.running or self._phase is not _Phase.RETURNING:
            return
        if isinstance(message, Exception):
            self.interrupt(Code.NOT_JUDGED(why=str(_why(message))))
            return
        self._found.append(message)
        self._full.publish(message)
        whys = [reason_from_message(m.why, m.reason) for m in self._found]
        if not message.passed:
            self._end(False, whys[-1])
        elif len(self._found) == len(self._tried.steps):
            said = "; ".join(map(str, whys))
            worst = max(whys, key=lambda why: why.code)
            self._end(True, replace(worst, said=said))

    def _go_on(self) -> None:
        last = self._samples[-_BEFORE:]
        self._rest = Rest(
            float(np.mean([y for _, y, _ in last])),
            float(np.mean([u for _, _, u in last])),
            self._rest.noise_std,
        )
        self._number += 1
        self._begin_step()

    def _words(self) -> str:
        """Say what the verification waits for and sees; empty where none runs."""
        if self._phase in (_Phase.PREPARING, _Phase.SETTLING):
            return self._waits_for or "computing what the step will do"
        if self._phase not in (_Phase.STEPPING, _Phase.RETURNING):
            return ""
        samples, wanted = self._samples, self._plans[self._number]
        done = duration(samples[-1][0] - samples[0][0] if samples else 0.0)
        now = (
            f"{done} of {duration(wanted.duration)}: the measurement is {self._recent[-1][1]:.6g}"
        )
        step = self._tried.steps[self._number]
        if self._phase is _Phase.RETURNING:
            return f"back without the step, {now}"
        what = f"set-point {step.setpoint:+g} y" if step.setpoint else f"load {step.load:+g} u"
        return f"step {self._number + 1} of {len(self._tried.steps)}, {what}, {now}"

    def _tell(self, status: str) -> None:
        if self._action.running is None:
            return
        planned = self._phase in (_Phase.STEPPING, _Phase.RETURNING)
        elapsed = self._recent[-1][0] - self._begun if planned else 0.0
        whole = 2.0 * sum(p.duration for p in self._plans) if planned else 0.0
        self._action.running.publish_feedback(
            Verify.Feedback(
                step=self._number + 1 if planned else 1,
                elapsed=elapsed,
                remaining=max(whole - elapsed, 0.0),
                status=status,
            )
        )

    # Ending.

    def interrupt(self, why: Reason) -> None:
        """End the verification without a verdict."""
        self._end(None, why)

    def _look(self) -> None:
        if not self._next_look.done():
            self._next_look.set_result(None)
        now = time.monotonic()
        if now > self._until:
            self.interrupt(Code.STEP_OVERTIME())
            return
        if self._phase is _Phase.PREPARING or not self._arrivals:
            return
        arrivals = self._arrivals
        usual = (arrivals[-1] - arrivals[0]) / max(len(arrivals) - 1, 1)
        patience = max(_SILENCE, _SILENT_INTERVALS * usual)
        if now - arrivals[-1] > patience:
            self.interrupt(Code.STEP_SILENT(silence=now - arrivals[-1]))
        elif now - self._advanced > patience:
            self.interrupt(Code.STEP_TIME_STANDS())

    def _end(self, passed: bool | None, why: Reason, *, succeeded: bool = True) -> None:
        if self._phase in (_Phase.IDLE, _Phase.ENDING):
            return
        if self._phase in (_Phase.STEPPING, _Phase.RETURNING):
            self._move(0.0, 0.0)
        self._phase = _Phase.ENDING
        # As a task, so that the executor wakes.
        self._node.executor.create_task(self._outcome.set_result, (passed, why, succeeded))


def judged(
    tried: Verifiable, step: Step, planned: Plan, samples: tuple[_Sample, ...], rest: Rest
) -> Any:
    """Compare a step with its prediction and return the `Verification` message.

    :param tried: gains, model and limits.
    :param step: the step.
    :param planned: for it.
    :param samples: time [s], measurement [y] and command [u] of each, the first at the step.
    :param rest: where the loop was before it.
    :raises RelayAutotuneError: if the measurement is too coarse to judge it.
    """
    t, y, u = (np.array(column) for column in zip(*samples, strict=True))
    levels = np.unique(y)
    if levels.size < 2:
        raise NotReadyError("the measurement did not change at all")
    # A loop at rest does not show how coarse its sensor is; rounding is noise, too.
    planned.require_visible(step, float(np.diff(levels).min()) / math.sqrt(12.0))
    limits = tried.limits
    found = compare(
        tried.control,
        tried.model,
        step,
        t - t[0],
        y - rest.measurement,
        limits=Limits(limits.low - rest.command, limits.high - rest.command),
        noise_std=rest.noise_std,
    )
    message = Verification(
        kind=Verification.SETPOINT if step.setpoint else Verification.LOAD,
        step=step.setpoint or step.load,
        time=float64_array(t - t[0]),
        measurement=float64_array(y),
        command=float64_array(u),
        predicted=float64_array(rest.measurement + found.predicted),
    )
    fill_reason(message.why, found.why)
    for name in ("passed", "reason", "fit", "gain_ratio", "ms", "ms_predicted"):
        setattr(message, name, getattr(found, name))
    for name in ("overshoot", "settling_time", "iae"):
        setattr(message, name, getattr(found.measured, name))
        setattr(message, f"{name}_predicted", getattr(found.expected, name))
    set_stamp(message.header.stamp, round(float(t[0]) * 1e9))
    return message


def without_arrays(message: Any) -> Any:
    """Return a `Verification` without its samples, which the topic has."""
    summary = Verification()
    for name, kind in message.get_fields_and_field_types().items():
        if not kind.startswith("sequence"):
            setattr(summary, name, getattr(message, name))
    return summary


def _why(error: Exception) -> Reason:
    if isinstance(error, RelayAutotuneError):
        return reason_of(error)
    return other(f"{type(error).__name__}: {error}")


def _result(passed: bool, why: Reason, reason: str, steps: Sequence[Any] = ()) -> Any:
    """Return the result for the client.

    :param passed: whether all steps passed.
    :param why: the reason.
    :param reason: the sentence, with what became of the gains.
    :param steps: those that were made, without arrays.
    """
    result = Verify.Result(passed=passed, reason=reason, steps=list(steps))
    fill_reason(result.why, why)
    return result
