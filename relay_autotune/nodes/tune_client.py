# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A client of relay_node's action ~/tune, which also finds the other nodes of the loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any

from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import qos_profile_sensor_data

from relay_autotune.errors import LoopError
from relay_autotune.exchange.messages import (
    made_visible,
    reason_from_message,
    record_from_message,
    without_impossible,
)
from relay_autotune.nodes import quality
from relay_autotune.nodes.live_types import CommandMessage, reader_of
from relay_autotune.nodes.loop_client import LoopClient, readable
from relay_autotune.reasons import Code, Reason
from relay_autotune.record.record import Record
from relay_autotune_msgs.action import Tune
from relay_autotune_msgs.msg import RelayCycle, RelayExperiment

# Another's relay_node counts as lost once it is missed for this time [s], in addition to the
# middleware's liveliness lease: on a busy machine a living one was missed for up to 1.4 s. One
# whose process has ended is heard for a while, since its last messages may be on their way.
_GONE, _LAST_WORDS = 3.0, 1.0
# Time after which one whose process runs, and whose liveliness has ended, counts as hung [s].
_HUNG = 10.0
# How long messages are handled before the answer is looked for again [s].
_TICK = 0.05
# States of an ended goal; the safe command was sent before.
_ENDED = (GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED)


class TuneClient(LoopClient):
    """Ask one relay_node for one tune.

    :param namespace: namespace of the loop; empty: the root, or as the ROS arguments say.
    :param node: name of the relay_node.
    :param ros: arguments for ROS.
    :param beside: another client, whose executor this one uses; None: it has its own.
    :raises ParameterError: if the name is not valid.
    """

    def __init__(
        self, namespace: str, node: str, ros: Sequence[str] = (), beside: LoopClient | None = None
    ) -> None:
        super().__init__("tune_loop", namespace, node, ros, beside, Tune)
        self._alive = True
        self._node.create_subscription(
            GoalStatusArray,
            f"{node}/tune/_action/status",
            lambda _: None,
            quality.STATUS,
            event_callbacks=SubscriptionEventCallbacks(
                liveliness=self._on_liveliness, use_default_callbacks=False
            ),
        )
        self._feedback: list[Any] = []
        self._goal: Any = None
        self._answer: Any = None
        # For how long it was looked for in vain [s]; a pause between two looks shows nothing.
        self._missed = 0.0
        self.why_ended: Callable[[], str] | None = None
        """Tells why the process of relay_node has ended, empty: it runs; None: it is another's."""
        self.left_behind: Callable[[], str] = lambda: (
            "nobody publishes the command, and the last one stays in force; see to the plant"
        )
        """Tells what follows where relay_node is lost during a tune."""
        self.refused: set[str] = set()
        """Sentences on results that were received and refused."""

    def find(self, patience: float, *, needs_identifier: bool, leave: Callable[[], bool]) -> None:
        """Wait for the relay_node, and for the identifier_node if it is needed.

        :param patience: longest wait [s].
        :param needs_identifier: whether model and gains are wanted.
        :param leave: returns True to stop waiting; this method then returns.
        :raises LoopError: if a node is missing; the sentence names the nodes that are there.
        """
        # Reading a model needs modules that take most of a second to load: load them now, while
        # the middleware looks for the nodes, and not at the first model in the middle of a tune.
        from relay_autotune.exchange import models  # noqa: F401

        deadline = time.monotonic() + patience
        self._find("relay_node", "offer a tune", patience, leave)
        gains = self._resolved("pi_gains")
        if needs_identifier and not self.wait(
            lambda: leave() or self._node.count_publishers(gains) > 0, deadline - time.monotonic()
        ):
            raise LoopError(
                f"no identifier_node publishes {gains}, so that no model and no gains would come; "
                f"start one in this namespace, or ask for a recording alone with --record-only"
            )

    def ask(self, amplitude: float, dry_run: bool) -> None:
        """Send the goal.

        :param amplitude: half the distance of the two commands [u]; 0: the node's parameter.
        :param dry_run: whether only to check, and not to start.
        :raises LoopError: if the node does not answer.
        """
        goal = Tune.Goal(amplitude=amplitude, dry_run=dry_run)
        self._goal = self._sent(goal, self._feedback.append)
        self._answer = self._goal.get_result_async()

    def check(self, amplitude: float) -> Any:
        """Ask whether a tune could start, and return the answer, a `Tune.Result`.

        :param amplitude: as of `ask`.
        :raises LoopError: if the node does not answer.
        """
        self.ask(amplitude, dry_run=True)
        while not self.done():
            self.spin(_TICK)
        return self.result

    def spin(self, seconds: float) -> None:
        """Handle messages for a time, or until the result is there.

        :param seconds: the time [s].
        :raises LoopError: if the node is lost.
        """
        # The error on a node lost during a tune says what that means for the plant.
        self._handle(self._answer.done, seconds)
        if self._answer.done() or not (why := self._why_gone(seconds)):
            return
        if self._goal.status in _ENDED:
            raise LoopError(
                f"{self.name} has ended, and the tune before it: the safe command is out; the log "
                f"and the recording say how the tune ended"
            )
        raise LoopError(f"during the tune {why}; {self.left_behind()}".rstrip("; "))

    def _why_gone(self, looked: float) -> str:
        """Return why relay_node must be gone; empty: it is there, or may only be late.

        A lease that has run out proves little where the process can be asked.

        :param looked: for how long it was looked for [s].
        """
        if self.why_ended is not None:
            why, limit = self.why_ended(), _LAST_WORDS
            if not (why or self._alive):
                why, limit = f"{self.name} hangs", _HUNG
        else:
            is_there = self._alive and self._action.server_is_ready()
            why = "" if is_there else f"{self.name} has gone, or cannot be heard any more"
            limit = _GONE
        self._missed = self._missed + looked if why else 0.0
        return why if self._missed > limit else ""

    def _on_liveliness(self, info: Any) -> None:
        self._alive = info.alive_count > 0

    def news(self) -> list[Any]:
        """Return the feedback received since the last call."""
        news, self._feedback[:] = list(self._feedback), []
        for feedback in news:
            self.refused.update(without_impossible(made_visible(feedback)))
        return [feedback for feedback in news if feedback.state <= Tune.Feedback.STATE_FAILED]

    def cancel(self) -> None:
        """Ask for the end of the tune."""
        self._goal.cancel_goal_async()

    def done(self) -> bool:
        """Tell whether the result is there."""
        return bool(self._answer.done())

    @property
    def result(self) -> Any:
        """The `Tune.Result`, without a model or gains that failed their check."""
        result = made_visible(self._answer.result().result)
        self.refused.update(without_impossible(result))
        result.outcome = min(result.outcome, Tune.Result.FAILED)
        return result

    @property
    def succeeded(self) -> bool:
        """Whether the goal was reached."""
        return bool(self._answer.result().status == GoalStatus.STATUS_SUCCEEDED)

    @property
    def not_ready_yet(self) -> bool:
        """Whether the reason for the refusal may disappear without action."""
        result = self.result
        refused = not self.succeeded and not result.experiment.experiment_id
        return refused and any(
            reason.code.row.transient or self._is_own(reason)
            for reason in map(reason_from_message, (result.why, *result.refusals))
        )

    def _is_own(self, reason: Reason) -> bool:
        """Return whether a second publisher is this client's own, of before the tune.

        It is known for a while after its end.
        """
        mine = self._first.get_fully_qualified_name()
        return reason.code is Code.SECOND_PUBLISHER and reason["others"] == mine

    @property
    def cancelled(self) -> bool:
        """Whether it was cancelled."""
        return bool(self._answer.result().status == GoalStatus.STATUS_CANCELED)

    def controllers(self) -> list[str]:
        """Return the full names of the nodes of this namespace that can apply gains."""
        return [name for name in self.owners("/apply") if self._is_here(name)]

    def record(self, patience: float) -> Record:
        """Return the samples of the tune, which relay_node publishes latched.

        :param patience: how long to wait for them [s].
        :raises LoopError: if they do not come.
        :raises RelayAutotuneError: if they are no record.
        """
        wanted = self.result.experiment.experiment_id
        found = self.latched(
            RelayExperiment, "relay_experiment", lambda m: m.experiment_id == wanted, patience
        )
        if found is None:
            raise LoopError(f"the samples of {wanted} have not come within {patience:g} s")
        return record_from_message(found)

    def watch_measurement(self, take: Callable[[float], None]) -> None:
        """Hear each measurement that relay_node hears.

        :param take: called with it [y].
        :raises LoopError: unless exactly one topic can be it.
        """
        values = self.values(self.name, ["measurement_type", "measurement_field"])
        reader = reader_of(*values.values())
        name = self._topic_of(self.name, "measurement", reader.type_name, published=False)
        # Best effort, so that nobody waits for this client.
        hear = readable(reader.value, take)
        self._node.create_subscription(reader.kind, name, hear, qos_profile_sensor_data)

    def command_watch(
        self, take: Callable[[float], None], cycle: Callable[[Any], None]
    ) -> Callable[[], AbstractContextManager[None]]:
        """Return a context in which the commands of a tune are heard.

        It is to be entered once the tune has begun: relay_node refuses a start where nobody hears
        its commands, and this client would count as somebody.

        :param take: called with each command [u].
        :param cycle: called with each `RelayCycle`.
        :raises LoopError: unless exactly one topic can be it.
        """
        names = ("command_type", "command_field", "command_message", "command_others")
        *given, others = self.values(self.name, names).values()
        commands = CommandMessage(*given, taken=others == "other_commands")
        name = self._topic_of(self.name, "command", commands.type_name, published=True)
        hear = readable(commands.value, take)

        @contextmanager
        def heard() -> Iterator[None]:
            with (
                self._hearing(commands.kind, name, hear),
                self._hearing(RelayCycle, "relay_cycle", cycle),
            ):
                yield

        return heard

    def identifier_values(self, patience: float) -> dict[str, Any] | None:
        """Return the parameters of the identifier_node by name; None: it did not answer.

        :param patience: how long to wait for them [s].
        """
        # Imported here, because it loads slowly and must not delay a tune.
        from relay_autotune.analysis import PARAMETERS

        names = [entry.name for entry in PARAMETERS]
        for end in self._node.get_publishers_info_by_topic(self._resolved("pi_gains")):
            with suppress(LoopError):
                return self.values(quality.who(end), names, patience)
        return None
