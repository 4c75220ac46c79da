"""What a report says in words: the verdict, its checks, the numbers, what remains in doubt."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from relay_autotune.exchange.text import date_text, digits
from relay_autotune.record.record import Outcome
from relay_autotune.report.case import Case, ModelCase
from relay_autotune.tuning import Gains

Tone = Literal["good", "warn", "bad"]

_MARKS: dict[Tone, str] = {"good": "\N{CHECK MARK}", "warn": "!", "bad": "\N{MULTIPLICATION X}"}
_OUTCOMES = {
    Outcome.UNKNOWN: "recorded elsewhere",
    Outcome.COMPLETED: "completed",
    Outcome.ABORTED: "aborted",
    Outcome.FAILED: "failed",
}
# Ms of 1.2 to 2 is the range that textbooks recommend (Astrom and Hagglund).
_USUAL_MS, _LARGEST_MS = 2.0, 2.5
_GAIN_MARGIN, _PHASE_MARGIN = 2.0, math.radians(30.0)
# A residual as large as the noise leaves nothing to explain.
_RESIDUAL_GOOD, _RESIDUAL_FAIR = 1.3, 2.5
_FIT_GOOD, _FIT_FAIR = 0.95, 0.85
_WHITE = 0.01


@dataclass(frozen=True)
class Verdict:
    """What came of an experiment, in a few words.

    :param text: for people.
    :param tone: how good that is.
    """

    text: str
    tone: Tone


@dataclass(frozen=True)
class Check:
    """One reason to trust a result or not to.

    :param name: what was looked at.
    :param value: what was found.
    :param meaning: what that means.
    :param tone: how good it is.
    """

    name: str
    value: str
    meaning: str
    tone: Tone

    @property
    def mark(self) -> str:
        """A sign that says the tone without colour."""
        return _MARKS[self.tone]


@dataclass(frozen=True)
class Number:
    """A number of the experiment with its name.

    :param name: what it is.
    :param text: the number with its unit.
    """

    name: str
    text: str


def verdict_of(case: Case) -> Verdict:
    """Return what came of an experiment.

    :param case: the experiment.
    """
    if case.model is None:
        return Verdict("nothing identified", "bad")
    if case.best_gains is None:
        return Verdict("model, but no gains", "bad")
    tones = {check.tone for check in checks_of(case)}
    if "bad" in tones:
        return Verdict("gains with serious doubts", "bad")
    if "warn" in tones or warnings_of(case):
        return Verdict("gains, with something to read first", "warn")
    return Verdict("gains ready to use", "good")


def facts_of(case: Case, *, with_id: bool) -> tuple[str, ...]:
    """Return where and when the experiment was recorded, and how it ended.

    :param case: the experiment.
    :param with_id: False if the page names its id elsewhere.
    """
    found = [_OUTCOMES[case.outcome]]
    if with_id and case.experiment_id:
        found.append(case.experiment_id)
    if case.start:
        found.append(date_text(case.start))
    length = f"{digits(case.duration)} s"
    if case.samples:
        length += f", {case.samples} samples"
        if case.lost_samples:
            length += f", {case.lost_samples} lost"
    return (*found, length)


def warnings_of(case: Case) -> tuple[str, ...]:
    """Return the sentences that must be read before anything else.

    :param case: the experiment.
    """
    found = list(case.model.warnings) if case.model is not None else []
    if case.best_gains is not None:
        found += case.best_gains.warnings
    disturbed = [c.index + 1 for c in case.cycles if c.disturbed]
    if disturbed:
        which = ", ".join(map(str, disturbed))
        found.append(f"Cycle {which} was disturbed and is left out of the averages.")
    return tuple(found)


def checks_of(case: Case) -> tuple[Check, ...]:
    """Return what speaks for the result and what against it.

    :param case: the experiment.
    """
    found = []
    if case.best_gains is not None:
        found += [_robustness(case.best_gains), _margins(case.best_gains)]
    if case.model is not None:
        found += [c for c in (_fit(case.model), _determined(case.model)) if c is not None]
    if case.limit_cycle is not None:
        cycles = len(case.limit_cycle.cycles)
        agree = f"The last {cycles} cycles agree" if cycles > 1 else "There is one cycle only"
        found.append(
            Check("Limit cycle", "settled", f"{agree}.", "good")
            if case.limit_cycle.converged
            else Check("Limit cycle", "not settled", "The cycles still differ.", "warn")
        )
    return tuple(found)


def _robustness(gains: Gains) -> Check:
    worst = gains.ms_95 if math.isfinite(gains.ms_95) else gains.ms
    tone: Tone = "good" if worst <= _USUAL_MS else "warn" if worst <= _LARGEST_MS else "bad"
    return Check(
        "Ms",
        f"{digits(gains.ms, 3)}, for 95 % of the models below {digits(gains.ms_95, 3)}",
        "The largest amplification of a disturbance by the loop; 1.2 to 2 is usual.",
        tone,
    )


def _margins(gains: Gains) -> Check:
    phase = math.degrees(gains.phase_margin)
    good = gains.gain_margin >= _GAIN_MARGIN and gains.phase_margin >= _PHASE_MARGIN
    delay = ""
    if math.isfinite(gains.delay_margin):
        delay = f" The loop bears {digits(gains.delay_margin, 3)} s more dead time."
    factor = digits(gains.gain_margin, 3) if math.isfinite(gains.gain_margin) else "any"
    return Check(
        "Margins",
        f"gain {factor}, phase {digits(phase, 3)}°",
        f"At least 2 and 30° are wanted.{delay}",
        "good" if good else "warn",
    )


def _fit(model: ModelCase) -> Check | None:
    fit = model.fit
    if not math.isfinite(fit.residual_rms):
        return None
    share = f"{100.0 * fit.fit:.2f} %" if math.isfinite(fit.fit) else ""
    left = f"residual {digits(fit.residual_rms, 3)} y rms"
    value = f"{share}, {left}" if share else left
    if math.isfinite(fit.noise_std) and fit.noise_std > 0.0:
        ratio = fit.residual_rms / fit.noise_std
        tone = _graded(ratio, _RESIDUAL_GOOD, _RESIDUAL_FAIR)
        noise = digits(fit.noise_std, 3)
        meaning = f"The residual is {digits(ratio, 3)} times the noise at rest, {noise} y."
    else:
        tone = _graded(-fit.fit, -_FIT_GOOD, -_FIT_FAIR)
        meaning = "The share of the measurement's movement that the model explains."
    if math.isfinite(fit.whiteness_p) and fit.whiteness_p < _WHITE:
        meaning += " It has a pattern that noise would not have."
    return Check("Fit", value, meaning, tone)


def _graded(value: float, good: float, fair: float) -> Tone:
    return "good" if value <= good else "warn" if value <= fair else "bad"


def _determined(model: ModelCase) -> Check | None:
    if not any(math.isfinite(e.low) for e in model.estimates):
        return None
    if not model.undetermined:
        return Check("Parameters", "determined", "Each is known to better than 20 %.", "good")
    return Check(
        "Parameters",
        f"{', '.join(model.undetermined)} not determined",
        "Their 95 % intervals are wider than 20 %.",
        "warn",
    )


def numbers_of(case: Case) -> tuple[Number, ...]:
    """Return what the limit cycle itself says.

    :param case: the experiment.
    """
    cycle = case.limit_cycle
    if cycle is None:
        return ()
    found = [
        Number("period", f"{digits(cycle.period)} s"),
        Number("high / low", f"{digits(cycle.period_high)} s / {digits(cycle.period_low)} s"),
        Number("measurement", f"{digits(cycle.peak_min)} to {digits(cycle.peak_max)} y"),
        Number("cycles averaged", f"{len(cycle.cycles)}"),
    ]
    if case.settings is not None:
        found += [
            Number("relay", f"±{digits(case.settings.amplitude)} u"),
            Number("bias", f"{digits(case.settings.bias)} u"),
            Number("hysteresis", f"±{digits(case.settings.hysteresis)} y"),
        ]
    return tuple(found)


def doubts_of(case: Case) -> tuple[str, ...]:
    """Return what remains uncertain and what would tell, in sentences.

    :param case: the experiment.
    """
    model = case.model
    if model is None:
        return ()
    found = []
    for estimate in model.estimates:
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
