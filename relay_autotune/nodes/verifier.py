"""The action ~/verify of controller_node: steps, what came of them, pass or fail."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.action import ActionServer, CancelResponse
from rclpy.node import Node

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.messages import float64_array, set_stamp
from relay_autotune.models import TransferFunction
from relay_autotune.nodes.goals import conclude
from relay_autotune.tuning.gains import Controller
from relay_autotune.tuning.sampled import Limits
from relay_autotune.verification import Plan, Step, compare, plan
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import Verification

# Samples before a step that tell where the loop was, and how noisy it is.
_BEFORE = 50
_LEAST_BEFORE = 10


class NotVerifiable(RelayAutotuneError):  # noqa: N818  it is a state of the loop, not a defect
    """A loop that cannot be verified now."""


class Verifier:
    """Make steps on a running loop and compare each with the prediction.

    :param node: the node.
    :param ready: returns gains, model, limits and the way a request may go; raises
        RelayAutotuneError with the reason where there is none.
    :param ended: called with True if all steps passed, and a sentence.
    """

    def __init__(
        self,
        node: Node,
        ready: Callable[[], tuple[Controller, TransferFunction, Limits]],
        heights: Callable[[Any], list[Step]],
        ended: Callable[[bool, str], str],
    ) -> None:
        self._node = node
        self._ready = ready
        self._heights = heights
        self._ended = ended
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=_BEFORE)
        self._goal: Any = None
        self._steps: list[Step] = []
        self._plans: list[Plan] = []
        self._found: list[Any] = []
        self._number = 0
        self._pausing = False
        self._samples: list[tuple[float, float, float]] = []
        self._rest = self._noise = self._centre = 0.0
        self._begun = 0.0
        self.offset = 0.0
        """Added to the set-point now [y]."""
        self.load = 0.0
        """Added to the command now [u]."""
        self._server = ActionServer(
            node,
            Verify,
            "~/verify",
            self._unused,
            handle_accepted_callback=self._accept,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    @property
    def is_running(self) -> bool:
        """True while steps are made."""
        return self._goal is not None

    # Beginning.

    def _accept(self, goal: Any) -> None:
        try:
            if self._goal is not None:
                raise NotVerifiable("a verification is running")
            self._gains, self._model, self._limits = self._ready()
            self._steps = self._heights(goal.request)
            self._look_at_rest()
            self._plans = [
                plan(self._gains, self._model, step, self._period, self._noise)
                for step in self._steps
            ]
        except RelayAutotuneError as error:
            conclude(goal, Verify.Result(passed=False, reason=str(error)), succeeded=False)
            return
        self._goal, self._found, self._number = goal, [], 0
        self._begun = self._recent[-1][0]
        self._begin_step()

    def _look_at_rest(self) -> None:
        if len(self._recent) < _LEAST_BEFORE:
            raise NotVerifiable(
                f"only {len(self._recent)} samples have come, expected {_LEAST_BEFORE}"
            )
        time, y, u = (np.array(column) for column in zip(*self._recent, strict=True))
        self._period = float(np.median(np.diff(time)))
        self._rest, self._centre = float(y.mean()), float(u.mean())
        line = np.polyfit(time - time[0], y, 1)
        self._noise = float(np.std(y - np.polyval(line, time - time[0]), ddof=2))
        drift = abs(float(line[0])) * float(time[-1] - time[0])
        smallest = min((abs(s.setpoint) for s in self._steps if s.setpoint), default=math.inf)
        if drift > 4.0 * self._noise and drift > 0.1 * smallest:
            raise NotVerifiable(
                f"the loop is not at rest: the measurement moved by {drift:.3g} over the last "
                f"{len(self._recent)} samples; wait until it has settled"
            )

    def _begin_step(self) -> None:
        step = self._steps[self._number]
        self._samples = []
        self._pausing = False
        self.offset, self.load = step.setpoint, step.load

    # While it runs.

    def sample(self, time: float, measurement: float, command: float) -> None:
        """Take a sample of the loop, after it was answered.

        :param time: s.
        :param measurement: y.
        :param command: the controller's answer, without the load [u].
        """
        self._recent.append((time, measurement, command))
        goal = self._goal
        if goal is None:
            return
        if goal.is_cancel_requested:
            self._end(False, "cancelled", revert=False)
            return
        self._samples.append((time, measurement, command))
        wanted = self._plans[self._number]
        elapsed = time - self._samples[0][0]
        if abs(measurement - self._rest) > wanted.runaway and not self._pausing:
            self._end(
                False,
                f"the measurement went {abs(measurement - self._rest):.3g} away from where it "
                f"was, more than {wanted.runaway:.3g}: three times what was predicted",
            )
        elif elapsed >= wanted.duration:
            self._after_step(time)

    def interrupt(self, reason: str) -> None:
        """End it without a verdict [the loop is no longer the controller's]."""
        if self._goal is not None:
            self._end(False, reason, revert=False)

    def _after_step(self, time: float) -> None:
        if not self._pausing:
            message = self._compared()
            self._found.append(message)
            if not message.passed:
                self._end(False, message.reason)
                return
            if self._number + 1 == len(self._steps):
                self._end(True, "; ".join(m.reason for m in self._found))
                return
            # Back to where it was, before the next one.
            self.offset = self.load = 0.0
            self._pausing = True
            self._samples = []
            return
        self._number += 1
        self._rest = float(np.mean([y for _, y, _ in self._samples[-_BEFORE:]]))
        self._centre = float(np.mean([u for _, _, u in self._samples[-_BEFORE:]]))
        self._tell(time)
        self._begin_step()

    def _tell(self, time: float) -> None:
        elapsed = time - self._begun
        whole = 2.0 * sum(p.duration for p in self._plans)
        self._goal.publish_feedback(
            Verify.Feedback(
                step=self._number + 1, elapsed=elapsed, remaining=max(whole - elapsed, 0.0)
            )
        )

    def _compared(self) -> Any:
        step = self._steps[self._number]
        time, y, u = (np.array(column) for column in zip(*self._samples, strict=True))
        found = compare(
            self._gains,
            self._model,
            step,
            time - time[0],
            y - self._rest,
            limits=Limits(self._limits.low - self._centre, self._limits.high - self._centre),
            noise_std=self._noise,
        )
        message = Verification(
            kind=Verification.SETPOINT if step.setpoint else Verification.LOAD,
            step=step.setpoint or step.load,
            passed=found.passed,
            reason=found.reason,
            overshoot=found.measured.overshoot,
            overshoot_predicted=found.expected.overshoot,
            settling_time=found.measured.settling_time,
            settling_time_predicted=found.expected.settling_time,
            iae=found.measured.iae,
            iae_predicted=found.expected.iae,
            fit=found.fit,
            gain_ratio=found.gain_ratio,
            ms=found.ms,
            ms_predicted=found.ms_predicted,
            time=float64_array(time - time[0]),
            measurement=float64_array(y),
            command=float64_array(u),
            predicted=float64_array(self._rest + found.predicted),
        )
        set_stamp(message.header.stamp, round(float(time[0]) * 1e9))
        return message

    # Ending.

    def _end(self, passed: bool, reason: str, *, revert: bool = True) -> None:
        goal, self._goal = self._goal, None
        self.offset = self.load = 0.0
        if passed or revert:
            reason = self._ended(passed, reason)
        result = Verify.Result(passed=passed, reason=reason, steps=self._found)
        conclude(goal, result, succeeded=True)

    def _unused(self, goal: Any) -> Any:
        goal.abort()
        return Verify.Result()
