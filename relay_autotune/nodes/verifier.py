# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The action ~/verify of controller_node: make steps, compare, pass or fail."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from rclpy.task import Future

from relay_autotune.control.controller import LONGEST_TIME, PredictedLoop, Step
from relay_autotune.control.gains_history import GainSet
from relay_autotune.control.verification import SETTLES, Plan, compare, plan
from relay_autotune.errors import NotReadyError, RelayAutotuneError
from relay_autotune.exchange.fields import float64_array
from relay_autotune.exchange.messages import (
    fill_reason,
    how_ended,
    reason_from_message,
    set_stamp,
)
from relay_autotune.experiment.settling import rest_state, slow_movement
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes import quality
from relay_autotune.nodes.gains_keeper import GainsKeeper
from relay_autotune.nodes.goals import Narrator, conclude, serve_goals
from relay_autotune.nodes.lifetime import ServedNode
from relay_autotune.nodes.results import keep
from relay_autotune.nodes.watch import LEAST_SILENCE, SILENT_INTERVALS
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.reasons import NONE, Code, Reason, other, reason_of
from relay_autotune.text import duration
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import Verification

# Number of samples before a step, for the loop's rest and noise.
_BEFORE = 50
_LEAST_BEFORE = 10
# A loop at rest moves by less than this part of a step, and is no further from its set-point.
_STILL = 0.1
# Slow noise moves the mean of a few samples by this many standard deviations at most.
_SLOW_NOISE = 4.0
# Longest silence of measurement and commands: a time [s], or a number of usual intervals if that
# is longer.
_SILENCE = 2.0
_SILENT_INTERVALS = 20.0
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
T = TypeVar("T")


@dataclass(frozen=True)
class Verifiable:
    """What is to be verified.

    :param steps: to be made.
    :param new: the gains that are put in force for it; None: those in force are tried.
    :param settles: how long the loop takes to settle with new gains [s]; NaN: not known.
    :param loop: the controller to be tried, and the process as identified.
    :param limits: range of the command.
    :param setpoint: about which the loop has to rest [y]; NaN: nothing brings it there.
    """

    steps: Sequence[Step]
    new: GainSet | None
    settles: float
    loop: PredictedLoop
    limits: Limits
    setpoint: float


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


@dataclass(eq=False)
class Trial:
    """A step that is being made.

    :param number: of the step, from 1 on.
    :param of: number of steps.
    :param step: the step.
    :param plan: for it.
    :param rest: of the loop before it.
    :param hole: longest gap in the samples [s].
    """

    number: int
    of: int
    step: Step
    plan: Plan
    rest: Rest
    hole: float
    samples: list[_Sample] = field(default_factory=list)
    """With the step, then back without it."""
    made: tuple[_Sample, ...] = ()
    """All samples with the step, once it is taken back."""

    @property
    def lasted(self) -> float:
        """Time of the samples [s]."""
        return self.samples[-1][0] - self.samples[0][0] if self.samples else 0.0

    @property
    def is_over(self) -> bool:
        """True once there are samples for the whole time."""
        return bool(self.samples) and self.lasted >= self.plan.duration


class CommandWatch:
    """Hear whether samples are answered by commands on the topic that the actuator takes.

    Only where commands have come before can they fall silent: else they go another way.
    """

    def __init__(self) -> None:
        self._heard: deque[float] = deque(maxlen=_BEFORE)
        # When the first sample came that waits for a command; NaN: none does.
        self._waits_since = math.nan
        self._longest = 0.0

    def begin(self) -> None:
        """Begin a proof."""
        self._longest = 0.0

    def sample(self) -> None:
        """Take note of a sample, which a command is to answer."""
        if math.isnan(self._waits_since):
            self._waits_since = time.monotonic()

    def hear(self) -> None:
        """Take note of a command."""
        self._longest = max(self._longest, self._silence)
        if self.too_long():
            self._heard.clear()
        self._heard.append(time.monotonic())
        self._waits_since = math.nan

    def forget(self) -> None:
        """Forget the commands, since others come while a tune runs."""
        self._heard.clear()

    def too_long(self) -> float:
        """Return for how long no command has come, where that ends a proof [s]; else 0."""
        silence = self._silence
        return silence if silence > _longest_silence(self._heard) else 0.0

    def unsure(self) -> float | None:
        """Return the longest silence in a proof [s] that leaves it unsure why it failed; else 0.

        None: not known yet, since the last sample still waits for its command.
        """
        few = _longest_silence(self._heard, LEAST_SILENCE, SILENT_INTERVALS)
        if 0.0 < self._silence <= few:
            return None
        longest = max(self._longest, self._silence)
        return longest if longest > few else 0.0

    @property
    def _silence(self) -> float:
        waits = len(self._heard) > 1 and not math.isnan(self._waits_since)
        return time.monotonic() - self._waits_since if waits else 0.0


def _longest_silence(
    arrivals: deque[float], least: float = _SILENCE, intervals: float = _SILENT_INTERVALS
) -> float:
    """Return how long messages may stay away that came at these times [s]."""
    if len(arrivals) < 2:
        return least
    return max(least, intervals * (arrivals[-1] - arrivals[0]) / (len(arrivals) - 1))


class _EndedError(Exception):
    """The proof has ended before its course did."""


class ProvenNode(ServedNode):
    """A node with a loop on which gains can be proven."""

    keeper: GainsKeeper
    """Keeps its gains: nothing has changed before it begins a proof, and it takes every end."""

    async def prepare_verification(self, request: Any) -> Verifiable:
        """Return what is to be verified.

        :param request: the `Verify.Goal`.
        :raises RelayAutotuneError: with the reason if the loop is not ready.
        """
        raise NotImplementedError

    def move(self, setpoint: float, load: float) -> None:
        """Put a step on the loop, in place of the one before; 0: none.

        :param setpoint: added to the set-point [y].
        :param load: added to the command [u].
        """
        raise NotImplementedError

    def why_silent(self, silence: float) -> Reason:
        """Return what it means that no command has come for a time.

        :param silence: the time [s].
        """
        raise NotImplementedError


class Verifier:
    """Make steps on a running loop and compare each with the prediction.

    The predictions take up to seconds, so they are computed in another thread.

    :param node: the node.
    """

    def __init__(self, node: ProvenNode) -> None:
        self._node = node
        self.commands = CommandWatch()
        """What it hears of the commands."""
        # Verdict and reason, once the proof has ended.
        self._over: tuple[bool | None, Reason] | None = None
        # Done at the next look, at the end of a step, and at that of the proof.
        self._wake: Future = Future()
        self._waits_for = ""
        self._recent: deque[_Sample] = deque(maxlen=_BEFORE)
        self._arrivals: deque[float] = deque(maxlen=_BEFORE)
        self._is_settling = False
        self._trial: Trial | None = None
        self._found: list[Any] = []
        # When the first step began, and how long all of them take, both ways [s].
        self._begun = self._planned = 0.0
        # On the steady clock: the deadline, and the last advance of the samples' time.
        self._until = self._advanced = 0.0
        self._beyond = 0
        self._narrator = Narrator(node, self._words, self._tell)
        self._full = quality.publisher(
            node, Verification, "verification", quality.latched(_STEPS_KEPT)
        )
        # The handle of the goal that runs.
        self._goal: Any = None
        self._server = serve_goals(node, Verify, "~/verify", self._accept, self._cancel)

    @property
    def is_running(self) -> bool:
        """True from the acceptance of a goal to its end."""
        return self._goal is not None

    @property
    def rested_at(self) -> float:
        """Command at rest before the present step [u]; NaN without a step."""
        return math.nan if self._trial is None else self._trial.rest.command

    # Beginning.

    def _accept(self, goal: Any) -> None:
        patience, why = goal.request.patience, NONE
        if self._goal is not None:
            why = Code.VERIFYING()
        elif not 0.0 <= patience <= LONGEST_TIME:
            why = other(f"patience is {patience:g} s, expected 0 to {LONGEST_TIME:g} s")
        if why:
            conclude(goal, _result(None, why, str(why)), succeeded=False)
            return
        self._goal, self._over, self._found = goal, None, []
        self._waits_for, self._is_settling = "", False
        self.commands.begin()
        self._until = time.monotonic() + _PREPARED_WITHIN + patience
        self._node.defer(self._narrator.now)
        self._node.executor.create_task(self._prove, goal)

    async def _prove(self, goal: Any) -> None:
        """Make a proof from its begin to its end; there is no other way out of it."""
        succeeded = True
        try:
            self._end(*await self._course(goal.request))
        except Exception as error:  # noqa: BLE001  the loop goes on, and the client gets the reason
            succeeded = self._over is not None
            self._end(None, _why(error))
        assert self._over is not None
        passed, why = self._over
        if passed is False:
            # Samples that no command has answered say nothing of the gains.
            while (silence := self.commands.unsure()) is None:
                await self._next()
            if silence:
                passed, why = None, self._node.why_silent(silence)
        try:
            became = await self._node.keeper.end_verification(passed)
        except Exception as error:  # noqa: BLE001
            became = f"; {_why(error)}"
        self._goal = None
        result = _result(passed, why, f"{why}{became}", self._found)
        self._node.get_logger().info(f"verification {how_ended(result)}")
        conclude(goal, result, succeeded=succeeded)

    async def _course(self, request: Any) -> tuple[bool | None, Reason]:
        """Put the gains on trial, make the steps, and return verdict and reason."""
        tried = await self._node.prepare_verification(request)
        self._require_on()
        patience = request.patience
        await self._once_ready(self._require_samples, time.monotonic() + patience)
        if tried.new is not None:
            await self._node.keeper.begin_verification(tried.new)
            self._require_on()
            shown = self._recent[-1][0] - self._recent[0][0]
            settles = tried.settles if math.isfinite(tried.settles) else shown
            await self._settled(SETTLES * settles)
            # A slow loop shows its rest no sooner.
            patience = max(patience, self._pace() * settles)
            self._until += patience - request.patience
        begun = time.monotonic()
        rest, period = await self._once_ready(
            lambda: self._at_rest(tried, time.monotonic() - begun < 0.5 * patience),
            begun + patience,
        )
        loop, noise = tried.loop, rest.noise_std
        plans = await self._computed(lambda: [plan(loop, s, period, noise) for s in tried.steps])
        for step, planned in zip(tried.steps, plans, strict=True):
            planned.require_visible(step, noise)
        if tried.new is None:
            await self._node.keeper.begin_verification(tried.new)
            self._require_on()
        self._begun, self._beyond = self._recent[-1][0], 0
        self._planned = 2.0 * sum(p.duration for p in plans)
        self._until = (
            time.monotonic() + _TIMES_PLANNED * self._pace() * self._planned + _MORE_THAN_PLANNED
        )
        whys: list[Reason] = []
        for number, (step, planned) in enumerate(zip(tried.steps, plans, strict=True), 1):
            hole = max(_SILENT_INTERVALS * period, _LARGEST_HOLE * planned.duration)
            self._trial = trial = Trial(number, len(plans), step, planned, rest, hole)
            self._node.move(step.setpoint, step.load)
            self._node.defer(self._narrator.now)
            while not trial.made:
                await self._woken()
            try:
                message = await self._computed(partial(judged, tried, trial))
            except _EndedError:
                raise
            except Exception as error:  # noqa: BLE001  the client gets the reason
                return None, Code.NOT_JUDGED(why=str(_why(error)))
            self._found.append(message)
            self._full.publish(message)
            # The client gets it without the samples, which the topic has.
            for name in ("time", "measurement", "command", "predicted"):
                setattr(message, name, [])
            whys.append(reason_from_message(message.why, message.reason))
            if not message.passed:
                return False, whys[-1]
            if number == len(plans):
                break
            while not trial.is_over:
                await self._woken()
            _, y, u = np.transpose(trial.samples[-_BEFORE:])
            rest = replace(rest, measurement=float(y.mean()), command=float(u.mean()))
        worst = max(whys, key=lambda why: why.code)
        return True, replace(worst, said="; ".join(map(str, whys)))

    def _require_on(self) -> None:
        if self._over is not None:
            raise _EndedError

    async def _woken(self) -> None:
        """Wait until something may have come; raise _EndedError if the proof has ended."""
        await self._next()
        self._require_on()

    async def _next(self) -> None:
        self._wake = Future()
        await self._wake

    def _wake_up(self) -> None:
        if not self._wake.done():
            self._wake.set_result(None)

    async def _computed(self, work: Callable[[], Any]) -> Any:
        """Return what ``work`` returns in a thread, or raise what it raises; the loop goes on."""
        found: list[Any] = []

        def taken(result: Any) -> None:
            found.append(result)
            self._wake_up()

        self._node.compute(work, taken)
        while not found:
            await self._woken()
        if isinstance(found[0], Exception):
            raise found[0]
        return found[0]

    async def _settled(self, seconds: float) -> None:
        """Wait until the loop has run for a time with its new gains.

        :param seconds: by the time of the samples [s].
        """
        self._is_settling = True
        self._until += _TIMES_PLANNED * self._pace() * seconds + _MORE_THAN_PLANNED
        begun, self._advanced = self._recent[-1][0], time.monotonic()
        # The first sample with the new gains aligns them without a bump: a step before it would be
        # taken for part of that.
        while not 0.0 < (done := self._recent[-1][0] - begun) >= seconds:
            self._waits_for = (
                f"the loop settles with the new gains, {duration(done)} of {duration(seconds)}"
            )
            await self._woken()
        self._is_settling = False

    async def _once_ready(self, look: Callable[[], T], until: float) -> T:
        """Return what a look at the loop returns, as soon as it refuses no more.

        :param look: raises NotReadyError.
        :param until: how long to wait, on the steady clock [s].
        :raises NotReadyError: that of the last look.
        """
        while True:
            try:
                found = look()
            except NotReadyError as error:
                if time.monotonic() >= until:
                    raise
                self._waits_for = str(error)
            else:
                self._waits_for = ""
                return found
            await self._woken()

    def _require_samples(self) -> None:
        """Refuse a loop whose samples are too few to know its rest."""
        if len(self._recent) < _LEAST_BEFORE:
            raise NotReadyError(Code.FEW_SAMPLES(samples=len(self._recent), needed=_LEAST_BEFORE))

    def _pace(self) -> float:
        """Return the steady time for one second of the samples' time."""
        ours = self._arrivals[-1] - self._arrivals[0]
        theirs = self._recent[-1][0] - self._recent[0][0]
        return ours / theirs if theirs > 0.0 else 1.0

    def _at_rest(self, tried: Verifiable, may_settle: bool) -> tuple[Rest, float]:
        """Return the loop's state of rest and its sample period [s].

        :param tried: what is to be verified.
        :param may_settle: True: a slow movement may be the rest of a transient; False: after so
            long it is the noise of this loop.
        """
        self._require_samples()
        t, y, u = np.transpose(self._recent)
        period = float(np.median(np.diff(t)))
        if not period > 0.0:
            raise NotReadyError(Code.STEP_TIME_STANDS())
        found = rest_state(t - t[0], y, len(t))
        smallest = min((abs(s.setpoint) for s in tried.steps if s.setpoint), default=math.inf)
        moved, by_noise = slow_movement(y)
        if not may_settle:
            by_noise = _SLOW_NOISE * found.noise_std
        # What is left of a transient shifts the rest, and would count as noise.
        if moved > max(by_noise, _STILL * smallest):
            raise NotReadyError(Code.NOT_AT_REST(drift=moved, samples=len(self._recent)))
        away = abs(found.mean - tried.setpoint)
        if away > max(by_noise / math.sqrt(len(y)), _STILL * smallest):
            raise NotReadyError(Code.NOT_AT_REST(away=away))
        return Rest(found.mean, float(u.mean()), found.noise_std), period

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
        self.commands.sample()
        if (trial := self._trial) is None:
            self._beyond = 0
        elif since < 0.0:
            self.interrupt(Code.STEP_TIME_BACKWARDS(by=-since))
        elif since > trial.hole:
            self.interrupt(Code.STEP_GAP(by=since))
        else:
            trial.samples.append(sample)
            if not trial.made:
                away = abs(measurement - trial.rest.measurement)
                self._beyond = self._beyond + 1 if away > trial.plan.runaway else 0
                if self._beyond >= _IN_A_ROW:
                    self._end(False, Code.STEP_RAN_AWAY(away=away, most=trial.plan.runaway))
                elif trial.is_over:
                    trial.made, trial.samples = tuple(trial.samples), []
                    self._node.move(0.0, 0.0)
                    self._wake_up()
            elif trial.is_over:
                self._wake_up()

    def hear_command(self) -> None:
        """Take note of a command on its way to the actuator."""
        self.commands.hear()
        if self._over is not None:
            self._wake_up()

    def why_silent(self) -> Reason | None:
        """Return a reason if the commands have stopped."""
        silence = self.commands.too_long()
        return self._node.why_silent(silence) if silence else None

    def out_of_range(self, measurement: float) -> None:
        """Take a measurement outside its range [y], which the controller did not answer."""
        self._beyond += 1
        tried = self._is_settling or (self._trial is not None and not self._trial.made)
        if tried and self._beyond >= _IN_A_ROW:
            self._end(False, Code.STEP_OUT_OF_RANGE(value=measurement))

    def _words(self) -> str:
        """Say what the verification waits for and sees; empty where none runs."""
        if self._goal is None or self._over is not None:
            return ""
        if (trial := self._trial) is None:
            return self._waits_for or "computing what the step will do"
        now = (
            f"{duration(trial.lasted)} of {duration(trial.plan.duration)}: the measurement is "
            f"{self._recent[-1][1]:.6g} y"
        )
        if trial.made:
            return f"back without the step, {now}"
        step = trial.step
        what = f"set-point {step.setpoint:+g} y" if step.setpoint else f"load {step.load:+g} u"
        return f"step {trial.number} of {trial.of}, {what}, {now}"

    def _tell(self, status: str) -> None:
        if self._goal is None:
            return
        feedback = Verify.Feedback(step=1, status=status)
        if (trial := self._trial) is not None:
            feedback.step = trial.number
            feedback.elapsed = self._recent[-1][0] - self._begun
            feedback.remaining = max(self._planned - feedback.elapsed, 0.0)
        self._goal.publish_feedback(feedback)

    # Ending.

    def _cancel(self, goal: Any) -> None:
        if self._goal is not None and goal.goal_id == self._goal.goal_id:
            self.interrupt(Code.CANCELLED())

    def interrupt(self, why: Reason) -> None:
        """End the verification without a verdict."""
        self._end(None, why)

    def disturb(self, sentence: str) -> None:
        """End the verification without a verdict, since somebody else has changed the loop."""
        self.interrupt(Code.INTERFERED(sentence=sentence))

    def look(self) -> None:
        """End a proof that takes too long, or whose loop is silent; to be called often."""
        self._wake_up()
        now = time.monotonic()
        if now > self._until:
            self.interrupt(Code.STEP_OVERTIME())
            return
        if why := self.why_silent():
            self.interrupt(why)
            return
        arrivals = self._arrivals
        if (self._trial is None and not self._is_settling) or not arrivals:
            return
        patience = _longest_silence(arrivals)
        if now - arrivals[-1] > patience:
            self.interrupt(Code.STEP_SILENT(silence=now - arrivals[-1]))
        elif now - self._advanced > patience:
            self.interrupt(Code.STEP_TIME_STANDS())

    def _end(self, passed: bool | None, why: Reason) -> None:
        """End the proof, unless it has ended or none runs."""
        if self._goal is None or self._over is not None:
            return
        self._over = passed, why
        if self._trial is not None:
            self._trial = None
            self._node.move(0.0, 0.0)
        # As a task, so that the executor wakes.
        self._node.executor.create_task(self._wake_up)


def judged(tried: Verifiable, trial: Trial) -> Any:
    """Compare a step with its prediction and return the `Verification` message.

    :param tried: gains, model and limits.
    :param trial: the step that was made.
    :raises RelayAutotuneError: if the measurement is too coarse to judge it.
    """
    step, rest = trial.step, trial.rest
    t, y, u = np.transpose(trial.made)
    levels = np.unique(y)
    if levels.size < 2:
        raise NotReadyError("the measurement did not change at all")
    # A loop at rest does not show how coarse its sensor is; rounding is noise, too.
    trial.plan.require_visible(step, float(np.diff(levels).min()) / math.sqrt(12.0))
    limits = tried.limits
    found = compare(
        tried.loop,
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


def _why(error: Exception) -> Reason:
    if isinstance(error, RelayAutotuneError):
        return reason_of(error)
    return other(f"{type(error).__name__}: {error}")


def _result(passed: bool | None, why: Reason, reason: str, steps: Sequence[Any] = ()) -> Any:
    """Return the result for the client.

    :param passed: whether all steps passed; None: there is no verdict.
    :param why: the reason.
    :param reason: the sentence, with what became of the gains.
    :param steps: those that were made, without arrays.
    """
    kinds = {None: Verify.Result.NONE, True: Verify.Result.PASSED, False: Verify.Result.FAILED}
    result = Verify.Result(verdict=kinds[passed], reason=reason, steps=list(steps))
    fill_reason(result.why, why)
    return result
