# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A client of controller_node: the gains that wait, those in force, and their proof."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from typing import Any

from action_msgs.msg import GoalStatus
from std_srvs.srv import Trigger

from relay_autotune.control.controller import Control, PredictedLoop
from relay_autotune.control.gains_history import GainSet
from relay_autotune.control.step_choice import StepChoice, StepRange
from relay_autotune.control.verification import SETTLES, noise_of
from relay_autotune.errors import LoopError
from relay_autotune.exchange.messages import (
    gains_from_message,
    made_visible,
    reason_from_message,
    record_from_message,
    transfer_function_from_message,
)
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes import quality
from relay_autotune.nodes.gains_place import gains_at, in_another_node, mapping_of
from relay_autotune.nodes.loop_client import ANSWER_WITHIN, GoneError, LoopClient
from relay_autotune.nodes.shell import prefix, ros_arguments
from relay_autotune.nodes.tables import GAINS, rate_from, rate_of, sensor_parameters
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.reasons import Code, may_pass
from relay_autotune.text import PROGRESS_EVERY, duration, visible
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, RelayExperiment, Verification
from relay_autotune_msgs.msg import TransferFunction as ModelMessage

# How long a latched result may take to come [s].
_RESULT_WITHIN = 5.0
_TURN = 0.1
# Limits that relay_node and controller_node both have.
LIMITS = ("measurement_min", "measurement_max", "command_min", "command_max")


class GainsClient(LoopClient):
    """Show, apply and verify gains with one controller_node.

    :param namespace: namespace of the loop; empty: the root.
    :param node: name of the controller_node.
    :param beside: another client of the same loop, whose own node this one uses; ``node`` is then
        the full name. None: it has a node of its own.
    :raises ParameterError: if the name is not valid.
    """

    def __init__(self, namespace: str, node: str, beside: LoopClient | None = None) -> None:
        super().__init__("apply_gains", namespace, node, beside=beside, action=Verify)
        self.left_behind = "; its set-point may still be moved"
        """What follows where the controller_node of another node's gains is lost in a proof."""

    def find(self, patience: float, leave: Callable[[], bool] = lambda: False) -> None:
        """Wait for the controller_node.

        :param patience: longest wait [s].
        :param leave: returns True to stop waiting.
        :raises LoopError: if it is not there.
        """
        self._find("controller_node", "verify gains", patience, leave)
        if leave():
            raise LoopError(f"ended while {self.name} was looked for")

    def _start(self) -> str:
        """Return what starts a controller_node for the relay_node of this namespace, if it can."""
        space, _, own = self.name.rpartition("/")
        relay = next((name for name in self.owners("/tune") if self._is_here(name)), "")
        names = ("measurement_type", "measurement_field", "baseline", *LIMITS)
        if not relay:
            return ""
        with suppress(LoopError):
            kind, field, *numbers = self.values(relay, names).values()
            measurement = self._topic_of(relay, "measurement", kind, published=False)
            given = dict(zip(("initial_command", *LIMITS), numbers, strict=True))
            values = {n: v for n, v in given.items() if math.isfinite(v)}
            values |= sensor_parameters(kind, field)
            topics = {"measurement": measurement}
            topics |= {"__node": own} if own != "controller_node" else {}
            words = ros_arguments(space, topics, values)
            return f": {prefix()}{shlex.join(['controller_node', '--ros-args', *words])}"
        return ""

    def newest(self) -> Any:
        """Return the newest `PidGains` of the loop.

        :raises LoopError: if there are none.
        """
        return self._result(PidGains, "pi_gains")

    def identified(self) -> tuple[TransferFunction, float]:
        """Return the newest model of the loop, and the noise in which a step is seen [y].

        That is the noise at rest or the residual; NaN: neither is known.

        :raises LoopError: if there is none.
        :raises RelayAutotuneError: if it cannot be.
        """
        found = self._result(ModelMessage, "transfer_function")
        noise = noise_of(found.noise_std, found.residual_rms)
        return transfer_function_from_message(found), noise

    def _result(self, kind: Any, topic: str) -> Any:
        found = self.latched(kind, topic, lambda m: m.final, _RESULT_WITHIN)
        if found is None:
            raise LoopError(
                f"nothing has come on {self._resolved(topic)} within {_RESULT_WITHIN:g} s: tune "
                f"the loop first, and leave identifier_node running"
            )
        return found

    def in_force(self) -> Controller | None:
        """Return the gains in force, also where another node has them; None: there are none."""
        return gains_at(self, *self._there())

    def ask(self, service: str) -> str:
        """Call ~/apply, ~/before or ~/revert, and return its answer.

        :param service: which of them.
        :raises LoopError: with the reason, if it refuses.
        """
        deadline = time.monotonic() + ANSWER_WITHIN
        while True:
            answer = self.call(Trigger, f"{self.name}/{service}", Trigger.Request())
            if answer.success:
                return str(answer.message)
            # A Trigger has no field for a code.
            if not may_pass(answer.message) or time.monotonic() > deadline:
                raise LoopError(f"{self.name} refuses: {answer.message}")
            self.rest(_TURN)

    def has(self, gains: Controller) -> bool:
        """Tell whether gains are in force already.

        :param gains: the gains; of another node's only those parts count that it is known to have.
        """
        node, places = self._there()
        wanted = {place: getattr(gains, name) for name, place in places.items()}
        return GainSet.of(self.values(node, list(wanted))).is_near(GainSet.of(wanted))

    def require_new(self, message: Any) -> None:
        """Refuse gains that are in force already.

        :param message: the `PidGains`.
        :raises LoopError: if they are.
        """
        if self.has(gains_from_message(message)):
            raise LoopError("these gains are in force already")

    @contextmanager
    def _offered(self, message: Any) -> Iterator[None]:
        """Offer gains as identifier_node does until the end of the block.

        The newest before are discarded, so that no others than these can be applied: a page may
        have offered its own since those that are shown.

        :param message: the `PidGains`.
        :raises LoopError: if they are in force already.
        """
        self.require_new(message)
        self.call(Trigger, f"{self.name}/discard", Trigger.Request())
        kind = "relay_autotune_msgs/msg/PidGains"
        topic = self._topic_of(self.name, "pi_gains", kind, published=False)
        offer = self._node.create_publisher(PidGains, topic, quality.RESULT)
        try:
            offer.publish(message)
            yield
        finally:
            self._node.destroy_publisher(offer)

    def put_in_force(self, message: Any) -> str:
        """Offer gains, apply them, and return the answer of ~/apply.

        :param message: the `PidGains`.
        :raises LoopError: with the reason, if they are refused.
        """
        with self._offered(message):
            return self.ask("apply")

    @contextmanager
    def allowing(self, **least: float | bool) -> Iterator[None]:
        """Let the node do until the end of the block what the user has agreed to.

        :param least: what its parameters have to be at least, by name.
        """
        before = self.values(self.name, list(least))
        raised = {name: value for name, value in least.items() if value > before[name]}
        if raised:
            self.set_values(self.name, raised)
        try:
            yield
        finally:
            # One that hangs may come back; one that has gone has lost them.
            if raised and self._action.server_is_ready():
                with suppress(LoopError):
                    self.set_values(self.name, {name: before[name] for name in raised})

    def steps(self, gains: Controller | None) -> StepsHere:
        """Return the steps of the set-point that may prove gains here.

        :param gains: those that are to make the step; None: there are none.
        :raises RelayAutotuneError: if the model is not there.
        """
        given = float(self.values(self.name, ["verify_step"])["verify_step"])
        found = self.latched(
            RelayExperiment, "relay_experiment", lambda m: len(m.cycle_start) > 1, _RESULT_WITHIN
        )
        if found is None or gains is None:
            return StepsHere(None, given)
        low, high, least, most = self.values(self.name, LIMITS).values()
        limits = Limits(low, high), Limits(least, most)
        model, noise = self.identified()
        loop = PredictedLoop(self._control(gains), model)
        return StepsHere(StepChoice(record_from_message(found), loop, *limits, noise), given)

    def _control(self, gains: Controller) -> Control:
        """Return gains as they run in the node that controls."""
        names = ("law", "law_period", "apply_to", "apply_feedforward")
        values = self.values(self.name, names)
        if not values["apply_to"]:
            return Control(gains, rate_from(values))
        newest = gains_from_message(self.newest())
        rate = rate_of(newest.law, newest.law_period)
        return in_another_node(gains, rate, values["apply_feedforward"])

    def prove(
        self,
        setpoint: float,
        load: float,
        patience: float,
        tell: Callable[[str], None],
        leave: Callable[[], bool] = lambda: False,
        new: Any = None,
    ) -> Any:
        """Verify with a step that the user has agreed to, whatever the node allows otherwise.

        New gains are put in force for it, and the node takes them back however the proof ends,
        unless they pass; this client does it where the node is gone.

        :param setpoint: step of the set-point [y]; 0: that of the node's parameter.
        :param load: step of the load [u]; 0: none.
        :param patience: how long to wait until the loop is at rest [s].
        :param tell: called at least each second with what is waited for.
        :param leave: returns True to end the verification without a verdict.
        :param new: the `PidGains` that are to be put in force; None: those in force are tried.
        :return: the `Verify.Result`.
        :raises LoopError: with the reason, if there is no verdict.
        """
        target, places = self._there()
        there = self.values(target, list(places.values()))
        goal = Verify.Goal(setpoint_step=setpoint, load_step=load, patience=patience)
        goal.apply = new is not None
        with (
            self.allowing(verify_step_max=abs(setpoint)),
            self._offered(new) if goal.apply else nullcontext(),
        ):
            try:
                return self._verified(goal, tell, leave)
            except GoneError as error:
                # Who is lost is no reason to leave the rest undone; after it nobody waits for it.
                why_lost, self.why_lost = self.why_lost, lambda: ""
                left = self._taken_back(target, there)
                self.why_lost = why_lost
                raise GoneError(f"{error}; {left}") from error

    def _there(self) -> tuple[str, dict[str, str]]:
        """Return the node that has the gains, and its parameter for each."""
        names = ("apply_to", "apply_parameters")
        target, mapping = self.values(self.name, names).values()
        own = {entry.name: entry.name for entry in GAINS}
        return (target, mapping_of(mapping)) if target else (self.name, own)

    def _taken_back(self, target: str, before: dict[str, float]) -> str:
        """Bring back the gains of another node, whose controller_node is gone, and say so.

        :param target: the other node; the controller_node itself: there is none.
        :param before: its parameters.
        """
        if target == self.name:
            return (
                "nobody controls the loop; started again, it begins with the gains that were "
                "proven, or with those of its parameters"
            )
        gains = GainSet.of(before)
        with suppress(LoopError):
            if self.values(target, list(before)) != before:
                self.set_values(target, before)
            if self.values(target, list(before)) == before:
                return f"{target} has {gains}, as before{self.left_behind}"
        return (
            f"{target} may have the new gains, which are not proven: start {self.name} again, "
            f"which brings {gains} back"
        )

    def steps_of(self, result: Any) -> list[Any]:
        """Return the steps of a verification with their samples, those that come in time.

        :param result: the `Verify.Result`.
        """
        stamps = {(step.kind, str(step.header.stamp)): step for step in result.steps}
        found = {}

        def take(message: Any) -> bool:
            key = message.kind, str(message.header.stamp)
            if key in stamps:
                found[key] = message
            return len(found) == len(stamps)

        if stamps:
            self.latched(Verification, "verification", take, _RESULT_WITHIN)
        return [found[key] for key in stamps if key in found]

    def let_settle(
        self, seconds: float, tell: Callable[[str], None], leave: Callable[[], bool]
    ) -> None:
        """Let the loop go back after a proof.

        :param seconds: how long [s].
        :param tell: called each second with what is waited for.
        :param leave: returns True to stop waiting.
        """
        begun = time.monotonic()
        while (waited := time.monotonic() - begun) < seconds and not leave():
            tell(f"the loop goes back, {duration(waited)} of {duration(seconds)}")
            self.wait(leave, min(PROGRESS_EVERY, seconds - waited))

    def _verified(self, goal: Any, tell: Callable[[str], None], leave: Callable[[], bool]) -> Any:
        """Have the steps made, and return the `Verify.Result`."""
        begun = time.monotonic()
        while not leave():
            sent = self._sent(goal, lambda found: tell(visible(found.status)))
            answer = self._ended(sent, leave)
            result = made_visible(answer.result)
            if answer.status == GoalStatus.STATUS_SUCCEEDED:
                return result
            code = reason_from_message(result.why).code
            if not code.row.transient or time.monotonic() - begun > ANSWER_WITHIN:
                raise LoopError(f"{self.name} has not verified the gains: {result.reason}")
            # The gains that are offered reach the node a moment later.
            if code is not Code.NONE_WAIT:
                tell(f"waiting: {result.reason}")
            self.wait(leave, PROGRESS_EVERY)
        raise LoopError("the verification was ended before it began: the gains are as before")

    def _ended(self, goal: Any, leave: Callable[[], bool]) -> Any:
        """Return the answer to a goal once it has ended, and cancel it where that is wished."""
        answer, until = goal.get_result_async(), math.inf
        while True:
            deadline = time.monotonic() + ANSWER_WITHIN
            while time.monotonic() < min(deadline, until):
                if self.wait(answer.done, _TURN):
                    return answer.result()
                if leave() and until == math.inf:
                    goal.cancel_goal_async()
                    until = time.monotonic() + ANSWER_WITHIN
            if not self._action.server_is_ready():
                raise GoneError(f"{self.name} has gone during the verification")
            if time.monotonic() >= until:
                raise GoneError(f"{self.name} has not ended the verification")


@dataclass(frozen=True)
class StepsHere:
    """The steps of the set-point that may prove gains of a controller_node.

    :param choice: what decides them; None: no tune has left its record, without which it is not
        known where the loop rests, and the node alone refuses.
    :param given: the step of the node [y]; 0: none.
    """

    choice: StepChoice | None
    given: float

    @property
    def allowed(self) -> StepRange:
        """The steps that the limits of the node allow.

        :raises TuningError: if the loop would be unstable.
        """
        return StepRange() if self.choice is None else self.choice.allowed

    @property
    def step(self) -> float:
        """The step of the node, else the one that proves most within its limits [y].

        :raises LoopError: if it is not known.
        """
        if not (step := self.given or (self.choice.best if self.choice else 0.0)):
            raise LoopError("the height of the step is not known: give --step")
        return self.allowed.nearest(step)

    def plan(self, step: float) -> tuple[tuple[str, str], ...]:
        """Return what a step will do, in sentences with a name for each.

        :param step: of the set-point [y].
        :raises TuningError: if it is not allowed.
        """
        self.allowed.require(step)
        moves = f"The set-point steps by {step:+g} y and back, once the loop is at rest."
        fails = ("if it fails", "The gains before come back by themselves.")
        if self.choice is None:
            return ("moves", moves), fails
        takes = duration(SETTLES * self.choice.settles + self.choice.lasts)
        expected = f"The command is expected {self.choice.expected(step)}; it takes about {takes}."
        return ("moves", moves), ("expected", expected), fails
