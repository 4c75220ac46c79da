# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a rule may ask of its task, and the sentences with which it refuses."""

from __future__ import annotations

from dataclasses import dataclass

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint, ultimate_point
from relay_autotune.tuning.task import DesignTask


@dataclass(frozen=True)
class Fopdt:
    """A stable process ``K exp(-D s)/(tau s + 1)`` for which a rule is made.

    :param gain: K [y/u].
    :param time_constant: tau [s].
    :param dead_time: D, with what the loop adds to it [s].
    :param note: what the reason must say of it; empty where it is the model itself.
    """

    gain: float
    time_constant: float
    dead_time: float
    note: str = ""

    @property
    def ratio(self) -> float:
        """D/tau."""
        return self.dead_time / self.time_constant


def process_of(task: DesignTask) -> TransferFunction:
    """Return the process as the controller meets it, with the delay that the loop adds."""
    return task.in_loop(task.model)


def named(model: TransferFunction) -> str:
    """Return in words what a model is, for a refusal."""
    if model.structure != "general":
        return model.structure
    kind = "an integrating" if model.integrators > 0 else "a stable"
    if model.grows:
        kind = "an unstable"
    return f"{kind} process of order {model.order} with {len(model.zeros)} zeros"


def is_first_order(model: TransferFunction) -> bool:
    """Return whether a model is one stable lag with or without dead time."""
    lags = model.time_constants
    return model.integrators == 0 and not model.zeros and len(lags) == 1 and lags[0].real > 0.0


def fopdt_of(rule: str, task: DesignTask) -> Fopdt:
    """Return the FOPDT process on which a rule designs: the model, or else the simple one.

    :param rule: name of the rule.
    :raises TuningError: if the model is no stable FOPDT and none that stands for it is known. For
        a process that integrates none does: its time constant would be that of the record.
    """
    delay = task.options.added_delay
    model, note = task.model, ""
    if not is_first_order(model):
        if model.grows:
            raise TuningError(
                f"the rule {rule} is for a stable FOPDT process, found {named(model)}, which is "
                "unstable: use robust or unstable"
            )
        if model.integrators or task.simple is None or not is_first_order(task.simple):
            raise TuningError(
                f"the rule {rule} is for a stable FOPDT process, found {named(model)}: use a "
                "rule for that structure, or robust"
            )
        model = task.simple
        tau = model.time_constants[0].real
        note = (
            f"; designed on the FOPDT {model.gain:.4g} e^(-{model.dead_time:.4g} s)/({tau:.4g} s "
            "+ 1), judged on the model"
        )
    return Fopdt(model.gain, model.time_constants[0].real, model.dead_time + delay, note)


def own_point(rule: str, task: DesignTask) -> UltimatePoint:
    """Return the ultimate point of the model itself.

    :param rule: name of the rule.
    :raises TuningError: if it has none, or is unstable.
    """
    model = process_of(task)
    if model.grows:
        raise TuningError(
            f"the rule {rule} is for processes that are stable or integrate, found "
            f"{named(model)}, which is unstable: use robust or unstable"
        )
    point = ultimate_point(model)
    if point is None:
        raise TuningError(
            f"the rule {rule} needs an ultimate point and the model has none (no gain makes it "
            "oscillate): use imc or robust"
        )
    return point


def describing_point(rule: str, task: DesignTask) -> UltimatePoint:
    """Return what the describing function reads from the limit cycle of the relay.

    :param rule: name of the rule.
    :raises TuningError: if no limit cycle is known, or the process is unstable.
    """
    own_point(rule, task)
    if task.describing is None:
        raise TuningError(
            f"the rule {rule} needs the limit cycle of an unbiased relay and none is known: use "
            f"{rule.removesuffix('_cycle')}, which takes the model's own ultimate point"
        )
    return task.describing


def wants_pid(rule: str, task: DesignTask, *, pi: bool = True, pid: bool = True) -> bool:
    """Return whether the rule's PID is asked for rather than its PI.

    :param rule: name of the rule.
    :param pi: whether the rule gives PI gains, which are the default.
    :param pid: whether it gives PID gains.
    :raises TuningError: if what is asked for is not what it gives.
    """
    asked = task.options.controller
    if asked == "pid" and not pid:
        raise TuningError(f"the rule {rule} gives no PID gains: ask for pi, or use another rule")
    if asked == "pi" and not pi:
        raise TuningError(f"the rule {rule} gives PID gains only: ask for pid, or use another")
    return asked == "pid" or not pi


def controller(
    task: DesignTask, kc: float, ti: float, td: float = 0.0, b: float = 1.0
) -> Controller:
    """Return a controller with the filter that derivative action needs, ``tf = td/filter_ratio``.

    :param kc: proportional gain [u/y].
    :param ti: integral time [s].
    :param td: derivative time [s].
    :param b: weight of the set-point.
    """
    return Controller(kc, ti, td, td / task.options.filter_ratio, b)
