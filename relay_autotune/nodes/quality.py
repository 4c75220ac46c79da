# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The topics of a loop: quality of service, and why a publisher and a subscriber do not match."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from difflib import SequenceMatcher
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.qos_overriding_options import QoSOverridingOptions

from relay_autotune.bag.writer import Qos
from relay_autotune.errors import ParameterError

# All of these are reliable, which is rclpy's default as volatile is. A sensor may burst after a
# stall of some milliseconds; at 1 kHz a depth of 1 loses samples.
MEASUREMENT = QoSProfile(depth=100)
COMMAND = QoSProfile(depth=10)


def latched(depth: int) -> QoSProfile:
    """Return the profile of a topic whose last messages reach late subscribers (latched).

    :param depth: number of messages kept.
    """
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


RESULT = latched(1)

OVERRIDABLE = {"qos_overriding_options": QoSOverridingOptions.with_default_policies()}
"""Options of a publisher or subscription whose quality of service parameters may change."""

# Topics of every node, and how many others are named where one is missing.
_COMMON = {"/rosout", "/parameter_events"}
# Types of what this package publishes of a tune: no sensor, and no actuator.
_RESULTS = "relay_autotune_msgs/"
_MOST_NAMED = 4

# A killed process stays in the graph for some 20 s. With this liveliness lease a subscriber
# notices its end sooner [s].
_ALIVE_WITHIN = 1.0
STATUS = QoSProfile(
    depth=1,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=_ALIVE_WITHIN),
)
"""Profile of the status that shows whether a tune runs, and whether relay_node lives."""

# How long the end of a process waits for the acknowledgement of its last message.
ACKNOWLEDGE = Duration(seconds=0.2)

# A node that was there before may be unknown until it next announces itself [s]: Fast DDS does so
# every 3 s, and its publishers are known within some 0.1 s.
ALL_KNOWN_AFTER = 3.5


def publisher(node: Node, *what: Any, **options: Any) -> Any:
    """Return a publisher without event callbacks: each costs time in every turn of the executor.

    :param node: that publishes.
    :param what: class of the messages, topic and quality of service.
    :param options: of `Node.create_publisher`.
    """
    silent = PublisherEventCallbacks(use_default_callbacks=False)
    return node.create_publisher(*what, event_callbacks=silent, **options)


def subscription(node: Node, *what: Any, **options: Any) -> Any:
    """Return a subscription without event callbacks, as :func:`publisher` has none.

    :param node: that subscribes.
    :param what: class of the messages, topic, what takes each of them, and quality of service.
    :param options: of `Node.create_subscription`.
    """
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    return node.create_subscription(*what, event_callbacks=silent, **options)


def require_apart(node: Node) -> None:
    """Refuse one topic for measurement and command: the node would hear itself.

    :param node: that has both.
    :raises ParameterError: with the topic.
    """
    topic = node.resolve_topic_name("measurement")
    if topic == node.resolve_topic_name("command"):
        raise ParameterError(f"measurement and command are both {topic}: remap them to two topics")


def for_bag(profile: QoSProfile) -> Qos:
    """Return a profile as a recording's metadata describe it."""
    return Qos(
        profile.reliability.name.lower(),
        profile.durability.name.lower(),
        profile.history.name.lower(),
        int(profile.depth),
    )


def why_unconnected(node: Node, topic: str, kind: str, *, hears: bool) -> str:
    """Return why nothing arrives from a topic, or on it, as far as the graph shows.

    :param node: the node that subscribes, or publishes.
    :param topic: resolved name of the topic.
    :param kind: the message type that is expected.
    :param hears: True: the node is to hear a measurement; False: its command is to be heard.
    """
    what, name, none = "publisher", "measurement", "nothing arrives"
    theirs, ours = node.get_publishers_info_by_topic, node.get_subscriptions_info_by_topic
    if not hears:
        what, name, none = "subscriber", "command", "none is connected yet"
        theirs, ours = ours, theirs
    if not (ends := theirs(topic)):
        first, more = nearest(node, topic, theirs, kind)
        typed = f"; {first} has one of this type: start the node with -r {name}:={first}{more}"
        return f"{topic} has no {what}{typed if first else ''}"
    # The profile in force; the requested one leaves deadlines to the middleware.
    mine = node.get_fully_qualified_name()
    own = next((end.qos_profile for end in ours(topic) if who(end) == mine), None)
    problems = []
    for end in ends:
        if end.topic_type != kind:
            problems.append(f"{who(end)} has type {end.topic_type}, expected {kind}")
            continue
        pair = (end.qos_profile, own) if hears else (own, end.qos_profile)
        compatibility, reason = qos_check_compatible(*pair)
        if compatibility == QoSCompatibility.ERROR:
            mismatch = reason.replace("ERROR: ", "").rstrip("; ").replace(";", ", ")
            problems.append(f"{who(end)} has an incompatible QoS: {mismatch}")
    count = f"{len(ends)} {what}{'s' * (len(ends) > 1)}"
    return f"{topic} has {count}, but {'; '.join(problems) or none}"


def nearest(
    node: Node, topic: str, ends_of: Callable[[str], Sequence[Any]], kind: str = ""
) -> tuple[str, str]:
    """Return the topic whose name is most like one that is missing, and a list of others.

    :param node: the node that looks for the topic.
    :param topic: the resolved name that is missing.
    :param ends_of: returns the ends that a topic must have: publishers, or subscriptions.
    :param kind: the message type; empty: any but those of a tune's results.
    :return: its name, empty if there is none; " (others: ...)", empty if there are none.
    """
    mine = node.get_fully_qualified_name()
    # Both sides of a topic of this node are its own, not those of a sensor or an actuator.
    own = {end.topic_name for end in (*node.publishers, *node.subscriptions)} | _COMMON
    there = sorted(
        (
            other
            for other, kinds in node.get_topic_names_and_types()
            if (kind in kinds if kind else not kinds[0].startswith(_RESULTS))
            and other not in own
            and any(who(e) != mine for e in ends_of(other))
        ),
        key=lambda other: SequenceMatcher(None, topic, other).ratio(),
        reverse=True,
    )
    if not there:
        return "", ""
    return there[0], f" (others: {', '.join(there[1:_MOST_NAMED])})" if there[1:] else ""


UNNAMED = "a node not known yet"
"""Stands for the name of a node that the middleware has not given yet."""


def who(end: Any) -> str:
    """Return the full name of the node of a publisher or subscription."""
    if end.node_name == "_NODE_NAME_UNKNOWN_":
        return UNNAMED
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def described(end: Any) -> str:
    """Return a publisher or subscription with its node, type and reliability."""
    best_effort = end.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    return f"{who(end)} ({end.topic_type}, {'best effort' if best_effort else 'reliable'})"


# The lockstep protocol between plant_node and relay_node: the plant repeats its first measurement
# until a command comes. The first command starts the run, and each command leads to one further
# sample. A repeat may cross the first command on its way and would then be counted as sample 1. So
# the plant pauses after the first command, and the relay drops a measurement equal to sample 0
# within the first half of that pause.

# Interval at which the plant repeats a measurement without an answer [s].
REPEAT_AFTER = 0.2

# Pause from the first command to sample 1 [s].
QUIET_AFTER_GO = 0.01

# If no sample follows within this time, the relay answers the measurement that it dropped [s].
NO_REPEAT_AFTER = 0.1
