# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""From records to models and gains: of an ended test, a running one, or several tests.

Live nodes and replay share this path.
The experiments of one recording are tests of one process: :func:`agreed` compares them.
``PARAMETERS`` are those of identifier_node: method, rule, known process values, design options.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from relay_autotune.errors import IdentificationError, RelayAutotuneError, TuningError, defect
from relay_autotune.experiment.early_end import MS
from relay_autotune.identification.judgement.assessment import assess, is_far_off
from relay_autotune.identification.judgement.checks import unequal_amplitudes
from relay_autotune.identification.judgement.difference import difference, widened
from relay_autotune.identification.judgement.disturbance import without_disturbance
from relay_autotune.identification.judgement.evidence import Evidence
from relay_autotune.identification.judgement.table import MODEL_CHECKS
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods import (
    DEFAULT_METHOD,
    METHODS,
    identify,
    identify_jointly,
    method_named,
    require_used,
    used_by,
)
from relay_autotune.identification.result import Identification
from relay_autotune.process.structures import FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import NORMAL_95, Quantity, declared
from relay_autotune.record.cycles import limit_cycle
from relay_autotune.record.record import Outcome, Record, one_record
from relay_autotune.record.thinning import thinned
from relay_autotune.result import Analysis, Shaping
from relay_autotune.text import digits
from relay_autotune.tuning import DEFAULT_RULE, RULES, design, rule_named
from relay_autotune.tuning.ensemble import predicted_ms
from relay_autotune.tuning.of_record import sampling_period, task_of_record, warned_of_rows
from relay_autotune.tuning.task import DesignOptions, DesignTask
from relay_autotune.verdict import NOT_JUDGED, Finding, Judgement, Result, Verdict, judge

_NO_GAINS = {
    Outcome.ABORTED: "the experiment was aborted",
    Outcome.FAILED: "the experiment failed",
}
# The structure of a running experiment is chosen again at the latest when its record has grown by
# this factor.
_CHOSEN_ANEW = 1.1

# Takes a sentence on what begins.
Tell = Callable[[str], object]


def _quiet(_: str) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Task:
    """How to identify a record and to design a controller for it.

    :param method: the method of the selected model.
    :param rule: the rule of the recommended gains.
    :param known: known values of the process.
    :param options: design options of the controller; noise, amplitude and sampling period come
        from the record if they are not given.
    :raises RelayAutotuneError: if method or rule are unknown, or the method does not use a value
        that is known; the message lists those that there are, or that do.
    """

    method: str = DEFAULT_METHOD
    rule: str = DEFAULT_RULE
    known: Known = NOTHING
    options: DesignOptions = field(default_factory=DesignOptions)

    def __post_init__(self) -> None:
        method_named(self.method)
        require_used(self.method, self.known)
        rule_named(self.rule)

    @property
    def chooses(self) -> bool:
        """Whether the structure is for the method to choose."""
        return self.method == DEFAULT_METHOD and not self.known.structure


def analyse(
    record: Record,
    *,
    method: str = DEFAULT_METHOD,
    rule: str = DEFAULT_RULE,
    known: Known = NOTHING,
    options: DesignOptions | None = None,
    rng: np.random.Generator | None = None,
    tell: Tell = _quiet,
    alone: bool = False,
) -> Analysis:
    """Identify a record and, where the experiment was completed, tune: by all methods and rules.

    >>> from relay_autotune import analyse, read_records
    >>> (record,) = read_records("bags/heater.csv")
    >>> found = analyse(record)
    >>> print(found.model.model)
    0.6204 e^(-15.89 s) / (1 + 110.2 s)
    >>> print(found.best_gains)
    kc = 4.4, ti = 44.18 s, td = 8.474 s

    Data without a usable model are a result, not an exception: the reason says what was found and
    what to do. Only a completed experiment, or data without any outcome, yield gains, and only if
    no check of the table in ``identification.judgement`` failed. The verdict says whether the
    gains may be used.

    :param record: the experiment.
    :param method: the method of the selected model.
    :param rule: the rule of the recommended gains.
    :param known: known values of the process.
    :param options: design options of the controller; noise and amplitude come from the record if
        they are not given.
    :param rng: draws the models within the uncertainty; default: a generator of fixed seed, so
        that equal records give equal numbers.
    :param tell: called with what begins, such as ``comparing structures``.
    :param alone: True: the model of ``method`` and the gains of ``rule`` without the others, in
        a fraction of the time; these two and the verdict are the same.
    :raises RelayAutotuneError: if method or rule are unknown, or it is not a record.
    """
    record = one_record(record, "analyse")
    task = Task(method, rule, known, options or DesignOptions())
    tell("comparing structures" if method == DEFAULT_METHOD else f"identifying by {method}")
    chosen = _chosen(record, task)
    if isinstance(chosen, Analysis):
        return chosen
    if not alone:
        tell("comparing methods")
    models = [chosen.model, *([] if alone else _others(chosen, task))]
    simple = next((m.model for m in models if m.structure == FOPDT.name), None)
    if alone:
        simple = chosen.simple(task)
    tell("judging the model")
    record = chosen.record
    found = Analysis(record, assess(models, record))
    settled = bool(found.cycles) and limit_cycle(found.cycles).converged
    return _judged(found, (record,), task, simple, rng, tell, alone=alone, settled=settled)


def model_so_far(record: Record, task: Task | None = None, *, predicts: bool = False) -> Analysis:
    """Identify the record of a running experiment by one method.

    This takes a fraction of the time of :func:`analyse`. There are no gains.

    :param record: the record so far.
    :param task: method, rule, what is known and asked; None: the defaults.
    :param predicts: True: the Ms of the gains is predicted.
    """
    task = task or Task()
    chosen = _chosen_so_far(record, task)
    if isinstance(chosen, Analysis):
        return chosen
    found = Analysis(chosen.record, (chosen.model,))
    if not predicts:
        return found
    designed = task_of_record(chosen.model, chosen.record, task.options, chosen.simple(task))
    return replace(found, predicted=predicted_ms(designed, rule_named(task.rule)))


class RunningFit:
    """Fit the record of a running experiment repeatedly, with as little work as possible.

    Choosing among all structures takes ten times as long as fitting one. So the last chosen
    structure is fitted first. If its interval is already too wide to end the experiment, the
    spread between the structures would only widen it, and the choice is skipped.
    """

    def __init__(self) -> None:
        self._chosen: Identification | None = None
        self._duration = 0.0

    def fit(self, record: Record, task: Task, sought: str, wanted: float) -> Analysis:
        """Return the model of the record so far, with the predicted Ms if that is sought.

        :param record: the record so far.
        :param task: settings of the fit.
        :param sought: the quantity whose interval ends the experiment, one of
            :data:`~relay_autotune.experiment.early_end.SOUGHT`.
        :param wanted: half the interval's width over the value.
        """
        so_far = partial(model_so_far, predicts=sought == MS)
        chosen = self._chosen
        recent = record.duration < _CHOSEN_ANEW * self._duration
        if task.chooses and chosen is not None and recent:
            order = chosen.estimate.structure.given_order
            known = replace(task.known, structure=chosen.structure, order=order)
            again = so_far(record, replace(task, known=known))
            if again.model is not None and not again.finding.width(sought) <= wanted:
                return again
        found = so_far(record, task)
        if task.chooses:
            self._chosen, self._duration = found.model, record.duration
        return found


@dataclass(frozen=True)
class _Chosen:
    """The selected model.

    :param records: what was identified; the first represents all.
    :param model: the identification, without the fit of the FOPDT, which holds many times the
        memory of the record.
    :param plain: of the identification.
    """

    records: Sequence[Record]
    model: Identification
    plain: Callable[[], Identification | None] | None

    @property
    def record(self) -> Record:
        """The record."""
        return self.records[0]

    def fopdt(self, known: Known) -> Identification | None:
        """Return the best FOPDT by the default method; None: there is none.

        :param known: known values of the process.
        """
        known = replace(used_by(DEFAULT_METHOD, known), structure=FOPDT.name, order=0)

        def fit() -> Identification:
            beside = None if self.plain is None else self.plain()
            return beside or identify_jointly(self.records, DEFAULT_METHOD, known)

        with suppress(RelayAutotuneError):
            return _guarded(DEFAULT_METHOD, fit)
        return None

    def simple(self, task: Task, *, alone: bool = True) -> TransferFunction | None:
        """Return the FOPDT that most rules need; None: these do not, or there is none.

        :param task: what is known, and the rule.
        :param alone: whether no other rule gives gains.
        """
        if self.model.structure == FOPDT.name:
            return self.model.model
        needed = not alone or task.rule != DEFAULT_RULE
        fopdt = self.fopdt(task.known) if needed else None
        return None if fopdt is None else fopdt.model


def _chosen(record: Record, task: Task) -> _Chosen | Analysis:
    """Return the selected model; without a model, the analysis with the reason."""
    record = thinned(record)

    def fit(part: Record) -> Identification:
        return _guarded(task.method, partial(identify, part, task.method, task.known))

    return _identified((record,), lambda: without_disturbance(record, fit))


def _identified(
    records: Sequence[Record], fit: Callable[[], Identification]
) -> _Chosen | Analysis:
    """Return the model of records, with how they were changed before among its warnings.

    :return: without a model, the analysis with the reason.
    """
    first = records[0]
    try:
        for record in records:
            sampling_period(record)
        found = fit()
    except RelayAutotuneError as error:
        reason = _with_outcome(first, str(error))
        return Analysis(first, reason=reason, judgement=Judgement(refused=reason))
    said = [record.unthinned.remark for record in records if record.unthinned is not None]
    model = replace(found, plain=None, warnings=(*found.warnings, *said))
    return _Chosen(records, model, found.plain)


def _chosen_so_far(record: Record, task: Task) -> _Chosen | Analysis:
    """Return the selected model of a running experiment, or the analysis with the reason."""
    chosen = _chosen(record, task)
    if isinstance(chosen, Analysis):
        # A running experiment without a model is not judged yet.
        return replace(chosen, judgement=NOT_JUDGED)
    if not is_far_off(chosen.model, chosen.record):
        return chosen
    # The record contradicts this model, so its interval must not end a test.
    model = replace(chosen.model, ultimate_gain_std=math.nan, ultimate_frequency_std=math.nan)
    return replace(chosen, model=model)


def analyse_jointly(
    records: Sequence[Record],
    *,
    method: str = DEFAULT_METHOD,
    rule: str = DEFAULT_RULE,
    known: Known = NOTHING,
    options: DesignOptions | None = None,
    rng: np.random.Generator | None = None,
) -> Analysis:
    """Identify one model from several records of a process and, where all were completed, tune.

    >>> from relay_autotune import Known, analyse_jointly, read_records
    >>> tests = [read_records(f"bags/{name}_relay{more}")[0]
    ...          for name, more in (("biased", ""), ("unbiased", "_with_noise"))]
    >>> found = analyse_jointly(tests, rule="simc", known=Known(structure="fopdt"))
    >>> found.model.model.structure, round(found.model.model.gain, 2)
    ('fopdt', 1.65)

    :param records: the experiments, at least one; the first represents all in the result.
    :param method: one of ``JOINT_METHODS``.
    :param rule: the rule of the recommended gains.
    :param known: known values of the process.
    :param options: as for :func:`analyse`.
    :param rng: as for :func:`analyse`.
    :raises RelayAutotuneError: if method or rule are unknown.
    """
    task = Task(method, rule, known, options or DesignOptions())
    records = [thinned(record) for record in records]
    joint = _identified(records, lambda: identify_jointly(records, method, known))
    if isinstance(joint, Analysis):
        return joint
    first, chosen = joint.record, joint.model
    warning = unequal_amplitudes(records, chosen.model)
    if warning:
        chosen = replace(chosen, warnings=(*chosen.warnings, warning))
    found = Analysis(first, assess((chosen,), first))
    return _judged(found, records, task, joint.simple(task, alone=False), rng)


def _judged(
    found: Analysis,
    records: Sequence[Record],
    asked: Task,
    simple: TransferFunction | None,
    rng: np.random.Generator | None,
    tell: Tell = _quiet,
    *,
    alone: bool = False,
    settled: bool = False,
) -> Analysis:
    """Judge the model, add gains if they are allowed, and judge the gains.

    :param asked: what is known and asked.
    :param simple: the FOPDT that most rules need; None: there is none.
    :param rng: draws the models within the uncertainty; None: of a fixed seed.
    :param tell: called with what begins.
    :param alone: whether the other rules give no gains for comparison.
    """
    chosen, *others = found.models
    beside = difference(chosen, found.record)
    chosen = widened(chosen, beside)
    found = replace(found, models=(chosen, *others))
    evidence = Evidence(found.record, chosen, beside, settled)
    ended = (
        f"{_NO_GAINS[r.outcome]}: no gains. {r.reason}" for r in records if r.outcome in _NO_GAINS
    )
    refused = next(ended, "").strip()
    findings = judge(MODEL_CHECKS, evidence)
    judgement = Judgement(findings, refused=refused)
    if judgement.verdict is Verdict.NONE:
        return _without_gains(found, judgement)
    tell("designing the gains")
    record, options = found.record, asked.options
    task = task_of_record(chosen, record, options, simple, rng, beside)
    shaping = Shaping(task, evidence, findings)
    chosen = warned_of_rows(chosen, record)
    found = replace(found, models=(chosen, *others), shaping=shaping)
    tuned = _tuned(found, task, asked.rule, () if alone else tuple(RULES))
    gains = tuned.best_gains
    if gains is None:
        return replace(tuned, judgement=replace(judgement, refused=tuned.reason))
    judgement = shaping.judgement(gains)
    if judgement.verdict is Verdict.NONE:
        return _without_gains(found, judgement)
    return replace(tuned, judgement=judgement)


def _without_gains(found: Analysis, judgement: Judgement) -> Analysis:
    reason = judgement.refused or f"no gains: {judgement.reason}"
    return replace(found, gains=(), judgement=judgement, reason=reason)


def _tuned(found: Analysis, task: DesignTask, rule: str, others: Sequence[str]) -> Analysis:
    """Add the gains of a rule, and of others that apply to the selected model."""
    try:
        gains = [design(task, rule)]
    except TuningError as error:
        return replace(found, reason=f"no gains: {error}")
    for name in others:
        # A rule that does not apply is left out: it is only for comparison.
        with suppress(TuningError):
            gains += [design(task, name)] if name != rule else []
    delay = task.options.added_delay
    return replace(found, gains=tuple(gains), added_delay=delay)


def _guarded(method: str, fit: Callable[[], Identification]) -> Identification:
    try:
        return fit()
    except RelayAutotuneError:
        raise
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        # A search raises ValueError when it meets a number that is not finite.
        raise IdentificationError(
            f"{method} broke down on this record, whose numbers it cannot work with: it holds no "
            f"usable response, or this is {defect(error)}"
        ) from error


def _others(chosen: _Chosen, task: Task) -> list[Identification]:
    """Return the models of the other methods that apply, for comparison.

    The first is the best FOPDT, which most rules need.
    """
    record, model = chosen.record, chosen.model
    is_fopdt = model.method == DEFAULT_METHOD and model.structure == FOPDT.name
    fopdt = None if is_fopdt else chosen.fopdt(task.known)
    found = [] if fopdt is None else [fopdt]
    for name in METHODS:
        if name not in (task.method, DEFAULT_METHOD):
            with suppress(RelayAutotuneError):
                found.append(
                    _guarded(name, partial(identify, record, name, used_by(name, task.known)))
                )
    return found


def _with_outcome(record: Record, reason: str) -> str:
    refused = _NO_GAINS.get(record.outcome)
    return f"{refused} ({record.reason}); {reason}" if refused else reason


def agreed(analyses: Sequence[Analysis]) -> tuple[Analysis, ...]:
    """Return the analyses of the parts of one recording, with a doubt where two contradict.

    One process has one sign and one ultimate gain. Where two parts with gains differ in the sign,
    or the intervals of the ultimate gain do not meet, at least one of them is wrong, or the
    process changed; nothing tells which part shows how it is now. Gains of the wrong sign drive
    the process to a limit: where the sign differs no part has gains.

    :param analyses: of all parts, in order.
    """
    given = [
        (number, analysis.model)
        for number, analysis in enumerate(analyses, start=1)
        if analysis.best_gains is not None and analysis.model is not None
    ]
    pairs = itertools.combinations(given, 2)
    apart = [(_apart(a[1], b[1]), a, b) for a, b in pairs]
    value, *two = max(apart, key=lambda pair: pair[0], default=(0.0,))
    if not value > 0.0:
        return tuple(analyses)
    said = " and ".join(f"{_gain(model)} in part {number}" for number, model in two)
    doubt = Finding(
        name="parts",
        title="Other parts",
        what="distance of the intervals of the ultimate gain in two parts of the recording",
        value=value,
        unit="u/y",
        limit=0.0,
        result=Result.FAILED if math.isinf(value) else Result.DOUBTFUL,
        sentence=f"the parts of this recording contradict each other: the ultimate gain is {said}",
        remedy="take the part that shows the process as it is, with --start and --end, or test "
        "again",
    )

    def doubted(each: Analysis) -> Analysis:
        judgement = replace(each.judgement, findings=(*each.judgement.findings, doubt))
        if each.best_gains is not None and judgement.verdict is Verdict.NONE:
            return _without_gains(each, judgement)
        return replace(each, judgement=judgement)

    return tuple(doubted(each) for each in analyses)


def _gain(found: Identification) -> str:
    if math.isfinite(found.ultimate_gain):
        return f"{digits(found.ultimate_gain, 3)} u/y"
    return "positive" if found.model.process_sign > 0 else "negative"


def _apart(a: Identification, b: Identification) -> float:
    """Return how far the intervals of the ultimate gains are apart [u/y]; inf: the sign differs.

    An unknown interval meets every other.
    """
    if a.model.process_sign != b.model.process_sign:
        return math.inf
    width = NORMAL_95 * (a.ultimate_gain_std + b.ultimate_gain_std)
    apart = abs(a.ultimate_gain - b.ultimate_gain) - width
    return apart if math.isfinite(apart) else 0.0


# Measured by the experiment, so they are no parameters.
_MEASURED = ("noise_std", "amplitude")
# Renamed, because the plain name would mean something else among a controller's parameters.
_PREFIXED = {"gain": "known_gain", "dead_time": "known_dead_time"}

KNOWN = tuple(
    replace(each, name=_PREFIXED.get(each.name, each.name), flag=each.name)
    for each in declared(Known)
)
DESIGN = tuple(each for each in declared(DesignOptions) if each.name not in _MEASURED)
PARAMETERS = (
    Quantity("method", DEFAULT_METHOD, choices=tuple(METHODS)).means(
        "Method whose model is published."
    ),
    Quantity("rule", DEFAULT_RULE, choices=tuple(RULES)).means("Rule whose gains are published."),
    *KNOWN,
    *DESIGN,
)


def known_from(values: Mapping[str, Any]) -> Known:
    """Return the known values of the process.

    :param values: of the parameters, by name.
    :raises ParameterError: if a value is out of its range, or the gain is zero.
    """
    return Known(**{each.flag: values[each.name] for each in KNOWN})


def options_from(values: Mapping[str, Any]) -> DesignOptions:
    """Return the design options of the controller.

    :param values: of the parameters, by name.
    :raises TuningError: if a value is out of its range.
    """
    return DesignOptions(**{each.name: values[each.name] for each in DESIGN})


def task_from(values: Mapping[str, Any]) -> Task:
    """Return how a record is to be identified and a controller to be designed.

    :param values: of the parameters, by name.
    :raises RelayAutotuneError: if a value is out of its range, or a name is unknown.
    """
    return Task(values["method"], values["rule"], known_from(values), options_from(values))
