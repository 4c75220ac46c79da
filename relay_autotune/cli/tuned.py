# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A tune that has ended, and the step of the set-point that proves its gains.

This module is loaded after the tune, since that takes long.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.apply_gains import Entries, found_entries
from relay_autotune.cli.arguments import exit_status
from relay_autotune.cli.loops import PATIENCE
from relay_autotune.cli.own_nodes import START_WITHIN
from relay_autotune.cli.settings import SETTING
from relay_autotune.cli.terminal import UNITS, WIDEST, Working
from relay_autotune.cli.tune_view import Paint, result_lines
from relay_autotune.control.controller import Control, PredictedLoop
from relay_autotune.control.step_choice import StepChoice, StepRange
from relay_autotune.control.verification import RUNAWAY, SETTLES, noise_of
from relay_autotune.errors import TuningError
from relay_autotune.exchange.messages import (
    gains_from_message,
    transfer_function_from_message,
    why_doubtful,
)
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes.gains_client import GainsClient
from relay_autotune.nodes.shell import ros_arguments
from relay_autotune.nodes.tables import parameters_of_law, rate_of
from relay_autotune.record.record import Record
from relay_autotune.text import digits, duration
from relay_autotune.verdict import Verdict

if TYPE_CHECKING:
    from relay_autotune.cli.loops import Loop
    from relay_autotune.result import Analysis

CONTROLLER = "controller_node"
# A loop may take this many settling times to come to rest, and at least a time [s].
_TIMES_SETTLING, _REST_WITHIN = 5.0, 60.0


@dataclass
class Tuned:
    """A tune that has ended.

    :param loop: that was tuned.
    """

    loop: Loop

    def __post_init__(self) -> None:
        self.client, self.options = self.loop.client, self.loop.options

    @cached_property
    def result(self) -> Any:
        """The `Tune.Result`."""
        return self.client.result

    @property
    def is_started(self) -> bool:
        """Whether it was more than a refusal."""
        return bool(self.result.experiment.experiment_id)

    @property
    def has_gains(self) -> bool:
        """Whether it has found gains."""
        return bool(self.result.gains.experiment_id)

    @cached_property
    def gains(self) -> Gains:
        """The gains of the tune, which are there."""
        return gains_from_message(self.result.gains)

    @property
    def doubt(self) -> str:
        """Why the gains are doubtful; empty: they are trusted."""
        return why_doubtful(self.result)

    @cached_property
    def left(self) -> str:
        """How the plant is left by a tune that was not completed; empty: it was."""
        ended = self.result.outcome == self.result.COMPLETED and not self.client.cancelled
        return "" if ended else self.loop.left() or "the plant is left at the safe command"

    def lines(self, paint: Paint, columns: int = WIDEST) -> list[str]:
        """Return the result as lines.

        :param paint: the look of text.
        :param columns: that a line may have.
        """
        return result_lines(self.result, self.client.cancelled, paint, columns, self.left)

    @property
    def is_complete(self) -> bool:
        """Whether it has given what was asked for."""
        return self.client.succeeded and (self.has_gains or self.options.record_only)

    def status(self, *, found: bool = True) -> int:
        """Return the exit status.

        :param found: whether there is what was asked for besides.
        """
        doubtful = self.result.verdict == Verdict.DOUBTFUL
        return exit_status(found=found and self.is_complete, doubtful=doubtful)

    @cached_property
    def record(self) -> Record:
        """Its samples, which relay_node keeps for a while."""
        return replace(self.client.record(PATIENCE), units=dict(UNITS))

    @cached_property
    def asked_there(self) -> dict[str, Any] | None:
        """The parameters of identifier_node by name; None: they are not known."""
        if self.options.record_only:
            return None
        with Working("asking identifier_node for its parameters"):
            return self.client.identifier_values(PATIENCE)

    @property
    def values(self) -> dict[str, Any]:
        """The parameters of the analysis by name: those of identifier_node, else the defaults."""
        # Imported here, because it loads slowly.
        from relay_autotune.analysis import PARAMETERS

        return self.asked_there or {entry.name: entry.default for entry in PARAMETERS}

    def analysed(
        self, tell: Callable[[str], None] = lambda _: None, *, alone: bool = False, **changed: Any
    ) -> Analysis:
        """Identify and tune as identifier_node does; once its parameters are known, in any thread.

        :param tell: called with what begins.
        :param alone: True: without the other methods and rules, which take most of the time.
        :param changed: other values of parameters by name.
        """
        from relay_autotune.analysis import analyse, task_from

        task = task_from(self.values | changed)
        return analyse(self.record, **vars(task), tell=tell, alone=alone)


class Proof:
    """A step of the set-point that is to prove gains for a loop that has been tuned.

    :param tune: that has ended with gains.
    :param message: the `PidGains`; None: those of the tune.
    :raises RelayAutotuneError: if there is no such step.
    """

    def __init__(self, tune: Tuned, message: Any = None) -> None:
        result, record, options = tune.result, tune.record, tune.options
        self._loop, self._message = tune.loop, message or result.gains
        self._gains = gains = gains_from_message(self._message)
        assert record.settings is not None, "gains come of a whole experiment"
        self._rest = rest = record.settings
        # Without limits the process has seen the levels of the relay.
        self._commands = options.command_within or (rest.low, rest.high)
        limits = Limits(*options.within), Limits(*self._commands)
        noise_std = noise_of(record.noise_std, result.transfer_function.residual_rms)
        model = transfer_function_from_message(result.transfer_function)
        self.rate = rate_of(gains.law, gains.law_period)
        predicted = PredictedLoop(Control(gains, self.rate), model)
        self._choice = choice = StepChoice(record, predicted, *limits, noise_std)
        if not (step := options.step or choice.best):
            raise TuningError("the limits leave no room for a step: widen --within")
        self.step: float = options.step or choice.allowed.nearest(step)
        self.allowed: StepRange = choice.allowed
        """The steps that the limits of the tune allow."""
        self.allowed.require(self.step)
        self._takes = choice.lasts + (SETTLES + 1.0) * choice.settles

    def plan(self, step: float) -> tuple[tuple[str, str], ...]:
        """Return what will move, how far and how long, in sentences with a name for each.

        :param step: of the set-point [y].
        :raises TuningError: if it is not allowed.
        """
        self.allowed.require(step)
        options, rest = self._loop.options, self._rest
        (low, high), (least, most) = options.within, self._commands
        runs = ""
        if self.rate is not None:
            runs = f", which runs {self.rate.law.name} every {self.rate.period:g} s,"
        moves = (
            f"A controller_node of this command{runs} takes the loop at "
            f"{rest.setpoint:.6g} y and {rest.baseline:.6g} u, moves the set-point of "
            f"{options.measurement} by {step:+g} y and back, and ends at "
            f"{rest.baseline:.6g} u after about {duration(self._takes)}."
        )
        expected = (
            f"{options.command} is expected {self._choice.expected(step)}, never beyond "
            f"{least:g} to {most:g} u."
        )
        fails = (
            f"If it fails, or {options.measurement} leaves {low:g} to {high:g} y or moves "
            f"{RUNAWAY:g} times as far as predicted, it ends there: {options.command} goes to "
            f"{rest.baseline:.6g} u."
        )
        return ("moves", moves), ("expected", expected), ("if it fails", fails)

    @contextmanager
    def _started(self, doubtful: bool) -> Iterator[GainsClient]:
        """Start a controller_node in front of relay_node, and end it with the block.

        :param doubtful: whether the gains are.
        """
        loop, rest, gains = self._loop, self._rest, self._gains
        # The journal of proven and failed gains is that of this controller_node alone.
        with (
            tempfile.TemporaryDirectory() as journal,
            GainsClient("", f"{loop.space}/{CONTROLLER}", beside=loop.client) as found,
        ):
            values = {
                **loop.target.parameters,
                "initial_setpoint": rest.setpoint,
                "initial_command": rest.baseline,
                "safe_command": rest.baseline,
                **SETTING["within"].values(loop.options.within),
                **SETTING["command_within"].values(self._commands),
                "accept_doubtful": str(doubtful).lower(),
                "record_directory": journal,
                **parameters_of_law(gains.law, gains.law_period),
            }
            # identifier_node's own gains, which may come late, are not the ones to be proven.
            topics = {
                "measurement": loop.options.measurement,
                # It ends the proof where another node commands, too.
                "command": loop.options.command,
                "pi_gains": f"{loop.space}/gains_of_{CONTROLLER}",
            }
            loop.nodes.start(CONTROLLER, ros_arguments(loop.space, topics, values))
            try:
                yield found
            finally:
                loop.nodes.end(CONTROLLER)

    def made(
        self, step: float, doubtful: bool, tell: Callable[[str], None], leave: Callable[[], bool]
    ) -> tuple[Any, Entries, list[Any]]:
        """Put the gains in force, make the step, and go back.

        :param step: of the set-point [y].
        :param doubtful: whether the gains are.
        :param tell: called with what is waited for.
        :param leave: returns True to end the step.
        :return: the `Verify.Result`; what it has found, of which gains and when; and its steps
            with their samples.
        :raises LoopError: with the reason, if there is no verdict.
        """
        patience = max(_TIMES_SETTLING * self._choice.settles, _REST_WITHIN)
        with self._started(doubtful) as controller:
            tell(f"starting {CONTROLLER}")
            controller.find(START_WITHIN, leave)
            found = controller.prove(step, 0.0, patience, tell, leave, self._message)
            if found.verdict == found.PASSED:
                # Without gains it would hold its command, wherever that is.
                controller.let_settle(self._choice.settles, tell, leave)
            steps = controller.steps_of(found)
        which = f"{gains_words(self._gains)}, at {time.strftime('%H:%M')}"
        return found, (("gains", which), *found_entries(found)), steps


def gains_words(gains: Controller | None) -> str:
    """Return gains in words."""
    if gains is None:
        return "no gains; its command is held"
    words = f"kc {digits(gains.kc)} u/y, ti {digits(gains.ti)} s, td {digits(gains.td)} s"
    if isinstance(gains, Gains) and gains.law:
        # Under another law the same numbers are other gains.
        words += f", {gains.law} every {gains.law_period:g} s"
    return words
