# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Whether a tune can start: the checks before it, and why one of them failed."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from relay_autotune.errors import NotReadyError, RelayAutotuneError
from relay_autotune.exchange.messages import fill_reason
from relay_autotune.experiment.faults import SafePolicy
from relay_autotune.experiment.parameters import PARAMETERS as EXPERIMENT_PARAMETERS
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import SMALL_CYCLES, how_long
from relay_autotune.experiment.relay_law import Levels, sought_swing
from relay_autotune.nodes.goals import refused
from relay_autotune.nodes.loop_ends import LoopSupervisor
from relay_autotune.nodes.parameters import merged, values_of
from relay_autotune.nodes.quality import described, who, why_unconnected
from relay_autotune.nodes.shell import prefix
from relay_autotune.nodes.tables import TUNE_PARAMETERS
from relay_autotune.nodes.watch import LastSamples, require_own_time
from relay_autotune.reasons import NONE, Code, Reason, reason_of
from relay_autotune.record.record import Cycle
from relay_autotune.text import duration
from relay_autotune_msgs.msg import Reason as ReasonMessage
from relay_autotune_msgs.srv import StartTune

_T = TypeVar("_T")

# Free space below which a recording is said to be at risk [bytes].
_LITTLE = 100_000_000
_NAME_WIDTH = 12


class Mark(Enum):
    """How a check ended: passed, passed with something to know, or a reason not to start."""

    OK = "ok"
    NOTE = "note"
    NO = "NO"


@dataclass(frozen=True)
class ChecklistLine:
    """One line of the checklist.

    :param mark: how it ended.
    :param name: what was looked at.
    :param found: what was found.
    :param why: the same for programs, where it failed or is to be known.
    """

    mark: Mark
    name: str
    found: str
    why: Reason = NONE

    def __str__(self) -> str:
        return f"{self.mark.value:<4}  {self.name:<{_NAME_WIDTH}}  {self.found}"


class Checklist:
    """Collect checks."""

    def __init__(self) -> None:
        self.checks: list[ChecklistLine] = []

    @property
    def refusals(self) -> list[Reason]:
        """Why each check that failed did so."""
        return [check.why for check in self.checks if check.mark is Mark.NO]

    def do(self, name: str, work: Callable[[], _T]) -> _T | None:
        """Make a check.

        :param name: what is looked at.
        :param work: returns what it finds, as people read it, or raises the reason not to start.
        :return: what was found; None: it failed.
        """
        try:
            value = work()
        except RelayAutotuneError as error:
            why = reason_of(error)
            self.checks.append(ChecklistLine(Mark.NO, name, str(why), why))
            return None
        self.checks.append(ChecklistLine(Mark.OK, name, str(value)))
        return value

    def tell(self, name: str, found: str | Reason, mark: Mark = Mark.OK) -> None:
        """Add a line that is no reason not to start.

        :param name: what was looked at.
        :param found: what was found; as a reason, it is to be known.
        :param mark: of a text.
        """
        why = found if isinstance(found, Reason) else NONE
        self.checks.append(ChecklistLine(Mark.NOTE if why else mark, name, str(found), why))


def answer_of(checks: Checklist, **facts: Any) -> StartTune.Response:
    """Return the answer to a dry run.

    :param checks: all that were made.
    :param facts: further fields; without them it is refused for the first check that failed.
    """
    answer = StartTune.Response(**facts) if facts else refused(checks.refusals[0])
    answer.checks = list(map(str, checks.checks))
    for check in checks.checks:
        answer.refusals.append(ReasonMessage())
        fill_reason(answer.refusals[-1], check.why)
    return answer


@dataclass(frozen=True)
class Ready:
    """What a tune will do.

    :param parameters: the experiment's parameters, valid.
    :param baseline: command of the operating point [u].
    :param policy: how the process will be left.
    :param from_small: True if a given amplitude is not put on at once.
    :param period: of the oscillation in the last tune [s]; NaN: not known.
    :param takes: how long it takes, for people.
    """

    parameters: ExperimentParameters
    baseline: float
    policy: SafePolicy
    from_small: bool
    period: float
    takes: str

    def __str__(self) -> str:
        """Return a sentence on the commands of the tune."""
        parameters, baseline = self.parameters, self.baseline
        levels = Levels(parameters, baseline)
        between = f"{levels.low:g} and {levels.high:g} u"
        plan = f"relay between {between} about the baseline {baseline:g}"
        if parameters.finds_amplitude:
            plan += (
                f" at first; these grow until the oscillation is clear of the noise, up to "
                f"{parameters.command_min:g} and {parameters.command_max:g} u"
            )
        elif self.from_small:
            small = Levels(parameters, baseline, from_small=True)
            plan += (
                f"; for the first cycle between {small.low:g} and {small.high:g} u: the swing has "
                f"to grow with the levels if the actuator goes as far; that takes about "
                f"{SMALL_CYCLES} oscillations"
            )
            if self.period > 0.0:
                plan += f", {duration(SMALL_CYCLES * self.period)} by the last tune"
        if self.policy.give_back:
            return f"{plan}, then back to controller_command"
        return f"{plan}, then proportional control holds the process" if self.policy.hold else plan


class Readiness:
    """Make the checks before a tune of relay_node.

    :param node: relay_node.
    :param loop: its loop.
    """

    def __init__(self, node: Node, loop: LoopSupervisor) -> None:
        self._node, self._loop, self._sensor = node, loop, loop.sensor
        self.last: tuple[float, Cycle] | None = None
        """Amplitude of the last tune [u], and its last cycle; None: there is none."""

    def of(self, amplitude: float, checks: Checklist) -> Ready | None:
        """Make the checks, and return what a tune would do; None where one of them failed.

        :param amplitude: half the distance of the two levels [u]; 0: the parameter.
        :param checks: get a line each.
        """
        values = values_of(self._node, TUNE_PARAMETERS)
        chosen = {entry.name: values[entry.name] for entry in EXPERIMENT_PARAMETERS}
        if amplitude != 0.0:
            chosen["amplitude"] = amplitude
        parameters = ExperimentParameters(**chosen)
        ready = checks.do("levels", partial(self._planned, values, parameters))
        checks.do("measurement", self._measured)
        checks.do("command", self._commanded)
        checks.do("alone", partial(self._alone, values["sample_period"]))
        checks.do("present", partial(_within, parameters, self._sensor.samples.newest))
        checks.tell("limits", _limits_of(parameters))
        checks.tell("at rest", _rest_of(self._sensor.samples))
        checks.tell("recording", _recording_in(values["record_directory"]))
        checks.tell("model", _identifier_of(self._node))
        checks.tell("expected", *_expected(parameters, self._sensor.samples, self.last))
        interval = self._sensor.samples.interval
        checks.tell("time", ready.takes if ready else how_long(parameters, interval))
        return None if checks.refusals else ready

    def _planned(self, values: Mapping[str, Any], parameters: ExperimentParameters) -> Ready:
        """Return what a tune would do; raise the reason where that is not possible."""
        moves_setpoint = self._loop.setpoint is not None
        if moves_setpoint:
            # First: the levels are found within the limits of the measurement.
            parameters, baseline = _on_setpoint(parameters)
        else:
            parameters.validate()
            baseline = self._baseline(values["baseline"])
        parameters.validate(baseline)
        policy = _policy_from(values, connected=self._loop.is_connected)
        # A feedback of the position, or the controller of a closed loop, also shows where the
        # actuator ends.
        shows_ends = moves_setpoint or self._node.count_publishers("command_feedback") > 0
        from_small = not (shows_ends or parameters.finds_amplitude)
        period = math.nan if self.last is None else self.last[1].period
        takes = how_long(parameters, self._sensor.samples.interval, from_small=from_small)
        return Ready(parameters, baseline, policy, from_small, period, takes)

    def _baseline(self, given: float) -> float:
        """Return the command of the operating point [u].

        :param given: the parameter ``baseline`` [u]; NaN: the mean of the present controller's
            commands, else the command that is held.
        :raises NotReadyError: if it is not known from any of them.
        """
        for known in (given, self._loop.mean_command()):
            if not math.isnan(known):
                return known
        if self._loop.held is None:
            raise NotReadyError(Code.NO_BASELINE())
        return self._loop.held

    def _measured(self) -> str:
        """Say who measures, and how; refuse a start without measurements, as the graph shows."""
        node, sensor, last = self._node, self._sensor, self._sensor.samples
        topic, rate = sensor.subscription.topic_name, "rate not known yet"
        if node.get_parameter("use_sim_time").value and node.get_clock().now().nanoseconds == 0:
            raise NotReadyError(Code.NO_CLOCK())
        if dead := sensor.why_dead():
            raise NotReadyError(dead)
        if (age := sensor.age) > sensor.timeout:
            why = why_unconnected(node, topic, sensor.reader.type_name, hears=True)
            raise NotReadyError(
                Code.NO_MEASUREMENT_YET(why=why)
                if math.isinf(age)
                else Code.NO_MEASUREMENT_NOW(silence=age, why=why)
            )
        if last.are_enough:
            rate = f"{1.0 / last.interval:.3g} per second"
        newest = "" if last.newest is None else f", newest {last.newest:.6g} y"
        sources = ", ".join(map(described, node.get_publishers_info_by_topic(topic)))
        return f"{topic} from {sources}, {rate}{newest}"

    def _commanded(self) -> str:
        """Say who takes the commands; refuse a start if nobody does, or they are not whole."""
        node, sent = self._node, self._loop.own
        topic, messages = sent.topic, sent.messages
        # In takeover one of the subscriptions is the node's own.
        own = sum(s.topic_name == topic for s in node.subscriptions)
        if sent.publisher.get_subscription_count() <= own:
            why = why_unconnected(node, topic, messages.type_name, hears=False)
            raise NotReadyError(Code.NO_SUBSCRIBER(why=why))
        if unknown := messages.why_unknown:
            raise NotReadyError(Code.OTHERS_NOT_THERE(why=unknown))
        there, mine = node.get_subscriptions_info_by_topic(topic), node.get_fully_qualified_name()
        takers = ", ".join(described(e) for e in there if who(e) != mine)
        return f"{messages.described} on {topic} to {takers}"

    def _alone(self, sample_period: float) -> str:
        require_own_time(sample_period, self._sensor.repeat_period, self._loop.repeat_period)
        self._loop.require_alone()
        return "no other node commands, measures, or has this name"


def _within(parameters: ExperimentParameters, newest: float | None) -> str:
    """Refuse a start whose first sample would end the tune.

    :param parameters: the experiment's parameters.
    :param newest: the newest measurement [y]; None: not known.
    :raises NotReadyError: with the limit to change.
    """
    low, high = parameters.measurement_min, parameters.measurement_max
    if newest is None or low <= newest <= high:
        return "the measurement is within its limits"
    limit, way = ("measurement_min", "lower") if newest < low else ("measurement_max", "higher")
    raise NotReadyError(Code.BEYOND_LIMITS(value=newest, low=low, high=high, way=way, limit=limit))


def _on_setpoint(parameters: ExperimentParameters) -> tuple[ExperimentParameters, float]:
    """Return the parameters of a relay on the set-point, and its baseline.

    The levels are set-points. So the limits of the measurement apply to them, and a higher level
    raises the measurement, because the loop is closed.

    :param parameters: the user's parameters; ``amplitude`` is in units of the measurement.
    :raises NotReadyError: if the set-point is not given.
    """
    if math.isnan(parameters.setpoint):
        raise NotReadyError(Code.NO_SETPOINT())
    changed = replace(
        parameters,
        command_min=parameters.measurement_min,
        command_max=parameters.measurement_max,
        process_gain_sign=1,
    )
    return changed, parameters.setpoint


def _policy_from(values: Mapping[str, Any], *, connected: bool) -> SafePolicy:
    """Return how the process is left at the end of a tune.

    :param values: the node's parameters.
    :param connected: True if commands of a present controller arrive.
    :raises NotReadyError: if the process would drift or run away, and nothing could hold it.
    """
    safe = values["safe_command"]
    kind, gain = values["process_type"], values["hold_gain"]
    if kind == "self_regulating":
        return SafePolicy(command=safe)
    if connected:
        return SafePolicy(command=safe, give_back=True)
    if gain == 0.0 and not values["start_without_hold"]:
        drift = "drift away" if kind == "integrating" else "run away"
        raise NotReadyError(Code.NO_HOLD(kind=kind, drift=drift))
    return SafePolicy(command=safe, hold=True, gain=gain)


def require_settable(node: Node, changes: Sequence[RosParameter], running: str) -> None:
    """Refuse a change of parameters that is not possible now, or values that cannot be.

    :param node: relay_node.
    :param changes: the changes about to be made; none: the present values are looked at.
    :param running: id of the running tune; empty: no tune runs.
    :raises RelayAutotuneError: with the reason.
    """
    names = {entry.name for entry in TUNE_PARAMETERS}
    if running and any(change.name in names for change in changes):
        raise NotReadyError(Code.FIXED_NOW(tune=running, node=node.get_fully_qualified_name()))
    values = merged(node, TUNE_PARAMETERS, changes)
    experiment = {entry.name: values[entry.name] for entry in EXPERIMENT_PARAMETERS}
    parameters = ExperimentParameters(**experiment)
    if parameters.amplitude > 0.0:
        parameters.validate()
    else:
        # A start request may still give the amplitude; then all is checked at the start.
        parameters.validate_but_amplitude()
    low, high = parameters.command_min, parameters.command_max
    # The latter is sent between tunes, too, where a controller_node in front of the relay ends.
    for name in ("baseline", "safe_command"):
        if not math.isnan(value := values[name]) and not low <= value <= high:
            raise NotReadyError(Code.UNSAFE_COMMAND(name=name, value=value, low=low, high=high))


def _rest_of(samples: LastSamples) -> str | Reason:
    """Say whether the measurement is at rest.

    :param samples: the last measurements.
    """
    rest = samples.rest()
    if rest is None:
        return Code.REST_UNKNOWN()
    if not rest.is_steady:
        return Code.STILL_MOVING(motion=rest.motion, span=rest.span)
    span = duration(rest.span)
    if not rest.noise_std:
        return f"{rest.mean:.6g} y for {span}; the noise is below the sensor's resolution"
    return f"{rest.mean:.6g} y with noise of {rest.noise_std:.2g} y over {span}"


def _limits_of(parameters: ExperimentParameters) -> str | Reason:
    """Say which limits of the measurement are missing.

    :param parameters: the experiment's parameters.
    """
    low, high = parameters.measurement_min, parameters.measurement_max
    ends = {"measurement_min": low, "measurement_max": high}
    missing = [name for name, value in ends.items() if math.isinf(value)]
    if not missing:
        return f"a tune ends where the measurement leaves {low:g} to {high:g} y"
    if (most := parameters.max_deviation) > 0.0:
        return f"a tune ends where the measurement is {most:g} y from its rest"
    return Code.NO_LIMITS(missing=" and ".join(missing), limit=missing[0])


def _recording_in(directory: str) -> str | Reason:
    """Say whether a recording can be written.

    :param directory: folder of the recordings.
    """
    folder = Path(directory).expanduser()
    there = next(path for path in (folder, *folder.parents) if os.access(path, os.F_OK))
    if not (there.is_dir() and os.access(there, os.W_OK)):
        return Code.NO_FOLDER(folder=str(there))
    free = shutil.disk_usage(there).free
    room = Code.LITTLE_SPACE(folder=str(folder), free=free / 1e9)
    return str(room) if free > _LITTLE else room


def _identifier_of(node: Node) -> str | Reason:
    """Say whether model and gains will come.

    :param node: the node that tunes.
    """
    topic = node.resolve_topic_name("pi_gains")
    if found := ", ".join(who(end) for end in node.get_publishers_info_by_topic(topic)):
        return f"from {found}"
    there = node.get_namespace()
    named = "" if there == "/" else f" --ros-args -r __ns:={there}"
    return Code.NO_IDENTIFIER(where=named, run=prefix())


def _expected(
    parameters: ExperimentParameters, samples: LastSamples, last: tuple[float, Cycle] | None
) -> tuple[str, Mark]:
    """Say how far the measurement will swing: by the last tune, else as far as the levels grow.

    A swing that reaches a limit is a note: the tune would end there.

    :param parameters: the experiment's parameters.
    :param samples: the last measurements.
    :param last: amplitude of the last tune [u], and its last cycle; None: there is none.
    """
    rest = samples.rest()
    low, high = parameters.measurement_min, parameters.measurement_max
    limits = [f"{limit:g}" for limit in (low, high) if math.isfinite(limit)]
    ends = f"; the tune ends at {' and '.join(limits)} y" if limits else ""
    if last is not None:
        amplitude, cycle = last
        ratio = parameters.amplitude / amplitude if parameters.amplitude else 1.0
        swing, ends = cycle.amplitude * ratio, ""
        text = f"a swing of about {swing:.2g} y each way in {duration(cycle.period)}, as last time"
        if rest is None or parameters.finds_amplitude:
            return text, Mark.OK
        mend = "give wider limits, or a smaller amplitude"
    elif rest is None or not parameters.finds_amplitude:
        text = f"how far the measurement swings is not known before the first tune{ends}"
        return text, Mark.OK
    else:
        seen, noise = np.array(samples.before()), rest.noise_std
        setpoint = rest.mean if math.isnan(parameters.setpoint) else parameters.setpoint
        swing = sought_swing(parameters, noise, setpoint, seen)
        text = f"a swing of at least {swing:.2g} y each way, where the levels stop growing"
        mend = "give wider limits"
    beyond = [f"{end:g}" for end in (low, high) if abs(end - rest.mean) <= swing]
    if beyond:
        return f"{text}; it would end the tune at {' or '.join(beyond)} y: {mend}", Mark.NOTE
    return text + ends, Mark.OK
