# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""identifier_node: models and gains from the cycles and records of relay_node."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.task import Future

from relay_autotune.analysis import (
    PARAMETERS,
    RunningFit,
    Task,
    analyse,
    analyse_jointly,
    model_so_far,
    task_from,
)
from relay_autotune.errors import RelayAutotuneError, defect
from relay_autotune.exchange.messages import (
    fill_gains,
    fill_reason,
    fill_transfer_function,
    record_from_cycles,
    record_from_message,
    start_nanoseconds,
)
from relay_autotune.expected_time import expected_time
from relay_autotune.experiment.early_end import ULTIMATE_GAIN, FitProgress
from relay_autotune.identification.methods import ONLY_JOINT
from relay_autotune.identification.result import Identification
from relay_autotune.loop.gains import Gains
from relay_autotune.nodes import quality
from relay_autotune.nodes.lifetime import ServedNode, run
from relay_autotune.nodes.parameters import ask_before_changes, declare, merged, values_of
from relay_autotune.nodes.results import Refusals, SignsOfLife
from relay_autotune.reasons import Code, Reason, other, reason_of
from relay_autotune.record.record import Outcome, Record
from relay_autotune.result import Analysis
from relay_autotune.verdict import Judgement
from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment, TransferFunction
from relay_autotune_msgs.srv import Identify

# Depth of the subscription, for latched cycles from before the identifier started.
CYCLE_DEPTH = 1000


# Largest number of waiting requests of ~/identify; each takes seconds.
_MOST_WAITING = 10


# A computation in another thread, which must not touch the node, and the callback of the node's
# executor for what it returned or raised.
_Fit = tuple[Callable[[], Analysis], Callable[[Any], None]]


class IdentifierNode(ServedNode):
    """Fit a model at each cycle, and model and gains at the end of an experiment.

    A message only adds work to a queue. One fit at a time runs in another thread: whole records
    first, in order of arrival, then the running experiment. A fit starts only when no message
    waits. So when several cycles arrive during a fit, only the newest one is fitted next.
    """

    def __init__(self) -> None:
        super().__init__("identifier_node")
        declare(self, PARAMETERS)
        self._cycles: dict[int, Any] = {}
        self._cycles_of = ""
        self._ended = ""
        # The method li takes the last two experiments together.
        self._earlier: Record | None = None
        self._waiting: deque[_Fit] = deque()
        # From the wish for a fit until nothing is left to be fitted.
        self._is_busy = False
        self._cycles_are_new = False
        self._progress: Any = None
        self._running, self._running_fit = "", RunningFit()
        self._refusals = Refusals(self)
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
        ask_before_changes(self, lambda given: task_from(merged(self, PARAMETERS, given)))
        self.get_logger().info(
            f"ready: waiting for {self.resolve_topic_name('relay_experiment')}; model and gains "
            f"go to {self._models.topic_name} and {self._gains.topic_name}"
        )

    # Input.

    def _on_cycle(self, message: Any) -> None:
        if message.experiment_id in (self._ended, self._running):
            # The experiment has ended, or its progress messages say more than its cycles.
            return
        if message.experiment_id != self._cycles_of:
            self._cycles_of = message.experiment_id
            self._cycles.clear()
        self._cycles[int(message.index)] = message
        while len(self._cycles) > CYCLE_DEPTH:
            self._cycles.pop(next(iter(self._cycles)))
        self._cycles_are_new = True
        self._look()

    def _on_progress(self, message: Any) -> None:
        """Note a running experiment; it is fitted once nothing else waits."""
        if message.experiment_id == self._ended:
            return
        if message.experiment_id != self._running:
            self._running, self._running_fit = message.experiment_id, RunningFit()
        self._progress = message
        self._look()

    def _on_experiment(self, message: Any) -> None:
        name = self._ended = message.experiment_id
        self._cycles.clear()
        try:
            record = record_from_message(message)
        except RelayAutotuneError as error:
            self._refusals.say("the record", name, error)
            self._signs.done(name, f"the experiment cannot be used: {error}")
            return
        self._signs.work_on(name)
        self._wait_for(self._whole(record), partial(self._identified, name))

    async def _on_identify(self, request: Any, response: Any) -> Any:
        """Answer with every method's model and every rule's gains for a record."""
        values = values_of(self, PARAMETERS)
        if len(self._waiting) >= _MOST_WAITING:
            return _answered(response, Code.QUEUE_FULL(waiting=_MOST_WAITING))
        try:
            record = record_from_message(request.experiment)
            values["method"] = request.method or values["method"]
            values["rule"] = request.rule or values["rule"]
            work = partial(analyse, record, **vars(task_from(values)))
        except RelayAutotuneError as error:
            return _answered(response, reason_of(error))
        done: Future = Future(executor=self.executor)
        self._wait_for(work, done.set_result)
        found = await done
        if isinstance(found, Exception):
            known = isinstance(found, RelayAutotuneError)
            return _answered(
                response,
                reason_of(found) if known else Code.NOT_ANALYSED(why=defect(found)),
            )
        response.success = found.model is not None
        _answered(response, other(found.reason))
        # Only the selected model was judged, and the recommended gains: the first ones.
        for number, identification in enumerate(found.models):
            judgement = None if number else found.judgement
            response.models.append(_model_message(record, identification, judgement))
        for number, gains in enumerate(found.gains):
            judgement = None if number else found.judgement
            response.gains.append(_gains_message(record, gains, judgement))
        response.selected = response.recommended = 0
        return response

    # One fit at a time.

    def _wait_for(self, work: Callable[[], Analysis], taken: Callable[[Any], None]) -> None:
        self._waiting.append((work, taken))
        self._look()

    def _look(self) -> None:
        """Start a fit once no message waits, unless one is running."""
        if not self._is_busy:
            self._is_busy = True
            self.defer_until_idle(self._begin)

    def _begin(self) -> None:
        fit = self._waiting.popleft() if self._waiting else self._of_running()
        if fit is None:
            self._is_busy = False
            return
        work, take = fit

        def taken(found: Any) -> None:
            self._is_busy = False
            try:
                take(found)
            finally:
                self._look()
                self.tidy_when_idle()

        self.compute(work, taken)

    def _of_running(self) -> _Fit | None:
        """Return the fit of the running experiment, None if there is nothing new."""
        progress, self._progress = self._progress, None
        fit: _Fit | None = None
        if progress is not None and progress.experiment_id != self._ended:
            with self._refusals.saying("the progress", progress.experiment_id):
                record = record_from_message(progress)
                # The quantity whose interval ends the experiment, and the wanted width.
                sought = progress.sought or ULTIMATE_GAIN, progress.sought_width
                work = partial(self._running_fit.fit, record, self._task(), *sought)
                fit = work, partial(self._fitted, record.experiment_id)
        elif self._cycles_are_new and self._cycles:
            self._cycles_are_new = False
            with self._refusals.saying("the cycles", self._cycles_of):
                record = record_from_cycles(self._cycles.values())
                work = partial(model_so_far, record, self._task())
                fit = work, partial(self._fitted, record.experiment_id)
        return fit

    def _whole(self, record: Record) -> Callable[[], Analysis]:
        """Return the function that analyses the record of a finished experiment."""
        earlier, asked = self._earlier, vars(self._task())
        if record.outcome == Outcome.COMPLETED:
            self._earlier = record
        if asked["method"] in ONLY_JOINT and earlier is not None:
            return partial(analyse_jointly, (record, earlier), **asked)
        # Those who wait for the gains need none of the other rules'.
        about = max(expected_time(len(record), alone=True), 1.0)

        def tell(stage: str) -> None:
            self._signs.at(f"{stage}, about {about:.0f} s in all")

        return partial(analyse, record, **asked, tell=tell, alone=True)

    # Output.

    def _fitted(self, name: str, found: Any) -> None:
        """Publish the model of a running experiment, unless it has ended meanwhile."""
        analysis = self._analysis(name, found)
        if name != self._ended and analysis is not None and analysis.model is not None:
            self._publish_model(analysis, final=False)

    def _identified(self, name: str, found: Any) -> None:
        """Publish model and gains of an experiment, and the reason if one is missing."""
        self._signs.done(name, self._published(name, self._analysis(name, found)))

    def _published(self, name: str, analysis: Analysis | None) -> str:
        if analysis is None:
            return "the experiment could not be analysed; the log of identifier_node says why"
        if analysis.model is not None:
            self._publish_model(analysis, final=True)
        gains, record = analysis.best_gains, analysis.record
        if gains is None:
            self.get_logger().warning(f"experiment {name}: {analysis.reason}")
            return analysis.reason
        self._gains.publish(_gains_message(record, gains, analysis.judgement))
        self.get_logger().info(
            f"experiment {name}: {gains.rule} (form {gains.form}) kc {gains.kc:.6g}, "
            f"ti {gains.ti:.6g} s, td {gains.td:.6g} s, {analysis.verdict.name.lower()}"
        )
        if analysis.judgement.reason:
            self.get_logger().warning(f"experiment {name}: {analysis.judgement.reason}")
        return ""

    def _analysis(self, name: str, found: Any) -> Analysis | None:
        # One bad record must not end the node.
        if isinstance(found, Analysis):
            return found
        self.get_logger().error(f"experiment {name} could not be analysed: {defect(found)}")
        return None

    def _task(self) -> Task:
        return task_from(values_of(self, PARAMETERS))

    def _publish_model(self, analysis: Analysis, *, final: bool) -> None:
        identification, finding = analysis.model, None if final else analysis.finding
        assert identification is not None
        message = _model_message(analysis.record, identification, analysis.judgement, finding)
        self._models.publish(message)
        if final:
            self.get_logger().info(
                f"experiment {analysis.record.experiment_id}: {identification.structure} by "
                f"{identification.method}, gain {identification.model.gain:.6g}, "
                f"dead time {identification.model.dead_time:.6g} s"
            )


def _answered(response: Any, why: Reason) -> Any:
    """Return an answer with its reason."""
    response.reason = str(why)
    fill_reason(response.why, why)
    return response


def _model_message(
    record: Record,
    found: Identification,
    judgement: Judgement | None,
    finding: FitProgress | None = None,
) -> TransferFunction:
    """Return the message of a model; with a finding, of an experiment that still runs."""
    message = TransferFunction()
    fill_transfer_function(
        message,
        found,
        experiment_id=record.experiment_id,
        final=finding is None,
        stamp_ns=_last_stamp(record),
        finding=finding,
        judgement=judgement,
    )
    return message


def _gains_message(record: Record, gains: Gains, judgement: Judgement | None) -> PidGains:
    message, stamp = PidGains(), _last_stamp(record)
    fill_gains(
        message, gains, experiment_id=record.experiment_id, stamp_ns=stamp, judgement=judgement
    )
    return message


def _last_stamp(record: Record) -> int:
    return start_nanoseconds(record.start) + math.floor(float(record.time[-1]) * 1e9 + 0.5)


def main(args: list[str] | None = None) -> int:
    """Run identifier_node."""
    return run(IdentifierNode, "identifier_node", args, PARAMETERS)
