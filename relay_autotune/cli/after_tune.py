# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What follows a tune: its result, proof of the gains, files for other programs, what is next.

The proof is a step of the set-point, which a controller_node of the command makes. This module is
loaded after the tune, since that takes long.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import shutil
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.apply_gains import found_lines
from relay_autotune.cli.arguments import DONE, NOTHING_FOUND, as_typed, exit_status, say
from relay_autotune.cli.own_nodes import (
    PROGRAM,
    START_WITHIN,
    OwnNodes,
    is_new_loop,
    own_namespace,
    own_node,
    ranges,
    ros_arguments,
)
from relay_autotune.cli.terminal import (
    StatusLine,
    Working,
    agreed_step,
    asked,
    asked_for_file,
    noted,
    number_of,
    tell,
    width,
    write,
)
from relay_autotune.cli.tune_view import (
    Paint,
    check_lines,
    document,
    next_commands,
    result_lines,
    wants_colour,
)
from relay_autotune.control.verification import (
    Step,
    allowed_steps,
    noise_of,
    plan,
    proving_step,
)
from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.exchange.export import (
    EXPORTS,
    WITHOUT_LAW,
    Target,
    exported,
    exports_of,
    node_parameters,
)
from relay_autotune.exchange.messages import gains_from_message, transfer_function_from_message
from relay_autotune.experiment.settling import NO_REST_AT
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes.gains_client import GainsClient
from relay_autotune.nodes.lifetime import NODE_FAILED
from relay_autotune.nodes.live_types import FLOAT64
from relay_autotune.nodes.tables import FIXED, GAINS, parameters_of_law, rate_from
from relay_autotune.nodes.tune_client import TuneClient
from relay_autotune.text import digits, duration
from relay_autotune.verdict import Verdict

if TYPE_CHECKING:
    from relay_autotune.cli.joint_tune import JointTune

Steps = list[tuple[str, str]]
_CONTROLLER = "controller_node"
_UNFINISHED = "the proof did not end"
# How long to wait for what the nodes still have to tell [s].
_PATIENCE = 5.0
# A loop may take this many settling times to come to rest, and at least a time [s].
_TIMES_SETTLING, _REST_WITHIN = 5.0, 60.0


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


@dataclass
class AfterTune:
    """A tune that has ended, and what can be done with its gains.

    :param client: with the result.
    :param options: of the command line, with all answers.
    :param parser: of the command line.
    :param nodes: of this command; None: they were there.
    :param joint: to whose controller the gains go; None: it is a loop of two topics.
    """

    client: TuneClient
    options: argparse.Namespace
    parser: argparse.ArgumentParser
    nodes: OwnNodes | None = None
    joint: JointTune | None = None

    @cached_property
    def result(self) -> Any:
        """The `Tune.Result`."""
        return self.client.result

    @property
    def _is_new(self) -> bool:
        """Whether the loop is one of two topics, whose nodes end with this command."""
        return not self.options.joint and is_new_loop(self.options)

    @cached_property
    def gains(self) -> Gains:
        """The gains of the tune, which are there."""
        return gains_from_message(self.result.gains)

    @property
    def doubt(self) -> str:
        """Why the gains are doubtful; empty: they are trusted."""
        trusted = self.result.verdict == Verdict.TRUSTED
        return "" if trusted else str(self.result.verdict_reason)

    @cached_property
    def left_its_limits(self) -> bool:
        """Whether the last measurement of a tune that was aborted is outside of its limits."""
        result, options = self.result, self.options
        if result.outcome != result.ABORTED or not options.within:
            return False
        try:
            measured = self.client.record(_PATIENCE).measurement
        except RelayAutotuneError:
            return False
        low, high = options.within
        return measured.size > 0 and not low <= float(measured[-1]) <= high

    # The result.

    def conclude(self) -> int:
        """Show the result, and hand the gains over; return the exit status."""
        result, options, client = self.result, self.options, self.client
        for refused in sorted(client.refused):
            say(PROGRAM, refused)
        if not result.experiment.experiment_id:
            return self._nothing_started()
        if not options.json:
            paint = Paint(colour=wants_colour(sys.stdout.isatty(), os.environ))
            left = self.left() if self._is_new else self.joint.left() if self.joint else ""
            lines = result_lines(result, client.cancelled, paint, width(), left)
            print("\n".join(lines), flush=True)
        flags, report = self._reported()
        # Gains of nodes that end with this command cannot be asked for later.
        controllers = client.controllers() if self.nodes is None else []
        proven = None
        if options.json:
            print(json.dumps(document(result, client.name, client.cancelled, report)))
        else:
            steps: Steps = []
            if self.nodes is not None and result.gains.experiment_id:
                proven, steps = self.hand_over()
            steps += next_commands(result, controllers, prefix(), flags, report)
            steps += self.repeated(proven)
            if steps:
                print("\nNext:")
            for what, command in steps:
                print(f"  {what:<26} {command}")
        complete = result.gains.experiment_id or options.record_only
        written = report or not options.report
        found = client.succeeded and complete and written and proven is not False
        return exit_status(found=found, doubtful=result.verdict == Verdict.DOUBTFUL)

    def _nothing_started(self) -> int:
        """Print the result of a dry run, or why the node refuses."""
        client, options = self.client, self.options
        reason, checks = self.result.reason, list(self.result.checks)
        if options.json:
            told = {"accepted": client.succeeded, "reason": reason, "checks": checks}
            print(json.dumps({"node": client.name} | told))
        elif checks:
            print("\n".join(check_lines(checks, width())))
        if not client.succeeded:
            say(PROGRAM, f"{client.name} refuses: {reason}")
            return NOTHING_FOUND
        if not options.json:
            again = [word for word in options.typed if word != "--dry-run"]
            print(f"\nNext:\n  {'start it':<26} {prefix()}{shlex.join((PROGRAM, *again))}")
        return DONE

    def left(self) -> str:
        """Return at which command the loop is left, and whether that is the right one."""
        command = self.options.at
        if self.result.reason.startswith(NO_REST_AT):
            return (
                f"the command stands at {command:.6g} u, which is not the one at which the "
                f"process rested: set the right one now"
            )
        told = f"the plant is left at the safe command {command:.6g} u"
        if self.left_its_limits:
            told += ": look whether the process rests there, else set the right one now"
        return told

    def repeated(self, proven: bool | None) -> Steps:
        """Return the commands that repeat the tune, with its answers as flags, or prove its gains.

        :param proven: whether its gains passed; None: they were not tried.
        """
        result, options, new = self.result, self.options, self._is_new
        words = options.typed
        if new:
            words = shlex.split(as_typed(PROGRAM, self.parser, options, verify=None))[1:]
        again = prefix() + shlex.join([PROGRAM, *words])
        if result.gains.experiment_id:
            # Nodes that end with this command cannot prove them later.
            return [("prove the gains", f"{again} --verify")] if new and proven is None else []
        if result.outcome == result.COMPLETED:
            return []
        if result.reason.startswith(NODE_FAILED):
            # The same command again would meet the same defect.
            return [
                ("report it", "this is a defect: send its reason, and the recording if you can")
            ]
        if new and result.reason.startswith(NO_REST_AT):
            # The same command again would drive the process away again.
            return [("once it rests", "start again with --at and the command at which it rests")]
        if new and self.left_its_limits:
            told = "the --at at which it rests, a smaller --amplitude, or wider --within"
            return [("once it rests", f"start again with {told}")]
        steps = [("run it again", again)]
        with suppress(RelayAutotuneError):
            if self.joint is not None and (typed := self.joint.activation()):
                return [("activate its controller", typed), *steps]
        if result.reason.startswith("no measurement on "):
            topic = result.reason.split()[3]
            told = f"the sensor (ros2 topic hz {topic}) and the load of the machine (uptime)"
            steps.append(("if it happens again", f"look at {told}"))
        return steps

    # The report.

    def _reported(self) -> tuple[str, str]:
        """Write the report if it is wanted; return the flags for `replay`, and its name."""
        client, options, result = self.client, self.options, self.result
        if client.cancelled:
            # Who ends it waits for nothing more that takes long.
            if options.report:
                told = f"no report: the tune was cancelled; {prefix()}report makes one"
                say(PROGRAM, f"{told} of {result.bag}" if result.bag else told)
            return "", ""
        with Working("asking identifier_node for its parameters"):
            # Imported here, because it loads slowly.
            from relay_autotune.cli.report import defaults, flags_of, report_of_tune

            values = None if options.record_only else client.identifier_values(_PATIENCE)
        flags = flags_of(values) if values is not None else ""
        if not options.report:
            return flags, ""
        try:
            if values is None:
                say(PROGRAM, "no identifier_node answers: the report uses its default parameters")
            with Working("writing the report"):
                record, source = client.record(_PATIENCE), result.bag or client.name
                told = report_of_tune(
                    record, values or defaults(), result, source, options.report, self._present()
                )
        except RelayAutotuneError as error:
            say(PROGRAM, f"no report: {error}")
            return flags, ""
        if told:
            say(PROGRAM, told)
        if not options.json:
            print(f"  {'report':<16} {options.report}")
        return flags, str(options.report)

    def _present(self) -> Controller | None:
        """Return the gains in force in the loop's controller; None: they are not known."""
        # The report is as good without them.
        with suppress(RelayAutotuneError):
            if self.joint is not None:
                return self.joint.present()
            for name in self.client.controllers()[:1]:
                with GainsClient("", name, beside=self.client) as loop:
                    return loop.in_force()
        return None

    # The gains.

    def hand_over(self) -> tuple[bool | None, Steps]:
        """Offer to apply or to prove the gains, and to write them for another controller.

        :return: whether they passed, or are in force with a joint, None: that was not wanted; and
            the commands that follow, each with its purpose.
        """
        options, joint, gains = self.options, self.joint, self.gains
        proven, against, steps = None, "", []
        if joint is None:
            proven, against = self._proven()
            steps = [] if against else self._own_controller()
        first = _Written(gains, exports_of(gains.law)[0], against or self.doubt)
        written, file = first, options.export
        if not (file or joint or options.yes) and sys.stdin.isatty():
            written, file = self._asked(first, against)
        if file:
            low, high = options.command_within or (-math.inf, math.inf)
            mine = Target(command_min=low, command_max=high, present=options.at)
            target = joint.target if joint else mine
            text = exported(written.gains, written.how, target, doubt=written.doubt)
            write(text, file)
            print(f"  {'gains for':<16} {written.how}: {Path(file).resolve()}")
        if written.gains is not gains and not against:
            law = {"law": written.gains.law, "sample_period": written.gains.law_period}
            again = as_typed(PROGRAM, self.parser, options, verify=None, **law)
            steps.append((f"prove those for {written.how}", f"{prefix()}{again} --verify"))
        if joint is not None and joint.applies:
            assert self.nodes is not None
            print()
            proven = joint.apply(self.client, self.nodes, written.doubt) == DONE
        return proven, steps

    def _asked(self, first: _Written, against: str) -> tuple[_Written, str]:
        """Ask for which program the gains are to be written, and to which file.

        :param first: the gains of the tune.
        :param against: what a proof says against them; empty: nothing.
        :return: the gains to write, and the file; empty: none.
        """
        chosen, own = first, exports_of(first.gains.law)
        names = ", ".join(name for name in EXPORTS if name != first.how)
        whose = " of ros2_controllers" * (first.how == WITHOUT_LAW)
        print()
        tell("file for", f"{first.how}{whose}; type another name to design for it: {names}")
        while True:
            what = f"Write the gains for {chosen.how}{' all the same' * bool(against)}"
            answer = asked_for_file(what, EXPORTS)
            if answer not in EXPORTS:
                return chosen, answer
            try:
                chosen = (
                    _Written(first.gains, answer, first.doubt)
                    if answer in own
                    else self._designed(answer, against)
                )
            except RelayAutotuneError as error:
                say(PROGRAM, f"no gains for {answer}: {error}")

    def _designed(self, law: str, against: str) -> _Written:
        """Design gains for the law of a program, from the record of the tune, and show them."""
        # Imported here, because it loads slowly.
        from relay_autotune.cli.report import analysed_as_there, defaults

        record = self.client.record(_PATIENCE)
        interval = f"{record.mean_interval:.3g}"
        what = f"time between two runs of {law} [s]"
        period = asked(what, "--sample-period", interval, "0.1", _positive)
        with Working(f"designing for {law}") as working:
            values = self.client.identifier_values(_PATIENCE) or defaults()
            asked_for = {**values, "law": law, "sample_period": period}
            found = analysed_as_there(record, asked_for, working.at)
        gains = found.best_gains
        if gains is None:
            raise RelayAutotuneError(found.reason.removeprefix("no gains: "))
        told = ", ".join(f"{name} {digits(getattr(gains, name))}" for name in ("kc", "ti", "td"))
        told += f", every {period:g} s; {'; '.join(gains.warnings) or 'Ms ' + digits(gains.ms, 3)}"
        tell(f"for {law}", told)
        doubtful = found.verdict is not Verdict.TRUSTED
        return _Written(gains, law, against or found.judgement.reason * doubtful)

    def _own_controller(self) -> Steps:
        """Return the commands that control the loop with the gains, without other controllers."""
        client, options, gains = self.client, self.options, self.gains
        assert self.nodes is not None
        names = ["measurement_type", "command_type"]
        kind, command_kind = client.values(client.name, names).values()
        default = {entry.name: entry.default for entry in FIXED}
        sensor = {"measurement_type": kind, "measurement_field": options.field}
        values: dict[str, Any] = {each.name: getattr(gains, each.name) for each in GAINS}
        values |= {n: v for n, v in sensor.items() if v != default[n]}
        values |= {"initial_command": options.at, "safe_command": options.at}
        values |= {"initial_setpoint": float(f"{self.result.experiment.settings.setpoint:.6g}")}
        values |= ranges(options.within, options.command_within)
        values |= parameters_of_law(gains.law, gains.law_period)
        topics, steps = {"measurement": options.measurement}, []
        if command_kind == FLOAT64:
            topics["controller_command"] = options.command
        else:
            # controller_node sends Float64 alone, and relay_node passes that on.
            words = [w for w in self.nodes.arguments("relay_node") if not w.startswith("__ns:=")]
            words = [*words[1:], "-p", f"initial_command:={options.at}"]
            command = shlex.join(["relay_node", "--ros-args", *words])
            steps.append(("pass its commands on", prefix() + command))
        # The folder of the recording keeps what belongs to the tune.
        bag, given = self.result.bag, ros_arguments("", topics, values)
        if bag and Path(bag).is_dir():
            file = str(Path(bag, f"{_CONTROLLER}.yaml"))
            write(node_parameters(gains, values), file)
            given = [*ros_arguments("", topics), "--params-file", file]
        words = [_CONTROLLER, "--ros-args", *given]
        return [("control with these gains", prefix() + shlex.join(words)), *steps]

    # Their proof.

    def _proven(self) -> tuple[bool | None, str]:
        """Offer to prove the gains of a tune.

        However it ends, the command is then that at which the process rested before the tune.

        :return: whether the proof has passed, None: none was wanted; and what speaks against the
            gains in the end, empty: nothing.
        """
        against = _UNFINISHED
        try:
            try:
                passed, against = self._offered()
            except RelayAutotuneError as error:
                say(PROGRAM, f"the gains are not proven: {error}")
                passed, against = False, f"not proven: {error}"
            return passed, against
        finally:
            self._say_what_is_left(against)

    def _offered(self) -> tuple[bool | None, str]:
        options, doubt = self.options, self.doubt
        assert self.nodes is not None
        asks = options.verify is None and not options.yes and sys.stdin.isatty()
        if not (asks or options.verify):
            print()
            return None, doubt
        with Working("choosing the step"):
            proof = _Proof(self)
        step = proof.step
        if asks:
            step = agreed_step(proof.question(doubt), proof.step, proof.allowed)
            if not step:
                print()
                return None, doubt
        elif doubt:
            raise TuningError(f"doubtful gains are not proven unasked: {doubt}")
        try:
            found = proof.made(self.nodes, step, bool(doubt))
        finally:
            self.nodes.end(_CONTROLLER)
        if found.passed:
            return True, ""
        return False, f"the step that was to prove them failed: {found.reason}"

    def _say_what_is_left(self, against: str) -> None:
        """Say in which state the plant is, when only relay_node holds its command.

        :param against: what speaks against the gains; empty: nothing.
        """
        assert self.nodes is not None
        if why := self.nodes.why_lost():
            say(PROGRAM, f"{why}: the last command stays in force; see to the plant")
            return
        then = (
            "do not start a controller with these gains, they are not proven"
            if against
            else "start your own controller with these gains"
        )
        tell(
            "left",
            f"the command stands at {self.options.at:.6g} u, the command that you gave, and "
            f"nobody controls the loop any more: {then}",
        )


def _positive(text: str) -> float | None:
    value = number_of(text)
    return value if value is not None and value > 0.0 else None


class _Proof:
    """A step of the set-point that is to prove the gains of a tune.

    :param tune: that has ended.
    :raises RelayAutotuneError: if there is no such step.
    """

    def __init__(self, tune: AfterTune) -> None:
        self._client, self._options, gains = tune.client, tune.options, tune.gains
        options, result, record = tune.options, tune.result, tune.client.record(_PATIENCE)
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
        period, rate = record.mean_interval, self._rate
        once = plan(gains, model, Step(setpoint=1.0), period, rate=rate)
        self.allowed = allowed_steps(record, model, *limits, once, noise)
        self.step: float = options.step or self.allowed.nearest(step)
        self.allowed.require(self.step)
        wanted = plan(gains, model, Step(setpoint=self.step), period, rate=rate)
        # How long the loop takes to settle with the gains, and all of it [s].
        known = math.isfinite(gains.settling_time)
        self._settles = gains.settling_time if known else wanted.duration
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
        return told + (f" The gains are doubtful: {doubt}." if doubt else "")

    def made(self, nodes: OwnNodes, step: float, doubtful: bool) -> Any:
        """Put the gains in force in a controller_node in front of relay_node, and make the step.

        :param nodes: of this command.
        :param step: of the set-point [y].
        :param doubtful: whether the gains are.
        :return: the `Verify.Result`.
        """
        client, options, rest, rate = self._client, self._options, self._rest, self._rate
        name, within, commands = own_node(options, _CONTROLLER), self._within, self._commands
        kind = client.values(client.name, ["measurement_type"])["measurement_type"]
        shown = StatusLine()
        # The journal of proven and failed gains is that of this controller_node alone.
        with (
            tempfile.TemporaryDirectory() as journal,
            GainsClient("", name, beside=client) as loop,
        ):
            values = {
                "initial_setpoint": rest.setpoint,
                "initial_command": rest.baseline,
                "safe_command": rest.baseline,
                **ranges((within.low, within.high), (commands.low, commands.high)),
                "verify_step_max": abs(step),
                "measurement_type": kind,
                "measurement_field": options.field,
                "accept_doubtful": str(doubtful).lower(),
                "record_directory": journal,
            }
            if rate is not None:
                values |= parameters_of_law(rate.law.name, rate.period)
            topics = {"measurement": options.measurement}
            nodes.start(_CONTROLLER, ros_arguments(own_namespace(options), topics, values))
            try:
                with Working(f"starting {name}"):
                    loop.find(START_WITHIN)
                patience = max(_TIMES_SETTLING * self._settles, _REST_WITHIN)
                with (
                    loop.offered(client.result.gains) as gains,
                    noted(lambda text: say(PROGRAM, text)) as leave,
                ):
                    found = loop.prove(step, 0.0, patience, shown, leave, gains)
                    loop.let_settle(self._settles, shown, "the loop goes back", leave)
            finally:
                shown.clear()
            print("\n" + "\n".join(found_lines(found, width(), self._noise_std)), flush=True)
            if rate is not None:
                tell(
                    "law",
                    f"controller_node ran {rate.law.name} every {rate.period:g} s; what your "
                    f"program does at a limit of the command was not tried",
                )
            return found
