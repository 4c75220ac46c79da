# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""controller_node: a PI or PID controller that takes new gains on request.

controller_node --gains FILE starts it with the parameters and topics that tune_loop has written.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Awaitable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from std_msgs.msg import Bool, Float64
from std_srvs.srv import SetBool, Trigger

from relay_autotune.control.controller import PredictedLoop, Step, is_usable, running
from relay_autotune.control.gains_history import GainSet
from relay_autotune.errors import (
    FieldError,
    NotReadyError,
    ParameterError,
    RelayAutotuneError,
    TuningError,
    system_says,
)
from relay_autotune.exchange.export import TOPICS
from relay_autotune.exchange.messages import why_doubtful
from relay_autotune.loop.analysis import is_stable
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.nodes import quality, tables
from relay_autotune.nodes.gains_keeper import GainsJournal, GainsKeeper
from relay_autotune.nodes.gains_place import (
    OwnGains,
    Place,
    RemoteController,
    controller_text,
    setpoint_message,
)
from relay_autotune.nodes.goals import serve
from relay_autotune.nodes.lifetime import STEADY, run
from relay_autotune.nodes.live_types import CommandMessage, command_reader, reader_of
from relay_autotune.nodes.loop_ends import CommandPublisher
from relay_autotune.nodes.parameters import ask_before_changes, declare, merged, values_of
from relay_autotune.nodes.results import ResultCheck
from relay_autotune.nodes.verifier import Predictors, ProvenNode, Verifiable, Verifier
from relay_autotune.nodes.watch import Sensor, require_own_time
from relay_autotune.reasons import Code, Reason
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, RelayExperiment
from relay_autotune_msgs.msg import TransferFunction as ModelMessage

FLAG = "--gains"


def with_gains_file(words: Sequence[str]) -> list[str]:
    """Return a command line with --gains FILE as ROS takes it.

    :param words: the arguments of controller_node.
    :raises ParameterError: if there is no file, or it cannot be read.
    """
    found = list(words)
    if FLAG not in found:
        return found
    at = found.index(FLAG)
    file = next(iter(found[at + 1 :]), "--")
    if file.startswith("--"):
        raise ParameterError(
            f"{FLAG} has no file; expected one that tune_loop has written for a controller_node"
        )
    topics = [word for name, topic in _topics(file).items() for word in ("-r", f"{name}:={topic}")]
    # Of parameters the last ones count, of names the first ones: what is typed beside the file.
    rest = [*found[:at], *found[at + 2 :]]
    return ["--ros-args", "--params-file", file, "--", *rest, "--ros-args", *topics]


def _topics(file: str) -> dict[str, str]:
    """Return the names of the topics that a file of gains gives."""
    try:
        read = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
        sections = {name: section["ros__parameters"] for name, section in read.items()}
        own = any("kc" in values for values in sections.values())
        topics = sections.get(TOPICS, {}).items()
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f"{FLAG} {file}: it cannot be read ({system_says(error)})") from None
    except (yaml.YAMLError, AttributeError, KeyError, TypeError):
        own = False
    if not own:
        raise ParameterError(
            f"{FLAG} {file}: it has no kc of a controller_node; expected a file that tune_loop "
            f"has written for one, or --export controller_node"
        )
    return {str(name): str(topic) for name, topic in topics}


NAMES_OF_GAINS = frozenset(entry.name for entry in tables.GAINS)
# Interval of the looks at a proof, and for a sensor that only offers best effort [s].
_LOOK_EVERY = 0.2
# How long the end of the process may wait for another node to restore its gains [s].
END_WITHIN = 5.0


class ControllerNode(ProvenNode):
    """Answer each measurement with a command.

    New gains wait until they are applied, and the previous gains are kept for ``~/revert``. While
    a tune runs (``hold_request``), the controller tracks ``command``, for a bumpless return.
    """

    def __init__(self) -> None:
        super().__init__("controller_node")
        declare(self, (*tables.GAINS, *tables.OTHERS))
        declare(self, tables.FIXED, read_only=True)
        values = values_of(self, tables.CONTROLLER_PARAMETERS)
        require_own_time(values["sample_period"], values["repeat_period"])
        self._rate = tables.rate_from(values)
        self._settings = tables.settings_from(values, self._rate)
        gains = self._settings.gains
        self._results = ResultCheck(self, lambda c, m: is_stable(self._place.control(c).law, m))
        # The newest gains, with the id of their experiment; after a revert they may be applied
        # again.
        self._newest: tuple[str, Gains] | None = None
        # Why those that came since were refused; empty: none were.
        self._refused = ""
        # Why the newest gains are doubtful; empty: they are trusted.
        self._doubt = ""
        # The last that were applied or tried, which auto_apply leaves.
        self._tried: tuple[str, Gains] | None = None
        self._predictors = Predictors(self._results.models)
        self._pid = running(
            self._rate,
            gains,
            values["initial_command"],
            limits=self._settings.limits,
            automatic=not values["manual"],
            usual_interval=values["repeat_period"],
        )
        self._setpoint: float = values["initial_setpoint"]
        if not (math.isnan(self._setpoint) or self._is_possible(self._setpoint)):
            raise ParameterError(f"initial_setpoint is {self._setpoint:g}, beyond {self._range}")
        self._period: float = values["sample_period"]
        self._simulated = bool(self.get_parameter("use_sim_time").value)
        self._count = 0
        self._ending = False
        self._held = False
        # True while nobody subscribes to the commands.
        self._untaken = True
        # False once a sensor that is silent at times has gone.
        self._alive = True
        # Steps that a verification adds to set-point and command.
        self._offset = self._load = 0.0
        # True while this node writes its gains into its own parameters.
        self._following = False
        self._verifier = Verifier(self)
        self._remote: RemoteController | None = None
        setpoints, self._reported = setpoint_message(values), command_reader(values)
        if values["apply_to"]:
            self._remote = RemoteController(self, values, setpoints, self._verifier.disturb)
        self._place: Place = self._remote or OwnGains(self._use, self._rate)
        reader = reader_of(values["measurement_type"], values["measurement_field"])
        self._value, self._stamp = reader.value, reader.stamp_ns
        self._commands = CommandPublisher(self, CommandMessage(), "controller_command")
        self._sensor = Sensor(self, reader, self._on_measurement, self._on_silence)
        measurement = self._sensor.subscription
        self.create_timer(_LOOK_EVERY, self._look, clock=STEADY)
        if self._remote is None:
            self.create_subscription(Float64, "setpoint", self._on_setpoint, quality.COMMAND)
        if self._reported is None:
            self.create_subscription(
                Float64, "command", lambda m: self._hear(m.data), quality.COMMAND
            )
        for kind, topic, take in (
            (Bool, "hold_request", self._on_hold),
            (RelayExperiment, "relay_experiment", self._on_experiment),
            (PidGains, "pi_gains", self._on_gains),
            (ModelMessage, "transfer_function", self._on_model),
        ):
            self.create_subscription(kind, topic, take, quality.RESULT)
        # The loop must keep running while these services wait for the disk or another node.
        waiting = {"callback_group": ReentrantCallbackGroup()}
        serve(self, Trigger, "~/apply", lambda _: self._logged(self._apply()), **waiting)
        serve(self, Trigger, "~/discard", self._discard)
        serve(self, Trigger, "~/before", lambda _: self.keeper.before())
        serve(self, Trigger, "~/revert", lambda _: self._logged(self.keeper.revert()), **waiting)
        serve(self, SetBool, "~/automatic", self._switch)
        ask_before_changes(self, self._require_settable)
        self.add_post_set_parameters_callback(self._after_set)
        rate = self._rate
        under = "" if rate is None else f"{rate.law.name} {rate.period:g} s"
        journal = GainsJournal(
            Path(values["record_directory"]).expanduser(),
            self.get_fully_qualified_name(),
            self.context.get_domain_id(),
            # The same numbers are other gains under another law.
            " ".join(filter(None, (measurement.topic_name, values["apply_to"], under))),
            "" if values["apply_to"] else self._commands.topic,
        )
        given = self._own(gains) if self._remote is None else None
        self.keeper = GainsKeeper(self, self._place, journal, given, self._require_bounds)
        if self._remote is None and self.keeper.history.gains != given:
            self._use(self.keeper.history.gains)
            self.get_logger().warning(
                f"starts with {controller_text(self._pid.gains)}, not with the parameters' "
                f"{controller_text(gains)}, for what was proven or failed before: see "
                f"{journal.path}"
            )
        self.get_logger().info(
            f"ready: {controller_text(self._pid.gains)}, "
            f"{'automatic' if self._pid.is_automatic else 'holding its command'}; "
            f"commands go to {self._commands.topic}, held until somebody subscribes to it; "
            f"measurements come on {self.resolve_topic_name('measurement')}, "
            f"set-points on {self.resolve_topic_name('setpoint')}"
        )

    def _look(self) -> None:
        self._sensor.look()
        self._verifier.look()
        if self._verifier.is_running and (why := self._second_commander()):
            self._verifier.interrupt(why)

    # The loop.

    def _on_measurement(self, message: Any, info: dict[str, Any]) -> None:
        try:
            value = self._value(message)
        except FieldError as error:
            self.get_logger().error(
                f"the measurement cannot be read: {error}: the command is held",
                throttle_duration_sec=5.0,
            )
            value = math.nan
        if (hear := self._sensor.hear) is not None:
            hear(value)
            self._is_alive(None)
        if self._period > 0.0:
            at = self._count * self._period
            self._count += 1
        elif self._simulated or hear is not None:
            # A repeated value has no stamp of its own.
            at = self.get_clock().now().nanoseconds * 1e-9
        elif self._stamp is not None:
            at = self._stamp(message) * 1e-9
        else:
            at = (info["source_timestamp"] or time.time_ns()) * 1e-9
        self._take(at, value)
        if self._reported is not None and self._remote is not None:
            # It answers this measurement; the one before was in force until now.
            try:
                self._hear(self._reported(message))
            except FieldError as error:
                self.get_logger().error(
                    f"the command of {self._place.name} cannot be read: {error}",
                    throttle_duration_sec=5.0,
                )

    def _on_silence(self, value: float, ago: float) -> None:
        """Take the last measurement again: a silent sensor means that it has not changed."""
        # A dead sensor must not be repeated: the integral would run away on an old value.
        if self._is_alive(self._sensor.why_dead()):
            self._take(self.get_clock().now().nanoseconds * 1e-9 - ago, value)

    def _is_alive(self, why_dead: Reason | None) -> bool:
        """Tell whether a sensor that is silent at times is alive, and log where that changes."""
        alive = why_dead is None
        if alive is not self._alive:
            self._alive = alive
            if alive:
                self.get_logger().info("the sensor is back")
            else:
                self.get_logger().warning(f"{why_dead}: the command is held")
        return alive

    def _take(self, at: float, value: float) -> None:
        if self._ending:
            return
        if math.isfinite(value) and not self._is_possible(value):
            self._verifier.out_of_range(value)
            self.get_logger().warning(
                f"the measurement is {value:g}, outside of its range, {self._range}: the sensor "
                f"is taken for faulty, and the command held until it is back or these are wider",
                throttle_duration_sec=5.0,
            )
            value = math.nan
        if math.isnan(self._setpoint) and math.isfinite(value):
            self._setpoint = value
        if self._remote is not None:
            command = self._remote.command
        else:
            if self._is_untaken():
                # An integral that went on would be a jump for whoever takes the commands later.
                self._pid.track(self._pid.command)
            command = self._pid.step(at, self._setpoint + self._offset, value)
            self._commands.send(self._settings.limits.clip(command + self._load))
        if math.isfinite(value) and math.isfinite(command):
            self._verifier.sample(at, value, command)

    def _second_commander(self) -> Reason | None:
        """Return a reason if a node commands that neither controls the loop nor is relay_node."""

        def publishers(topic: str) -> list[str]:
            return [quality.who(end) for end in self.get_publishers_info_by_topic(topic)]

        topics = {self.resolve_topic_name("command")} if self._reported is None else set()
        if self._remote is None:
            own = self.get_fully_qualified_name()
            topics.add(self._commands.topic)
        else:
            own = self.resolve_topic_name(self._remote.name.rstrip("/"))
        known = {own, quality.UNNAMED, *publishers(self.resolve_topic_name("hold_request"))}
        for topic in topics:
            names = publishers(topic)
            if len(names) > 1 and (others := sorted({*names} - known)):
                return Code.SECOND_PUBLISHER(topic=topic, others=" and ".join(others))
        return None

    def _is_untaken(self) -> bool:
        """Tell whether nobody subscribes to the commands, and log where that has changed."""
        untaken = self._commands.publisher.get_subscription_count() == 0
        if untaken is not self._untaken:
            self._untaken = untaken
            topic, held = self._commands.topic, self._pid.command
            if untaken:
                self._verifier.interrupt(Code.NOBODY_SUBSCRIBES(topic=topic, since="any more"))
                self.get_logger().warning(
                    f"nobody subscribes to {topic}: the command is held at {held:g} until "
                    f"somebody does"
                )
            else:
                self.get_logger().info(f"{topic} has a subscriber: it begins from {held:g}")
        return untaken

    @property
    def _range(self) -> str:
        within = self._settings.within
        return f"measurement_min {within.low:g} to measurement_max {within.high:g}"

    def _is_possible(self, value: float) -> bool:
        within = self._settings.within
        return is_usable(value) and within.low <= value <= within.high

    def _on_setpoint(self, message: Float64) -> None:
        value = message.data
        if not self._is_possible(value):
            self.get_logger().error(
                f"the set-point {value:g} is outside of the measurement's range, {self._range}, "
                f"so that {self._setpoint:g} stays"
            )
            return
        if value != self._setpoint:
            self._verifier.disturb(f"the set-point was changed to {value:g} by another node")
        self._setpoint = value

    def _hear(self, command: float) -> None:
        """Take a command on its way to the actuator [u], of whoever commands it."""
        if not is_usable(command):
            return
        if not self._held:
            self._verifier.hear_command()
        if self._remote is not None:
            self._remote.command = command
        elif self._held or self._untaken:
            self._pid.track(command)

    def why_silent(self, silence: float) -> Reason:
        """Return what it means that no command has come for a time [s]."""
        if self._remote is not None:
            return Code.SILENT_OWNER(node=self._place.name, silence=silence)
        topic = self.resolve_topic_name("command")
        why = f"no command on {topic} for {silence:.3g} s: what passes them on has stopped"
        return Code.INTERFERED(sentence=why)

    def _on_hold(self, message: Bool) -> None:
        if message.data is self._held:
            return
        self._held, why = message.data, "a tune has begun"
        if self._held:
            self._verifier.commands.forget()
            self._verifier.disturb(why)
        self.get_logger().info(why if self._held else "the tune has ended")

    def _switch(self, request: SetBool.Request) -> str:
        if not request.data:
            self._verifier.disturb("the controller was switched to manual")
        before = self._pid.is_automatic
        self._pid.switch(automatic=request.data)
        if self._pid.is_automatic != request.data:
            raise TuningError("there are no gains yet: the command is held")
        now = "automatic" if request.data else f"manual: {self._pid.command:g} is held"
        if before != request.data:
            self.get_logger().info(now)
        return now

    # Gains.

    def _on_gains(self, message: Any) -> None:
        if not message.final:
            return
        name = message.experiment_id
        try:
            gains = self._results.gains(message)
            self._place.require_law(gains)
            self._settings.bounds.require(gains)
            self.keeper.history.require_not_failed(self._place.set_of(gains))
        except RelayAutotuneError as error:
            self._results.refusals.say("gains", name, error)
            self._refused = self._results.refusals.last
            return
        self._newest, self._refused = (name, gains), ""
        self._doubt = why_doubtful(message)
        if self._doubt:
            self.get_logger().warning(f"gains of {name} are not trusted: {self._doubt}")
        asked = self.get_parameter("auto_apply").value
        cut_short = not self.keeper.history.is_open_to(self._place.set_of(gains))
        if self._doubt or cut_short or not asked:
            self.get_logger().info(
                f"gains of {name} wait: {controller_text(gains)}; call "
                f"{self.get_fully_qualified_name()}/apply or /discard"
                + (
                    "; their verification was cut short, so that auto_apply leaves them"
                    * cut_short
                )
            )
        self._apply_by_itself()

    def _on_model(self, message: Any) -> None:
        if message.final and self._results.model(message) is not None:
            self._apply_by_itself()

    def _on_experiment(self, message: Any) -> None:
        self._results.experiment(message)
        self._apply_by_itself()

    def _apply_by_itself(self) -> None:
        """Apply gains if auto_apply is set and record and model of their experiment are here."""
        if self._newest is None or self._newest is self._tried or self._doubt:
            return
        name, gains = self._newest
        if not self.get_parameter("auto_apply").value:
            return
        if not self.keeper.history.is_open_to(self._place.set_of(gains)):
            return
        doubt = self._results.doubt(name, gains)
        if doubt:
            self._results.refusals.say("to apply gains by itself", name, TuningError(doubt))
        else:
            self._tried = self._newest
            self.executor.create_task(self._apply_and_tell)

    async def _logged(self, change: Awaitable[str]) -> str:
        """Log the sentence on a change of the gains, and return it."""
        said = await change
        self.get_logger().info(said)
        return said

    async def _apply_and_tell(self) -> None:
        try:
            await self._logged(self._apply())
        except RelayAutotuneError as error:
            self.get_logger().error(str(error))

    def _acceptable(self) -> tuple[str, Gains]:
        """Return the newest gains, with the id of their experiment.

        :raises RelayAutotuneError: if there are none, or they may not be applied.
        """
        if self._newest is None:
            raise TuningError(
                Code.NONE_WAIT(**({"refused": self._refused} if self._refused else {}))
            )
        name, gains = self._newest
        try:
            # The record may have come after the gains.
            self._results.check(name, gains)
            self._settings.bounds.require(gains)
            if self._doubt and not self.get_parameter("accept_doubtful").value:
                raise TuningError(
                    f"they are not trusted: {self._doubt}; set the parameter accept_doubtful to "
                    "true to have them all the same"
                )
        except RelayAutotuneError as error:
            raise _not_in_force(name, error) from error
        self._tried = self._newest
        self._predictors.applied(self._place.set_of(gains), name)
        return self._newest

    async def _apply(self) -> str:
        name, gains = self._acceptable()
        try:
            done = await self.keeper.apply(self._place.set_of(gains))
        except RelayAutotuneError as error:
            raise _not_in_force(name, error) from error
        with suppress(TuningError):
            self.keeper.before()
            done += "; ~/revert brings back those before"
        return f"gains of {name}: {done}"

    def _discard(self, _: Trigger.Request) -> str:
        waiting, self._newest, self._refused = self._newest, None, ""
        if waiting is None:
            raise TuningError("no gains wait")
        return "discarded"

    def _use(self, kept: GainSet | None) -> None:
        """Put gains in force, and into the parameters."""
        gains = None if kept is None else self._place.controller_of(kept)
        self._pid.use(gains)
        values: dict[str, Any] = {entry.name: entry.default for entry in tables.GAINS}
        if gains is not None:
            values = {name: getattr(gains, name) for name in values}
        self._following = True
        try:
            done = self.set_parameters_atomically(
                [Parameter(name, value=float(value)) for name, value in values.items()]
            )
        finally:
            self._following = False
        if not done.successful:
            self.get_logger().error(f"the parameters do not show these gains: {done.reason}")

    # Proof.

    async def prepare_verification(self, request: Verify.Goal) -> Verifiable:
        """Return what is to be verified, if the loop is ready."""
        if self._held:
            raise NotReadyError(Code.TUNING())
        self._predictors.require_any()
        if self._remote is None and self._untaken:
            raise NotReadyError(Code.NOBODY_SUBSCRIBES(topic=self._commands.topic))
        if self._remote is not None:
            self._remote.require_ready()
        if why := self._verifier.why_silent():
            raise NotReadyError(why)
        new, settles = None, math.nan
        if request.apply:
            _, gains = self._acceptable()
            new, settles = self._place.set_of(gains), gains.settling_time
        kept = new or await self._place.read() or self.keeper.history.gains
        if kept is None or (self._remote is None and self._pid.is_manual):
            raise NotReadyError(Code.NOT_AUTOMATIC())
        model, doubt = self._predictors.of(kept)
        if doubt and not self.get_parameter("accept_doubtful").value:
            raise NotReadyError(Code.DOUBTFUL_MODEL(doubt=doubt))
        steps, limits = self._steps_of(request), self._settings.limits
        loop = PredictedLoop(self._place.control(self._place.controller_of(kept)), model)
        # Without an integral it rests anywhere.
        setpoint = self._present_setpoint if loop.control.gains.ti else math.nan
        return Verifiable(steps, new, settles, loop, limits, setpoint)

    @property
    def _present_setpoint(self) -> float:
        return self._setpoint if self._remote is None else self._remote.setpoint

    def _steps_of(self, request: Verify.Goal) -> list[Step]:
        height = request.setpoint_step or self.get_parameter("verify_step").value
        allowed = self.get_parameter("verify_load_max").value
        highest = max(
            abs(self.get_parameter(name).value) for name in ("verify_step", "verify_step_max")
        )
        if not (math.isfinite(height) and math.isfinite(request.load_step)):
            raise NotReadyError("a step must be finite")
        if height == 0.0 and request.load_step == 0.0:
            raise NotReadyError(
                "no step is given: set setpoint_step, or the parameter verify_step"
            )
        if abs(height) > highest:
            raise NotReadyError(
                f"setpoint_step is {height:g}, verify_step_max allows {highest:g}: set it to the "
                "largest step that the process may be given"
            )
        if height and not self._is_possible(goes_to := self._present_setpoint + height):
            raise NotReadyError(
                f"the step leads to the set-point {goes_to:g}, beyond {self._range}"
            )
        if request.load_step and self._remote is not None:
            raise NotReadyError(
                f"{self._place.name} commands: no load step can be added to that, ask for none"
            )
        if abs(request.load_step) > allowed:
            raise NotReadyError(
                f"load_step is {request.load_step:g}, verify_load_max allows {allowed:g}"
            )
        steps = [Step(setpoint=height)] if height else []
        return steps + ([Step(load=request.load_step)] if request.load_step else [])

    def move(self, setpoint: float, load: float) -> None:
        """Put a step on set-point [y] and command [u]; 0: none."""
        if self._remote is not None:
            self._remote.move(setpoint)
        self._offset, self._load = setpoint, load

    # The end.

    def end(self, reason: Reason) -> None:
        """Undo the steps of a verification, and leave a safe command and trusted gains."""
        rested = self._verifier.rested_at
        at_work = self._verifier.is_running or self.keeper.is_at_work
        self._ending = True
        self._verifier.interrupt(reason)
        if self._remote is not None:
            self._remote.setpoints.publisher.wait_for_all_acked(quality.ACKNOWLEDGE)
        elif self._commands.last is not None and not self._held:
            given = self.get_parameter("safe_command").value
            last = self._pid.command if math.isnan(rested) else rested
            safe = self._settings.limits.clip(last if math.isnan(given) else given)
            self._commands.send(safe)
            self._commands.publisher.wait_for_all_acked(quality.ACKNOWLEDGE)
            self.get_logger().info(f"{reason}; the command is left at {safe:g}")
        if at_work:
            self._undo()

    def _undo(self) -> None:
        """End the verification, which takes its gains back, or undo a change of another node."""
        deadline = time.monotonic() + END_WITHIN
        while time.monotonic() < deadline and self._verifier.is_running:
            self.executor.turn(0.02)
        undone = self.executor.create_task(self.keeper.abandon)
        while time.monotonic() < deadline and not undone.done():
            self.executor.turn(0.02)
        # Give the action's client its result.
        for _ in range(20):
            self.executor.turn(0.01)

    # Parameters.

    def _own(self, gains: Controller | None) -> GainSet | None:
        """Return the gains of the parameters as the history keeps them."""
        return None if gains is None else self._place.set_of(gains)

    def _require_bounds(self, gains: GainSet) -> None:
        """Refuse gains that the present parameters do not allow."""
        self._settings.bounds.require(self._place.controller_of(gains))

    def _require_settable(self, changes: list[Parameter]) -> None:
        if self._following:
            return
        if self._verifier.is_running:
            raise ParameterError("parameters stay as they are while a verification runs")
        values = merged(self, (*tables.GAINS, *tables.OTHERS), changes)
        gains = tables.settings_from(values, self._rate).gains
        if self._remote is None and {change.name for change in changes} & NAMES_OF_GAINS:
            odd = self._why_odd(gains)
            self.keeper.edit(self._own(gains))
            if odd:
                self.get_logger().warning(odd)

    def _why_odd(self, gains: Controller | None) -> str:
        """Return why the sign of gains that are set by hand looks wrong; "" if it does not.

        :raises TuningError: if the newest trusted model says that the loop would run away.
        """
        models = reversed(self._results.models.values())
        model = next((model for model, doubt in models if not doubt), None)
        present = self._pid.gains
        sign = model.process_sign if model else present.kc if present else 0.0
        if gains is None or gains.kc * sign >= 0.0:
            return ""
        others = "the process by its model" if model else "the gains in force"
        why = f"kc is {gains.kc:g}, of the other sign than {others}: the loop"
        if model and not is_stable(self._place.control(gains).law, model):
            raise TuningError(f"{why} would run away; tune again, or give it at the node's start")
        return f"{why} may run away"

    def _after_set(self, changes: list[Parameter]) -> None:
        if self._following:
            return
        values = values_of(self, (*tables.GAINS, *tables.OTHERS))
        self._settings = tables.settings_from(values, self._rate)
        if {change.name for change in changes} & NAMES_OF_GAINS and self._remote is None:
            self._pid.use(self._settings.gains)
        self._pid.limit(self._settings.limits)


def _not_in_force(name: str, error: RelayAutotuneError) -> TuningError:
    return TuningError(f"the gains of {name} are not in force: {error}")


def main(args: list[str] | None = None) -> int:
    """Run controller_node."""
    given = sys.argv[1:] if args is None else args
    try:
        words = with_gains_file(given)
    except ParameterError as error:
        sys.stderr.write(f"controller_node: {error}\n")
        return 2
    return run(ControllerNode, "controller_node", words, tables.CONTROLLER_PARAMETERS)
