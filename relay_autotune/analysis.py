# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""From a record to models and gains; live nodes and replay share this path."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.errors import IdentificationError, RelayAutotuneError, TuningError, defect
from relay_autotune.identification.judgement.assessment import assess, is_far_off
from relay_autotune.identification.judgement.checks import unequal_amplitudes
from relay_autotune.identification.judgement.disturbance import with_its_load, without_disturbance
from relay_autotune.identification.judgement.evidence import Evidence
from relay_autotune.identification.judgement.table import MODEL_CHECKS
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods import (
    DEFAULT_METHOD,
    METHODS,
    identify,
    identify_jointly,
    method_named,
)
from relay_autotune.identification.result import Identification
from relay_autotune.process.structures import FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint
from relay_autotune.record.cycles import cycles_of, limit_cycle
from relay_autotune.record.record import Cycle, Outcome, Record, one_record
from relay_autotune.record.thinning import thinned
from relay_autotune.result import Analysis
from relay_autotune.shaping import Shaping
from relay_autotune.tuning import (
    DEFAULT_RULE,
    RULES,
    DesignOptions,
    DesignTask,
    design,
    ensemble,
    rule_named,
)
from relay_autotune.tuning.ensemble import predicted_ms
from relay_autotune.tuning.rules.limit_cycle import describing_point_of_cycle
from relay_autotune.verdict import NOT_JUDGED, Judgement, Verdict, judge

_NO_GAINS = {
    Outcome.ABORTED: "the experiment was aborted",
    Outcome.FAILED: "the experiment failed",
}
# Parameters of a load step: its instant and size.
_LOAD = 2

# Takes a sentence on what begins.
Tell = Callable[[str], object]


def _quiet(_: str) -> None:
    """Tell nobody."""


def check_names(method: str, rule: str) -> None:
    """Refuse unknown names before any work is done.

    :raises RelayAutotuneError: for an unknown method or rule; the message lists the known ones.
    """
    method_named(method)
    rule_named(rule)


def analyse(
    record: Record,
    *,
    method: str = DEFAULT_METHOD,
    rule: str = DEFAULT_RULE,
    known: Known = NOTHING,
    options: DesignOptions | None = None,
    rng: np.random.Generator | None = None,
    tell: Tell = _quiet,
) -> Analysis:
    """Identify a record and, where the experiment was completed, tune: by all methods and rules.

    >>> from relay_autotune import analyse, read_records
    >>> (record,) = read_records("bags/heater.csv")
    >>> found = analyse(record)
    >>> print(found.model.model)
    0.6204 e^(-15.89 s) / (1 + 110.2 s)
    >>> print(found.best_gains)
    kc = 4.994, ti = 43.34 s, td = 7.297 s

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
    :raises RelayAutotuneError: if method or rule are unknown, or it is not a record.
    """
    record = one_record(record, "analyse")
    check_names(method, rule)
    tell("comparing structures" if method == DEFAULT_METHOD else f"identifying by {method}")
    chosen = _chosen(record, method, known)
    if isinstance(chosen, Analysis):
        return chosen
    tell("comparing methods")
    models = [chosen.model, *_others(chosen.driven, method, known, chosen.model)]
    simple = next((m.model for m in models if m.structure == FOPDT.name), None)
    return _assessed(chosen, models, known, _first(rule), simple, options, rng, tell)


def analyse_alone(
    record: Record,
    *,
    method: str = DEFAULT_METHOD,
    rule: str = DEFAULT_RULE,
    known: Known = NOTHING,
    options: DesignOptions | None = None,
    rng: np.random.Generator | None = None,
) -> Analysis:
    """Identify a record by one method and, where the experiment was completed, tune by one rule.

    Model and gains equal those of :func:`analyse`, without the other methods and rules; for many
    records.

    :param record: the experiment.
    :param method: the method.
    :param rule: the rule.
    :param known: known values of the process.
    :param options: as for :func:`analyse`.
    :param rng: as for :func:`analyse`.
    :raises RelayAutotuneError: if method or rule are unknown, or it is not a record.
    """
    record = one_record(record, "analyse_alone")
    check_names(method, rule)
    chosen = _chosen(record, method, known)
    if isinstance(chosen, Analysis):
        return chosen
    simple = chosen.simple(known, rule)
    return _assessed(chosen, [chosen.model], known, (rule,), simple, options, rng)


def model_so_far(
    record: Record, *, method: str = DEFAULT_METHOD, known: Known = NOTHING
) -> Analysis:
    """Identify the record of a running experiment by one method.

    This takes a fraction of the time of :func:`analyse`. There are no gains.

    :param record: the record so far.
    :param method: the method.
    :param known: known values of the process.
    :raises RelayAutotuneError: if the method is unknown.
    """
    method_named(method)
    chosen = _chosen_so_far(record, method, known)
    return chosen if isinstance(chosen, Analysis) else chosen.alone


def prediction_so_far(
    record: Record,
    *,
    method: str = DEFAULT_METHOD,
    rule: str = DEFAULT_RULE,
    known: Known = NOTHING,
    options: DesignOptions | None = None,
    rng: np.random.Generator | None = None,
) -> Analysis:
    """Identify like :func:`model_so_far`, and predict the Ms of the gains.

    :param record: the record so far.
    :param method: the method.
    :param rule: the rule of the gains.
    :param known: known values of the process.
    :param options: as for :func:`analyse`.
    :param rng: as for :func:`analyse`.
    :raises RelayAutotuneError: if method or rule are unknown.
    """
    check_names(method, rule)
    chosen = _chosen_so_far(record, method, known)
    if isinstance(chosen, Analysis):
        return chosen
    task = _task(chosen.alone, rng, chosen.simple(known, rule), options)
    return replace(chosen.alone, predicted=predicted_ms(task, rule_named(rule)))


@dataclass(frozen=True)
class _Chosen:
    """The selected model.

    :param record: the record.
    :param cycles: its whole cycles.
    :param model: the identification.
    :param driven: the record including the load step, if one was found.
    """

    record: Record
    cycles: tuple[Cycle, ...]
    model: Identification
    driven: Record

    @property
    def alone(self) -> Analysis:
        """The analysis with this model only."""
        return Analysis(self.record, self.cycles, (self.model,), 0)

    def simple(self, known: Known, rule: str) -> TransferFunction | None:
        """Return the FOPDT for a rule, None if the rule needs none or there is none."""
        if self.model.structure == FOPDT.name:
            return self.model.model
        return None if rule == DEFAULT_RULE else _simple((self.driven,), known, self.model)


def _chosen(record: Record, method: str, known: Known) -> _Chosen | Analysis:
    """Return the selected model; without a model, the analysis with the reason."""
    record = thinned(record)
    cycles: tuple[Cycle, ...] = ()
    try:
        cycles = cycles_of(record)
        chosen = _with_remarks(_guarded(record, method, known), (record,))
    except RelayAutotuneError as error:
        return _nothing(record, cycles, error)
    chosen = without_disturbance(
        chosen, record, cycles, lambda part: _guarded(part, method, known)
    )
    if chosen.method != DEFAULT_METHOD or known.structure:
        return _Chosen(record, cycles, chosen, record)
    loaded = with_its_load(
        chosen,
        record,
        cycles,
        lambda part, kind: _guarded(part, method, replace(known, structure=kind)),
    )
    return _Chosen(record, cycles, *loaded)


def _chosen_so_far(record: Record, method: str, known: Known) -> _Chosen | Analysis:
    """Return the selected model of a running experiment, or the analysis with the reason."""
    chosen = _chosen(record, method, known)
    if isinstance(chosen, Analysis):
        # A running experiment without a model is not judged yet.
        return replace(chosen, judgement=NOT_JUDGED)
    if not is_far_off(chosen.model, chosen.record):
        return chosen
    # The record contradicts this model, so its interval must not end a test.
    model = replace(chosen.model, ultimate_gain_std=math.nan, ultimate_frequency_std=math.nan)
    return replace(chosen, model=model)


def _assessed(
    chosen: _Chosen,
    models: Sequence[Identification],
    known: Known,
    rules: Sequence[str],
    simple: TransferFunction | None,
    options: DesignOptions | None,
    rng: np.random.Generator | None,
    tell: Tell = _quiet,
) -> Analysis:
    """Judge models, the selected one first, and tune it."""
    record = chosen.record
    tell("judging the model")
    found = Analysis(record, chosen.cycles, assess(models, record), 0)
    evidence = Evidence(
        record,
        found.models[0],
        beside=0 if chosen.driven is record else _LOAD,
        free=not known.structure,
        samples=chosen.model.method == DEFAULT_METHOD,
        others=found.models[1:],
        settled=bool(chosen.cycles) and limit_cycle(chosen.cycles).converged,
        driven=chosen.driven,
    )
    return _judged(found, evidence, (record,), rules, simple, options, rng, tell)


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
    rule_named(rule)
    records = [thinned(record) for record in records]
    first = records[0]
    cycles: tuple[Cycle, ...] = ()
    try:
        cycles = cycles_of(first)
        chosen = _with_remarks(identify_jointly(records, method, known), records)
    except RelayAutotuneError as error:
        return _nothing(first, cycles, error)
    told = unequal_amplitudes(records, chosen.model)
    if told:
        chosen = replace(chosen, warnings=(*chosen.warnings, told))
    found = Analysis(first, cycles, assess((chosen,), first), 0)
    evidence = Evidence(first, found.models[0], free=False, samples=method == DEFAULT_METHOD)
    simple = _simple(records, known, chosen)
    return _judged(found, evidence, records, _first(rule), simple, options, rng)


def _nothing(record: Record, cycles: tuple[Cycle, ...], error: RelayAutotuneError) -> Analysis:
    """Return the analysis of a record without a model."""
    reason = _with_outcome(record, str(error))
    return Analysis(record, cycles, reason=reason, judgement=Judgement(refused=reason))


def _judged(
    found: Analysis,
    evidence: Evidence,
    records: Sequence[Record],
    rules: Sequence[str],
    simple: TransferFunction | None,
    options: DesignOptions | None,
    rng: np.random.Generator | None,
    tell: Tell = _quiet,
) -> Analysis:
    """Judge the model, add gains if they are allowed, and judge the gains."""
    refused = next((_refusal(r) for r in records if r.outcome in _NO_GAINS), "")
    findings = judge(MODEL_CHECKS, evidence)
    judgement = Judgement(findings, refused=refused)
    if judgement.verdict is Verdict.NONE:
        return _without_gains(found, judgement)
    tell("designing the gains")
    shaping = Shaping(_task(found, rng, simple, options), evidence, findings)
    found = replace(found, shaping=shaping)
    tuned = _tuned(found, shaping.task, rules)
    gains = tuned.best_gains
    if gains is None:
        return replace(tuned, judgement=replace(judgement, refused=tuned.reason))
    judgement = shaping.judgement(gains)
    if judgement.verdict is Verdict.NONE:
        return _without_gains(found, judgement)
    return replace(tuned, judgement=judgement)


def _with_remarks(found: Identification, records: Sequence[Record]) -> Identification:
    """Add to a model's warnings how the records were changed before."""
    said = [record.unthinned.remark for record in records if record.unthinned is not None]
    return replace(found, warnings=(*found.warnings, *said))


def _refusal(record: Record) -> str:
    return f"{_NO_GAINS[record.outcome]}: no gains. {record.reason}".strip()


def _without_gains(found: Analysis, judgement: Judgement) -> Analysis:
    reason = judgement.refused or f"no gains: {judgement.reason}"
    return replace(found, gains=(), recommended=None, judgement=judgement, reason=reason)


def _first(rule: str) -> tuple[str, ...]:
    """Return the names of all rules, the chosen one first."""
    return (rule, *(name for name in RULES if name != rule))


def _simple(
    records: Sequence[Record], known: Known, chosen: Identification
) -> TransferFunction | None:
    """Return the best FOPDT, which most rules need; None if there is none."""
    if chosen.structure == FOPDT.name:
        return chosen.model
    try:
        found = identify_jointly(records, DEFAULT_METHOD, replace(known, structure=FOPDT.name))
    except RelayAutotuneError:
        return None
    return found.model


def _tuned(found: Analysis, task: DesignTask, rules: Sequence[str]) -> Analysis:
    """Add the gains of the rules that apply to the selected model; the first rule must apply."""
    try:
        first = design(task, rules[0])
    except TuningError as error:
        return replace(found, reason=f"no gains: {error}")
    gains = [first]
    for name in rules[1:]:
        try:
            gains.append(design(task, name))
        except TuningError:
            # Skip a rule that does not apply: it is only for comparison.
            continue
    delay = task.options.added_delay
    return replace(found, gains=tuple(gains), recommended=0, added_delay=delay)


def _task(
    found: Analysis,
    rng: np.random.Generator | None,
    simple: TransferFunction | None,
    options: DesignOptions | None,
) -> DesignTask:
    chosen = found.models[0]
    return DesignTask(
        model=chosen.model,
        options=_with_noise(options or DesignOptions(), found),
        simple=simple,
        models=ensemble(chosen, rng=rng or np.random.default_rng(0)),
        describing=_describing_point(found),
    )


def _with_noise(options: DesignOptions, found: Analysis) -> DesignOptions:
    """Take noise, amplitude and sampling period from the record if they are not given."""
    record, chosen = found.record, found.models[0]
    # The controller will see single samples, not means of many.
    before = record.unthinned
    if math.isnan(options.noise_std):
        measured = record.noise_std if record.noise_std > 0.0 else chosen.fit.residual_rms
        measured = measured if before is None else before.noise
        options = replace(options, noise_std=measured)
    if math.isnan(options.amplitude):
        # Without relay settings: half of the command's range.
        settings, half = record.settings, 0.5 * float(np.ptp(record.command))
        options = replace(options, amplitude=half if settings is None else abs(settings.amplitude))
    if options.sample_period == 0.0 and len(record) > 1:
        period = record.interval if before is None else before.interval
        # Further digits are jitter of the stamps, and no program is set to them.
        options = replace(options, sample_period=float(f"{period:.3g}"))
    return options


def _describing_point(found: Analysis) -> UltimatePoint | None:
    """Return the describing function's ultimate point of the limit cycle; None without cycle."""
    settings = found.record.settings
    if not found.cycles or settings is None:
        return None
    cycle = limit_cycle(found.cycles)
    amplitude = 0.5 * (cycle.peak_max - cycle.peak_min)
    if not amplitude > 0.0:
        return None
    return describing_point_of_cycle(
        cycle.period,
        cycle.period_high,
        amplitude,
        settings.amplitude,
        found.models[0].model.process_sign,
    )


def _guarded(record: Record, method: str, known: Known) -> Identification:
    try:
        return identify(record, method, known)
    except RelayAutotuneError:
        raise
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        # A search raises ValueError when it meets a number that is not finite.
        raise IdentificationError(
            f"{method} broke down on this record, whose numbers it cannot work with: it holds no "
            f"usable response, or this is {defect(error)}"
        ) from error


def _others(
    record: Record, method: str, known: Known, chosen: Identification
) -> list[Identification]:
    """Return the models of the other methods that apply, for comparison.

    The first is the best FOPDT, which most rules need.
    """
    wanted = [(DEFAULT_METHOD, replace(known, structure=FOPDT.name))]
    wanted += [(name, known) for name in METHODS if name not in (method, DEFAULT_METHOD)]
    if chosen.method == DEFAULT_METHOD and chosen.structure == FOPDT.name:
        wanted = wanted[1:]
    found = []
    for name, facts in wanted:
        try:
            found.append(_guarded(record, name, facts))
        except RelayAutotuneError:
            continue
    return found


def _with_outcome(record: Record, reason: str) -> str:
    refused = _NO_GAINS.get(record.outcome)
    return f"{refused} ({record.reason}); {reason}" if refused else reason
