# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What tune_loop tunes: a loop whose nodes run, or one of two topics, whose nodes it starts.

A joint of ros2_control is a third kind, see `joint_tune`. The steps of a tune are the same for
all: look at the loop, ask for what is not known, start nodes, check, tune, hand over the gains.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Protocol

from relay_autotune.bag.definitions import FLOAT64
from relay_autotune.bag.field_path import first_numbers, unit_of_field
from relay_autotune.bag.topics import only_field
from relay_autotune.cli.own_nodes import OwnNodes
from relay_autotune.cli.settings import FLAGS, SETTING, Answers, as_flags
from relay_autotune.cli.terminal import UNITS, Working, asked, broken, width
from relay_autotune.errors import LoopError, ParameterError, RelayAutotuneError, SelectionError
from relay_autotune.exchange.export import Target
from relay_autotune.exchange.messages import (
    reason_from_message,
    transfer_function_from_message,
)
from relay_autotune.nodes.live_types import (
    CommandMessage,
    Reader,
    message_class,
    reader_of,
    struct_of,
)
from relay_autotune.nodes.shell import ros_arguments, typed_for_parameter
from relay_autotune.nodes.tables import sensor_parameters
from relay_autotune.reasons import Code, Reason
from relay_autotune.text import in_units

if TYPE_CHECKING:
    from relay_autotune.loop.gains import Controller
    from relay_autotune.nodes.tune_client import TuneClient

# Purpose and text of each command that may follow.
Steps = list[tuple[str, str]]
# Says, from the state of a tune, why it has to end; empty: it goes on.
WhyOver = Callable[[int], str]
# Time between two looks at a tune, and two updates of a terminal [s].
_TICK = 0.25
# How long to wait for what a node still has to answer, and at most while a page waits [s].
PATIENCE, _ANSWERS = 5.0, 1.0
# How long present commands are listened to [s].
_LISTEN = 1.0


class Face(Protocol):
    """Where a tune is shown."""

    def take(self, feedback: Any) -> None:
        """Show a `Tune.Feedback`."""

    def tick(self) -> None:
        """Show that time passes."""

    def say(self, text: str) -> None:
        """Write a line that stays."""


class Loop:
    """A loop whose nodes run.

    :param client: of its relay_node.
    :param options: of the command line, with all answers.
    """

    form: tuple[str, ...] = ("at", "within", "command_within", "amplitude")
    """Settings that may be changed before each tune."""
    has_own_nodes = False
    """Whether its nodes are those of this command."""
    proves = False
    """Whether a controller_node of this command can prove the gains."""

    def __init__(self, client: TuneClient, options: argparse.Namespace) -> None:
        self.client, self.options = client, options
        self.answers = Answers(options)
        self.nodes = OwnNodes()
        # Settings of relay_node before a dry run.
        self._before: dict[str, Any] = {}

    @property
    def title(self) -> str:
        """The name of the loop for people."""
        return self.client.name

    @property
    def space(self) -> str:
        """The namespace of its nodes."""
        return self.client.name.rpartition("/")[0]

    def set(self, changed: dict[str, Any]) -> None:
        """Take other values of the settings of `form`.

        :param changed: the values by name.
        :raises RelayAutotuneError: if one cannot be.
        """
        if unknown := set(changed) - set(self.form):
            raise SelectionError(f"{', '.join(sorted(unknown))} is no setting of {self.title}")
        self.answers.take(changed)
        self.client.set_values(self.client.name, self.answers.parameters(changed))

    def lacking(self) -> list[str]:
        """Return the questions that must be answered before a tune."""
        lacking = filter(self.answers.lacks, self.form if self.has_own_nodes else ())
        return [SETTING[name].question for name in lacking]

    def look(self) -> None:
        """Take the settings that relay_node has now; nobody else changes one of this command."""
        if self.has_own_nodes:
            return
        names = [name for each in self.form for name in SETTING[each].parameters]
        with suppress(LoopError):
            self.answers.read(self.client.values(self.client.name, names, _ANSWERS))

    def joined(self) -> None:
        """Exchange settings with relay_node, once that is there: what is given goes to it.

        :raises LoopError: if it refuses them, or somebody else commands.
        """
        options = self.options
        if self.has_own_nodes:
            return
        # An amplitude is that of one tune, unless a page can start more.
        names = [name for name in self.form if name != "amplitude" or options.web]
        given = [n for n in (*names, "measurement_timeout") if SETTING[n].is_given(options)]
        if given:
            values = self.answers.parameters(given)
            if options.dry_run:
                self._before = self.client.values(self.client.name, list(values))
            self.client.set_values(self.client.name, values)
        if options.web:
            self.look()

    def restore(self) -> None:
        """Give relay_node back the settings from before a dry run, which changes nothing.

        :raises LoopError: if it refuses them or does not answer.
        """
        if self._before:
            self.client.set_values(self.client.name, self._before)

    def ask_again(self) -> None:
        """Ask for the last answer again, and tell relay_node."""
        changed = self.answers.ask_again()
        self.client.set_values(self.client.name, self.answers.parameters(changed))

    def before_tune(self) -> None:
        """End what proves gains on a page."""

    def after_tune(self) -> None:
        """Start what proves gains on a page."""

    def plan(self) -> list[str]:
        """Return what the loop itself has to say of a tune, as lines of a checklist."""
        return []

    def arguments(self) -> dict[str, list[str]]:
        """Return the arguments for ROS of its own nodes, by the names of their executables."""
        return {}

    def checklist(self, result: Any) -> list[str]:
        """Return the lines of relay_node's checklist, with what to type.

        :param result: the `Tune.Result` of a dry run.
        """
        # A relay_node of an older version sends no reasons.
        reasons = map(reason_from_message, result.refusals)
        return [
            "; ".join(filter(None, (check, self.to_type(why) if why is not None else "")))
            for check, why in zip_longest(result.checks, reasons)
        ]

    def to_type(self, why: Reason) -> str:
        """Return what sets the parameter that a reason names; empty: nothing that can be given."""
        name, _, value = why.typed.partition(" ")
        if name in FLAGS:
            return f"give {FLAGS[name]}"
        if not name or self.has_own_nodes:
            return ""
        return typed_for_parameter(self.client.name, name, value)

    @contextmanager
    def opened(self) -> Iterator[WhyOver]:
        """Open the loop for a tune, if its kind needs that."""
        yield lambda _: self.nodes.why_lost("identifier_node")

    def check(self, deadline: float = 0.0) -> Any:
        """Ask whether a tune could start; return the answer, a `Tune.Result`.

        :param deadline: until when its nodes may not know yet what they need.
        """
        client, options = self.client, self.options
        # Right after its start a node of the command does not know all of these yet.
        awaited = {Code.REST_UNKNOWN, *[Code.NO_IDENTIFIER] * (not options.record_only)}
        while True:
            found = client.check(options.amplitude)
            lacking = self.has_own_nodes and any(why.code in awaited for why in found.refusals)
            if not (client.not_ready_yet or lacking) or time.monotonic() > deadline:
                return found
            time.sleep(_TICK)

    def tune(
        self, face: Face, interrupted: list[int], deadline: float = 0.0, tick: float = _TICK
    ) -> None:
        """Ask for a tune, and show it until its result is there; cancel it when asked to.

        :param face: where it is shown.
        :param interrupted: signals that have come.
        :param deadline: until when its nodes may not be ready; 0: they are asked once.
        :param tick: interval of the looks [s].
        """
        client = self.client
        with self.opened() as why_over:
            while True:
                client.ask(self.options.amplitude, dry_run=False)
                self._follow(face, interrupted, why_over, tick)
                if interrupted or not client.not_ready_yet or time.monotonic() > deadline:
                    return
                time.sleep(_TICK)

    def _follow(self, face: Face, interrupted: list[int], why_over: WhyOver, tick: float) -> None:
        client, cancelled, state = self.client, False, 0
        while not client.done():
            client.spin(tick)
            for feedback in client.news():
                face.take(feedback)
                state = feedback.state
            face.tick()
            over = why_over(state)
            if (interrupted or over) and not cancelled:
                cancelled = True
                client.cancel()
                if over:
                    face.say(over)
                face.say("cancelling: the safe command goes out, then the recording is closed")
            elif any(number != signal.SIGHUP for number in interrupted[1:]):
                # SIGHUP does not count: a shell that ends with its terminal sends it once more.
                sender = "its node, which ends," if self.has_own_nodes else client.name
                raise LoopError(
                    f"stopped waiting; {sender} still sends {self.safe_command}, and its log says "
                    f"how the tune ended"
                )

    @property
    def safe_command(self) -> str:
        """The safe command in words."""
        return "the safe command"

    @property
    def is_silent(self) -> bool:
        """Whether the last tune ended since its sensor fell silent."""
        return self.client.result.why.code in (Code.SILENT_SENSOR, Code.SENSOR_GONE)

    def left(self) -> str:
        """Return in which state a tune without gains has left the plant; empty: not known."""
        sent = f"{self.safe_command} was sent"
        if others := self.other_commander():
            return f"{sent}, but {others} commands, too, and goes on"
        if self.is_silent:
            return f"{sent}, and no measurement shows whether the plant has it"
        if self.has_own_nodes:
            return ""
        controllers = self.client.others_on("controller_command")
        return f"{sent}, and {controllers} commands again" * bool(controllers)

    def other_commander(self) -> str:
        """Return who else commanded during a tune that ended for that; empty: nobody."""
        why = reason_from_message(self.client.result.why)
        of_others = Code.SECOND_PUBLISHER, Code.FOREIGN_COMMAND
        return str(why.values.get("others", "another node")) if why.code in of_others else ""

    def again(self, command: str) -> Steps:
        """Return how to tune it again, with what has to be done before.

        :param command: that tunes it in the same way.
        """
        return [("once it measures and rests" if self.is_silent else "run it again", command)]

    def present(self) -> Controller | None:
        """Return the gains in force in its controller; None: they are not known."""
        from relay_autotune.nodes.gains_client import GainsClient

        with suppress(RelayAutotuneError):
            for name in self.client.controllers()[:1]:
                with GainsClient("", name, beside=self.client) as loop:
                    return loop.in_force()
        return None

    @property
    def target(self) -> Target:
        """Where exported gains go."""
        return Target(noise_std=self.client.result.transfer_function.noise_std)

    def apply(self, doubt: str) -> tuple[bool | None, str]:  # noqa: ARG002  see JointLoop
        """Offer the gains to its controller.

        :param doubt: why they are doubtful; empty: they are trusted.
        :return: whether they are in force, None: it has no controller; and why their step failed.
        """
        return None, ""


class TopicLoop(Loop):
    """A loop of two topics, whose nodes this command starts.

    Looking at it asks on the terminal for what is not given, unless a page asks.

    :param client: of the relay_node that will be started.
    :param options: of the command line.
    :raises LoopError: if a topic is not there, or something is not known and nobody can be asked.
    """

    has_own_nodes = proves = True

    def __init__(self, client: TuneClient, options: argparse.Namespace) -> None:
        super().__init__(client, options)
        answers, measurement, command = self.answers, options.measurement, options.command
        with Working(f"looking at {measurement} and {command}"):
            self._kind = client.kind_of(measurement, options.wait, published=True)
            self._command_kind = client.kind_of(command, options.wait, published=False)
        reader = self._reader()
        with Working(f"listening to {measurement}"):
            heard = client.heard(reader.kind, measurement, bool, options.wait, number=reader.value)
        answers.measured = heard[-1] if heard else math.nan
        try:
            self._commands = CommandMessage(
                self._command_kind, options.command_field, options.command_message or ""
            )
        except ParameterError as error:
            raise SelectionError(as_flags(str(error))) from None
        for letter, kind, field in (
            ("y", self._kind, options.field),
            ("u", self._command_kind, options.command_field),
        ):
            if unit := unit_of_field(kind, field):
                UNITS[letter] = unit
        with Working(f"looking who commands {command}"):
            self._require_alone()
        self._give_up = client.claim(self._commands.kind, command)
        client.left_behind = self._left_behind
        if not options.web:
            answers.ask(*(SETTING[name] for name in self.form))

    def _reader(self) -> Reader:
        """Return what reads the measurement; ask where the messages do not have that of --field.

        Where none is given, it is the number that the messages are about, as for `replay`.

        :raises SelectionError: if nobody can be asked.
        """
        options = self.options
        while True:
            try:
                return reader_of(self._kind, options.field)
            except ParameterError as error:
                problem = as_flags(str(error))
            root = struct_of(message_class(self._kind, "measurement_type"))
            only = only_field(root)
            if only and options.field == SETTING["field"].default != only:
                print(f"using --field {only} of {root.name}", file=sys.stderr)
                options.field = only
                continue
            first = "".join(first_numbers(root, 1))
            if not (first and sys.stdin.isatty()):
                raise SelectionError(
                    f"{problem}: give it, such as --field {first}" if first else problem
                )
            print("\n".join(broken(problem, width())), file=sys.stderr)
            what = "the number that measures"
            options.field = asked(what, "--field", first, first, str)

    @property
    def title(self) -> str:
        """The name of the loop for people."""
        return f"{self.options.measurement} -> {self.options.command}"

    def joined(self) -> None:
        """Leave the command to relay_node alone, which has the settings since its start.

        :raises LoopError: if somebody else commands.
        """
        self._require_alone()
        self._give_up()

    def _require_alone(self) -> None:
        """Refuse a loop that somebody else commands, with its name and what to do."""
        topic = self.options.command
        if through := self.client.others_on("controller_command"):
            raise LoopError(
                f"{through} publishes {self.space}/controller_command: its commands would reach "
                f"the actuator only until the nodes of this command end; stop it, or start "
                f"relay_node and identifier_node yourself, and leave out --measurement and "
                f"--command"
            )
        if not (others := self.client.others_on(topic)):
            return
        commands, says, at = self._commands, "", ""
        heard = self.client.heard(
            commands.kind, topic, lambda _: False, _LISTEN, number=commands.value
        )
        if heard:
            present = sum(heard) / len(heard)
            says = f", {present:.6g} u now"
            at = f" with --at {present:.6g}, while the process still rests there"
        problem = (
            f"{others} commands {topic}{says}: end it first (Ctrl-C where it runs; one that was "
            f"killed is forgotten after some 20 s), then start again{at}"
        )
        raise LoopError(in_units(problem, UNITS))

    def arguments(self) -> dict[str, list[str]]:
        """Return the arguments for ROS of its nodes, by the names of their executables."""
        options, space = self.options, self.space
        values: dict[str, Any] = {
            "measurement_type": self._kind,
            "command_type": self._command_kind,
            "baseline_is_present": True,
            # By the rate, which relay_node measures before the tune.
            "measurement_timeout": 0.0,
            **self.answers.parameters(),
            # Without an identifier_node it would wait for nothing.
            **({"model_timeout": 0.0} if options.record_only else {}),
        }
        if others := options.command_message:
            # The value of a parameter is YAML itself, so that this text needs quotes.
            values["command_message"] = json.dumps(others)
        topics = {"measurement": options.measurement, "command": options.command}
        nodes = {"relay_node": ros_arguments(space, topics, values)}
        if not options.record_only:
            asked_for = {name: getattr(options, name) for name in ("law", "sample_period")}
            given = {name: value for name, value in asked_for.items() if value is not None}
            nodes["identifier_node"] = ros_arguments(space, values=given)
        return nodes

    @property
    def safe_command(self) -> str:
        """The safe command in words."""
        return f"the safe command {self.options.at:.6g} u"

    def _left_behind(self) -> str:
        """Send the safe command in the place of a relay_node that is lost, and tell it."""
        # One that hangs might command again.
        self.nodes.end("relay_node")
        self.client.send(self._commands.written(self.options.at), self.options.command)
        return self._sent_to_nobody or f"{self.safe_command} was sent in its place"

    @property
    def _sent_to_nobody(self) -> str:
        """What is said where nobody hears the safe command; empty: somebody does."""
        topic = self.options.command
        if self.client.is_taken(topic):
            return ""
        return (
            f"{self.safe_command} was sent, but nobody takes commands from {topic} any more: see "
            f"to the plant"
        )

    def left(self) -> str:
        """Return at which command the loop is left, and whether that is the right one."""
        command = self.options.at
        if nobody := self._sent_to_nobody:
            return nobody
        if left := super().left():
            return left
        if self._rests_elsewhere:
            return (
                f"the command stands at {command:.6g} u, which is not the one at which the "
                f"process rested: set the right one now"
            )
        left = f"the plant is left at {self.safe_command}"
        if self.left_its_limits:
            left += ": look whether the process rests there, else set the right one now"
        return left

    def other_commander(self) -> str:
        """Return who else commanded during a tune that ended for that; empty: nobody."""
        # Its name may have become known since.
        found = super().other_commander()
        return found and (self.client.others_on(self.options.command) or found)

    def again(self, command: str) -> Steps:
        """Return how to tune it again; the same tune may drive the process away."""
        if self._rests_elsewhere:
            advice = "start again with --at and the command at which it rests"
            return [("once it rests", advice)]
        if self.left_its_limits:
            changes = "the --at at which it rests, a smaller --amplitude, or wider --within"
            return [("once it rests", f"start again with {changes}")]
        others = self.other_commander()
        first = [("first", f"end {others}, which commands {self.options.command}")] * bool(others)
        return [*first, *super().again(command)]

    @property
    def _rests_elsewhere(self) -> bool:
        """Whether the process did not rest at the command that was said to be the present one."""
        why = reason_from_message(self.client.result.why)
        at_limit = why.code is Code.OUTSIDE_LIMITS and "baseline" in why.values
        return at_limit or why.code is Code.NOT_AT_BASELINE

    @cached_property
    def left_its_limits(self) -> bool:
        """Whether the last measurement of a tune that was aborted is outside of its limits."""
        result, within = self.client.result, self.options.within
        if result.outcome != result.ABORTED or not within:
            return False
        try:
            measured = self.client.record(PATIENCE).measurement
        except RelayAutotuneError:
            return False
        low, high = within
        return measured.size > 0 and not low <= float(measured[-1]) <= high

    @property
    def target(self) -> Target:
        """Where exported gains go: within the limits of the command, from the present one on.

        What a tune may see is not what the sensor can tell, so the measurement has no limits.
        """
        options = self.options
        low, high = options.command_within or (-math.inf, math.inf)
        setpoint = self.client.result.experiment.settings.setpoint
        topics = {"measurement": options.measurement}
        # controller_node sends Float64 alone; relay_node passes that on as another type.
        if self._command_kind == FLOAT64:
            topics["controller_command"] = options.command
        return Target(
            command_min=low,
            command_max=high,
            present=options.at,
            noise_std=self.client.result.transfer_function.noise_std,
            model=transfer_function_from_message(self.client.result.transfer_function),
            parameters={
                **sensor_parameters(self._kind, options.field),
                "safe_command": options.at,
                "initial_setpoint": float(f"{setpoint:.6g}"),
            },
            topics=topics,
            units=dict(UNITS),
        )
