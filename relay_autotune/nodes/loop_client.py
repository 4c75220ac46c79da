# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A client of the nodes of one loop: it finds them, calls them and hears their latched topics."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Self, TypeVar

import rclpy
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace
from rclpy.validate_node_name import validate_node_name
from rclpy.validate_topic_name import validate_topic_name

from relay_autotune.errors import FieldError, LoopError, ParameterError
from relay_autotune.exchange.messages import made_visible
from relay_autotune.nodes import quality

_Result = TypeVar("_Result")
# How long present commands are listened to [s].
_LISTEN = 1.0
# How long a node may take to answer [s], and after which time one may be asked again.
ANSWER_WITHIN, _ASK_AGAIN = 10.0, 3.0
# Messages of a latched topic from before the subscription that are taken.
_MOST_HEARD = 100
# How long somebody who hears a topic may take to get a message [s].
_HEARD_WITHIN = 2.0
# Interval in which a message is published until it has arrived [s].
_AGAIN = 0.2

# Topics of relay_node that may have the type of measurement and command.
_OTHER_ENDS = (
    "controller_command",
    "command_feedback",
    "other_commands",
    "setpoint",
    "hold_request",
)


def readable(
    value: Callable[[Any], float], take: Callable[[float], object]
) -> Callable[[Any], None]:
    """Return what takes the number in each message, and passes over messages without it.

    :param value: reads it.
    :param take: called with it.
    """

    def hear(message: Any) -> None:
        with suppress(FieldError):
            take(value(message))

    return hear


def _why_invalid(error: NameValidationException) -> str:
    """Return in a part of a sentence why rclpy takes something for no name."""
    return str(error).splitlines()[0].partition(": ")[2].rstrip(":")


class GoneError(LoopError):
    """A node has gone, or does not answer any more."""


class LoopClient:
    """Call the nodes of one loop.

    :param own: name of the client's own node.
    :param namespace: namespace of the loop; empty: the root, or as the ROS arguments say.
    :param node: name of the node that is called most.
    :param ros: arguments for ROS.
    :param beside: another client, whose executor this one uses, and without a namespace its own
        node, too; None: it has its own.
    :param action: type of the action of that node which is asked for; None: none is.
    :raises ParameterError: if the name is not valid.
    """

    _answers_within = ANSWER_WITHIN
    # How long its node may take to answer [s]; one that has just started, as it may to start.

    def __init__(
        self,
        own: str,
        namespace: str,
        node: str,
        ros: Sequence[str] = (),
        beside: LoopClient | None = None,
        action: Any = None,
    ) -> None:
        try:
            validate_namespace(f"/{namespace.strip('/')}")
            validate_topic_name(f"{node}/tune")
            validate_node_name(node.rpartition("/")[2])
        except NameValidationException as error:
            why = _why_invalid(error)
            raise ParameterError(f"no node can be {namespace}/{node}: {why}") from None
        self.why_lost: Callable[[], str] = beside.why_lost if beside else lambda: ""
        """Tells why it is no use to wait any longer; empty: it is."""
        self._ends = ExitStack()
        if beside is None:
            self._context = Context()
            rclpy.init(
                context=self._context,
                args=list(ros),
                signal_handler_options=SignalHandlerOptions.NO,
            )
            self._ends.callback(self._context.try_shutdown)
            self._executor = SingleThreadedExecutor(context=self._context)
        else:
            self._context, self._executor = beside._context, beside._executor
        if beside is None or namespace:
            self._node = Node(own, namespace=namespace or None, context=self._context)
            self._executor.add_node(self._node)
            self._ends.callback(self._node.destroy_node)
            self._ends.callback(self._executor.remove_node, self._node)
        else:
            self._node = beside._node
        if beside is None:
            self._ends.callback(self._executor.shutdown, timeout_sec=0.0)
        # That of the client which has the executor.
        self._first: Node = beside._first if beside else self._node
        self._joined = time.monotonic()
        self.name = self._node.resolve_service_name(node)
        self._services: dict[str, Any] = {}
        if action is not None:
            self._ending = f"/{action.__name__.lower()}"
            self._action = ActionClient(self._node, action, f"{node}{self._ending}")
            self._ends.callback(self._action.destroy)

    def close(self) -> None:
        """Leave the graph."""
        self._ends.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def hearing(self, kind: Any, topic: str) -> list[Any]:
        """Return a list that gets all messages of a latched topic, until this client ends.

        :param kind: the message class.
        :param topic: its unresolved name.
        """
        came: list[Any] = []
        profile = quality.latched(_MOST_HEARD)
        self._ends.enter_context(self._hearing(kind, topic, came.append, profile))
        return came

    def heard(
        self,
        kind: Any,
        topic: str,
        enough: Callable[[list[Any]], bool],
        patience: float = ANSWER_WITHIN,
        # Best effort, so that nobody waits for this client.
        profile: QoSProfile = qos_profile_sensor_data,
        *,
        least: float = 0.0,
        number: Callable[[Any], float] | None = None,
    ) -> list[Any]:
        """Return what comes on a topic until it is enough, or a time is over.

        :param kind: the message class.
        :param topic: its name.
        :param enough: tells whether what has come is enough.
        :param patience: how long to wait for it [s].
        :param profile: quality of service.
        :param least: how long to hear it in any case [s].
        :param number: reads the number in a message; messages without it are passed over. None:
            the messages themselves are returned.
        """
        came: list[Any] = []
        take = readable(number, came.append) if number else came.append
        until = time.monotonic() + least
        with self._hearing(kind, topic, take, profile):
            self.wait(lambda: enough(came) and time.monotonic() >= until, patience)
        return came

    def latched(
        self, kind: Any, topic: str, wanted: Callable[[Any], bool], patience: float
    ) -> Any | None:
        """Return the newest wanted message of a latched topic; None: none came.

        :param kind: the message class.
        :param topic: its name.
        :param wanted: tells whether a message is one of them.
        :param patience: how long to wait for it [s].
        """
        profile = quality.latched(10)
        came = self.heard(kind, topic, lambda came: any(map(wanted, came)), patience, profile)
        return next(filter(wanted, reversed(came)), None)

    def call(
        self, kind: Any, service: str, request: Any, patience: float = 0.0, *, again: bool = False
    ) -> Any:
        """Return the answer of a service.

        :param kind: the service class.
        :param service: its full name.
        :param request: what is asked.
        :param patience: how long to wait for it [s]; 0: as long as its node may take.
        :param again: True: it may be asked repeatedly, since an answer can be lost where a node
            does not know this client yet.
        :raises LoopError: if it does not answer.
        """
        own = service.startswith(f"{self.name}/")
        patience = patience or (self._answers_within if own else ANSWER_WITHIN)
        is_there = self._service(kind, service).service_is_ready
        answers: list[Any] = []
        asked = -math.inf

        def has_answered() -> bool:
            nonlocal asked
            is_due = again and time.monotonic() - asked > _ASK_AGAIN
            if (is_due or not answers) and is_there():
                asked = time.monotonic()
                answers.append(self.begin(kind, service, request))
            return any(answer.done() for answer in answers)

        if not self.wait(has_answered, patience):
            raise LoopError(f"{service} has not answered within {patience:g} s")
        return made_visible(next(answer.result() for answer in answers if answer.done()))

    def begin(self, kind: Any, service: str, request: Any) -> Any:
        """Ask a service, and return the future of its answer.

        :param kind: the service class.
        :param service: its full name.
        :param request: what is asked.
        """
        return self._service(kind, service).call_async(request)

    def _find(self, what: str, does: str, patience: float, leave: Callable[[], bool]) -> None:
        """Wait for the node with the action.

        :param what: its executable.
        :param does: what nodes with this action do.
        :param patience: longest wait [s].
        :param leave: returns True to stop waiting; this method then returns.
        :raises LoopError: if it is missing; the sentence names the nodes that are there.
        """
        self._answers_within = max(patience, ANSWER_WITHIN)
        if not self.wait(lambda: leave() or self._action.server_is_ready(), patience):
            # This client itself appears in the graph under the name that it looks for.
            others = ", ".join(n for n in self.owners(self._ending) if n != self.name) or "none"
            raise LoopError(
                f"no {what} {self.name} within {patience:g} s; nodes that {does}: {others}. "
                f"Start it{self._start()}, or name another with --namespace and --node"
            )

    def _start(self) -> str:
        """Return what starts the node, after a colon; empty: it is not known."""
        return ""

    def _sent(self, goal: Any, feedback: Callable[[Any], object]) -> Any:
        """Send a goal, and return its handle.

        :param goal: what is asked for.
        :param feedback: takes each message of the goal's feedback.
        :raises LoopError: if it is not answered, or rejected.
        """
        sent = self._action.send_goal_async(goal, feedback_callback=lambda m: feedback(m.feedback))
        if not self.wait(sent.done, self._answers_within):
            raise LoopError(
                f"{self.name} has not answered the request within {self._answers_within:g} s"
            )
        if not sent.result().accepted:
            raise LoopError(f"{self.name} has rejected the request; its log says why")
        # It has started, which alone may take longer.
        self._answers_within = ANSWER_WITHIN
        return sent.result()

    def _service(self, kind: Any, service: str) -> Any:
        if service not in self._services:
            self._services[service] = self._node.create_client(kind, service)
        return self._services[service]

    def wait(self, condition: Callable[[], bool], patience: float) -> bool:
        """Handle messages until a condition holds, and return whether it does.

        :param condition: what is waited for.
        :param patience: how long [s].
        :raises GoneError: if it is no use to wait any longer.
        """

        def is_over() -> bool:
            if condition():
                return True
            if why := self.why_lost():
                raise GoneError(why)
            return False

        return self._handle(is_over, patience)

    def _handle(self, condition: Callable[[], bool], patience: float) -> bool:
        deadline = time.monotonic() + patience
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            self._executor.spin_once(timeout_sec=min(left, 0.05))
        return True

    def computed(self, work: Future[_Result], leave: Callable[[], bool]) -> _Result:
        """Return what another thread computes; messages are handled, and signals are heeded.

        :param work: what is computed.
        :param leave: returns True when it is to end.
        :raises LoopError: if it has to end before.
        """
        self.wait(lambda: work.done() or leave(), math.inf)
        if not work.done():
            work.cancel()
            raise LoopError("ended while it was computed")
        return work.result()

    def rest(self, seconds: float) -> None:
        """Handle messages for a time.

        :param seconds: the time [s].
        """
        self.wait(lambda: False, seconds)

    @contextmanager
    def _hearing(
        self,
        kind: Any,
        topic: str,
        take: Callable[[Any], object],
        profile: QoSProfile = qos_profile_sensor_data,
    ) -> Iterator[None]:
        """Hear a topic until the end of the block."""
        ear = self._node.create_subscription(
            kind, self._resolved(topic), lambda message: take(made_visible(message)), profile
        )
        try:
            yield
        finally:
            self._node.destroy_subscription(ear)

    def publish(
        self, message: Any, topic: str, kind: Any, answers: str, accepted: Callable[[Any], bool]
    ) -> bool:
        """Publish a message every 0.2 s until an answer shows that it was taken.

        :param message: what is published.
        :param topic: its full name.
        :param kind: class of the answers.
        :param answers: full name of their topic.
        :param accepted: tells whether an answer shows it.
        :return: whether one did.
        """
        shown: list[bool] = []
        deadline = time.monotonic() + ANSWER_WITHIN
        with (
            self._hearing(kind, answers, lambda m: shown.append(accepted(m))),
            self.publishing(message, topic) as publish,
        ):
            while not any(shown) and time.monotonic() < deadline:
                publish()
                self.wait(lambda: any(shown), _AGAIN)
        return any(shown)

    @contextmanager
    def publishing(self, message: Any, topic: str) -> Iterator[Callable[[], None]]:
        """Return what publishes a message, as soon as the topic has a subscription.

        :param message: what is published.
        :param topic: its full name.
        """
        mouth = self._node.create_publisher(type(message), topic, quality.COMMAND)
        try:
            self.wait(lambda: mouth.get_subscription_count() > 0, ANSWER_WITHIN)
            yield lambda: mouth.publish(message)
            # A message that nobody has taken yet is lost with its publisher.
            mouth.wait_for_all_acked(Duration(seconds=_AGAIN))
        finally:
            self._node.destroy_publisher(mouth)

    def values(self, node: str, names: Sequence[str], patience: float = 0.0) -> dict[str, Any]:
        """Return parameters of a node by name.

        :param node: its full name.
        :param names: the parameters.
        :param patience: how long to wait for them [s]; 0: as long as the node may take.
        :raises LoopError: if it does not answer, or does not have one of them.
        """
        request = GetParameters.Request(names=list(names))
        answer = self.call(GetParameters, f"{node}/get_parameters", request, patience, again=True)
        found = [parameter_value_to_python(value) for value in answer.values]
        lacking = [n for n, value in zip(names, found, strict=False) if value is None]
        if len(found) != len(names) or lacking:
            raise LoopError(f"{node} does not have the parameters {', '.join(lacking or names)}")
        return dict(zip(names, found, strict=True))

    def set_values(self, node: str, values: Mapping[str, float | bool]) -> None:
        """Set parameters of a node, all of them or none.

        :param node: its full name.
        :param values: the values by name.
        :raises LoopError: if the node refuses or does not answer.
        """
        request = SetParametersAtomically.Request(
            parameters=[Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
        )
        result = self.call(
            SetParametersAtomically, f"{node}/set_parameters_atomically", request, again=True
        ).result
        if not result.successful:
            raise LoopError(f"{node} refuses {', '.join(values)}: {result.reason}")

    def kind_of(self, topic: str, patience: float, *, published: bool) -> str:
        """Return the message type of a topic, as soon as its other end is there.

        :param topic: its name.
        :param patience: how long to wait for it [s].
        :param published: True: it has to have a publisher; False: a subscription.
        :raises LoopError: with the topics that may be meant, if it has none.
        """
        name = self._resolved(topic)
        node = self._node
        both = [
            ("publisher", "--measurement", node.get_publishers_info_by_topic),
            ("subscription", "--command", node.get_subscriptions_info_by_topic),
        ]
        (what, flag, ends_of), (other, _, others_of) = both if published else both[::-1]
        if self.wait(lambda: bool(ends_of(name)), patience):
            return str(ends_of(name)[0].topic_type)
        lacking = f"{name} has no {what} within {patience:g} s"
        if others_of(name):
            raise LoopError(f"{lacking}, but a {other}: the topics may be the wrong way round")
        first, others = quality.nearest(node, name, ends_of)
        meant = f"; type {flag} {first}" if first else ""
        raise LoopError(f"{lacking}{meant}{others}")

    def others_on(self, topic: str) -> str:
        """Return the names of the nodes that publish a topic, but this and the one called most.

        Whoever was there before this client is among them.

        :param topic: its name.
        :return: empty: there are none.
        """
        name = self._resolved(topic)
        own = {self.name, self._node.get_fully_qualified_name()}

        def found() -> list[str]:
            ends = self._node.get_publishers_info_by_topic(name)
            return sorted({quality.who(end) for end in ends} - own)

        self.rest(self._joined + quality.ALL_KNOWN_AFTER - time.monotonic())
        # A publisher is known before the name of its node.
        self.wait(lambda: quality.UNNAMED not in found(), _LISTEN)
        return " and ".join(found())

    def claim(self, kind: Any, topic: str) -> Callable[[], object]:
        """Show to others that this client is about to command, and return what ends that.

        :param kind: the message class.
        :param topic: name of the command's topic.
        """
        mouth = self._node.create_publisher(kind, self._resolved(topic), quality.COMMAND)
        return lambda: self._node.destroy_publisher(mouth)

    def send(self, message: Any, topic: str) -> None:
        """Send a message, and wait until who hears the topic has it, for a few seconds at most.

        :param message: of any type.
        :param topic: its name.
        """
        mouth = self._node.create_publisher(type(message), self._resolved(topic), quality.COMMAND)
        self._handle(lambda: mouth.get_subscription_count() > 0, _HEARD_WITHIN)
        mouth.publish(message)
        mouth.wait_for_all_acked(Duration(seconds=_HEARD_WITHIN))

    def _topic_of(self, relay: str, topic: str, type_name: str, *, published: bool) -> str:
        """Return the name that a topic of a relay_node has, which may be remapped.

        :param relay: full name of the relay_node.
        :param topic: its name without a remapping.
        :param type_name: its message type.
        :param published: whether the relay_node publishes it.
        :raises LoopError: unless exactly one topic can be it.
        """
        space, _, name = relay.rpartition("/")
        ends = (
            self._node.get_publisher_names_and_types_by_node
            if published
            else self._node.get_subscriber_names_and_types_by_node
        )
        others = {self._resolved(other) for other in _OTHER_ENDS}

        there: list[tuple[str, list[str]]] = []

        def is_known() -> bool:
            # Its services may be known before its name and its topics are.
            with suppress(NodeNameNonExistentError):
                there[:] = ends(name, space or "/")
            return any(type_name in types for _, types in there)

        self.wait(is_known, ANSWER_WITHIN)
        found = [end for end, types in there if type_name in types and end not in others]
        own = self._resolved(topic)
        if own in found or len(found) == 1:
            return own if own in found else found[0]
        topics = ", ".join(found) or "none"
        raise LoopError(
            f"the {topic} cannot be shown: {relay} has {topics} of {type_name} for it, expected "
            f"one; give this command the same -r {topic}:=TOPIC"
        )

    def _is_here(self, name: str) -> bool:
        return name.rpartition("/")[0] == self.name.rpartition("/")[0]

    def has_publisher(self, topic: str) -> bool:
        """Return whether a topic has a publisher.

        :param topic: its full name.
        """
        return self._node.count_publishers(topic) > 0

    def is_taken(self, topic: str) -> bool:
        """Return whether another node subscribes to a topic.

        :param topic: its name.
        """
        own = self._node.get_fully_qualified_name()
        ends = self._node.get_subscriptions_info_by_topic(self._resolved(topic))
        return any(quality.who(end) != own for end in ends)

    def owners(self, ending: str) -> list[str]:
        """Return the full names of the nodes with a service that has this ending.

        :param ending: such as ``/apply``.
        """
        services = self._node.get_service_names_and_types()
        goals = [name.removesuffix("/_action/send_goal") for name, _ in services]
        return sorted({name.removesuffix(ending) for name in goals if name.endswith(ending)})

    def _resolved(self, topic: str) -> str:
        try:
            validate_topic_name(topic)
        except NameValidationException as error:
            raise ParameterError(
                f"no topic can be {topic!r}: {_why_invalid(error)}; give one such as /tank/level"
            ) from None
        return str(self._node.resolve_topic_name(topic))
