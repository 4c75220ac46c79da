# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The proof that tune_loop offers: its own controller_node makes a step with the new gains."""

from __future__ import annotations

import argparse
import math
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from relay_autotune.cli.apply_gains import found_lines
from relay_autotune.cli.arguments import say
from relay_autotune.cli.new_loop import PROGRAM, START_WITHIN
from relay_autotune.cli.own_nodes import OwnNodes, own_namespace, own_node, ros_arguments
from relay_autotune.cli.terminal import StatusLine, Working, agreed_step, labelled, width
from relay_autotune.control.verification import (
    LEAST_OF_NOISE,
    Step,
    allowed_steps,
    noise_of,
    plan,
    proving_step,
)
from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.exchange.messages import gains_from_message, transfer_function_from_message
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes.gains_client import GainsClient
from relay_autotune.nodes.tables import parameters_of_law, rate_from
from relay_autotune.nodes.tune_client import TuneClient
from relay_autotune.text import duration
from relay_autotune.verdict import Verdict

_CONTROLLER = "controller_node"
_UNFINISHED = "the proof did not end"
# How long to wait for the record of the tune [s].
_RECORD_WITHIN = 5.0
# A loop may take this many settling times to come to rest, and at least a time [s].
_TIMES_SETTLING, _REST_WITHIN = 5.0, 60.0


@dataclass(frozen=True)
class Outcome:
    """What is known of the gains in the end.

    :param passed: whether a proof has passed; None: none was wanted.
    :param against: what speaks against the gains; empty: nothing.
    """

    passed: bool | None
    against: str


class _Proof:
    """A step of the set-point that is to prove the gains of a tune.

    :param client: of the tune that has ended.
    :param nodes: the nodes of this command.
    :param options: of the command line, with all answers.
    :raises RelayAutotuneError: if there is no such step.
    """

    def __init__(self, client: TuneClient, nodes: OwnNodes, options: argparse.Namespace) -> None:
        self._client, self._nodes, self._options = client, nodes, options
        result, record = client.result, client.record(_RECORD_WITHIN)
        gains = gains_from_message(result.gains)
        model = transfer_function_from_message(result.transfer_function)
        assert record.settings is not None, "gains come of a whole experiment"
        self._rest = rest = record.settings
        self._within = Limits(*options.within)
        # Without limits the process has seen the levels of the relay.
        self._commands = Limits(*(options.command_within or (rest.low, rest.high)))
        limits = self._within, self._commands
        self._noise_std = noise = noise_of(record.noise_std, result.transfer_function.residual_rms)
        step = options.step or proving_step(record, model, *limits, noise)
        if not step:
            raise TuningError("the limits leave no room for a step: widen --within")
        self._rate = rate_from(parameters_of_law(gains.law, gains.law_period))
        wanted = plan(gains, model, Step(setpoint=step), record.mean_interval, rate=self._rate)
        peak = wanted.peak / abs(step)
        self.allowed = allowed_steps(record, model, *limits, peak, noise)
        self.step: float = options.step or self.allowed.nearest(step)
        self.allowed.require(self.step)
        # How long the loop takes to settle with the gains, and all of it [s].
        self._settles = gains.settling_time
        if not math.isfinite(self._settles):
            self._settles = wanted.duration
        self._takes = wanted.duration + 2.0 * self._settles
        # The predicted range of the command [u].
        self._expected = [self._commands.clip(rest.baseline + end) for end in wanted.command]

    def question(self, doubt: str) -> str:
        """Say what will move, how far and how long."""
        options, commands = self._options, self._commands
        rest, (least, most) = self._rest, self._expected
        runs = ""
        if self._rate is not None:
            runs = f", which runs {self._rate.law.name} every {self._rate.period:g} s,"
        told = (
            f"Prove the gains now? A controller_node of this command{runs} takes the loop at "
            f"{rest.setpoint:.6g} y and {rest.baseline:.6g} u, moves the set-point of "
            f"{options.measurement} by {self.step:+g} y and back, and ends at "
            f"{rest.baseline:.6g} u after about {duration(self._takes)}. {options.command} is "
            f"expected from {least:.3g} to {most:.3g} u, never beyond "
            f"{commands.low:g} to {commands.high:g} u. Ctrl-C ends it at once, likewise."
        )
        if abs(self.step) < LEAST_OF_NOISE * self._noise_std:
            told += (
                f" The limits allow a step of {abs(self.step) / self._noise_std:.1f} times the "
                f"noise, expected {LEAST_OF_NOISE:g}: it will prove little."
            )
        return told + (f" The gains are doubtful: {doubt}." if doubt else "")

    def made(self, step: float, doubtful: bool) -> Any:
        """Put the gains in force in a controller_node in front of relay_node, and make the step.

        :param step: of the set-point [y].
        :param doubtful: whether the gains are.
        :return: the `Verify.Result`.
        """
        name, rate = own_node(self._options, _CONTROLLER), self._rate
        kind = self._client.values(self._client.name, ["measurement_type"])["measurement_type"]
        shown = StatusLine()
        # The journal of proven and failed gains is that of this controller_node alone.
        with (
            tempfile.TemporaryDirectory() as journal,
            GainsClient("", name, beside=self._client) as loop,
        ):
            values = {
                "initial_setpoint": self._rest.setpoint,
                "initial_command": self._rest.baseline,
                "safe_command": self._rest.baseline,
                "measurement_min": self._within.low,
                "measurement_max": self._within.high,
                "command_min": self._commands.low,
                "command_max": self._commands.high,
                "verify_step_max": abs(step),
                "measurement_type": kind,
                "measurement_field": self._options.field,
                "accept_doubtful": str(doubtful).lower(),
                "record_directory": journal,
            }
            if rate is not None:
                values |= parameters_of_law(rate.law.name, rate.period)
            topics = {"measurement": self._options.measurement}
            self._nodes.start(
                _CONTROLLER, ros_arguments(own_namespace(self._options), topics, values)
            )
            try:
                with Working(f"starting {name}"):
                    loop.find(START_WITHIN)
                    self._nodes.require_alive()
                    loop.put_in_force(self._client.result.gains)
                patience = max(_TIMES_SETTLING * self._settles, _REST_WITHIN)
                with _noted(self._nodes) as leave:
                    found = loop.prove(step, 0.0, self._settles, patience, shown, leave)
                    loop.let_settle(self._settles, shown, "the loop goes back", leave)
            finally:
                shown.clear()
            print("\n" + "\n".join(found_lines(found, width(), self._noise_std)), flush=True)
            if rate is not None:
                told = (
                    f"controller_node ran {rate.law.name} every {rate.period:g} s; what "
                    f"your program does at a limit of the command was not tried"
                )
                print("\n".join(labelled("law", told, width())), flush=True)
            return found


def prove(client: TuneClient, nodes: OwnNodes, options: argparse.Namespace) -> Outcome:
    """Offer to prove the gains of a tune; return what is known of them.

    However it ends, the command is then that at which the process rested before the tune.

    :param client: of the tune that has ended.
    :param nodes: the nodes of this command.
    :param options: of the command line, with all answers.
    """
    against = _UNFINISHED
    try:
        try:
            outcome = _offered(client, nodes, options)
        except RelayAutotuneError as error:
            say(PROGRAM, f"the gains are not proven: {error}")
            outcome = Outcome(False, f"not proven: {error}")
        against = outcome.against
        return outcome
    finally:
        _say_what_is_left(nodes, options.at, against)


def _offered(client: TuneClient, nodes: OwnNodes, options: argparse.Namespace) -> Outcome:
    result = client.result
    doubt = result.verdict_reason if result.verdict != Verdict.TRUSTED else ""
    unproven = Outcome(None, doubt)
    asks = options.verify is None and not options.yes and sys.stdin.isatty()
    if not (asks or options.verify):
        print()
        return unproven
    with Working("choosing the step"):
        proof = _Proof(client, nodes, options)
    step = proof.step
    if asks:
        step = agreed_step(proof.question(doubt), proof.step, proof.allowed)
        if not step:
            print()
            return unproven
    elif doubt:
        raise TuningError(f"doubtful gains are not proven unasked: {doubt}")
    try:
        found = proof.made(step, bool(doubt))
    finally:
        nodes.end(_CONTROLLER)
    if found.passed:
        return Outcome(True, "")
    return Outcome(False, f"the step that was to prove them failed: {found.reason}")


@contextmanager
def _noted(nodes: OwnNodes) -> Iterator[Callable[[], bool]]:
    """Only note signals in the block, and obey them after it.

    An exception could be lost in a callback of rclpy.

    :param nodes: of this command.
    :return: what tells whether one has come, and raises LoopError if a node has ended.
    """
    came: list[int] = []

    def leave() -> bool:
        nodes.require_alive()
        return bool(came)

    before = {
        number: signal.signal(number, lambda n, _: came.append(n))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield leave
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            raise KeyboardInterrupt if came[0] == signal.SIGINT else SystemExit(128 + came[0])


def _say_what_is_left(nodes: OwnNodes, command: float, against: str) -> None:
    """Say in which state the plant is, when only relay_node holds its command.

    :param nodes: of this command.
    :param command: that of relay_node [u].
    :param against: what speaks against the gains; empty: nothing.
    """
    try:
        nodes.require_alive()
    except RelayAutotuneError as error:
        say(PROGRAM, f"{error}: the last command stays in force; see to the plant")
        return
    then = (
        "do not start a controller with these gains, they are not proven"
        if against
        else "start your own controller with these gains"
    )
    told = (
        f"the command stands at {command:.6g} u, the command that you gave, and nobody controls "
        f"the loop any more: {then}"
    )
    print("\n".join(labelled("left", told, width())), flush=True)
