"""relay_node: runs relay experiments on a loop and records them."""

from __future__ import annotations

import math
import secrets
import time
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.timer import Timer
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from relay_autotune.errors import ParameterError, RecordError, RelayAutotuneError
from relay_autotune.messages import fill_cycle, fill_experiment, fill_settings, set_stamp
from relay_autotune.nodes.ends import Ends
from relay_autotune.nodes.health import diagnostics
from relay_autotune.nodes.lifetime import ServedNode, run
from relay_autotune.nodes.lockstep import NO_REPEAT_AFTER
from relay_autotune.nodes.parameters import declare, merged, values_of
from relay_autotune.nodes.quality import why_no_publisher
from relay_autotune.nodes.readiness import (
    NotReadyError,
    baseline_from,
    plan_of,
    require_connections,
)
from relay_autotune.nodes.recordings import Recordings
from relay_autotune.nodes.session import Session
from relay_autotune.nodes.tune_parameters import (
    EXPERIMENT_PARAMETERS,
    FIXED_PARAMETERS,
    TUNE_PARAMETERS,
)
from relay_autotune.record import Outcome
from relay_autotune.relay import RelayExperiment
from relay_autotune.relay_parameters import ExperimentParameters
from relay_autotune_msgs.msg import RelayCycle
from relay_autotune_msgs.msg import RelayExperiment as ExperimentMessage
from relay_autotune_msgs.srv import StartTune

# How long the end of the process waits for the record to be acknowledged.
ACKNOWLEDGE = Duration(seconds=0.2)
# Cycles that wait for who comes late, or max_cycles at the node's start if that is more.
CYCLES_KEPT = 100
# How long the end of the process may wait for the last bytes of a recording [s].
CLOSE_WITHIN = 3.0


class RelayNode(ServedNode):
    """Answers each measurement with a command while a tune runs, and holds the baseline after."""

    def __init__(self) -> None:
        super().__init__("relay_node")
        declare(self, TUNE_PARAMETERS)
        declare(self, FIXED_PARAMETERS, read_only=True)
        initial = self.get_parameter("initial_command").value
        self._held: float | None = None if math.isnan(initial) else initial
        self._session: Session | None = None
        self._watchdog: Timer | None = None
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._simulated = bool(self.get_parameter("use_sim_time").value)
        self._last_arrival = -math.inf
        self._arrivals = self._arrivals_before = 0
        self._sequence = 0
        self._lost = 0
        self._counted = False
        self._ahead = 0
        self._summary = "no tune yet"
        self._ends = Ends(
            self,
            on_measurement=self._on_measurement,
            on_result=self._on_result,
            cycles_kept=max(self.get_parameter("max_cycles").value, CYCLES_KEPT),
        )
        self._send = self._ends.send
        if not self._simulated:
            # With /clock, the time of a sample comes by another callback.
            self.favoured = self._ends.measurement
        self._recordings = Recordings(self, self._ends.recorded())
        self.create_service(StartTune, "~/start_tune", self._on_start)
        self.create_service(Trigger, "~/abort", self._on_abort)
        self.create_timer(1.0, self._publish_diagnostics, clock=self._steady)
        self.add_on_set_parameters_callback(self._on_set)
        self._name = self.get_fully_qualified_name()
        self.get_logger().info(
            f"ready: {self._ends.measurement.topic_name} in, {self._ends.command.topic_name} out; "
            f"start a tune with the service {self._name}/start_tune"
        )

    # The hot path.

    def _on_measurement(self, message: Float64, info: dict[str, Any]) -> None:
        session = self._session
        if self._ahead:
            self._ahead -= 1
        elif session is not None:
            command = session.answer(message.data, info)
            if command is not None:
                # Nothing comes before this: the actuator waits for it.
                self._send(command)
                session.answered()
                experiment = session.experiment
                if experiment.cycle_count != session.published_cycles:
                    self._defer_cycles(session)
                if experiment.finished:
                    self._leave(session)
            elif session.may_be_no_repeat:
                self._answer_later(session)
        elif self._held is not None:
            self._send(self._held)
        self._last_arrival = time.monotonic()
        self._arrivals += 1
        number = info["publication_sequence_number"]
        if number is not None:
            if number > self._sequence + 1 and self._sequence:
                self._lost += number - self._sequence - 1
            self._sequence = number

    def _answer_later(self, session: Session) -> None:
        def answer() -> None:
            self.destroy_timer(timer)
            command = session.answer_after_all() if session is self._session else None
            if command is not None:
                self._send(command)
                session.answered()

        timer = self.create_timer(NO_REPEAT_AFTER, answer, clock=self._steady)

    # Starting.

    def _on_start(
        self, request: StartTune.Request, response: StartTune.Response
    ) -> StartTune.Response:
        try:
            parameters, baseline = self._ready(request.amplitude)
        except RelayAutotuneError as error:
            response.accepted = False
            response.reason = str(error)
            self.get_logger().warning(f"start refused: {error}")
            return response
        response.accepted = True
        plan = plan_of(parameters, baseline)
        if request.dry_run:
            response.reason = f"a tune could start: {plan}"
            return response
        response.experiment_id, recorded = self._start(parameters, baseline)
        response.reason = f"{plan}; {recorded}"
        self.get_logger().info(f"tune {response.experiment_id} started: {response.reason}")
        return response

    def _ready(self, amplitude: float) -> tuple[ExperimentParameters, float]:
        if self._session is not None:
            raise NotReadyError(
                f"tune {self._session.id} is running; wait for its end or call {self._name}/abort"
            )
        values = values_of(self, EXPERIMENT_PARAMETERS)
        if amplitude != 0.0:
            values["amplitude"] = amplitude
        parameters = ExperimentParameters(**values)
        parameters.validate()
        baseline = baseline_from(self.get_parameter("baseline").value, self._held)
        parameters.validate(baseline)
        require_connections(
            self,
            self._ends.measurement,
            self._ends.command,
            time.monotonic() - self._last_arrival,
            self.get_parameter("measurement_timeout").value,
        )
        return parameters, baseline

    def _start(self, parameters: ExperimentParameters, baseline: float) -> tuple[str, str]:
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        identity = f"{stamp}_{secrets.token_hex(4)}"
        clock = self.get_clock()
        session = Session(
            RelayExperiment(parameters, baseline, identity),
            identity,
            sample_period=parameters.sample_period,
            clock=(lambda: int(clock.now().nanoseconds)) if self._simulated else None,
        )
        sample, recorded = self._recordings.begin(
            identity, self.get_parameter("record_directory").value
        )
        session.record_with(sample)
        self._lost = 0
        # Numbers of several publishers cannot be told apart.
        self._counted = self._ends.measurement.get_publisher_count() == 1
        self._last_arrival = time.monotonic()
        self._session = session
        timeout = self.get_parameter("measurement_timeout").value
        self._watchdog = self.create_timer(timeout, self._watch, clock=self._steady)
        return identity, recorded

    # While a tune runs.

    def _defer_cycles(self, session: Session) -> None:
        for index in range(session.published_cycles, session.experiment.cycle_count):
            self.defer(partial(self._publish_cycle, session, index))
        session.published_cycles = session.experiment.cycle_count

    def _publish_cycle(self, session: Session, index: int) -> None:
        experiment = session.experiment
        first, stop = experiment.cycle_start[index], experiment.cycle_start[index + 1] + 1
        begin = 0 if index == 0 else first
        columns = experiment.samples(begin, stop)
        message = RelayCycle()
        cycle = experiment.cycles[index]
        fill_cycle(
            message,
            cycle,
            settings=experiment.settings,
            experiment_id=session.id,
            start_ns=session.start_ns,
            time=columns[0],
            measurement=columns[1],
            command=columns[2],
            lead_in=first - begin,
        )
        self._ends.cycles.publish(message)
        self._recordings.message(session.id, "relay_cycle", session.now_ns(), message)

    def _watch(self) -> None:
        session, watchdog = self._session, self._watchdog
        if session is None or watchdog is None:
            return
        timeout = self.get_parameter("measurement_timeout").value
        silent = time.monotonic() - self._last_arrival
        if silent < timeout:
            watchdog.timer_period_ns = max(int((timeout - silent) * 1e9), 1_000_000)
            watchdog.reset()
            return
        self._stop(
            session, f"no measurement on {self._ends.measurement.topic_name} for {silent:.3g} s"
        )

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        session = self._session
        if session is None:
            response.success = False
            response.message = "no tune is running"
            return response
        acknowledged = self._stop(session, "aborted on request")
        response.success = True
        response.message = (
            f"tune {session.id} aborted; the safe command {self._held:g} is out"
            f"{'' if acknowledged else ', but was not acknowledged'}"
        )
        return response

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        names = {entry.name for entry in TUNE_PARAMETERS}
        try:
            if self._session is not None and any(c.name in names for c in changes):
                raise ParameterError(
                    f"parameters stay as they are while tune {self._session.id} runs; "
                    f"wait for its end or call {self._name}/abort"
                )
            values = merged(self, TUNE_PARAMETERS, changes)
            experiment = {entry.name: values[entry.name] for entry in EXPERIMENT_PARAMETERS}
            # Without an amplitude, which a request may bring, the rest is judged at the start.
            if experiment["amplitude"] > 0.0:
                ExperimentParameters(**experiment).validate()
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # Ending.

    def _stop(self, session: Session, reason: str) -> bool:
        """End a running tune; return True if the safe command was acknowledged."""
        acknowledged = self._send_safe(session.experiment.safe_command)
        session.experiment.abort(reason)
        self._leave(session)
        return acknowledged

    def _send_safe(self, command: float) -> bool:
        count, acknowledged = self._ends.send_until_acknowledged(command)
        if self.get_parameter("sample_period").value > 0.0:
            # A plant in lockstep answers each of these with a measurement, which wants no more.
            self._ahead = count
        return acknowledged

    def _leave(self, session: Session) -> None:
        # The safe command is out. All that takes time waits until the callback has returned.
        self._held = session.experiment.safe_command
        self._session = None
        session.lost_samples = self._lost if self._counted else 0
        if self._watchdog is not None:
            self.destroy_timer(self._watchdog)
            self._watchdog = None
        self.defer(partial(self._complete, session))

    def _complete(self, session: Session) -> None:
        experiment = session.experiment
        message = ExperimentMessage()
        try:
            fill_experiment(message, session.record())
        except RecordError:
            # Ended before the first sample: there is an outcome, but nothing was recorded.
            fill_settings(message.settings, experiment.settings)
            message.experiment_id = session.id
            message.outcome = int(experiment.outcome)
            message.reason = experiment.reason
            message.noise_std = math.nan
        if session.sample_count:
            set_stamp(message.header.stamp, session.start_ns)
        self._ends.experiments.publish(message)
        outcome = experiment.outcome.name.lower()
        self._summary = f"last tune {session.id} {outcome}: {experiment.reason}"
        self.get_logger().info(f"tune {session.id} {outcome}: {experiment.reason}")
        self._recordings.message(session.id, "relay_experiment", session.now_ns(), message)
        if experiment.outcome == Outcome.COMPLETED:
            timeout = self.get_parameter("model_timeout").value
            self._recordings.close_with_results(session.id, timeout)
        else:
            self._recordings.close(session.id, f"after a tune that was {outcome}")

    def _on_result(self, name: str, message: Any) -> None:
        now = int(self.get_clock().now().nanoseconds)
        self._recordings.message(message.experiment_id, name, now, message)

    def end(self, reason: str) -> None:
        """Send the safe command, then finish the record and close the bag."""
        session = self._session
        try:
            if session is not None:
                self._stop(session, reason)
            elif self._held is not None:
                self._send_safe(self._held)
            self.work_off()
            self._ends.experiments.wait_for_all_acked(ACKNOWLEDGE)
        finally:
            self._recordings.close_all(f"because {reason}", CLOSE_WITHIN)

    # Telling.

    def _publish_diagnostics(self) -> None:
        session = self._session
        age = time.monotonic() - self._last_arrival
        problems = []
        if age > self.get_parameter("measurement_timeout").value:
            why = why_no_publisher(self, self._ends.measurement.topic_name)
            problems.append(f"no measurement comes: {why}")
        if self._recordings.problem():
            problems.append(self._recordings.problem())
        values: dict[str, object] = {
            "state": "idle" if self._held is None else "holding",
            "experiment": "" if session is None else session.id,
            "rate [Hz]": float(self._arrivals - self._arrivals_before),
            "age of the last sample [s]": age,
        }
        self._arrivals_before = self._arrivals
        if session is not None:
            experiment = session.experiment
            values |= {
                "state": experiment.state.name.lower(),
                "cycles": experiment.cycle_count,
                "noise standard deviation": experiment.noise_std,
                "samples": session.sample_count,
                "lost samples": self._lost if self._counted else 0,
            }
        summary = self._summary if session is None else f"tune {session.id} is running"
        now = int(self.get_clock().now().nanoseconds)
        name = self.get_fully_qualified_name().lstrip("/")
        self._ends.diagnostics.publish(diagnostics(name, now, problems, summary, values))


def main(args: list[str] | None = None) -> int:
    """Run relay_node."""
    return run(RelayNode, "relay_node", args)
