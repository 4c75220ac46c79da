"""identifier_node: models and gains from the cycles and records of relay_node."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from relay_autotune.analysis import Analysis, analyse, analyse_jointly, check_names
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.exchange.messages import (
    fill_gains,
    fill_transfer_function,
    record_from_cycles,
    record_from_message,
    start_nanoseconds,
)
from relay_autotune.experiment.early_end import ULTIMATE_GAIN
from relay_autotune.identification import DEFAULT_METHOD, METHODS, ONLY_JOINT
from relay_autotune.identification.running_fit import RunningFit, Task
from relay_autotune.nodes import quality
from relay_autotune.nodes.design_parameters import DESIGN_PARAMETERS, options_from
from relay_autotune.nodes.known_parameters import KNOWN_PARAMETERS, known_from
from relay_autotune.nodes.lifetime import ServedNode, run
from relay_autotune.nodes.parameters import NodeParameter, declare, merged, values_of
from relay_autotune.nodes.signs_of_life import SignsOfLife
from relay_autotune.record.record import Outcome, Record
from relay_autotune.tuning import DEFAULT_RULE, RULES
from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment, TransferFunction
from relay_autotune_msgs.srv import Identify

PARAMETERS = (
    NodeParameter(
        "method",
        DEFAULT_METHOD,
        "",
        "Method whose model is published.",
        choices=tuple(METHODS),
    ),
    NodeParameter(
        "rule", DEFAULT_RULE, "", "Rule whose gains are published.", choices=tuple(RULES)
    ),
    *KNOWN_PARAMETERS,
    *DESIGN_PARAMETERS,
)

# Latched cycles that may wait for an identifier that comes late.
CYCLE_DEPTH = 1000


class IdentifierNode(ServedNode):
    """Fits a model at each cycle, and model and gains at the end of an experiment.

    A message only notes what is to be done. The fit follows once no message waits any more, so
    that of several cycles that came during a fit only the newest one leads to another.
    """

    def __init__(self) -> None:
        super().__init__("identifier_node")
        declare(self, PARAMETERS)
        self._cycles: dict[int, Any] = {}
        self._cycles_of = ""
        self._ended = ""
        # The method li takes the last two experiments together.
        self._earlier: Record | None = None
        self._fit_asked_for = False
        self._progress: Any = None
        self._running, self._running_fit = "", RunningFit()
        self._signs = SignsOfLife(self)
        self._models = self.create_publisher(TransferFunction, "transfer_function", quality.RESULT)
        self._gains = self.create_publisher(PidGains, "pi_gains", quality.RESULT)
        self.create_subscription(
            RelayCycle, "relay_cycle", self._on_cycle, quality.latched(CYCLE_DEPTH)
        )
        self.create_subscription(
            RelayExperiment, "relay_experiment", self._on_experiment, quality.latched(10)
        )
        self.create_subscription(
            RelayExperiment, "relay_progress", self._on_progress, quality.RESULT
        )
        self.create_service(Identify, "~/identify", self._on_identify)
        self.add_on_set_parameters_callback(self._on_set)
        self.get_logger().info(
            f"ready: waiting for {self.resolve_topic_name('relay_experiment')}; model and gains "
            f"go to {self._models.topic_name} and {self._gains.topic_name}"
        )

    def _on_cycle(self, message: Any) -> None:
        if message.experiment_id in (self._ended, self._running):
            # It has ended, or its progress tells more than its cycles.
            return
        if message.experiment_id != self._cycles_of:
            self._cycles_of = message.experiment_id
            self._cycles.clear()
        self._cycles[int(message.index)] = message
        if not self._fit_asked_for:
            self._fit_asked_for = True
            self.defer_until_idle(self._fit_cycles)

    def _on_progress(self, message: Any) -> None:
        """Take an experiment that is under way, to be fitted once nothing else waits."""
        if message.experiment_id == self._ended:
            return
        if message.experiment_id != self._running:
            self._running, self._running_fit = message.experiment_id, RunningFit()
        waiting, self._progress = self._progress, message
        if waiting is None:
            self.defer_until_idle(self._fit_progress)

    def _fit_progress(self) -> None:
        message, self._progress = self._progress, None
        if message is None or message.experiment_id == self._ended:
            return
        try:
            record = record_from_message(message)
        except RelayAutotuneError as error:
            self.get_logger().warning(f"progress of {message.experiment_id}: {error}")
            return
        analysis = self._guarded(
            record,
            partial(self._running_fit.fit, record, self._task(), *_sought(message)),
        )
        if analysis is not None and analysis.model is not None:
            self._publish_model(analysis, final=False)

    def _fit_cycles(self) -> None:
        self._fit_asked_for = False
        if not self._cycles:
            return
        try:
            record = record_from_cycles(self._cycles.values())
        except RelayAutotuneError as error:
            self.get_logger().warning(f"cycles of {self._cycles_of} cannot be used: {error}")
            return
        analysis = self._analyse(record, final=False)
        if analysis is not None and analysis.model is not None:
            self._publish_model(analysis, final=False)

    def _on_experiment(self, message: Any) -> None:
        self._ended = message.experiment_id
        self._cycles.clear()
        with self._signs.working_on(self._ended):
            lacking = self._identify_whole(message)
        self._signs.done(self._ended, lacking)

    def _identify_whole(self, message: Any) -> str:
        """Publish model and gains of an experiment; return why one of them does not come."""
        try:
            record = record_from_message(message)
        except RelayAutotuneError as error:
            self.get_logger().error(f"experiment {self._ended} cannot be used: {error}")
            return f"the experiment cannot be used: {error}"
        analysis = self._analyse(record, final=True)
        if analysis is None:
            return "the experiment could not be analysed; the log of identifier_node says why"
        if analysis.model is not None:
            self._publish_model(analysis, final=True)
        gains = analysis.best_gains
        if gains is None:
            self.get_logger().warning(f"experiment {self._ended}: {analysis.reason}")
            return analysis.reason
        message = PidGains()
        fill_gains(
            message, gains, experiment_id=record.experiment_id, stamp_ns=_last_stamp(record)
        )
        self._gains.publish(message)
        self.get_logger().info(
            f"experiment {self._ended}: {gains.rule} (form {gains.form}) kc {gains.kc:.6g}, "
            f"ti {gains.ti:.6g} s, td {gains.td:.6g} s"
        )
        return ""

    def _on_identify(self, request: Any, response: Any) -> Any:
        """Answer with every method's model and every rule's gains for a record."""
        values = values_of(self, PARAMETERS)
        try:
            record = record_from_message(request.experiment)
            found = analyse(
                record,
                method=request.method or values["method"],
                rule=request.rule or values["rule"],
                known=known_from(values),
                options=options_from(values),
            )
        except Exception as error:  # noqa: BLE001  one bad record must not end the node
            response.reason = str(error) or type(error).__name__
            return response
        name, stamp = record.experiment_id, _last_stamp(record)
        response.success, response.reason = found.model is not None, found.reason
        for identification in found.models:
            message = TransferFunction()
            fill_transfer_function(
                message, identification, experiment_id=name, final=True, stamp_ns=stamp
            )
            response.models.append(message)
        for gains in found.gains:
            message = PidGains()
            fill_gains(message, gains, experiment_id=name, stamp_ns=stamp)
            response.gains.append(message)
        response.selected = found.selected or 0
        response.recommended = found.recommended or 0
        return response

    def _task(self) -> Task:
        values = values_of(self, PARAMETERS)
        return Task(values["method"], values["rule"], known_from(values), options_from(values))

    def _analyse(self, record: Record, *, final: bool) -> Analysis | None:
        earlier = self._earlier
        if final and record.outcome == Outcome.COMPLETED:
            self._earlier = record
        asked = vars(self._task())
        if final and asked["method"] in ONLY_JOINT and earlier is not None:
            return self._guarded(record, partial(analyse_jointly, (record, earlier), **asked))
        return self._guarded(record, partial(analyse, record, final=final, **asked))

    def _guarded(self, record: Record, analysis: Callable[[], Analysis]) -> Analysis | None:
        try:
            return analysis()
        except Exception as error:  # noqa: BLE001  one bad record must not end the node
            self.get_logger().error(
                f"experiment {record.experiment_id} could not be analysed: "
                f"{type(error).__name__}: {error}"
            )
            return None

    def _publish_model(self, analysis: Analysis, *, final: bool) -> None:
        identification = analysis.model
        assert identification is not None
        message = TransferFunction()
        fill_transfer_function(
            message,
            identification,
            experiment_id=analysis.record.experiment_id,
            final=final,
            stamp_ns=_last_stamp(analysis.record),
            finding=None if final else analysis.finding,
        )
        self._models.publish(message)
        if final:
            self.get_logger().info(
                f"experiment {self._ended}: {identification.structure} by "
                f"{identification.method}, gain {identification.model.gain:.6g}, "
                f"dead time {identification.model.dead_time:.6g} s"
            )

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            values = merged(self, PARAMETERS, changes)
            check_names(values["method"], values["rule"])
            known_from(values)
            options_from(values)
        except RelayAutotuneError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def _sought(progress: Any) -> tuple[str, float]:
    """Return what ends an experiment, and how narrow its interval has to be."""
    return progress.sought or ULTIMATE_GAIN, progress.sought_width


def _last_stamp(record: Record) -> int:
    return start_nanoseconds(record.start) + math.floor(float(record.time[-1]) * 1e9 + 0.5)


def main(args: list[str] | None = None) -> int:
    """Run identifier_node."""
    return run(IdentifierNode, "identifier_node", args, PARAMETERS)
