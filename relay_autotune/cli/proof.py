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
from relay_autotune.cli.asking import agreed_step
from relay_autotune.cli.layout import labelled, width
from relay_autotune.cli.new_loop import (
    PROGRAM,
    START_WITHIN,
    own_namespace,
    own_node,
    ros_arguments,
)
from relay_autotune.cli.own_nodes import OwnNodes
from relay_autotune.cli.progress import StatusLine, Working
from relay_autotune.control.verification import (
    LEAST_OF_NOISE,
    Step,
    StepRange,
    allowed_steps,
    noise_of,
    plan,
    proving_step,
)
from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.exchange.messages import gains_from_message, transfer_function_from_message
from relay_autotune.loop.laws import LawRate
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes.controller_parameters import parameters_of_law, rate_from
from relay_autotune.nodes.gains_client import GainsClient
from relay_autotune.nodes.tune_client import TuneClient
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record, RelaySettings
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


@dataclass(frozen=True)
class _Proof:
    """What is to be done.

    :param step: of the set-point [y].
    :param allowed: the steps that the limits allow.
    :param expected: predicted range of the command [u].
    :param takes: about how long all of it takes [s].
    :param settles: how long the loop takes to settle with the gains [s].
    :param rest: set-point and baseline of the tune.
    :param within: range of the measurement [y].
    :param commands: range of the command [u].
    :param noise_std: of the measurement [y]; NaN: not known.
    :param rate: the law that the gains are for; None: our own.
    """

    step: float
    allowed: StepRange
    expected: tuple[float, float]
    takes: float
    settles: float
    rest: RelaySettings
    within: Limits
    commands: Limits
    noise_std: float
    rate: LawRate | None

    def question(self, options: argparse.Namespace, doubt: str) -> str:
        """Say what will move, how far and how long."""
        rest, (least, most) = self.rest, self.expected
        runs = ""
        if self.rate is not None:
            runs = f", which runs {self.rate.law.name} every {self.rate.period:g} s,"
        told = (
            f"Prove the gains now? A controller_node of this command{runs} takes the loop at "
            f"{rest.setpoint:.6g} y and {rest.baseline:.6g} u, moves the set-point of "
            f"{options.measurement} by {self.step:+g} y and back, and ends at "
            f"{rest.baseline:.6g} u after about {duration(self.takes)}. {options.command} is "
            f"expected from {least:.3g} to {most:.3g} u, never beyond "
            f"{self.commands.low:g} to {self.commands.high:g} u. Ctrl-C ends it at once, likewise."
        )
        if abs(self.step) < LEAST_OF_NOISE * self.noise_std:
            told += (
                f" The limits allow a step of {abs(self.step) / self.noise_std:.1f} times the "
                f"noise, expected {LEAST_OF_NOISE:g}: it will prove little."
            )
        return told + (f" The gains are doubtful: {doubt}." if doubt else "")


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
        proof = _planned(client.record(_RECORD_WITHIN), result, options)
    step = proof.step
    if asks:
        step = agreed_step(proof.question(options, doubt), proof.step, proof.allowed)
        if not step:
            print()
            return unproven
    elif doubt:
        raise TuningError(f"doubtful gains are not proven unasked: {doubt}")
    try:
        found = _made(client, nodes, options, proof, step, bool(doubt))
    finally:
        nodes.end(_CONTROLLER)
    if found.passed:
        return Outcome(True, "")
    return Outcome(False, f"the step that was to prove them failed: {found.reason}")


def _planned(record: Record, result: Any, options: argparse.Namespace) -> _Proof:
    gains = gains_from_message(result.gains)
    model: TransferFunction = transfer_function_from_message(result.transfer_function)
    rest = record.settings
    assert rest is not None, "gains come of a whole experiment"
    within = Limits(*options.within)
    # Without limits the process has seen the levels of the relay.
    commands = Limits(*(options.command_within or (rest.low, rest.high)))
    noise = noise_of(record.noise_std, result.transfer_function.residual_rms)
    step = options.step or proving_step(record, model, within, commands, noise)
    if not step:
        raise TuningError("the limits leave no room for a step: widen --within")
    rate = rate_from(parameters_of_law(gains.law, gains.law_period))
    wanted = plan(gains, model, Step(setpoint=step), record.mean_interval, rate=rate)
    peak = wanted.peak / abs(step)
    allowed = allowed_steps(record, model, within, commands, peak, noise)
    step = options.step or allowed.nearest(step)
    allowed.require(step)
    settles = gains.settling_time
    if not math.isfinite(settles):
        settles = wanted.duration
    least, most = (commands.clip(rest.baseline + end) for end in wanted.command)
    takes = wanted.duration + 2.0 * settles
    ends = (least, most)
    return _Proof(step, allowed, ends, takes, settles, rest, within, commands, noise, rate)


def _made(
    client: TuneClient,
    nodes: OwnNodes,
    options: argparse.Namespace,
    proof: _Proof,
    step: float,
    doubtful: bool,
) -> Any:
    """Put the gains in force in a controller_node in front of relay_node, and make the step.

    :return: the `Verify.Result`.
    """
    name = own_node(options, _CONTROLLER)
    kind = client.values(client.name, ["measurement_type"])["measurement_type"]
    shown = StatusLine()
    # The journal of proven and failed gains is that of this controller_node alone.
    with tempfile.TemporaryDirectory() as journal, GainsClient("", name, beside=client) as loop:
        values = {
            "initial_setpoint": proof.rest.setpoint,
            "initial_command": proof.rest.baseline,
            "safe_command": proof.rest.baseline,
            "measurement_min": proof.within.low,
            "measurement_max": proof.within.high,
            "command_min": proof.commands.low,
            "command_max": proof.commands.high,
            "verify_step_max": abs(step),
            "measurement_type": kind,
            "measurement_field": options.field,
            "accept_doubtful": str(doubtful).lower(),
            "record_directory": journal,
        }
        if proof.rate is not None:
            values |= parameters_of_law(proof.rate.law.name, proof.rate.period)
        topics = {"measurement": options.measurement}
        nodes.start(_CONTROLLER, ros_arguments(own_namespace(options), topics, values))
        try:
            with Working(f"starting {name}"):
                loop.find(START_WITHIN)
                nodes.require_alive()
                loop.put_in_force(client.result.gains)
            patience = max(_TIMES_SETTLING * proof.settles, _REST_WITHIN)
            with _noted(nodes) as leave:
                found = loop.prove(step, 0.0, proof.settles, patience, shown, leave)
                loop.let_settle(proof.settles, shown, "the loop goes back", leave)
        finally:
            shown.clear()
        print("\n" + "\n".join(found_lines(found, width(), proof.noise_std)), flush=True)
        if proof.rate is not None:
            told = (
                f"controller_node ran {proof.rate.law.name} every {proof.rate.period:g} s; what "
                f"your program does at a limit of the command was not tried"
            )
            print("\n".join(labelled("law", told, width())), flush=True)
        return found


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
