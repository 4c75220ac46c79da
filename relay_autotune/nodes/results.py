# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Results from topics: records, models and gains, checked; and whether identifier_node lives.

Any node of the network can publish them. Here each message becomes a checked object of the core
and is compared with the known facts of its experiment, before it has any effect.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node

from relay_autotune.errors import ModelError, RelayAutotuneError, TuningError

# Loaded now, though it is needed only for the first model: that comes in a tune, and loading takes
# most of a second, in which no measurement would be answered.
from relay_autotune.exchange import models  # noqa: F401
from relay_autotune.exchange.evidence import ExperimentFacts, check_finding
from relay_autotune.exchange.messages import (
    finding_from_message,
    gains_from_message,
    record_from_message,
    transfer_function_from_message,
    why_doubtful,
)
from relay_autotune.loop.gains import Gains
from relay_autotune.nodes import quality
from relay_autotune.nodes.lifetime import STEADY
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome

if TYPE_CHECKING:
    from relay_autotune.nodes.session import Session

SIGNS_OF_LIFE = "identifier_status"
# Interval of the signs of life during a computation [s].
EVERY = 1.0

_EXPERIMENT, _STATE = "experiment", "state"
_WORKING, _DONE = "working", "done"


class SignsOfLife:
    """Publish which experiments are in work.

    :param node: identifier_node.
    """

    def __init__(self, node: Node) -> None:
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._publisher = quality.publisher(node, DiagnosticStatus, SIGNS_OF_LIFE, quality.RESULT)
        self._working: list[str] = []
        self._stage = _WORKING
        self._timer = node.create_timer(EVERY, self._tell, clock=STEADY, autostart=False)

    def work_on(self, experiment_id: str) -> None:
        """Give signs of life until the work is done.

        :param experiment_id: the experiment in work.
        """
        self._working.append(experiment_id)
        self._publish(experiment_id, _WORKING, "")
        self._timer.reset()

    def at(self, stage: str) -> None:
        """Note what the work is at; any thread may call it.

        :param stage: such as ``comparing structures``.
        """
        self._stage = stage

    def _tell(self) -> None:
        for experiment_id in self._working:
            self._publish(experiment_id, _WORKING, "")

    def done(self, experiment_id: str, lacking: str) -> None:
        """Publish that all results of an experiment are out.

        :param experiment_id: its id.
        :param lacking: why model or gains are missing; empty: both were published.
        """
        if experiment_id in self._working:
            self._working.remove(experiment_id)
        if not self._working:
            self._timer.cancel()
        self._publish(experiment_id, _DONE, lacking)

    def _publish(self, experiment_id: str, state: str, reason: str) -> None:
        values = {_EXPERIMENT: experiment_id, _STATE: state}
        self._publisher.publish(
            DiagnosticStatus(
                level=DiagnosticStatus.WARN if reason else DiagnosticStatus.OK,
                name=self._name,
                message=reason or (self._stage if state == _WORKING else state),
                values=[KeyValue(key=key, value=value) for key, value in values.items()],
            )
        )


def said_by(message: Any) -> tuple[str, bool, str]:
    """Return experiment id, whether it is still in work, and a text.

    That is what the work is at, or after it why results are missing; empty: neither is known.

    :param message: the `DiagnosticStatus`.
    """
    values = {pair.key: pair.value for pair in message.values}
    working = values.get(_STATE) == _WORKING
    has_text = message.message != _WORKING if working else message.level != DiagnosticStatus.OK
    return values.get(_EXPERIMENT, ""), working, message.message if has_text else ""


# Limits on remembered experiments and logged reasons, since a node may send any number.
_MOST = 8
_MOST_REASONS = 50
MODEL = "transfer_function"
_TOO_SOON = "the experiment still runs, so that nothing final can be said of it"
_NUMBER = re.compile(r"[-+]?(?:\d[\d.]*(?:e[-+]?\d+)?|\binf\b|\bnan\b)", re.IGNORECASE)


class Refusals:
    """Log why something is refused, once for each cause.

    :param node: the node whose log is used.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._said: set[str] = set()
        self.last = ""
        """The last refusal as a sentence, whether it was logged or not."""

    @contextmanager
    def saying(self, what: str, experiment_id: str) -> Iterator[None]:
        """Log what is refused in the block, which ends there; see :meth:`say`."""
        try:
            yield
        except RelayAutotuneError as error:
            self.say(what, experiment_id, error)

    def say(self, what: str, experiment_id: str, error: RelayAutotuneError) -> None:
        """Log a refusal, unless this cause was logged before.

        :param what: the refused thing, such as ``gains``.
        :param experiment_id: its experiment, according to the message.
        :param error: the reason.
        """
        sentence = f"{what} of {experiment_id or 'an experiment without id'} refused: {error}"
        self.last = sentence
        # The same fault with other numbers is the same cause.
        cause = f"{what}: {_NUMBER.sub('#', str(error))}"
        if cause in self._said or len(self._said) > _MOST_REASONS:
            return
        self._said.add(cause)
        last = "" if len(self._said) <= _MOST_REASONS else "; further reasons are not logged"
        self._node.get_logger().error(
            f"{sentence} (others refused for the same reason are not logged){last}"
        )


class ResultCheck:
    """Judge models and gains by the records of their experiments.

    :param node: the node that logs refusals.
    :param is_stable: returns whether gains make a stable loop with a model; None: no such check,
        because the modules for it load slowly.
    """

    def __init__(
        self, node: Node, is_stable: Callable[[Gains, TransferFunction], bool] | None = None
    ) -> None:
        self.refusals = Refusals(node)
        self._is_stable = is_stable
        self._evidence: dict[str, ExperimentFacts] = {}
        self.models: dict[str, tuple[TransferFunction, str]] = {}
        """The final models by experiment, the newest last, each with the reason to doubt it."""

    def experiment(self, message: Any) -> None:
        """Remember the facts of an experiment's record, if the message holds a valid one.

        A later record with the same id changes nothing.

        :param message: the `RelayExperiment`.
        """
        with self.refusals.saying("the record", message.experiment_id):
            record = record_from_message(message)
            if record.experiment_id not in self._evidence:
                keep(self._evidence, record.experiment_id, ExperimentFacts.of(record))

    def model(self, message: Any) -> TransferFunction | None:
        """Return the model in a message, None if it is refused.

        :param message: the `TransferFunction`.
        """
        name = message.experiment_id
        try:
            model = transfer_function_from_message(message)
            if name in self._evidence:
                self._evidence[name].check_model(model)
        except RelayAutotuneError as error:
            self.refusals.say("the model", name, error)
            return None
        if message.final:
            keep(self.models, name, (model, why_doubtful(message)))
        return model

    def gains(self, message: Any) -> Gains:
        """Return the gains in a message.

        Gains of an unknown experiment without a model are accepted, because a user who applies
        them by hand may know more. :meth:`doubt` reports them.

        :param message: the `PidGains`.
        :raises RelayAutotuneError: if they are refused.
        """
        gains = gains_from_message(message)
        self.check(message.experiment_id, gains)
        return gains

    def doubt(self, experiment_id: str, gains: Gains) -> str:
        """Return why gains must not be applied automatically; "" if they may.

        :param experiment_id: their experiment, according to the message.
        :param gains: as :meth:`gains` returned them.
        """
        if experiment_id not in self._evidence:
            return "no record of their experiment has come"
        if experiment_id not in self.models:
            return "no model of their experiment has come"
        try:
            self.check(experiment_id, gains)
        except RelayAutotuneError as error:
            return str(error)
        return ""

    def check(self, experiment_id: str, gains: Gains) -> None:
        """Refuse gains that contradict the known facts of their experiment.

        :param experiment_id: their experiment, according to the message.
        :param gains: the gains.
        :raises TuningError: if they contradict them, or the experiment was not completed.
        """
        evidence = self._evidence.get(experiment_id)
        if evidence is None:
            return
        evidence.require_completed()
        if experiment_id not in self.models:
            return
        model, _ = self.models[experiment_id]
        try:
            # The model may have come before the record did.
            evidence.check_model(model)
        except ModelError as error:
            raise TuningError(f"their model is refused: {error}") from error
        evidence.check_gains(gains, model)
        if self._is_stable is not None and not self._is_stable(gains, model):
            raise TuningError(f"{gains} makes an unstable loop with the model of the experiment")


class OwnResults(ResultCheck):
    """Accept results of this node's own experiments only.

    :param node: relay_node.
    :param on_setpoint: True if its relay moves a set-point, so that levels and sign of the relay
        are not those of the command.
    """

    def __init__(self, node: Node, *, on_setpoint: bool) -> None:
        super().__init__(node)
        self._on_setpoint = on_setpoint
        # Gains that arrived before their model.
        self._early: tuple[str, Any] | None = None
        # Of the running experiment: its id and number of switches, its facts, its swing [y].
        self._so_far = ("", 0), ExperimentFacts(Outcome.UNKNOWN, 0.0), math.nan

    def take(self, name: str, message: Any, running: Session | None) -> list[tuple[str, Any]]:
        """Return the messages that may be stored, each with the name of its topic.

        :param name: the message's topic, ``transfer_function`` or ``pi_gains``.
        :param message: the message.
        :param running: the session of its experiment, if that still runs.
        """
        of = message.experiment_id
        found: list[tuple[str, Any]] = []
        with self.refusals.saying("the model" if name == MODEL else "gains", of):
            if running is not None:
                self._require_possible(name, message, running)
            if name == MODEL:
                if self.model(message) is not None:
                    found.append((name, message))
                    if (early := self._early) is not None and message.final:
                        self._early = None
                        found += self.take(*early, running)
            elif message.final and of in self._evidence and of not in self.models:
                self._early = name, message
            else:
                self.gains(message)
                found.append((name, message))
        return found

    def _require_possible(self, name: str, message: Any, running: Session) -> None:
        """Refuse what cannot be said of an experiment that still runs."""
        if name != MODEL or message.final:
            raise TuningError(_TOO_SOON)
        experiment = running.experiment
        sign, amplitude, relay = experiment.facts.sign, math.nan, math.nan
        cycles, settings = experiment.cycles, experiment.settings
        facts, swing = self._facts_so_far(running)
        if self._on_setpoint:
            sign = 0
        elif settings is not None:
            amplitude = cycles[-1].amplitude if cycles else 0.5 * swing
            relay = settings.amplitude
        found = finding_from_message(message)
        check_finding(found, sign=sign, amplitude=amplitude, relay=relay)
        facts.check_model(transfer_function_from_message(message))

    def _facts_so_far(self, running: Session) -> tuple[ExperimentFacts, float]:
        """Return what is known of a running experiment, and its swing [y].

        :raises RecordError: if it has no sample yet.
        """
        # Anybody may send any number of models, and a long record takes time.
        of = running.id, running.experiment.switches
        if of != self._so_far[0]:
            record = running.record()
            # An oscillation that has just begun tells the size of the response, not its phase.
            facts = replace(ExperimentFacts.of(record), whole=False)
            self._so_far = of, facts, float(np.ptp(record.measurement))
        return self._so_far[1:]


def keep(known: dict[Any, Any], name: Any, value: Any) -> None:
    """Put a value last among a limited number of them; the oldest ones go."""
    known.pop(name, None)
    known[name] = value
    while len(known) > _MOST:
        known.pop(next(iter(known)))
