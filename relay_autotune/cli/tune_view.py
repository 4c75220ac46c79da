# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a tune shows: its progress, its result, and the next commands.

All text here is made from the messages of the action `Tune` alone.
"""

from __future__ import annotations

import math
import os
import shlex
import shutil
import textwrap
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TextIO

from relay_autotune.cli.table import gains_lines, identification_lines
from relay_autotune.cli.terminal import UNITS, WIDEST, labelled
from relay_autotune.exchange.messages import (
    identification_from_message,
    transfer_function_from_message,
    why_doubtful,
)
from relay_autotune.nodes.shell import prefix
from relay_autotune.process.transfer_function import process_text
from relay_autotune.quantities import NORMAL_95
from relay_autotune.reasons import Code
from relay_autotune.text import LOGGED_EVERY, digits, duration, in_units
from relay_autotune.verdict import Verdict

# By the constants of Tune.Feedback and RelayExperiment.
STATES = ("unknown", "settling", "kick", "relay", "completed", "aborted", "failed")
OUTCOMES = ("unknown", "completed", "aborted", "failed")
# Reasons whose sentence begins with the outcome.
_OUTCOME_OF = {Code.CANCELLED: "cancelled", Code.REQUESTED: "aborted"}

# Columns that a terminal needs for lines that are updated in place.
NARROWEST = 80

_BAR = 16
_GREEN, _YELLOW, _RED, _BOLD, _DIM, _PLAIN = "32", "33", "31", "1", "2", "0"
# Where the name of a check begins, and its text.
_NAME, _CHECK_INDENT = 6, 20
# Lines of a terminal for what the tune waits for and sees.
_STATUS_LINES = 2


@dataclass(frozen=True)
class Paint:
    """The look of text.

    :param colour: True if escape sequences for colours may be used.
    :param blocks: True if the terminal can show more than ASCII.
    """

    colour: bool = False
    blocks: bool = False

    def __call__(self, text: str, code: str) -> str:
        """Return a text in a colour or weight, if that is possible."""
        return f"\x1b[{code}m{text}\x1b[{_PLAIN}m" if self.colour and text else text


def wants_colour(is_terminal: bool, environment: Mapping[str, str]) -> bool:
    """Return whether colours are wanted: on a terminal that supports them, without NO_COLOR.

    :param is_terminal: True if the output is a terminal.
    :param environment: the variables of the process.
    """
    return is_terminal and not environment.get("NO_COLOR") and environment.get("TERM") != "dumb"


def estimate(feedback: Any) -> str:
    """Return the ultimate gain with its 95 % interval; empty where none is known yet.

    :param feedback: a `Tune.Feedback`.
    """
    value, std = feedback.ultimate_gain, feedback.ultimate_gain_std
    if not math.isfinite(value):
        return ""
    if not math.isfinite(std):
        return f"K_u {digits(value)} u/y"
    low, high = value - NORMAL_95 * std, value + NORMAL_95 * std
    return f"K_u {digits(value)} u/y (95 %: {digits(low)} to {digits(high)})"


def oscillation(feedback: Any) -> str:
    """Return period and amplitude of the last whole cycle; empty before the first.

    :param feedback: a `Tune.Feedback`.
    """
    if not math.isfinite(feedback.period):
        return ""
    text = f"period {digits(feedback.period)} s"
    if math.isfinite(feedback.amplitude):
        text += f", amplitude {digits(feedback.amplitude)} y"
    return text


def cycle_line(begins: str, feedback: Any) -> str:
    """Return the last whole cycle and what is known after it, as far as they are there.

    :param begins: the first words.
    :param feedback: a `Tune.Feedback`.
    """
    return ", ".join(filter(None, (begins, oscillation(feedback), estimate(feedback))))


def log_line(feedback: Any, before: Any = None) -> str:
    """Return a feedback as one plain line, for a log.

    :param feedback: a `Tune.Feedback`.
    :param before: the feedback before it, None for the first.
    """
    state = STATES[feedback.state]
    line = feedback.status or state
    if state == "completed" and (before is None or before.state != feedback.state):
        line = cycle_line(state, feedback)
    elif feedback.cycle and (before is None or before.cycle != feedback.cycle):
        line = cycle_line(f"cycle {feedback.cycle}", feedback)
        if math.isfinite(feedback.remaining) and feedback.remaining > 0.0:
            line += f", about {duration(feedback.remaining)} left"
    return f"{feedback.elapsed:8.1f} s  {line}"


def live_lines(
    feedback: Any, paint: Paint, since: float = 0.0, width: int = NARROWEST
) -> list[str]:
    """Return a feedback as the lines that a terminal shows until the next one.

    :param feedback: a `Tune.Feedback`.
    :param paint: the look of text.
    :param since: time since the feedback came [s], not negative.
    :param width: columns of the terminal, at least `NARROWEST`.
    """
    state = STATES[feedback.state]
    if state in OUTCOMES:
        # Its time stands still while the model is computed.
        since = 0.0
    done = round(_BAR * min(max(feedback.progress, 0.0), 1.0))
    full, empty = ("█", "░") if paint.blocks else ("#", "-")
    colour = {"completed": _GREEN, "aborted": _RED, "failed": _RED}.get(state, _YELLOW)
    bar = paint(full * done, colour) + paint(empty * (_BAR - done), _DIM)
    times = f"{duration(feedback.elapsed + since)} so far"
    left = feedback.remaining - since
    if math.isfinite(left) and left > 0.0:
        times += f", about {duration(left)} left"
    lines = [f"  {paint(f'{state:<10}', _BOLD)} {bar} {100.0 * feedback.progress:3.0f} %  {times}"]
    rows = textwrap.wrap(feedback.status, width - 14, max_lines=_STATUS_LINES, placeholder=" ...")
    rows += [""] * (_STATUS_LINES - len(rows))
    cycle = f"cycle {feedback.cycle}: {oscillation(feedback)}" if feedback.cycle else ""
    model = feedback.transfer_function
    shown = process_text(transfer_function_from_message(model)) if model.experiment_id else ""
    rows += [cycle, estimate(feedback), paint(shown[: width - 14], _DIM)]
    lines += [f"  {'':<10} {row}".rstrip() for row in rows]
    return lines


def check_lines(checks: Sequence[str], width: int) -> list[str]:
    """Return the checklist of a dry run, each check with its further lines indented.

    :param checks: a line for each check, its text from column `_CHECK_INDENT` on.
    :param width: columns of the terminal.
    """
    return [
        line
        for check in checks
        for line in textwrap.wrap(
            in_units(check, UNITS),
            max(width - 1, 2 * _CHECK_INDENT),
            subsequent_indent=" " * _CHECK_INDENT,
            break_long_words=False,
            break_on_hyphens=False,
        )
    ]


def check_parts(check: str) -> tuple[str, ...]:
    """Return a line of the checklist in its columns: mark, name and what was found.

    :param check: the line.
    """
    return tuple(
        map(str.strip, (check[:_NAME], check[_NAME:_CHECK_INDENT], check[_CHECK_INDENT:]))
    )


def result_lines(
    result: Any, cancelled: bool, paint: Paint, columns: int = WIDEST, left: str = ""
) -> list[str]:
    """Return the result of a tune.

    :param result: a `Tune.Result` with an experiment.
    :param cancelled: True if this command cancelled it.
    :param paint: the look of text.
    :param columns: that a line may have.
    :param left: in which state the plant is left.
    """
    outcome = "cancelled" if cancelled else OUTCOMES[result.outcome]
    colour = {"completed": _GREEN}.get(outcome, _RED)
    repeats = _OUTCOME_OF.get(result.why.code) == outcome
    sentence = result.reason if repeats else f"{outcome}: {result.reason}"
    if cancelled and result.outcome == result.COMPLETED:
        sentence = f"cancelled after the relay had ended, before the gains: {result.reason}"
    first, *rest = labelled("tune", sentence, columns)
    lines = [first.replace(outcome, paint(outcome, f"{_BOLD};{colour}"), 1), *rest]
    if outcome != "completed":
        sentence = "; ".join(filter(None, (left, "no gains are given")))
        lines += labelled("", sentence, columns)
    if result.transfer_function.experiment_id:
        found = identification_from_message(result.transfer_function)
        lines += ["", *identification_lines(found, columns)]
        lines += ["", *_verdict_lines(result, paint, columns)]
    if result.gains.experiment_id:
        lines += ["", *gains_lines(result.gains, Verdict(result.verdict), columns)]
    lines += ["", *labelled("recording", result.bag or "none", columns)]
    return lines


def _verdict_lines(result: Any, paint: Paint, columns: int) -> list[str]:
    """Return the verdict in its colour, with what to look at."""
    verdict = Verdict(result.verdict)
    colour = {Verdict.TRUSTED: _GREEN, Verdict.DOUBTFUL: _YELLOW}.get(verdict, _RED)
    lines = [f"  {'verdict':<16} {paint(verdict.name.lower(), f'{_BOLD};{colour}')}"]
    reason, model = result.verdict_reason, result.transfer_function
    known = verdict is Verdict.TRUSTED and math.isfinite(result.gains.ms_95)
    if known and (model.undetermined or model.warnings):
        reason = (
            f"whatever is not determined or warned of here, with these gains Ms stays below "
            f"{digits(result.gains.ms_95, 3)} on 95 % of the models that the data allow"
        )
    return lines + (labelled("", reason, columns) if reason else [])


def next_commands(
    result: Any, controllers: Sequence[str], flags: str = "", report: str = ""
) -> list[tuple[str, str]]:
    """Return the next commands, each with its purpose.

    :param result: a `Tune.Result`.
    :param controllers: full names of the controller_nodes that receive these gains.
    :param flags: options with which `replay` and `report` give the identifier_node's result.
    :param report: the report that was written; empty: none.
    """
    steps = []
    if report:
        steps.append(("see it in figures", f"xdg-open {shlex.quote(report)}"))
    if result.bag and result.outcome == result.COMPLETED:
        bag = f"{shlex.quote(result.bag)} {flags}".rstrip()
        if result.transfer_function.experiment_id and not report:
            steps.append(("see it in figures", f"{prefix()}report {bag} -o report.html"))
        steps.append(("see every method and rule", f"{prefix()}replay {bag}"))
    if result.gains.experiment_id:
        for name in controllers:
            namespace, _, node = name.rpartition("/")
            words = [f"{prefix()}apply_gains"]
            words += ["--namespace", namespace] if namespace else []
            words += ["--node", node] if node != "controller_node" else []
            words += ["--accept-doubtful"] if why_doubtful(result) else []
            steps.append(("apply and verify the gains", " ".join(words)))
    return steps


def document(result: Any, node: str, cancelled: bool, report: str = "") -> dict[str, Any]:
    """Return a result for a JSON document; null stands for "not estimated" or "none".

    :param result: a `Tune.Result`.
    :param node: full name of the relay_node.
    :param cancelled: True if this command cancelled it.
    :param report: the report that was written; empty: none.
    """
    model, gains = result.transfer_function, result.gains
    return {
        "node": node,
        "experiment_id": result.experiment.experiment_id,
        "outcome": "cancelled" if cancelled else OUTCOMES[result.outcome],
        "reason": result.reason,
        "verdict": Verdict(result.verdict).name.lower(),
        "verdict_reason": result.verdict_reason,
        "bag": result.bag or None,
        "report": report or None,
        "transfer_function": _fields(model) if model.experiment_id else None,
        "gains": _fields(gains) if gains.experiment_id else None,
    }


def _fields(value: Any) -> Any:
    """Return a message as dictionaries, lists, texts and finite numbers."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _fields(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (str, int)):
        return value
    return [_fields(item) for item in value]


class Shown:
    """The progress of a tune on the screen or in the log.

    :param stream: where it is written.
    :param live: True for a terminal, whose lines may be overwritten.
    """

    def __init__(self, stream: TextIO, live: bool) -> None:
        self._stream = stream
        self._width = shutil.get_terminal_size().columns
        self._live = live and os.environ.get("TERM") != "dumb" and self._width >= NARROWEST
        blocks = (stream.encoding or "").lower().replace("-", "") == "utf8"
        self._paint = Paint(wants_colour(live, os.environ), blocks)
        self._lines = 0
        self._last: Any = None
        self._came = self._logged = 0.0

    def take(self, feedback: Any) -> None:
        """Show a feedback."""
        now, last = time.monotonic(), self._last
        if not self._live:
            begins = last is None or (feedback.state, feedback.cycle) != (last.state, last.cycle)
            if begins or now - self._logged >= LOGGED_EVERY:
                self._write(f"{log_line(feedback, last)}\n")
                self._logged = now
        elif last is not None and not feedback.transfer_function.experiment_id:
            # A model comes only once.
            feedback.transfer_function = last.transfer_function
        self._last, self._came = feedback, now

    def tick(self) -> None:
        """Update the times on a terminal."""
        if not self._live or self._last is None:
            return
        since = time.monotonic() - self._came
        lines = live_lines(self._last, self._paint, since, self._width)
        self.clear()
        self._write("\n".join(lines) + "\n")
        self._lines = len(lines)

    def say(self, text: str) -> None:
        """Write a line that stays."""
        self.clear()
        self._write(f"{text}\n")

    def clear(self) -> None:
        """Remove the lines that are shown in place."""
        if self._lines:
            self._write(f"\x1b[{self._lines}A\x1b[J")
            self._lines = 0

    def _write(self, text: str) -> None:
        # The tune continues even if its progress cannot be written.
        with suppress(OSError):
            self._stream.write(in_units(text, UNITS))
            self._stream.flush()
