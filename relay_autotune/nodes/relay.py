# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""relay_node: runs relay experiments on a loop and records them."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import ReentrantCallbackGroup
from std_srvs.srv import Trigger

from relay_autotune.errors import FieldError, NotReadyError, ParameterError
from relay_autotune.exchange.messages import finding_from_message, set_stamp
from relay_autotune.experiment.early_end import EarlyEnd
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.nodes import quality
from relay_autotune.nodes.goals import Narrator, TuneGoal, conclude, refused, serve, serve_goals
from relay_autotune.nodes.lifetime import STEADY, ServedNode, run
from relay_autotune.nodes.live_types import command_reader, reader_of
from relay_autotune.nodes.loop_ends import LoopSupervisor
from relay_autotune.nodes.parameters import ask_before_changes, declare, values_of
from relay_autotune.nodes.quality import NO_REPEAT_AFTER, why_unconnected
from relay_autotune.nodes.readiness import Checklist, Readiness, Ready, answer_of, require_settable
from relay_autotune.nodes.recording import Recording
from relay_autotune.nodes.results import MODEL, SIGNS_OF_LIFE, OwnResults, said_by
from relay_autotune.nodes.session import Session, SetpointSession
from relay_autotune.nodes.tables import FIXED_PARAMETERS, TUNE_PARAMETERS
from relay_autotune.nodes.watch import Sensor, arrival
from relay_autotune.reasons import Code, Reason
from relay_autotune.record.record import Outcome
from relay_autotune.text import duration
from relay_autotune_msgs.action import Tune
from relay_autotune_msgs.msg import PidGains, RelayCycle, TransferFunction
from relay_autotune_msgs.msg import RelayExperiment as ExperimentMessage
from relay_autotune_msgs.srv import StartTune

# Where a tune that was started by the service is seen.
WATCH = "the log of {}, or the topic /diagnostics, which tell each second how it goes"
# Number of latched cycles for late subscribers; max_cycles at the node's start if that is more.
CYCLES_KEPT = 100
# Silence of the measurement that is reported during a tune [s].
SILENT = 0.5
# How long the end of the process may wait for the last bytes of a recording [s].
CLOSE_WITHIN = 3.0


class RelayNode(ServedNode):
    """Answer each measurement with a command during a tune, and hold the process after it."""

    def __init__(self) -> None:
        super().__init__("relay_node")
        declare(self, TUNE_PARAMETERS)
        declare(self, FIXED_PARAMETERS, read_only=True)
        fixed = values_of(self, FIXED_PARAMETERS)
        self._session: Session | None = None
        self._simulated = bool(self.get_parameter("use_sim_time").value)
        self._ahead = 0
        self._summary = "no tune yet"
        self._alarm = ""
        self._reader = reader_of(fixed["measurement_type"], fixed["measurement_field"])
        self._value = self._reader.value
        require_reported(fixed)
        self._reported = command_reader(fixed)
        self._sensor = Sensor(self, self._reader, self._on_measurement, self._on_silence)
        now_ns = self._now_ns if self._simulated else time.time_ns
        self._loop = LoopSupervisor(self, self._sensor, now_ns, self._stop_now)
        self._relay = self._loop.relay.send
        self._on_setpoint = self._loop.setpoint is not None
        self._readiness = Readiness(self, self._loop)
        tells, hears = partial(quality.publisher, self), partial(quality.subscription, self)
        cycles_kept = max(self.get_parameter("max_cycles").value, CYCLES_KEPT)
        self._cycles = tells(RelayCycle, "relay_cycle", quality.latched(cycles_kept))
        self._progress = tells(ExperimentMessage, "relay_progress", quality.RESULT)
        self._experiments = tells(ExperimentMessage, "relay_experiment", quality.RESULT)
        self._diagnostics = tells(DiagnosticArray, "/diagnostics", 1)
        self._models, self._gains = (
            hears(kind, name, partial(self._on_result, name), quality.RESULT)
            for kind, name in ((TransferFunction, MODEL), (PidGains, "pi_gains"))
        )
        hears(DiagnosticStatus, SIGNS_OF_LIFE, self._on_status, quality.RESULT)
        self._hear = self._sensor.hear
        self._topic = self._sensor.subscription.topic_name
        self._results = OwnResults(self, on_setpoint=self._on_setpoint)
        self._arrival = arrival(self)
        # The others of the loop go on while it waits.
        waiting = ReentrantCallbackGroup()
        self.create_service(StartTune, "~/start_tune", self._on_start, callback_group=waiting)
        serve(self, Trigger, "~/abort", self._abort)
        self._action = serve_goals(
            self,
            Tune,
            "~/tune",
            lambda handle: self.executor.create_task(self._on_goal, handle),
            self._cancel,
            status_pub_qos_profile=quality.STATUS,
        )
        # The tune that runs, and before it those whose gains are awaited, by their ids.
        self._tunes: dict[str, Session] = {}
        # Of the newest tune.
        self._recording: Recording | None = None
        self._narrator = Narrator(self, self._words, self._tell)
        self.create_timer(1.0, self._publish_diagnostics, clock=STEADY)
        require_settable(self, (), self._running)
        ask_before_changes(self, lambda given: require_settable(self, given, self._running))
        self._name = self.get_fully_qualified_name()
        self.get_logger().info(
            f"ready: {self._topic} in, {self._loop.command.topic} out; "
            f"start with the service {self._name}/start_tune or the action {self._name}/tune"
        )

    # The hot path.

    def _on_measurement(self, message: Any, info: dict[str, Any]) -> None:
        session, sensor = self._session, self._sensor
        try:
            value = self._value(message)
        except FieldError as error:
            why = str(error)
            sensor.misread = Code.MISREAD(what="measurement", topic=self._topic, why=why)
            self._stop_now(sensor.misread)
            return
        if sensor.misread is not None:
            sensor.misread = None
        if self._hear is not None:
            self._hear(value)
        if self._ahead:
            self._ahead -= 1
        elif session is not None:
            stamp = self._reader.stamp_ns
            source = info["source_timestamp"] if stamp is None else stamp(message)
            command = session.answer(value, source, info["received_timestamp"])
            if command is not None:
                self._respond(session, command)
            elif session.may_be_no_repeat:
                self._answer_later(session)
        else:
            self._loop.answer(value)
            sensor.samples.add(value, info["source_timestamp"])
        if self._reported is not None:
            # After the answer: it belongs to this sample, and the one before is still needed.
            try:
                self._loop.handover.note(self._reported(message))
            except FieldError as error:
                what, why = "controller's command", str(error)
                self._stop_now(Code.MISREAD(what=what, topic=self._topic, why=why))
        sensor.count(info["publication_sequence_number"])

    def _on_silence(self, value: float, ago: float) -> None:
        """Take the last measurement again: a silent sensor means that it has not changed."""
        if (session := self._session) is not None:
            self._respond(session, session.repeat(value, ago))
        else:
            self._loop.answer(value)

    def _respond(self, session: Session, command: float) -> None:
        # Publish first, because the actuator waits for it.
        self._relay(command)
        session.answered()
        self._defer_news(session)
        if session.experiment.finished:
            self._leave(session, command)

    def _answer_later(self, session: Session) -> None:
        def answer() -> None:
            self.destroy_timer(timer)
            command = session.answer_after_all() if session is self._session else None
            if command is not None:
                self._respond(session, command)

        timer = self.create_timer(NO_REPEAT_AFTER, answer, clock=STEADY)

    # Starting.

    async def _on_start(
        self, request: StartTune.Request, _: StartTune.Response
    ) -> StartTune.Response:
        await self._arrival
        return self._request(request.amplitude, request.dry_run)

    async def _on_goal(self, handle: Any) -> None:
        """Take a goal. A tune may begin while the one before waits for its gains."""
        request = handle.request
        await self._arrival
        if handle.is_cancel_requested:
            started = refused(Code.CANCELLED())
        else:
            started = self._request(request.amplitude, request.dry_run, TuneGoal(handle))
        if not started.experiment_id:
            said = {n: getattr(started, n) for n in ("reason", "why", "checks", "refusals")}
            conclude(handle, Tune.Result(**said), succeeded=started.accepted)

    def _request(
        self, amplitude: float, dry_run: bool, goal: TuneGoal | None = None
    ) -> StartTune.Response:
        if self._session is not None:
            return self._refuse(Code.RUNNING(tune=self._session.id, node=self._name))
        checks = Checklist()
        ready = self._readiness.of(amplitude, checks)
        if ready is None:
            return answer_of(checks) if dry_run else self._refuse(checks.refusals[0])
        if dry_run:
            reason = f"a tune could start: {ready}; {ready.takes}"
            return answer_of(checks, accepted=True, reason=reason)
        identity, recorded = self._start(ready, goal)
        reason = f"{ready}; {recorded}; {ready.takes}"
        self.get_logger().info(f"tune {identity} started: {reason}")
        reason += f"; watch {WATCH.format(self._name)}"
        return StartTune.Response(accepted=True, reason=reason, experiment_id=identity)

    def _recorded(self) -> dict[str, Any]:
        """Return the publishers and subscriptions to record, by the topics' unresolved names."""
        return {
            "measurement": self._sensor.subscription,
            "command": self._loop.command.publisher,
            "relay_cycle": self._cycles,
            "relay_experiment": self._experiments,
            "transfer_function": self._models,
            "pi_gains": self._gains,
        }

    def _refuse(self, why: Reason) -> StartTune.Response:
        self.get_logger().warning(f"start refused: {why}")
        return refused(why)

    def _start(self, ready: Ready, goal: TuneGoal | None) -> tuple[str, str]:
        parameters, policy = ready.parameters, ready.policy
        identity = f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}_{secrets.token_hex(4)}"
        converged = self.get_parameter("stop_when").value == "converged"
        kind: Callable[..., Session] = Session
        if self._on_setpoint:
            kind = partial(SetpointSession, actual=lambda: self._loop.handover.last)
        present = self.get_parameter("baseline_is_present").value
        experiment = RelayExperiment(
            parameters,
            ready.baseline,
            identity,
            policy=policy,
            until_converged=converged,
            from_small=ready.from_small,
            before=self._sensor.samples.before() if present else None,
        )
        directory = self.get_parameter("record_directory").value
        self._recording = recording = Recording(self, self._recorded(), directory, identity)
        session = kind(
            experiment,
            recording,
            clock=self._now_ns if self._simulated else None,
            repeats=self._hear is not None,
            one_clock=self._reported is not None,
            goal=goal,
        )
        if not converged:
            sought = self.get_parameter("confident_of").value
            session.early = EarlyEnd(sought, self.get_parameter("confidence").value)
        self._sensor.samples.forget()
        self._alarm = ""
        self._session = self._tunes[identity] = session
        self._loop.take(session.experiment)
        self.defer(self._narrator.now)
        return identity, recording.problem() or f"recorded in {recording.path}"

    # While a tune runs.

    def _defer_news(self, session: Session) -> None:
        experiment, early = session.experiment, session.early
        while session.published_cycles < experiment.cycle_count:
            self.defer(partial(self._publish_cycle, session, session.published_cycles))
            session.published_cycles += 1
        if experiment.state is not session.published_state:
            session.published_state = experiment.state
            self.defer(self._narrator.now)
        if early is not None and early.is_due(experiment):
            early.look(experiment)
            self.defer(lambda: self._progress.publish(session.message()))

    def _publish_cycle(self, session: Session, index: int) -> None:
        self._tell(session.experiment.status)
        if self._on_setpoint:
            # The controller's commands are known only at the end.
            return
        message = session.cycle_message(index)
        self._cycles.publish(message)
        session.recording.message("relay_cycle", session.now_ns(), message)

    def _abort(self, _: Trigger.Request) -> str:
        session = self._session
        if session is None:
            raise NotReadyError("no tune is running")
        acknowledged = self._stop(session, Code.REQUESTED())
        but = "" if acknowledged else ", but was not acknowledged"
        safe = session.experiment.after_end(math.nan)
        return f"tune {session.id} aborted; the safe command {safe:g} is out{but}"

    @property
    def _running(self) -> str:
        """Id of the running tune; empty: no tune runs."""
        return "" if self._session is None else self._session.id

    def _on_result(self, name: str, message: Any) -> None:
        session = self._session
        running = session if session is not None and message.experiment_id == session.id else None
        now = self._now_ns()
        taken = self._results.take(name, message, running)
        for topic, found in taken:
            if (tune := self._tunes.get(found.experiment_id)) is not None:
                # The last result closes the recording, and that ends the goal.
                if tune.goal is not None:
                    tune.goal.note(topic, found)
                tune.recording.message(topic, now, found)
        if name == MODEL and message.final and not taken:
            # Gains without a model are no result: waiting longer brings nothing.
            self._note_progress(message.experiment_id, False, self._results.refusals.last)
        if running is None or not taken:
            return
        self._tell(running.experiment.status)
        if running.early is None or not running.experiment.is_tried:
            return
        if reason := running.early.judge(running.experiment, finding_from_message(message)):
            self._send_safe(command := running.experiment.conclude(reason))
            self._leave(running, command)

    def _on_status(self, message: Any) -> None:
        self._note_progress(*said_by(message))

    def _note_progress(self, experiment_id: str, working: bool, text: str) -> None:
        """Take a sign of life of the identifier, as `Recording.note_progress`."""
        if (tune := self._tunes.get(experiment_id)) is not None:
            tune.recording.note_progress(working, text)

    # Ending.

    def _stop_now(self, reason: Reason) -> None:
        if (session := self._session) is not None:
            self._stop(session, reason)

    def _cancel(self, handle: Any) -> None:
        """End a tune at its client's wish, also one that waits for its model alone."""
        for tune in [*self._tunes.values()]:
            if tune.goal is None or not tune.goal.is_of(handle):
                continue
            if tune is self._session:
                self._stop(tune, Code.CANCELLED())
            else:
                tune.recording.wait_no_longer("cancelled")

    def _stop(self, session: Session, reason: Reason) -> bool:
        """End a running tune; return True if the safe command was acknowledged."""
        acknowledged = self._send_safe(command := session.experiment.abort(reason))
        self._leave(session, command)
        return acknowledged

    def _send_safe(self, command: float) -> bool:
        count, acknowledged = self._loop.send_until_acknowledged(command)
        if self.get_parameter("sample_period").value > 0.0:
            # A plant in lockstep answers each repeat with a measurement; these need no answer.
            self._ahead = count
        return acknowledged

    def _leave(self, session: Session, command: float) -> None:
        # The safe command is out. Slow work is deferred until the callback has returned.
        self._session = None
        session.lost_samples = self._sensor.lost
        self._loop.give_back(session.experiment, command)
        self.defer(partial(self._complete, session))

    def _complete(self, session: Session) -> None:
        experiment = session.experiment
        message = session.message()
        self._experiments.publish(message)
        outcome = experiment.outcome.name.lower()
        self._summary = f"last tune {session.id} {outcome}: {experiment.reason}"
        completed = experiment.outcome == Outcome.COMPLETED
        if experiment.cycles and experiment.settings is not None:
            self._readiness.last = experiment.settings.amplitude, experiment.cycles[-1]
        self._alarm = "" if completed else self._summary
        count = session.lost_samples
        lost = str(Code.NOTE_LOST(samples=count)) if count else ""
        sentence = "; ".join(filter(None, (experiment.reason, lost)))
        self.get_logger().info(f"tune {session.id} {outcome}: {sentence}")
        self._publish_diagnostics()
        if session.sample_count:
            self._results.experiment(message)
        session.recording.message("relay_experiment", session.now_ns(), message)
        if (goal := session.goal) is not None:
            goal.tell(experiment, experiment.status)
        self.tidy_when_idle()

        def closed(missing: str) -> None:
            del self._tunes[session.id]
            bag = "" if session.recording.problem() else str(session.recording.path)
            if goal is not None:
                without = "; ".join(filter(None, (lost, missing)))
                goal.end(session.message(arrays=False), bag, without)

        if completed:
            timeout = self.get_parameter("model_timeout").value
            session.recording.close_with_results(timeout, closed)
            self._narrator.now()
        else:
            session.recording.close(f"after a tune that was {outcome}")
            closed("")

    def end(self, reason: Reason) -> None:
        """Send the safe command, then finish the record and close the bag."""
        session = self._session
        try:
            if session is not None:
                self._stop(session, reason)
            elif self._loop.is_driven:
                self._loop.leave()
            elif self._loop.held is not None:
                self._send_safe(self._loop.held)
            self.work_off()
            self._experiments.wait_for_all_acked(quality.ACKNOWLEDGE)
        finally:
            for tune in [*self._tunes.values()]:
                tune.recording.close(f"because {reason}")
            if self._recording is not None:
                self._recording.join(CLOSE_WITHIN)

    # Status.

    def _words(self) -> str:
        """Say what the tune waits for and sees; empty where none runs or waits for its model."""
        if (session := self._session) is None:
            waiting = self._told
            return "" if waiting is None else waiting.recording.awaited()
        sentence = session.experiment.status
        if (age := self._sensor.age) > max(SILENT, 2.0 * self._sensor.samples.interval):
            sentence += f"; no measurement for {duration(age)}"
        lost = self._sensor.lost
        return f"{sentence}; {Code.NOTE_LOST(samples=lost)}" if lost else sentence

    def _tell(self, status: str) -> None:
        """Send feedback of the tune that runs, or that waits for its model."""
        if (tune := self._told) is not None and tune.goal is not None:
            tune.goal.tell(tune.experiment, status)

    @property
    def _told(self) -> Session | None:
        """The tune that runs, else the last that waits for its model."""
        waiting = (t for t in reversed(self._tunes.values()) if t.recording.is_waiting)
        return self._session or next(waiting, None)

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _publish_diagnostics(self) -> None:
        session = self._session
        problems = [self._alarm] if self._alarm else []
        if self._sensor.misread:
            problems.append(str(self._sensor.misread))
        elif self._sensor.age > self._sensor.timeout:
            why = why_unconnected(self, self._topic, self._reader.type_name, hears=True)
            problems.append(f"no measurement comes: {why}")
        unrecorded = "" if self._recording is None else self._recording.problem()
        problems += filter(None, (unrecorded, self._loop.problem))
        held = "idle" if self._loop.held is None else "holding"
        values: dict[str, object] = {
            "state": "passing" if self._loop.is_driven else held,
            "experiment": "",
            "rate [Hz]": float(self._sensor.arrivals()),
            "age of the last sample [s]": self._sensor.since_message,
        }
        summary = self._summary
        if session is not None:
            values |= session.facts(self._sensor.lost)
            summary = f"tune {session.id}: {self._words()}"
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if problems else DiagnosticStatus.OK,
            name=f"{self._name.lstrip('/')}: experiment",
            hardware_id="none",
            message="; ".join(problems) or summary,
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        set_stamp(message.header.stamp, self._now_ns())
        self._diagnostics.publish(message)


def require_reported(values: Mapping[str, Any]) -> None:
    """Refuse a command in the measurement's message that nothing would use."""
    field = values["controller_command_field"]
    if field and (values["relay_on"], values["path"]) != ("setpoint", "passthrough"):
        raise ParameterError(
            f"controller_command_field is {field!r}, which is for relay_on setpoint with path "
            f"passthrough: found {values['relay_on']} and {values['path']}"
        )


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def main(args: list[str] | None = None) -> int:
    """Run relay_node."""
    return run(RelayNode, "relay_node", args, (*TUNE_PARAMETERS, *FIXED_PARAMETERS))
