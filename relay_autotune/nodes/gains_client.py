# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A client of controller_node: the gains that wait, those in force, and their proof."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from std_srvs.srv import Trigger

from relay_autotune.errors import LoopError
from relay_autotune.exchange.messages import (
    gains_from_message,
    record_from_message,
    transfer_function_from_message,
)
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.nodes.controller_parameters import GAINS
from relay_autotune.nodes.loop_client import ANSWER_WITHIN, LoopClient
from relay_autotune.nodes.remote_gains import controller_of, mapping_of
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.text import TOLD_EVERY, duration
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, RelayExperiment
from relay_autotune_msgs.msg import TransferFunction as ModelMessage

# How long a latched result may take to come [s].
_RESULT_WITHIN = 5.0
# Beginning of the refusal of ~/verify that time cures.
_NOT_AT_REST = "the loop is not at rest"


class GainsClient(LoopClient):
    """Show, apply and verify gains with one controller_node.

    :param namespace: namespace of the loop; empty: the root, or as the ROS arguments say.
    :param node: name of the controller_node.
    :param ros: arguments for ROS.
    :raises ParameterError: if the name is not valid.
    """

    def __init__(self, namespace: str, node: str, ros: Sequence[str] = ()) -> None:
        super().__init__("apply_gains", namespace, node, ros)
        self._verify = ActionClient(self._node, Verify, f"{node}/verify")

    def close(self) -> None:
        """Leave the graph."""
        self._verify.destroy()
        super().close()

    def find(self, patience: float) -> None:
        """Wait for the controller_node.

        :param patience: longest wait [s].
        :raises LoopError: if it is not there.
        """
        if not self._wait(self._verify.server_is_ready, time.monotonic() + patience):
            there = ", ".join(n for n in self._owners("/verify") if n != self.name) or "none"
            raise LoopError(
                f"no controller_node {self.name} within {patience:g} s; nodes that verify gains: "
                f"{there}. Start it, or name another with --namespace and --node"
            )

    def waiting(self) -> tuple[Gains, str]:
        """Return the newest gains of the loop, and why they are doubtful; empty: they are not.

        :raises LoopError: if there are none.
        :raises RelayAutotuneError: if they cannot be.
        """
        found = self._result(PidGains, "pi_gains")
        doubt = "" if found.verdict == PidGains.VERDICT_TRUSTED else found.verdict_reason
        if not doubt and found.verdict != PidGains.VERDICT_TRUSTED:
            doubt = "they carry no verdict"
        return gains_from_message(found), doubt

    def model(self) -> TransferFunction:
        """Return the newest model of the loop.

        :raises LoopError: if there is none.
        :raises RelayAutotuneError: if it cannot be.
        """
        return transfer_function_from_message(self._result(ModelMessage, "transfer_function"))

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
        names = ("apply_to", "apply_parameters")
        target, mapping = self.values(self.name, names).values()
        if target:
            places = mapping_of([part.strip() for part in mapping.split(",")])
            there = self.values(target, list(places.values()))
            return controller_of({gain: there[place] for gain, place in places.items()})
        found = self.values(self.name, [entry.name for entry in GAINS])
        return Controller(**found) if found["kc"] else None

    def swing(self) -> float | None:
        """Return half the swing of the measurement in the last cycle of the newest tune [y]."""
        found = self.latched(
            RelayExperiment, "relay_experiment", lambda m: len(m.cycle_start) > 1, _RESULT_WITHIN
        )
        if found is None:
            return None
        record = record_from_message(found)
        first, stop = record.cycle_start[-2:]
        return 0.5 * float(np.ptp(record.measurement[first : stop + 1]))

    def ask(self, service: str) -> str:
        """Call ~/apply, ~/revert or ~/discard, and return its answer.

        :param service: which of them.
        :raises LoopError: with the reason, if it refuses.
        """
        answer = self.call(Trigger, f"{self.name}/{service}", Trigger.Request())
        if not answer.success:
            raise LoopError(f"{self.name} refuses: {answer.message}")
        return str(answer.message)

    def let_settle(self, seconds: float, tell: Callable[[str], None]) -> None:
        """Wait until a loop with new gains has come to rest.

        :param seconds: how long it takes [s].
        :param tell: called each second with what is waited for.
        """
        begun = time.monotonic()
        while (waited := time.monotonic() - begun) < seconds:
            tell(f"the loop settles with the new gains, {duration(waited)} of {duration(seconds)}")
            self.rest(min(TOLD_EVERY, seconds - waited))

    def verify(
        self, setpoint: float, load: float, patience: float, tell: Callable[[str], None]
    ) -> Any:
        """Make the steps, as soon as the loop is at rest, and return the `Verify.Result`.

        :param setpoint: step of the set-point [y]; 0: that of the node's parameter.
        :param load: step of the load [u]; 0: none.
        :param patience: how long to wait until the loop is at rest [s].
        :param tell: called at least each second with what is waited for.
        :raises LoopError: with the reason, if it was refused.
        """
        begun = time.monotonic()
        goal = Verify.Goal(setpoint_step=setpoint, load_step=load)
        while True:
            sent = self._verify.send_goal_async(
                goal, feedback_callback=lambda message: tell(message.feedback.status)
            )
            if not self._wait(sent.done, time.monotonic() + ANSWER_WITHIN):
                raise LoopError(f"{self.name} has not answered within {ANSWER_WITHIN:g} s")
            answer = sent.result().get_result_async()
            while not self._wait(answer.done, time.monotonic() + ANSWER_WITHIN):
                if not self._verify.server_is_ready():
                    raise LoopError(f"{self.name} has gone during the verification")
            result = answer.result().result
            if answer.result().status == GoalStatus.STATUS_SUCCEEDED:
                return result
            if not result.reason.startswith(_NOT_AT_REST):
                raise LoopError(f"{self.name} has not verified the gains: {result.reason}")
            if time.monotonic() - begun > patience:
                raise LoopError(
                    f"the gains are in force, but not verified: {result.reason}; run this again "
                    f"with --verify-only"
                )
            tell(result.reason)
            self.rest(TOLD_EVERY)
