# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The words of a report: the verdict, its checks, the numbers, and what remains uncertain."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from relay_autotune.loop.analysis import as_run
from relay_autotune.loop.gains import Controller, Gains, Performance
from relay_autotune.quantities import result_fields
from relay_autotune.report.case import Case
from relay_autotune.text import date_text, digits, percent, span_text
from relay_autotune.verdict import Finding, Result, Verdict

Tone = Literal["good", "warn", "bad"]

# A sign that shows the tone without colour, and the tone.
_TONES: dict[Result, tuple[str, Tone]] = {
    Result.PASSED: ("\N{CHECK MARK}", "good"),
    Result.DOUBTFUL: ("!", "warn"),
    Result.FAILED: ("\N{MULTIPLICATION X}", "bad"),
}
_VERDICTS: dict[Verdict, tuple[str, Tone]] = {
    Verdict.TRUSTED: ("gains ready to use", "good"),
    Verdict.DOUBTFUL: ("doubtful gains: read first what to look at", "warn"),
    Verdict.NONE: ("model, but no gains", "bad"),
    Verdict.UNKNOWN: ("not judged", "warn"),
}


class Chip(NamedTuple):
    """The outcome of an experiment in a few words, and how good it is."""

    text: str
    tone: Tone


class CheckRow(NamedTuple):
    """A reason to trust a result or not to: what was looked at, what was found, its meaning."""

    mark: str
    tone: Tone
    name: str
    value: str
    meaning: str


# By what present gains are compared with new ones: numbers; effects with labels and meanings.
_NUMBERS = ("kc", "ti", "td", "tf", "b")
_EFFECTS = (
    ("Ms", "ms", "below 1.4 careful, above 2 risky"),
    ("error after a load step", "iae_load", "the smaller, the sooner it is over"),
    ("overshoot", "overshoot", "after a step of the set-point"),
    ("settling time (2 %)", "settling_time", "after a step of the set-point"),
)
UNITS = {each.name: each.unit for each in result_fields(Gains)}
"""Units of gains and of what they do, by their names."""


class Compared(NamedTuple):
    """A number of present gains, the same of new ones, and what it means."""

    name: str
    unit: str
    present: str
    new: str
    meaning: str = ""


def verdict_of(case: Case) -> Chip:
    """Return the verdict on an experiment.

    :param case: the experiment.
    """
    if case.model is None:
        return Chip("nothing identified", "bad")
    return Chip(*_VERDICTS[case.judgement.verdict])


def facts_of(case: Case, *, with_id: bool) -> tuple[str, ...]:
    """Return where and when the experiment was recorded, and how it ended.

    :param case: the experiment.
    :param with_id: False if the page names its id elsewhere.
    """
    found = [case.outcome.words]
    if with_id and case.experiment_id:
        found.append(case.experiment_id)
    if case.start:
        found.append(date_text(case.start))
    return (*found, span_text(case.duration, case.samples, case.lost_samples))


def steps_of(case: Case) -> tuple[str, ...]:
    """Return what the reader is to do, in order.

    :param case: the experiment.
    """
    gains = case.best_gains
    if gains is None:
        return (case.reason or "No gains were given, and no reason was recorded.",)
    watch = "Make a small step of the set-point"
    if math.isfinite(gains.overshoot) and math.isfinite(gains.settling_time):
        watch += (
            f": the measurement should overshoot by about {percent(gains.overshoot)} % "
            f"and settle within {digits(gains.settling_time, 2)} s"
        )
        if gains.bare is not None:
            watch += (
                f" (without {gains.softeners}: {percent(gains.bare.overshoot)} % and "
                f"{digits(gains.bare.settling_time, 2)} s)"
            )
    steps = (
        "Write down the gains that the controller has now.",
        "Type in the new gains, in the form that your controller has.",
        f"{watch}.",
        "If the loop swings, go back to the gains that you wrote down.",
    )
    if case.judgement.verdict is Verdict.DOUBTFUL:
        return ('Check the points under "Read this first" before you use these gains.', *steps)
    return steps


def compared(
    present: Controller | None, does: Performance | None, new: Gains | None
) -> list[Compared]:
    """Return the numbers by which present gains are compared with new ones.

    :param present: the present gains; None: there are none.
    :param does: what they do on the model; None: they make the loop unstable.
    :param new: the new gains, whose law runs both; None: there are none, and it is continuous.
    """
    both = ((present, does), (new, new))

    def effect(gains: Controller | None, does: Performance | None, name: str) -> str:
        if gains is None or does is None:
            return "-" if gains is None else "unstable"
        value = getattr(does, name)
        return f"{100.0 * value:.0f} %" if name == "overshoot" else digits(value, 3)

    numbers = [
        (name, UNITS[name], *(digits(getattr(g, name)) if g else "none" for g, _ in both))
        for name in _NUMBERS
    ]
    effects = [
        (label, UNITS[name], *(effect(*each, name) for each in both), meaning)
        for label, name, meaning in _EFFECTS
    ]
    jumps = (digits(as_run(each, new).jump, 3) if each else "-" for each, _ in both)
    jump = ("jump of the command", "u/y", *jumps, "at once, by a unit step of the set-point")
    return [Compared(*row) for row in (*numbers, *effects, jump)]


def repeats_of(case: Case) -> tuple[tuple[str, str], ...]:
    """Return how to make the same report, and the same test, again: names and commands.

    :param case: the experiment.
    """
    found = [("The same report:", case.command)] if case.command else []
    relay = case.settings
    if relay is not None and relay.amplitude > 0.0:
        names = ("amplitude", "baseline", "bias", "hysteresis")
        values = {name: getattr(relay, name) for name in names}
        # ROS reads 1 as an integer, and refuses it for a number
        given = " ".join(
            f"-p {name}:={float(f'{value:.6g}')!r}"
            for name, value in values.items()
            if value and math.isfinite(value)
        )
        command = f"ros2 run relay_autotune relay_node --ros-args {given}"
        found.append(("The same relay in a live loop:", command))
    return tuple(found)


def warnings_of(case: Case) -> tuple[str, ...]:
    """Return the sentences that must be read before anything else; none where all is trusted.

    :param case: the experiment.
    """
    verdict = case.judgement.verdict
    if verdict is Verdict.TRUSTED:
        return ()
    doubts = [f.said for f in case.judgement.findings if f.sentence]
    return (*(doubts if verdict is Verdict.DOUBTFUL else ()), *_noted(case))


def remarks_of(case: Case) -> tuple[str, ...]:
    """Return what else is to be known of a result that is trusted.

    :param case: the experiment.
    """
    return _noted(case) if case.judgement.verdict is Verdict.TRUSTED else ()


def _noted(case: Case) -> tuple[str, ...]:
    """Return what model, gains and cycles have to say besides the checks."""
    found = list(case.model.warnings) if case.model is not None else []
    if case.best_gains is not None:
        found += case.best_gains.warnings
    disturbed = [c.index + 1 for c in case.cycles if c.disturbed]
    if disturbed:
        which = ", ".join(map(str, disturbed))
        found.append(f"Cycle {which} was disturbed and is left out of the averages.")
    return tuple(found)


def checks_of(case: Case) -> tuple[CheckRow, ...]:
    """Return the checks of the result.

    :param case: the experiment.
    """
    return tuple(map(_check, case.judgement.findings))


def _check(found: Finding) -> CheckRow:
    unit = f" {found.unit}" if found.unit else ""
    meaning = found.said if found.sentence else f"{found.what[0].upper()}{found.what[1:]}"
    value = f"{_number(found.value)}{unit}, at most {_number(found.limit)}{unit}"
    return CheckRow(*_TONES[found.result], found.title, value, f"{meaning}.")


def _number(value: float) -> str:
    return f"{value:g}" if math.isinf(value) else digits(value, 3)


def numbers_of(case: Case) -> tuple[tuple[str, str], ...]:
    """Return the numbers of the limit cycle with their units, each behind its name.

    :param case: the experiment.
    """
    cycle = case.limit_cycle
    if cycle is None:
        return ()
    found = [
        ("period", f"{digits(cycle.period)} s"),
        ("high / low", f"{digits(cycle.period_high)} s / {digits(cycle.period_low)} s"),
        ("measurement", f"{digits(cycle.peak_min)} to {digits(cycle.peak_max)} y"),
        ("cycles averaged", f"{len(cycle.cycles)}"),
        ("limit cycle", "settled" if cycle.converged else "still changing"),
    ]
    if case.settings is not None:
        found += [
            ("relay", f"±{digits(case.settings.amplitude)} u"),
            ("bias", f"{digits(case.settings.bias)} u"),
            ("hysteresis", f"±{digits(case.settings.hysteresis)} y"),
        ]
    return tuple(found)


def doubts_of(case: Case) -> tuple[str, ...]:
    """Return what remains uncertain, in sentences.

    :param case: the experiment.
    """
    model = case.model
    if model is None:
        return ()
    found = []
    for estimate in case.parameters:
        if not estimate.determined:
            found.append(
                f"The {estimate.title} is between {digits(estimate.low)} and "
                f"{digits(estimate.high)} {estimate.unit}: more than 20 % to either side."
            )
    if model.rivals:
        share = 100.0 * sum(r.support for r in model.rivals)
        found.append(
            f"Other structures hold {digits(share, 2)} % of the support; they are listed below."
        )
    if not found:
        found.append("Nothing: every parameter is determined, and no other structure is a rival.")
    return tuple(found)
