# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What follows a tune of tune_loop's own nodes: proof, files for other programs, what is next."""

from __future__ import annotations

import argparse
import math
import shlex
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.arguments import DONE, as_typed, say
from relay_autotune.cli.export import EXPORTS, WITHOUT_LAW, Target, exported, exports_of, write
from relay_autotune.cli.new_loop import PROGRAM, is_new_loop
from relay_autotune.cli.own_nodes import ros_arguments
from relay_autotune.cli.terminal import Working, asked, asked_for_file, labelled, number_of, width
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.exchange.messages import gains_from_message
from relay_autotune.experiment.settling import NO_REST_AT
from relay_autotune.loop.gains import Gains
from relay_autotune.text import digits
from relay_autotune.verdict import Verdict

if TYPE_CHECKING:
    from relay_autotune.cli.joint_tune import JointTune
    from relay_autotune.cli.own_nodes import OwnNodes
    from relay_autotune.nodes.tune_client import TuneClient

# How long to wait for what the nodes still have to tell [s].
PATIENCE = 5.0
Steps = list[tuple[str, str]]


@dataclass
class HandedOver:
    """What became of the gains.

    :param proven: whether they passed, or are in force with a joint; None: that was not wanted.
    :param steps: commands that follow, each with its purpose.
    """

    proven: bool | None = None
    steps: Steps = field(default_factory=list)


@dataclass(frozen=True)
class _Written:
    """Gains that are to be written.

    :param gains: the gains.
    :param how: for which program, or "yaml".
    :param doubt: what speaks against them; empty: nothing.
    """

    gains: Gains
    how: str
    doubt: str


def prefix() -> str:
    """Return what stands before a command of this package where the shell does not find it."""
    return "" if shutil.which("replay") else "ros2 run relay_autotune "


def hand_over(
    client: TuneClient,
    options: argparse.Namespace,
    parser: argparse.ArgumentParser,
    nodes: OwnNodes,
    joint: JointTune | None,
) -> HandedOver:
    """Offer to apply or to prove the gains, and to write them for another controller.

    :param client: with the result.
    :param options: of the command line, with all answers.
    :param parser: of the command line.
    :param nodes: of this command.
    :param joint: to whose controller the gains go; None: it is a loop of two topics.
    """
    result, done, against = client.result, HandedOver(), ""
    gains = gains_from_message(result.gains)
    doubt = result.verdict_reason if result.verdict != Verdict.TRUSTED else ""
    if joint is None:
        # Imported here, because it loads slowly and must not delay a tune.
        from relay_autotune.cli.proof import prove

        outcome = prove(client, nodes, options)
        done.proven, against = outcome.passed, outcome.against
        if not against:
            done.steps += _own_controller(client, options, nodes, gains)
    first = _Written(gains, exports_of(gains.law)[0], against or doubt)
    written, file = first, options.export
    if not (file or joint or options.yes) and sys.stdin.isatty():
        written, file = _asked(client, first, against)
    if file:
        low, high = options.command_within or (-math.inf, math.inf)
        mine = Target(command_min=low, command_max=high, present=options.at)
        target = joint.target if joint else mine
        text = exported(written.gains, written.how, target, doubt=written.doubt)
        write(text, file)
        print(f"  {'gains for':<16} {written.how}: {Path(file).resolve()}")
    if written.gains is not first.gains and not against:
        law = {"law": written.gains.law, "sample_period": written.gains.law_period}
        again = as_typed(PROGRAM, parser, options, verify=None, **law)
        done.steps.append((f"prove those for {written.how}", f"{prefix()}{again} --verify"))
    if joint is not None and joint.applies:
        print()
        done.proven = joint.apply(nodes, written.doubt) == DONE
    return done


def _asked(client: TuneClient, first: _Written, against: str) -> tuple[_Written, str]:
    """Ask for which program the gains are to be written, and to which file.

    :param client: of the tune.
    :param first: the gains of the tune.
    :param against: what a proof says against them; empty: nothing.
    :return: the gains to write, and the file; empty: none.
    """
    chosen, own = first, exports_of(first.gains.law)
    names = ", ".join(name for name in EXPORTS if name != first.how)
    whose = " of ros2_controllers" * (first.how == WITHOUT_LAW)
    told = f"{first.how}{whose}; type another name to design for it: {names}"
    print("\n" + "\n".join(labelled("file for", told, width())))
    while True:
        what = f"Write the gains for {chosen.how}{' all the same' * bool(against)}"
        answer = asked_for_file(what, EXPORTS)
        if answer not in EXPORTS:
            return chosen, answer
        try:
            chosen = (
                _Written(first.gains, answer, first.doubt)
                if answer in own
                else _designed(client, answer, against)
            )
        except RelayAutotuneError as error:
            say(PROGRAM, f"no gains for {answer}: {error}")


def _designed(client: TuneClient, law: str, against: str) -> _Written:
    """Design gains for the law of a program, from the record of the tune, and show them."""
    # Imported here, because it loads slowly.
    from relay_autotune.cli.report import analysed_as_there, defaults

    record = client.record(PATIENCE)
    interval = f"{record.mean_interval:.3g}"
    period = asked(
        f"time between two runs of {law} [s]", "--sample-period", interval, "0.1", _positive
    )
    with Working(f"designing for {law}") as working:
        values = client.identifier_values(PATIENCE) or defaults()
        asked_for = {**values, "law": law, "sample_period": period}
        found = analysed_as_there(record, asked_for, working.at)
    gains = found.best_gains
    if gains is None:
        raise RelayAutotuneError(found.reason.removeprefix("no gains: "))
    told = ", ".join(f"{name} {digits(getattr(gains, name))}" for name in ("kc", "ti", "td"))
    told += f", every {period:g} s; {'; '.join(gains.warnings) or 'Ms ' + digits(gains.ms, 3)}"
    print("\n".join(labelled(f"for {law}", told, width())))
    doubtful = found.verdict is not Verdict.TRUSTED
    return _Written(gains, law, against or found.judgement.reason * doubtful)


def _positive(text: str) -> float | None:
    value = number_of(text)
    return value if value is not None and value > 0.0 else None


def _own_controller(
    client: TuneClient, options: argparse.Namespace, nodes: OwnNodes, gains: Gains
) -> Steps:
    """Return the commands that control the loop with the gains, without any other controller."""
    # Imported here, because it loads slowly.
    from relay_autotune.nodes.live_types import FLOAT64
    from relay_autotune.nodes.tables import FIXED, GAINS, parameters_of_law

    names = ["measurement_type", "command_type"]
    kind, command_kind = client.values(client.name, names).values()
    default = {entry.name: entry.default for entry in FIXED}
    sensor = {"measurement_type": kind, "measurement_field": options.field}
    values: dict[str, Any] = {each.name: getattr(gains, each.name) for each in GAINS}
    values |= {n: v for n, v in sensor.items() if v != default[n]}
    values |= {"initial_command": options.at, "safe_command": options.at}
    values |= {"initial_setpoint": float(f"{client.result.experiment.settings.setpoint:.6g}")}
    for name, limits in (("measurement", options.within), ("command", options.command_within)):
        if limits:
            values |= dict(zip((f"{name}_min", f"{name}_max"), limits, strict=True))
    values |= parameters_of_law(gains.law, gains.law_period)
    topics, steps = {"measurement": options.measurement}, []
    if command_kind == FLOAT64:
        topics["controller_command"] = options.command
    else:
        # controller_node sends Float64 alone, and relay_node passes that on.
        words = [w for w in nodes.arguments("relay_node") if not w.startswith("__ns:=")][1:]
        words = ["relay_node", "--ros-args", *words, "-p", f"initial_command:={options.at}"]
        steps.append(("pass its commands on", prefix() + shlex.join(words)))
    words = ["controller_node", "--ros-args", *ros_arguments("", topics, values)]
    return [("control with these gains", prefix() + shlex.join(words)), *steps]


def left(result: Any, command: float, outside: bool) -> str:
    """Return at which command a loop of two topics is left, and whether that is the right one.

    :param result: of the tune.
    :param command: the safe command [u].
    :param outside: whether the measurement left its limits.
    """
    if result.reason.startswith(NO_REST_AT):
        return (
            f"the command stands at {command:.6g} u, which is not the one at which the process "
            f"rested: set the right one now"
        )
    told = f"the plant is left at the safe command {command:.6g} u"
    if outside:
        told += ": look whether the process rests there, else set the right one now"
    return told


def left_its_limits(client: TuneClient, options: argparse.Namespace) -> bool:
    """Return whether the last measurement of a tune that was aborted is outside of its limits.

    :param client: with the result.
    :param options: of the command line, with all answers.
    """
    result = client.result
    if result.outcome != result.ABORTED or not options.within:
        return False
    try:
        measured = client.record(PATIENCE).measurement
    except RelayAutotuneError:
        return False
    low, high = options.within
    return measured.size > 0 and not low <= float(measured[-1]) <= high


def repeated(
    result: Any,
    options: argparse.Namespace,
    parser: argparse.ArgumentParser,
    proven: bool | None,
    outside: bool,
) -> Steps:
    """Return the commands that repeat the tune, with its answers as flags, or prove its gains.

    :param result: of the tune.
    :param options: of the command line, with all answers.
    :param parser: of the command line.
    :param proven: whether its gains passed; None: they were not tried.
    :param outside: whether the measurement left its limits.
    """
    words = options.typed
    new = not options.joint and is_new_loop(options)
    if new:
        words = shlex.split(as_typed(PROGRAM, parser, options, verify=None))[1:]
    again = prefix() + shlex.join([PROGRAM, *words])
    if result.gains.experiment_id:
        # Nodes that end with this command cannot prove them later.
        return [("prove the gains", f"{again} --verify")] if new and proven is None else []
    if result.outcome == result.COMPLETED:
        return []
    if new and result.reason.startswith(NO_REST_AT):
        # The same command again would drive the process away again.
        return [("once it rests", "start again with --at and the command at which it rests")]
    if new and outside:
        told = (
            "start again with the --at at which it rests, a smaller --amplitude, or wider --within"
        )
        return [("once it rests", told)]
    steps = [("run it again", again)]
    if result.reason.startswith("no measurement on "):
        topic = result.reason.split()[3]
        told = f"look at the sensor (ros2 topic hz {topic}) and the load of the machine (uptime)"
        steps.append(("if it happens again", told))
    return steps
