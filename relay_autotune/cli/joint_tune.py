# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What tune_loop does for a joint of ros2_control: find its loop, say the plan, open it, apply."""

from __future__ import annotations

import argparse
import json
import math
import shlex
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import Any

import yaml

from relay_autotune.cli.apply_gains import apply_at
from relay_autotune.cli.arguments import say
from relay_autotune.cli.loops import Loop, Steps, WhyOver
from relay_autotune.cli.own_nodes import PROGRAM, START_WITHIN, namespace_of_joint
from relay_autotune.cli.settings import SETTING, Setting
from relay_autotune.cli.terminal import Working, tell
from relay_autotune.errors import LoopError, SelectionError
from relay_autotune.exchange.export import Target
from relay_autotune.exchange.messages import gains_from_message
from relay_autotune.loop.gains import Controller
from relay_autotune.nodes.controller_manager import (
    ControllerManager,
    ManagedController,
    forwarding,
    in_the_way,
    opened,
)
from relay_autotune.nodes.gains_place import gains_at, gains_text
from relay_autotune.nodes.joint_loop import COMMAND_TYPE, STATE_TYPE, joint_loop
from relay_autotune.nodes.live_types import CommandMessage, message_class
from relay_autotune.nodes.loop_client import GoneError, LoopClient
from relay_autotune.nodes.readiness import ChecklistLine, Mark
from relay_autotune.nodes.shell import ros_arguments
from relay_autotune.nodes.tune_client import TuneClient
from relay_autotune_msgs.action import Tune

_JOINT_STATES = "joint_states"
_JOINT_STATE = "sensor_msgs/msg/JointState"
_FLOATS = "std_msgs/msg/Float64MultiArray"
# How long to wait for a manager that may be gone [s].
_PATIENCE = 2.0
# Height of the trajectory that verifies gains by hand, as a part of the joint's range.
_PROOF = 0.05


class JointLoop(Loop):
    """A joint that is to be tuned.

    :param robot: a node of the graph; it goes on where a node of this command is lost.
    :param options: of the command line.
    :param client: returns the client of the relay_node that will be started in a namespace.
    :raises LoopError: if the loop is not there, or something is not known and nobody can be asked.
    """

    has_own_nodes = True

    def __init__(
        self,
        robot: LoopClient,
        options: argparse.Namespace,
        client: Callable[[str, LoopClient], TuneClient],
    ) -> None:
        self._robot = robot
        self._forward: ManagedController | None = None
        self._former: tuple[str, ...] = ()
        with Working(f"looking at {options.controller}"):
            space, slash, controller = options.controller.rpartition("/")
            within = f"/{space.strip('/')}".rstrip("/") if slash else None
            self._manager = ControllerManager(
                robot, options.controller_manager or "", within, options.wait
            )
            self._loop = loop = joint_loop(robot, self._manager, controller, options.joint)
            self.options = options
            if options.open:
                loaded = self._manager.controllers()
                # What has to be held while the controller is off.
                limp = loop.follows and loop.commanded == "effort"
                beside = [f"{dof}/effort" for dof in loop.dofs] if limp else []
                self._forward = forwarding(loaded, loop.interface, options.forward or "", beside)
                self._former = in_the_way(loaded, self._forward.needs)
                self._held = self._commands_beside(self._forward)
        if loop.why_not_moved and not options.open:
            raise LoopError(f"{loop.controller} stays as it is: {self._why_not_closed()}")
        if not options.open and not math.isfinite(loop.state.reference):
            raise LoopError(
                f"{loop.controller} has no reference for {loop.joint} yet: publish one on "
                f"{loop.reference_topic}, and wait until the joint rests there"
            )
        super().__init__(client(namespace_of_joint(loop.node, loop.joint), robot), options)
        # The reference is given back after that, and reported then.
        back = f"{loop.joint} gets back its controllers of before" if options.open else ""
        self.client.left_behind = lambda: back
        self._take_known()
        if not options.web:
            self.answers.ask(*self._questions())

    def _take_known(self) -> None:
        """Take what the robot tells of the settings that are not given."""
        loop, answers = self._loop, self.answers
        if answers["within"] is None and loop.within is not None:
            answers.take({"within": loop.within}, "robot_description")
        answers.measured = loop.state.feedback
        if not self.options.open:
            self.form = ("within", "amplitude")
            return
        if answers["at"] is None and math.isfinite(loop.state.output):
            answers.take({"at": loop.state.output}, "its output")
        limits = [loop.clamps, loop.command_within or (-math.inf, math.inf)]
        found = [max(low for low, _ in limits), min(high for _, high in limits)]
        if answers["command_within"] is None and all(map(math.isfinite, found)):
            answers.take({"command_within": found}, "its limits")

    def _questions(self) -> Iterator[Setting]:
        """Yield what is asked for where it is not known."""
        loop = self._loop
        of = f"{loop.commanded} of {loop.joint}"
        for name, question, example in (
            ("within", f"lowest and highest {loop.measured} that {loop.joint} may have", "-5 5"),
            ("at", f"present {of}, at which it rests", "0"),
            ("command_within", f"lowest and highest {of}", "-2 2"),
        ):
            if name in self.form:
                yield replace(SETTING[name], question=question, example=example)

    @property
    def title(self) -> str:
        """The name of the loop for people."""
        return f"{self._loop.joint} of {self._loop.controller}"

    def _why_not_closed(self) -> str:
        loop = self._loop
        if not loop.above:
            return f"{loop.why_not_moved}, which a relay cannot move; give --open"
        typed = self._manager.command_for([], loop.above)
        back = self._manager.command_for(loop.above, [])
        return (
            f"{loop.why_not_moved}, which has to be inactive for a tune of {loop.controller}: "
            f"type: {typed}; publish the references on {loop.reference_topic}, and after the tune "
            f"type: {back}; or give --open"
        )

    # What is to happen.

    def plan(self) -> list[str]:
        """Return the plan, as lines of a checklist, some seconds after the first look.

        :raises LoopError: if another robot was found meanwhile, which may be the one meant.
        """
        self._manager.require_alone()
        loop = self._loop
        lines = [
            ChecklistLine(Mark.OK, name, text)
            for name, text in (
                ("joint", f"{loop.joint}: {loop.measured}, commanded by {loop.interface}"),
                (
                    "controller",
                    f"{loop.controller} of {self._manager.name}, {1.0 / loop.period:.4g} Hz"
                    + ("" if self._forward else ", stays active"),
                ),
                *self._moves(),
                ("present gains", ", ".join(map("{} {:.6g}".format, "pid", loop.gains))),
                ("gains then", self._applied()),
            )
        ]
        lines += [ChecklistLine(Mark.NOTE, *note) for note in self._notes()]
        return list(map(str, lines))

    def _moves(self) -> Iterator[tuple[str, str]]:
        loop = self._loop
        low, high = self.options.within
        limits = f"{low:g} to {high:g} ({self.answers.source('within')})"
        others = [each for each in loop.joints if each != loop.joint]
        if self._forward is None:
            yield "moves", f"the reference of {loop.joint} about {loop.state.reference:.6g}"
            yield "within", f"{limits}, for reference and {loop.measured}"
            if others:
                yield "holds", f"{', '.join(others)}: the references that they have"
            return
        off = ", ".join(self._former)
        yield (
            "switches",
            f"{off} off and {self._forward.name} on, in one strict request; back after it",
        )
        yield "moves", f"the {loop.commanded} of {loop.joint} itself, about {self.options.at:.6g}"
        yield "within", f"{limits}, for {loop.measured}"
        beside = [
            f"{name} {value:.6g}"
            for name, value in zip(self._forward.needs, self._held, strict=True)
            if name != loop.interface
        ]
        if beside:
            yield "holds", ", ".join(beside)

    def _applied(self) -> str:
        if self.options.keep_gains:
            return "stay, whatever is found (--keep-gains)"
        why = self._loop.why_not_moved
        return f"{self._places} at once, " + (
            f"read back, not verified by a step: {why}"
            if why
            else "verified by a step of the reference; those of now come back where that fails"
        )

    @property
    def _places(self) -> str:
        first, *others = self._loop.places.values()
        return "/".join([first, *(name.rpartition(".")[2] for name in others)])

    def _notes(self) -> Iterator[tuple[str, str]]:
        """Say what the controller's settings do to the gains."""
        loop = self._loop
        limited = " (no u_clamp is set, so that this never acts)" * (
            not any(map(math.isfinite, loop.clamps))
        )
        yield (
            "antiwindup",
            {
                "back_calculation": "back_calculation: at a u_clamp the integral gives way within "
                "tracking_time_constant, which is set with the gains: sqrt(d/i), without "
                "derivative action p/i" + limited,
                "conditional_integration": "conditional_integration: no integration at a u_clamp"
                + limited,
                "none": "none: the integral winds up at a limit of the command",
                "legacy": "legacy: the integral is added before the output, and limited by "
                "i_clamp alone; the design is for that",
            }[loop.strategy],
        )
        yield "law", f"{loop.law}, every {1000.0 * loop.period:.4g} ms"
        yield (
            "derivative",
            f"minus the velocity state, without a filter. The design takes the difference of "
            f"{loop.measured} for it, which is that or half a period late"
            if loop.has_rate
            else "the plain difference of the error: noise passes, and PI is chosen where that "
            "is too much",
        )
        if loop.feedforward:
            yield (
                "feed-forward",
                f"{loop.feedforward:g} times the velocity of the trajectory is added: it is 0 at "
                f"rest, and the gains are right with it"
                if loop.follows
                else f"{loop.feedforward:g} times the reference is added: the gains are right "
                f"with it, and the step of the verification is predicted with it",
            )
        if loop.wraps:
            yield "wraparound", "the error is wrapped to half a turn: keep the limits within one"
        if self._forward is None:
            return
        if loop.follows:
            yield (
                "switched off",
                f"{loop.controller} then commands 0, until the relay's first command comes some "
                f"hundredths of a second later; when it is active again it holds the joints where "
                f"they are, and its integral begins at 0",
            )
        else:
            yield (
                "save_i_term",
                "true: the integral goes on where it was when the controller is active again"
                if loop.save_i_term
                else "false: the integral begins at 0 when the controller is active again",
            )
        without = sorted(
            set(loop.dofs) - {name.rpartition("/")[0] for name in self._forward.needs}
        )
        if without:
            names = ", ".join(without)
            kept = "command 0" if loop.follows else "its last command"
            yield "no control", f"{names} keeps {kept}, with no controller meanwhile"
        typed = self._manager.command_for(self._former, [self._forward.name])
        yield "if killed", f"only kill -9 of this command leaves that; then type: {typed}"

    # The loop while it is tuned.

    def arguments(self) -> dict[str, list[str]]:
        """Return the arguments for ROS of the nodes that tune it."""
        loop, options = self._loop, self.options
        topics, values = self._opened_ends() if options.open else self._at_controller()
        if not options.open:
            # It moves the reference.
            values |= {"relay_on": "setpoint", "setpoint": loop.state.reference}
        values |= self.answers.parameters((*self.form, "measurement_timeout"))
        nodes = {"relay_node": ros_arguments(self.space, topics, values)}
        if not options.record_only:
            design = {"law": loop.law, "sample_period": loop.period}
            nodes["identifier_node"] = ros_arguments(self.space, {}, design)
        return nodes

    def _at_controller(self) -> tuple[dict[str, str], dict[str, Any]]:
        """Return topics and parameters of a node that hears the controller and moves it."""
        loop = self._loop
        return {"measurement": loop.state_topic, "setpoint": loop.reference_topic}, {
            "measurement_type": STATE_TYPE,
            "measurement_field": f"{loop.state_field}.feedback",
            "controller_command_field": f"{loop.state_field}.output",
            "command_type": COMMAND_TYPE,
            "command_field": loop.reference_field,
            "command_message": json.dumps(loop.reference_alone),
            **SETTING["within"].values(self.options.within),
        }

    def _opened_ends(self) -> tuple[dict[str, str], dict[str, Any]]:
        assert self._forward is not None
        loop, options, client = self._loop, self.options, self._robot
        kind, field = _JOINT_STATE, f"{loop.measured}[{loop.joint}]"
        topic = options.measurement or self._manager.node_of(_JOINT_STATES)
        found = client.kind_of(topic, options.wait, published=True)
        if options.measurement and options.field != "data":
            kind, field = found, options.field
        topics = {
            "measurement": topic,
            "command": f"{self._manager.node_of(self._forward.name)}/commands",
        }
        held = json.dumps([0.0 if math.isnan(value) else value for value in self._held])
        place = self._forward.needs.index(loop.interface)
        values = {
            "measurement_type": kind,
            "measurement_field": field,
            "command_type": _FLOATS,
            "command_field": f"data[{place}]",
            "command_message": json.dumps(f"{{data: {held}}}"),
            "use_sim_time": loop.is_simulated,
        }
        if loop.measured == "position" and loop.commanded != "position":
            # It drifts at a constant command, but its controllers come back at once.
            values |= {"process_type": "integrating", "start_without_hold": True}
        return topics, values

    def _commands_beside(self, forward: ManagedController) -> list[float]:
        """Return what each interface of the forwarding controller gets; NaN: the joint."""
        loop = self._loop
        outputs = {
            f"{dof}/{loop.commanded}": state.output
            for dof, state in zip(loop.dofs, loop.states, strict=True)
        }
        others = [name for name in forward.needs if name != loop.interface]
        if self.options.command_message and others:
            return self._given_beside(forward)
        commands = {loop.interface: math.nan}
        for name in others:
            value = outputs.get(name, math.nan)
            joint, _, kind = name.rpartition("/")
            if math.isnan(value) and kind == "position":
                value = self._position_of(joint)
            if math.isnan(value) and kind == "velocity":
                value = 0.0
            if math.isnan(value):
                raise LoopError(
                    f"{forward.name} also commands {name}, and nothing tells what holds it: give "
                    f"--command-message '{{data: [...]}}' with {len(forward.needs)} numbers, "
                    f"those of {', '.join(forward.needs)}"
                )
            commands[name] = value
        return [commands[name] for name in forward.needs]

    def _given_beside(self, forward: ManagedController) -> list[float]:
        with suppress(yaml.YAMLError, TypeError, ValueError, KeyError):
            data = [float(v) for v in yaml.safe_load(self.options.command_message)["data"]]
            if len(data) == len(forward.needs):
                return data
        raise SelectionError(
            f"--command-message is {self.options.command_message}, expected "
            f"'{{data: [...]}}' with {len(forward.needs)} numbers: {', '.join(forward.needs)}"
        )

    def _position_of(self, joint: str) -> float:
        kind = message_class(_JOINT_STATE, "measurement_type")
        for message in self._robot.heard(kind, self._manager.node_of(_JOINT_STATES), bool):
            if joint in message.name:
                return float(message.position[list(message.name).index(joint)])
        return math.nan

    @contextmanager
    def opened(self) -> Iterator[WhyOver]:
        """Open the loop for a tune if asked for, and close it as soon as the relay ends."""
        loop, forward = self._loop, self._forward
        # It is closed with the block, however that ends.
        with ExitStack() as stack:
            if forward is not None:
                # Controllers that command 0 when they are switched off leave it to the next one.
                with self._robot.publishing(*self._first_command()) as command:
                    give_back = self._give_references_back
                    stack.enter_context(
                        opened(self._manager, forward.name, self._former, give_back)
                    )
                    command()
            why_lost = self._manager.still_active(forward.name if forward else loop.controller)

            def why_over(state: int) -> str:
                if state <= Tune.Feedback.STATE_RELAY and (why := why_lost()):
                    return why
                if state > Tune.Feedback.STATE_RELAY:
                    stack.close()
                # A relay_node that is lost cannot be asked to end the tune.
                return self.nodes.why_lost("identifier_node")

            try:
                yield why_over
            except LoopError as error:
                # A node that is lost leaves the reference where the relay had it.
                if forward is None:
                    raise LoopError(f"{error}; {self._put_back()}") from error
                raise

    def _first_command(self) -> tuple[Any, str]:
        """Return the message of the first command, and its topic."""
        topics, values = self._opened_ends()
        beside = json.loads(values["command_message"])
        message = CommandMessage(values["command_type"], values["command_field"], beside)
        return message.written(self.options.at), topics["command"]

    def _put_back(self) -> str:
        """Give the reference back where its controller takes it; return how the joint is left."""
        loop = self._loop
        with suppress(LoopError):
            if typed := self.activation():
                return (
                    f"{self.left()}; type: {typed}; then publish the reference "
                    f"{loop.state.reference:g} on {loop.reference_topic}"
                )
            if not self._give_references_back():
                return f"{loop.controller} is active, and the reference may still be moved"
        return self.left()

    def _give_references_back(self) -> bool:
        """Publish the references of before, which the controller forgets when it is switched.

        :return: whether the controller has them.
        """
        loop = self._loop
        if loop.why_not_moved:
            return True
        reference = loop.state.reference
        commands = CommandMessage(COMMAND_TYPE, loop.reference_field, loop.references)
        states = message_class(STATE_TYPE, "measurement_type")

        def is_back(message: Any) -> bool:
            references = {dof.name: dof.reference for dof in message.dof_states}
            return bool(references.get(loop.joint) == reference)

        if math.isfinite(reference) and not self._robot.publish(
            commands.written(reference), loop.reference_topic, states, loop.state_topic, is_back
        ):
            say(
                PROGRAM,
                f"{loop.controller} is active again, but does not take its former reference "
                f"{reference:g} for {loop.joint}: publish it on {loop.reference_topic}",
            )
            return False
        return True

    def activation(self) -> str:
        """Return what to type so that its controller is active; empty: it is.

        :raises LoopError: if the manager does not answer.
        """
        name = self._loop.controller
        listed = self._manager.controllers(_PATIENCE)
        active = any(each.name == name and each.is_active for each in listed)
        return "" if active else self._manager.command_for([name], [])

    def left(self) -> str:
        """Return in which state the joint is."""
        loop = self._loop
        stays = f"{loop.joint} has the last {loop.commanded} that it got"
        try:
            if self.activation():
                return f"{loop.controller} is not active: {stays}"
        except LoopError as error:
            return f"{error}: {stays}, or what its hardware does without a manager"
        what = loop.why_not_moved or f"the reference of {loop.joint} is that of before"
        return f"{loop.controller} is active, {what}"

    # The gains.

    @property
    def target(self) -> Target:
        """Where exported gains go."""
        noise = self.client.result.transfer_function.noise_std
        return Target(self._loop.node, self._loop.dof, noise_std=noise, is_set_up=True)

    def present(self) -> Controller | None:
        """Return the gains that the joint's controller has; None: it has none.

        :raises LoopError: if it does not answer.
        """
        return gains_at(self._robot, self._loop.node, self._loop.places)

    def again(self, command: str) -> Steps:
        """Return how to tune it again, and before how to activate its controller, if it is not."""
        with suppress(LoopError):
            if typed := self.activation():
                return [("activate its controller", typed), *super().again(command)]
        return super().again(command)

    def apply(self, doubt: str) -> tuple[bool | None, str]:
        """Offer the gains to the controller, and verify them.

        :param doubt: why they are doubtful; empty: they are trusted.
        :return: whether they are in force, None: the controller keeps those that it has as asked
            for; and why their step failed; empty: it did not.
        """
        if self.options.keep_gains:
            return None, ""
        print()
        if doubt and self.options.yes:
            say(PROGRAM, f"the gains are doubtful, so that --yes does not apply them: {doubt}")
            return None, ""
        loop, question, before = self._loop, "", dict[str, float]()
        places = list(loop.places.values())
        if loop.why_not_moved:
            question = f"Set {self._places} of {loop.node}, without a step that verifies them?"
            before = self._robot.values(loop.node, places)
        self._start_controller()
        why_inactive = self._manager.still_active(loop.controller)
        self.client.why_lost = lambda: self.nodes.why_lost() or why_inactive()
        try:
            in_force, failed = apply_at(
                f"{self.space}/controller_node",
                self.client,
                question,
                doubtful=bool(doubt),
                yes=self.options.yes,
                patience=START_WITHIN,
            )
        except GoneError as error:
            # It would have taken its step back.
            self.nodes.end("controller_node")
            raise GoneError(f"{error}; {self._put_back()}") from error
        if in_force:
            now = self._robot.values(loop.node, places)
            if question:
                self._say_unverified(before, now)
            if not self.options.export:
                lines = ", ".join(f"{name} {value:.6g}" for name, value in now.items())
                advice = f"the gains are those of its parameter file again: put there {lines}"
                tell("after a restart", advice)
        return in_force, failed

    def _start_controller(self) -> None:
        """Start a controller_node that puts gains into the joint's controller and verifies them.

        Not before a tune: relay_node refuses a second publisher of the reference.
        """
        loop = self._loop
        places = ",".join(map("{}:{}".format, *zip(*loop.places.items(), strict=True)))
        topics, values = self._at_controller()
        values |= {
            "apply_to": loop.node,
            "apply_parameters": places,
            "apply_feedforward": loop.feedforward,
            "initial_setpoint": loop.state.reference,
        }
        for name, clamp in zip(("command_min", "command_max"), loop.clamps, strict=True):
            if math.isfinite(clamp):
                values[name] = clamp
        self.nodes.start("controller_node", ros_arguments(self.space, topics, values))

    def after_tune(self) -> None:
        """Let a page show, change and verify the gains of the joint's controller."""
        if not (self.options.keep_gains or self._loop.why_not_moved):
            self._start_controller()

    def before_tune(self) -> None:
        """End that: relay_node has to be the only one that publishes the reference."""
        self.nodes.end("controller_node")
        self.client.wait(lambda: not self.client.controllers(), _PATIENCE)

    def _say_unverified(self, before: dict[str, float], now: dict[str, float]) -> None:
        """Say which gains are in force without a step, and how to see what they do.

        :param before: those before, by the names of their parameters.
        :param now: those in force.
        """
        loop = self._loop
        tell("gains", f"in force, read back: {gains_text(now)}; before: {gains_text(before)}")
        moved = f"move it by {loop.above[-1]}" if loop.above else "give it a short trajectory"
        tell(
            "not verified",
            f"{loop.why_not_moved}: {moved}, and see in {loop.state_topic} that {loop.joint} "
            f"follows",
        )
        if loop.follows:
            # In one line, so that it can be copied.
            gains = gains_from_message(self.client.result.gains)
            print(f"  {self._short_trajectory(gains.settling_time)}")

    def _short_trajectory(self, settling_time: float) -> str:
        """Return what to type for a small motion of the joint.

        :param settling_time: predicted [s].
        """
        loop = self._loop
        low, high = self.options.within
        now = [
            at if math.isfinite(at := self._position_of(joint)) else state.feedback
            for joint, state in zip(loop.joints, loop.states, strict=True)
        ]
        place = loop.joints.index(loop.joint)
        # Towards the middle of its range.
        now[place] += math.copysign(_PROOF * (high - low), 0.5 * (low + high) - now[place])
        seconds = max(2, math.ceil(2.0 * settling_time)) if math.isfinite(settling_time) else 2
        # YAML takes a number such as 5e-05, without a point, for text.
        point = f"{{positions: [{', '.join(map('{:.5f}'.format, now))}], "
        point += f"time_from_start: {{sec: {seconds}}}}}"
        message = f"{{joint_names: [{', '.join(loop.joints)}], points: [{point}]}}"
        words = ["ros2", "topic", "pub", "--once", f"{loop.node}/joint_trajectory"]
        return shlex.join([*words, "trajectory_msgs/msg/JointTrajectory", message])
