# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A node that starts a tune and observes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from relay_autotune.nodes.quality import latched
from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment, TransferFunction
from relay_autotune_msgs.srv import StartTune

_MOST_KEPT = 100


class Onlooker:
    """Calls relay_node and collects what a tune publishes.

    :param domain: the ROS domain of the loop.
    :param check: called while waiting; raises when there is nothing to wait for any more.
    """

    def __init__(self, domain: int, check: Callable[[], None]) -> None:
        self._check = check
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = Node("onlooker", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.cycles: list[Any] = self._listen("relay_cycle", RelayCycle)
        self.experiments: list[Any] = self._listen("relay_experiment", RelayExperiment)
        self.models: list[Any] = self._listen("transfer_function", TransferFunction)
        self.gains: list[Any] = self._listen("pi_gains", PidGains)

    def __enter__(self) -> Onlooker:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown(timeout_sec=0.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _listen(self, topic: str, kind: Any) -> list[Any]:
        messages: list[Any] = []
        self._node.create_subscription(kind, topic, messages.append, latched(_MOST_KEPT))
        return messages

    def wait(self, condition: Callable[[], Any]) -> Any:
        """Take messages until a condition holds, and return its value.

        :param condition: called after each message.
        """
        while True:
            value = condition()
            if value:
                return value
            self._check()
            self._executor.spin_once(timeout_sec=0.05)

    def start_tune(self) -> Any:
        """Ask relay_node to tune until it accepts, and return its answer."""
        client = self._node.create_client(StartTune, "relay_node/start_tune")
        self.wait(client.service_is_ready)
        while True:
            future = client.call_async(StartTune.Request())
            self.wait(future.done)
            answer = future.result()
            if answer.accepted:
                self._node.destroy_client(client)
                return answer
            # The nodes may not have discovered each other yet.
            self._executor.spin_once(timeout_sec=0.1)
