# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Controllers with a model inside: compensation of dead time and of higher order.

Thyagarajan and Yu, "Improved Autotuning Using the Shape Factor from Relay Feedback", Ind. Eng.
Chem. Res. 2003, section 4.3, with internal model control (Morari and Zafiriou 1989). From error
to command the controller is ``Q/(1 - Q G)`` with ``Q = F/G_-``, F the filter and G_- the model
without its dead time:

    eq 50:  1/K (tau s + 1)/(lambda s + 1 - e^{-D s}),                    lambda = 2 tau;
    eq 54:  1/(n K lambda s) (tau s + 1)^n/(...) = (tau s + 1)^n/(K [(lambda s + 1)^n - 1]),
            lambda = 0.45 tau,

the latter here for any n, and with the model's dead time. On a perfect model the set-point
response is that of the filter, whatever lambda. The model limits them: as D/lambda grows, the Ms
of eq 50 grows towards 2 and its delay margin falls to about 1.5 lambda. So if the dead time is
known to 10 %, lambda must not be only a few percent of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import InternalModelLaw
from relay_autotune.process.structures import LAG_N
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.rules.formulas import fopdt_of, named
from relay_autotune.tuning.task import DesignTask

DEAD_TIME_LAMBDA = 2.0
HIGH_ORDER_LAMBDA = 0.45


@dataclass(frozen=True)
class Compensator:
    """A controller with a model inside.

    :param name: what it is called.
    :param model: the model inside.
    :param closed_loop_time: lambda [s].
    :param reason: what it is, and where lambda comes from.
    """

    name: str
    model: TransferFunction
    closed_loop_time: float
    reason: str

    @property
    def law(self) -> InternalModelLaw:
        """The controller, to be analysed."""
        lags = self.model.time_constants
        fast = (complex(self.closed_loop_time),) * len(lags)
        q = TransferFunction(1.0 / self.model.gain, lags, fast)
        return InternalModelLaw(q, TransferFunction(1.0, (), fast, 0, self.model.dead_time))


def dead_time_compensator(task: DesignTask) -> Compensator:
    """Return the controller that compensates the dead time of a FOPDT process (eq 50).

    :param task: a stable FOPDT process; its ``closed_loop_time`` is lambda.
    :raises TuningError: for any other.
    """
    process = fopdt_of("dead_time_compensator", task)
    closed, why = _lambda(task, DEAD_TIME_LAMBDA * process.lag, "2 tau (eq 51)")
    model = TransferFunction.fopdt(process.gain, process.lag, process.delay)
    reason = f"dead-time compensator (eq 50) with lambda = {why}{process.note}"
    return Compensator("dead_time_compensator", model, closed, reason)


def high_order_compensator(task: DesignTask) -> Compensator:
    """Return the controller that compensates n equal lags (eq 54, any n).

    :param task: a process of two or more equal lags; its ``closed_loop_time`` is lambda.
    :raises TuningError: for any other.
    """
    model = task.process
    if not LAG_N.holds(model):
        raise TuningError(
            "the high_order_compensator is for two or more equal lags, found "
            f"{named(task.model)}: use dead_time_compensator, or gains of a rule"
        )
    closed, why = _lambda(task, HIGH_ORDER_LAMBDA * model.time_constants[0].real, "0.45 tau")
    reason = f"higher-order IMC (eq 54) for {model.order} equal lags with lambda = {why}"
    return Compensator("high_order_compensator", model, closed, reason)


COMPENSATORS: dict[str, Callable[[DesignTask], Compensator]] = {
    "dead_time_compensator": dead_time_compensator,
    "high_order_compensator": high_order_compensator,
}


def _lambda(task: DesignTask, default: float, why: str) -> tuple[float, str]:
    closed, given = task.options.closed_loop(default)
    return closed, f"{closed:.4g} s{given}" if given else f"{why} = {closed:.4g} s"
