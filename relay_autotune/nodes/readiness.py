"""Whether a tune can start, and the sentence that says why not."""

from __future__ import annotations

import math

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.nodes.quality import why_no_publisher, why_no_subscriber
from relay_autotune.relay_parameters import ExperimentParameters


class NotReadyError(RelayAutotuneError):
    """A tune that cannot start."""


def require_connections(
    node: Node, measurement: Subscription, command: Publisher, age: float, timeout: float
) -> None:
    """Refuse a start without measurements, or with nobody who takes the commands.

    :param node: the node that would tune.
    :param measurement: its subscription.
    :param command: its publisher.
    :param age: time since the last measurement came [s]; inf: none has come.
    :param timeout: the greatest age that counts as "arriving" [s].
    :raises NotReadyError: with the reason, as far as the graph tells it.
    """
    if node.get_parameter("use_sim_time").value and node.get_clock().now().nanoseconds == 0:
        raise NotReadyError("use_sim_time is true, but no time has come on /clock")
    if age > timeout:
        when = "yet" if math.isinf(age) else f"for {age:.3g} s"
        why = why_no_publisher(node, measurement.topic_name)
        raise NotReadyError(f"no measurement has come {when}: {why}")
    if command.get_subscription_count() == 0:
        why = why_no_subscriber(node, command.topic_name)
        raise NotReadyError(f"no command would arrive: {why}")


def baseline_from(parameter: float, held: float | None) -> float:
    """Return the command of the operating point.

    :param parameter: the parameter ``baseline`` [u]; NaN: not given.
    :param held: the command that the node holds now [u]; None: it has sent none.
    :raises NotReadyError: if neither is known.
    """
    if not math.isnan(parameter):
        return parameter
    if held is None:
        raise NotReadyError(
            "the baseline is not known: set the parameter baseline, or initial_command at the "
            "node's start, to the command of the operating point"
        )
    return held


def plan_of(parameters: ExperimentParameters, baseline: float) -> str:
    """Say what a tune will command.

    :param parameters: the experiment's parameters.
    :param baseline: command of the operating point [u].
    """
    middle = baseline + parameters.relay_bias
    low, high = middle - parameters.amplitude, middle + parameters.amplitude
    return f"relay between {low:g} and {high:g} about the baseline {baseline:g}"
