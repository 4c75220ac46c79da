# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What follows a tune in a terminal: its result, the proof of its gains, files, what is next.

This module is loaded after the tune, since that takes long.
"""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from relay_autotune.bag.definitions import FLOAT64
from relay_autotune.cli.arguments import as_typed, say
from relay_autotune.cli.loops import Steps
from relay_autotune.cli.own_nodes import PROGRAM
from relay_autotune.cli.table import beside
from relay_autotune.cli.terminal import (
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
    document,
    next_commands,
    wants_colour,
)
from relay_autotune.cli.tuned import CONTROLLER, Proof, Tuned
from relay_autotune.errors import RelayAutotuneError, SelectionError, TuningError
from relay_autotune.exchange.export import (
    EXPORTS,
    controller_file,
    controller_values,
    exported,
    exports_of,
)
from relay_autotune.exchange.messages import (
    how_ended,
    reason_from_message,
    transfer_function_from_message,
)
from relay_autotune.loop.gains import Gains
from relay_autotune.nodes.shell import prefix, ros_arguments
from relay_autotune.nodes.tables import parameters_of_law
from relay_autotune.reasons import Code
from relay_autotune.text import digits

if TYPE_CHECKING:
    from relay_autotune.report.case import Case

# Relative difference of gains that are the same.
_NEAR = 1e-6
_UNFINISHED = "the proof did not end"
_FAILED = "the step that was to prove them {}"


@dataclass(frozen=True)
class _Written:
    """Gains that are to be written.

    :param gains: the gains.
    :param how: for which program, or "yaml".
    :param doubt: why they are doubtful; empty: they are trusted.
    :param unproven: why a proof of them has not passed; empty: it has, or none was made.
    """

    gains: Gains
    how: str
    doubt: str
    unproven: str


@dataclass
class AfterTune(Tuned):
    """What follows a tune in a terminal."""

    # What the report shows, and what a proof has found.
    _case: Case | None = None
    _proof: tuple[tuple[str, str], ...] = ()

    # The result.

    def conclude(self) -> int:
        """Show the result, and hand the gains over; return the exit status."""
        result, options, client = self.result, self.options, self.client
        for refused in sorted(client.refused):
            say(PROGRAM, refused)
        if not options.json:
            paint = Paint(colour=wants_colour(sys.stdout.isatty(), os.environ))
            print("\n".join(self.lines(paint, width())), flush=True)
            self._compare()
        flags, report = self._reported()
        # Gains of nodes that end with this command cannot be asked for later.
        controllers = [] if self.loop.has_own_nodes else client.controllers()
        proven = None
        if options.json:
            print(json.dumps(document(result, client.name, client.cancelled, report)))
        else:
            steps: Steps = []
            if self.loop.has_own_nodes and self.has_gains:
                proven, steps = self.hand_over()
                self._report_proof()
            steps += next_commands(result, controllers, flags, report)
            steps += self.repeated(proven)
            if steps:
                print("\nNext:")
            for what, command in steps:
                print(f"  {what:<26} {command}")
        written = bool(report) or not options.report
        return self.status(found=written and proven is not False)

    def _compare(self) -> None:
        """Show the gains in force beside the new ones, if a controller of the loop has some."""
        result, loop = self.result, self.loop
        if loop.has_own_nodes or not result.gains.experiment_id:
            return
        if (present := loop.present()) is not None:
            model = transfer_function_from_message(result.transfer_function)
            print("\n" + "\n".join(beside(present, self.gains, model, width())), flush=True)

    def repeated(self, proven: bool | None) -> Steps:
        """Return the commands that repeat the tune, with its answers as flags, or prove its gains.

        :param proven: whether its gains passed; None: they were not tried.
        """
        result, options, loop = self.result, self.options, self.loop
        if result.gains.experiment_id:
            # Nodes that end with this command cannot prove them later.
            wanted = loop.proves and proven is None
            return [self._to_prove("prove the gains")] if wanted else []
        if result.outcome == result.COMPLETED:
            return []
        if result.why.code == Code.NODE_FAILED:
            # The same command again would meet the same defect.
            return [
                ("report it", "this is a defect: send its reason, and the recording if you can")
            ]
        again = shlex.join([PROGRAM, *options.typed])
        if loop.proves:
            again = as_typed(options, verify=None)
        steps = loop.again(prefix() + again)
        if result.why.code == Code.SILENT_SENSOR:
            why = reason_from_message(result.why)
            what = f"the sensor of {why['topic']} (--dry-run tells its rate) and the load (uptime)"
            wait = f"for a longer silence {loop.to_type(why)}"
            steps.append(("if it happens again", f"look at {what}; {wait}"))
        return steps

    # The report.

    def _reported(self) -> tuple[str, str]:
        """Write the report if it is wanted; return the flags for `replay`, and its name."""
        client, options, result = self.client, self.options, self.result
        if client.cancelled:
            # Who ends it waits for nothing more that takes long.
            if options.report:
                sentence = f"no report: the tune was cancelled; {prefix()}report makes one"
                say(PROGRAM, f"{sentence} of {result.bag}" if result.bag else sentence)
            return "", ""
        # Imported here, because it loads slowly.
        from relay_autotune.cli.report import flags_of

        flags = flags_of(self.values)
        if not options.report:
            return flags, ""
        try:
            if self.asked_there is None:
                say(PROGRAM, "no identifier_node answers: the report uses its default parameters")
            with Working("writing the report"):
                sentence = self._write_report(flags)
        except RelayAutotuneError as error:
            say(PROGRAM, f"no report: {error}")
            return flags, ""
        if sentence:
            say(PROGRAM, sentence)
        if not options.json:
            print(f"  {'report':<16} {options.report}")
        return flags, str(options.report)

    def _write_report(self, flags: str) -> str:
        """Write the report; return a warning where it has other gains than the tune, else ""."""
        from relay_autotune.cli.report import write_report
        from relay_autotune.report.case import case_of

        result, output, present = self.result, self.options.report, self.loop.present()
        found = self.analysed()
        case = replace(case_of(found, result.bag or self.loop.title), present=present)
        if result.bag:
            again = f"report {shlex.quote(result.bag)} {flags}".rstrip()
            if present is not None:
                again += f" --present {present.kc:.6g} {present.ti:.6g} {present.td:.6g}"
            case = replace(case, command=f"{again} -o {shlex.quote(output)}")
        write_report([case], output)
        self._case = case
        gains, published = found.best_gains, result.gains
        kc = gains.kc if gains is not None else math.nan
        if not published.experiment_id or math.isclose(kc, published.kc, rel_tol=_NEAR):
            return ""
        return (
            f"the report has kc {kc:.6g} where the identifier_node gave {published.kc:.6g}: "
            "the node had other parameters, or is of another version"
        )

    def _report_proof(self) -> None:
        """Write the report again, with the proof: one that is cut short leaves it without."""
        if self._case is None or not self._proof:
            return
        from relay_autotune.cli.report import write_report

        with Working("writing the proof into the report"):
            try:
                write_report([replace(self._case, proof=self._proof)], self.options.report)
            except RelayAutotuneError as error:
                say(PROGRAM, f"the report lacks the proof: {error}")

    # The gains.

    def hand_over(self) -> tuple[bool | None, Steps]:
        """Offer to apply or to prove the gains, and to write them for another controller.

        :return: whether they passed, or are in force with a joint, None: that was not wanted; and
            the commands that follow, each with its purpose.
        """
        options, loop, gains = self.options, self.loop, self.gains
        proven, unproven = self._tried()
        against = unproven or self.doubt * (proven is None)
        steps = self._own_controller() if loop.proves and not against else []
        first = _Written(gains, exports_of(gains.law)[0], self.doubt, unproven)
        written, file = first, options.export
        asks = loop.proves and not (file or options.yes) and sys.stdin.isatty()
        if asks:
            written, file = self._asked(first)
        while file and not self._write(written, file) and asks:
            written, file = self._asked(first)
        if written.gains is not gains and not against:
            law = {"law": written.gains.law, "sample_period": written.gains.law_period}
            steps.append(self._to_prove(f"prove those for {written.how}", **law))
        return proven, steps

    def _to_prove(self, what: str, **law: Any) -> tuple[str, str]:
        """Return the command that makes the tune again and proves its gains, with its purpose.

        :param what: the purpose.
        :param law: options that ask for the law of another program.
        """
        options, file = self.options, self.options.export
        law["export"] = None if file and Path(file).exists() else file
        # Doubtful gains are proven where a person agrees.
        law["yes"] = options.yes and not self.doubt
        again = as_typed(options, verify=None, **law)
        return what, f"{prefix()}{again}{'' if self.doubt else ' --verify'}"

    def _write(self, written: _Written, file: str) -> bool:
        """Write gains to a file; return whether they are there."""
        # The tune is made, and its recording has the gains.
        bag = shlex.quote(self.result.bag or "BAG")
        again = f"{prefix()}replay {bag} --export {written.how}"
        doubt, unproven = written.doubt, written.unproven
        why = f"not proven: {unproven}" if unproven else f"doubtful: {doubt}" if doubt else ""
        if why and self.options.export and not self.options.accept_doubtful:
            again += " --accept-doubtful" * bool(doubt)
            say(PROGRAM, f"{file} is not written: the gains are {why}; to have it: {again}")
            return False
        try:
            target = self.loop.target
            text = exported(written.gains, written.how, target, doubt=doubt, unproven=unproven)
        except SelectionError as error:
            say(PROGRAM, f"{file} is not written: {error}, such as {again}")
            return False
        try:
            write(text, file)
        except SelectionError as error:
            if self.options.export:
                raise
            say(PROGRAM, f"{error}; to have the gains: {again}")
            return False
        print(f"  {'gains for':<16} {written.how}: {Path(file).resolve()}")
        return True

    def _asked(self, first: _Written) -> tuple[_Written, str]:
        """Ask for which program the gains are to be written, and to which file.

        :param first: the gains of the tune.
        :return: the gains to write, and the file; empty: none.
        """
        chosen, own = first, exports_of(first.gains.law)
        all_the_same = " all the same" * bool(first.unproven or first.doubt)
        names = ", ".join(name for name in EXPORTS if name != first.how)
        print()
        tell("file for", f"{first.how}; type another name to design for it: {names}")
        while True:
            what = f"Write the gains for {chosen.how}{all_the_same}"
            answer = asked_for_file(what, EXPORTS)
            if answer not in EXPORTS:
                return chosen, answer
            try:
                chosen = (
                    replace(first, how=answer)
                    if answer in own
                    else self._designed(answer, first.unproven)
                )
            except RelayAutotuneError as error:
                say(PROGRAM, f"{answer}: {error}")

    def _designed(self, law: str, unproven: str) -> _Written:
        """Design gains for the law of a program, from the record of the tune, and show them."""
        # One machine runs either program.
        period = self.gains.law_period or float(f"{self.record.mean_interval:.3g}")
        what = f"time between two runs of {law} [s]"
        period = asked(what, "--sample-period", f"{period:g}", "0.1", _positive)
        with Working(f"designing for {law}") as working:
            found = self.analysed(working.at, law=law, sample_period=period)
        gains = found.best_gains
        if gains is None:
            raise RelayAutotuneError(found.reason)
        text = ", ".join(f"{name} {digits(getattr(gains, name))}" for name in ("kc", "ti", "td"))
        text += f", every {period:g} s; {'; '.join(gains.warnings) or 'Ms ' + digits(gains.ms, 3)}"
        tell(f"for {law}", text)
        return _Written(gains, law, self.doubt or found.judgement.reason, unproven)

    def _own_controller(self) -> Steps:
        """Return the commands that control the loop with the gains, without other controllers."""
        gains, target, steps = self.gains, self.loop.target, []
        law = parameters_of_law(gains.law, gains.law_period)
        target = replace(target, parameters={**target.parameters, **law})
        if "controller_command" not in target.topics:
            given = self.loop.arguments()["relay_node"]
            words = [w for w in given if not w.startswith("__ns:=")]
            words = [*words[1:], "-p", f"initial_command:={self.options.at}"]
            command = shlex.join(["relay_node", "--ros-args", *words])
            steps.append(("pass its commands on", prefix() + command))
        # The folder of the recording keeps what belongs to the tune.
        bag, values = self.result.bag, controller_values(gains, target)
        words = [CONTROLLER, "--ros-args", *ros_arguments("", target.topics, values)]
        if bag and Path(bag).is_dir():
            file = str(Path(bag, f"{CONTROLLER}.yaml"))
            write(controller_file(gains, target), file)
            words = [CONTROLLER, "--gains", file]
        started = ("control with these gains", prefix() + shlex.join(words))
        return [started, ("set-points for it", f"{FLOAT64} on /setpoint"), *steps]

    # Their proof.

    def _tried(self) -> tuple[bool | None, str]:
        """Offer to prove the gains of a tune, or to put them in force at a joint.

        Without a controller of its own, the command is then that at which the process rested
        before the tune, however it ends.

        :return: whether that has succeeded, None: it was not wanted; and why the gains are not
            proven, empty: they are, or nobody has tried.
        """
        loop = self.loop
        passed, unproven = None, _UNFINISHED
        try:
            passed, failed = self._offered() if loop.proves else loop.apply(self.doubt)
            unproven = _FAILED.format(failed) if failed else ""
        except RelayAutotuneError as error:
            say(PROGRAM, f"the gains are not proven: {error}")
            passed, unproven = False, str(error)
        finally:
            if loop.proves:
                self._say_what_is_left(unproven or self.doubt * (passed is None))
        return passed, unproven

    def _offered(self) -> tuple[bool | None, str]:
        """Offer to prove the gains; return what `Loop.apply` returns."""
        options, doubt = self.options, self.doubt
        asks = options.verify is None and not options.yes and sys.stdin.isatty()
        if not (asks or options.verify):
            print()
            return None, ""
        with Working("choosing the step"):
            proof = Proof(self)
        step = proof.step
        if asks:
            plan = " ".join(text for _, text in proof.plan(step))
            question = f"Prove the gains now? {plan} Ctrl-C ends it at once, likewise."
            question += f" The gains are doubtful: {doubt}." if doubt else ""
            step = agreed_step(question, step, proof.allowed)
            if not step:
                print()
                return None, ""
        elif doubt:
            raise TuningError(f"doubtful gains are not proven unasked: {doubt}")
        found = self._made(proof, step)
        passed = found.verdict == found.PASSED
        return passed, "" if passed else how_ended(found)

    def _made(self, proof: Proof, step: float) -> Any:
        """Make the step, and show what it has found."""
        with noted(lambda text: say(PROGRAM, text)) as (shown, leave):
            found, self._proof, _ = proof.made(step, bool(self.doubt), shown, leave)
        print()
        for entry in self._proof[1:]:
            tell(*entry)
        if proof.rate is not None:
            tell(
                "law",
                f"controller_node ran {proof.rate.law.name} every {proof.rate.period:g} s; "
                f"what your program does at a limit of the command was not tried",
            )
        return found

    def _say_what_is_left(self, against: str) -> None:
        """Say in which state the plant is, when only relay_node holds its command.

        :param against: what speaks against the gains; empty: nothing.
        """
        if why := self.loop.nodes.why_lost():
            say(PROGRAM, f"{why}; {self.loop.client.left_behind()}")
            return
        sent = f"{self.options.at:.6g} u, the command that you gave"
        if others := self.loop.client.others_on(self.options.command):
            tell("left", f"{sent}, was sent, but {others} commands, too, and goes on")
            return
        then = (
            "do not start a controller with these gains, they are not proven"
            if against
            else "start your own controller with these gains"
        )
        tell(
            "left",
            f"the command stands at {sent}, and nobody controls the loop any more: {then}",
        )


def _positive(text: str) -> float:
    value = number_of(text)
    if value is None or value <= 0.0:
        raise SelectionError("expected a number, such as 0.1")
    return value
