# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The table of checks. Adding a check is adding a row, and the function that measures it.

Each function returns a number that is the larger the worse, or None where the check does not
apply. How often each row speaks on right and on wrong gains, of records of many kinds, is counted
by benchmarks/verdicts.py and shown in docs/verdict.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from relay_autotune.identification.judgement.assessment import misfit, unexplained_share
from relay_autotune.identification.judgement.checks import (
    followed_changes,
    followed_share,
    lost_effect,
)
from relay_autotune.identification.judgement.evidence import MOST_GROWTH, Evidence, Loop
from relay_autotune.identification.judgement.refits import other_sign
from relay_autotune.identification.result import NOT_AT_REST
from relay_autotune.identification.waveform.starts import latest_dead_time
from relay_autotune.process.transfer_function import TransferFunction, process_text
from relay_autotune.quantities import NORMAL_95
from relay_autotune.text import digits
from relay_autotune.verdict import Check, Measured

_FREQUENCIES = 300
# Quantile of Ms over the models of a half that counts: nine of ten are worse.
_BUT_FEW = 0.1
# Half width of the interval of K_u, relative to K_u, up to which K_u is known.
_KNOWN = 0.2
# Residual of a half's best model on the whole record, over the least one, from which the whole
# overrules the half; the share that then counts is doubtful.
_FAR_WORSE, _OVERRULED = 3.0, 0.8


def _direction(evidence: Evidence) -> Measured | None:
    other = evidence.other
    if other is None:
        return None
    sign = other.model.process_sign
    raises, lowers = ("raises", "lowers") if sign > 0 else ("lowers", "raises")
    return Measured(
        other.lead,
        f"the relay assumed that a higher command {lowers} the measurement; a process where it "
        f"first {lowers} and then {raises} it fits the record as well: test with "
        f"process_gain_sign {sign} (0: it is found)",
    )


def _fed_back(evidence: Evidence) -> Measured | None:
    share = followed_share(evidence.record, evidence.found.model.process_sign)
    return None if share is None else Measured(share)


def _fed_back_changes(evidence: Evidence) -> Measured | None:
    share = followed_changes(evidence.record, evidence.found.model.process_sign)
    return None if share is None else Measured(share)


def _rival_direction(evidence: Evidence) -> Measured | None:
    models = (*evidence.rivals, *evidence.plain)
    if not models:
        return None
    other = [m for m in models if m.process_sign != evidence.found.model.process_sign]
    return Measured(len(other), process_text(other[0]) if other else "")


def _open_dead_time(evidence: Evidence) -> Measured | None:
    found = evidence.found
    high = dict(zip(found.parameters, found.ci95_high, strict=True)).get("dead_time", math.nan)
    if math.isnan(high):
        return None
    return Measured(float(high) / evidence.record.duration)


def _first_response(evidence: Evidence) -> Measured | None:
    record, model = evidence.record, evidence.found.model
    # In a relay test a load may come before the response, and the cycles show the dead time.
    if record.settings is not None:
        return None
    latest = latest_dead_time(record.time, record.measurement, record.drive(), model.process_sign)
    return Measured(model.dead_time / latest) if math.isfinite(latest) else None


def _resolution(evidence: Evidence) -> Measured | None:
    model = evidence.found.model
    answer = model.dead_time + sum(abs(t) for t in model.time_constants)
    return Measured(evidence.record.interval / answer) if answer > 0.0 else None


def _residual(evidence: Evidence) -> Measured | None:
    # Only noise measured at rest counts: noise may have any colour, and second differences show
    # its fast part alone.
    if not math.isfinite(evidence.record.noise_std):
        return None
    value = misfit(evidence.found, evidence.record)
    return None if math.isnan(value) else Measured(value)


def _share(evidence: Evidence) -> Measured | None:
    if math.isnan(evidence.found.fit.residual_rms):
        return None
    return Measured(unexplained_share(evidence.found, evidence.record))


def _limit_cycle(evidence: Evidence) -> Measured | None:
    validation = evidence.found.validation
    if validation is None or not evidence.settled:
        return None
    away = abs(validation.period)
    said = f"oscillates with another period, {digits(away, 3)} off"
    if validation.reason:
        away, said = math.inf, f"does not oscillate as recorded: {validation.reason}"
    first = ""
    if any(warning.startswith(NOT_AT_REST) for warning in evidence.found.warnings):
        first = f"{NOT_AT_REST}, so that the baseline may be wrong, and "
    return Measured(away, f"{first}the same relay on the model {said}")


def _ultimate(evidence: Evidence) -> Measured | None:
    found = evidence.found
    if not math.isfinite(found.ultimate_gain) or math.isnan(found.ultimate_gain_std):
        return None
    return Measured(NORMAL_95 * found.ultimate_gain_std / abs(found.ultimate_gain))


def _models_around(evidence: Evidence) -> Measured | None:
    loop = evidence.loop
    return None if loop is None else Measured(loop.ms_95 / loop.ms)


def _growth(evidence: Evidence) -> Measured | None:
    growth = evidence.growth(evidence.found.model)
    return Measured(growth) if growth > 0.0 else None


def _visible(evidence: Evidence) -> Measured | None:
    loop, error = evidence.loop, evidence.visible
    if loop is None or error is None:
        return None
    record, model = evidence.record, evidence.found.model
    interval = record.mean_interval
    w = np.geomspace(2.0 * math.pi / record.duration, math.pi / interval, _FREQUENCIES)
    process = model(1j * w) * np.exp(-1j * w * loop.added_delay)
    tolerance = np.abs(loop.controller(1j * w) / (1.0 + process * loop.controller(1j * w)))
    share = error.sure(w) * tolerance
    at = int(np.argmax(share))
    return Measured(float(share[at]), f"{w[at]:.3g} rad/s")


def _worst(loop: Loop, models: Sequence[TransferFunction]) -> tuple[float, TransferFunction]:
    """Return the largest Ms of the gains on models, and its model."""
    ms = loop.ms_of(models)
    at = int(np.argmax(ms))
    return float(ms[at]), models[at]


def _rivals(evidence: Evidence) -> Measured | None:
    loop = evidence.loop
    if loop is None or not evidence.rivals:
        return None
    ms, model = _worst(loop, evidence.rivals)
    return Measured(ms / loop.ms, process_text(model))


def _halves(evidence: Evidence) -> Measured | None:
    loop = evidence.loop
    if loop is None or not evidence.halves:
        return None
    # Nine of ten models have to be bad, so that a half that determines little does not count.
    found = [
        (float(np.quantile(loop.ms_of(part.models), _BUT_FEW, method="lower")), part)
        for part in evidence.halves
    ]
    ms, part = max(found, key=lambda pair: pair[0])
    return Measured(ms / loop.ms, part.span)


def _halves_direction(evidence: Evidence) -> Measured | None:
    sign = evidence.found.model.process_sign
    found = []
    for part in evidence.halves:
        share = other_sign(part.models, sign)
        # Feedback or a disturbance in one half does not overrule the whole record.
        found.append((min(share, _OVERRULED) if part.worse > _FAR_WORSE else share, part))
    if not found:
        return None
    share, part = max(found, key=lambda pair: pair[0])
    return Measured(share, part.span)


def _plain(evidence: Evidence) -> Measured | None:
    loop = evidence.loop
    if loop is None or not evidence.plain:
        return None
    ms, model = _worst(loop, evidence.plain)
    return Measured(ms / loop.ms, process_text(model))


def _beyond(evidence: Evidence) -> Measured | None:
    found = evidence.found
    half = NORMAL_95 * found.ultimate_gain_std / abs(found.ultimate_gain)
    longest = max(
        (abs(t) for t in (*found.model.time_constants, found.model.dead_time)), default=0
    )
    # Of a lag much longer than the record the loop needs the slope alone, which is part of K_u.
    if half <= _KNOWN or not evidence.record.duration > 0.0:
        return None
    return Measured(longest / evidence.record.duration)


def _left_out(evidence: Evidence) -> Measured | None:
    fitted = evidence.found.fitted
    return Measured(float(np.isnan(fitted).mean())) if len(fitted) else None


def _clipped(evidence: Evidence) -> Measured | None:
    model, fitted = evidence.found.model, evidence.found.fitted
    found = lost_effect(evidence.driven or evidence.record, model, fitted)
    return None if found is None else Measured(found[0], f"{found[1]:.4g}")


MODEL_CHECKS = (
    Check(
        name="direction",
        title="Direction",
        what="criterion of the best model in the relay's direction minus that of the best one in "
        "the other (6 is odds of e^3)",
        unit="",
        failed=-6.0,
        sentence="{detail}",
        remedy="test again when nothing drifts",
        measure=_direction,
    ),
    Check(
        name="rival_direction",
        title="Direction of rivals",
        what="number of models of the other direction among the other models that explain the "
        "record as well",
        unit="",
        failed=0.0,
        sentence="{detail} explains the record as well, and in it a higher command moves the "
        "measurement the other way",
        remedy="run a test with larger moves of the command, or record from rest without other "
        "inputs",
        measure=_rival_direction,
    ),
    Check(
        name="fed_back",
        title="Feedback",
        what="share of the command's variance that follows the measurement at the same instant, "
        "in the direction that the model says would run away",
        unit="",
        failed=0.98,
        sentence="the command follows the measurement ({value} of its variance), in a direction "
        "in which a loop with this process would have run away: the model is the controller, read "
        "backward",
        remedy="move the set-point while recording, or let a relay work in place of the "
        "controller",
        measure=_fed_back,
    ),
    Check(
        name="fed_back_changes",
        title="Feedback of changes",
        what="share of the variance of the command's changes that the measurement's change at the "
        "same instant explains beyond its earlier ones, in the direction that the model says "
        "would run away",
        unit="",
        failed=0.5,
        sentence="the command's changes follow those of the measurement ({value} of their "
        "variance), in a direction in which a loop with this process would have run away: the "
        "model is the controller, read backward",
        remedy="move the set-point while recording, or let a relay work in place of the "
        "controller",
        measure=_fed_back_changes,
    ),
    Check(
        name="dead_time_open",
        title="Dead time",
        what="upper end of the dead time's interval over the length of the record",
        unit="",
        failed=1.0,
        sentence="the record fits a dead time of any length, so that no gain is known to be safe",
        remedy="record a relay test, or a step that stands clear of the noise",
        measure=_open_dead_time,
    ),
    Check(
        name="first_response",
        title="First response",
        what="dead time of the model over twice the time from the first change of the command to "
        "the first visible response",
        unit="",
        doubtful=1.0,
        failed=3.0,
        sentence="the measurement moves before the model does: its dead time is {value} times the "
        "longest that the first visible response allows",
        remedy="use the method waveform, or name the dead time",
        measure=_first_response,
    ),
    Check(
        name="resolution",
        title="Sampling",
        what="time between samples over the model's dead time and lags together",
        unit="",
        doubtful=0.4,
        sentence="the time between samples is {value} of the whole response, whose form cannot be "
        "seen",
        remedy="sample faster",
        measure=_resolution,
    ),
    Check(
        name="growth",
        title="Growth",
        what="longest time for which the command stood still, over the time constant with which "
        "the model grows",
        unit="",
        failed=MOST_GROWTH,
        sentence="the model grows by itself: under a constant command it would have run away for "
        "{value} time constants, and the record did not",
        remedy="name a stable structure, or record the controller's command if a loop was closed",
        measure=_growth,
    ),
    Check(
        name="residual",
        title="Residual",
        what="residual over the larger of 1.3 times the noise at rest and 2 % of the "
        "measurement's spread",
        unit="",
        doubtful=4.0,
        sentence="the residual is {value} times the largest one that noise and a simple structure "
        "explain",
        remedy="look at the residual in the report: what repeats with the command is not in the "
        "model, what comes once is a disturbance",
        measure=_residual,
    ),
    Check(
        name="explained",
        title="Fit",
        what="share of the measurement's variance that neither model nor noise explains",
        unit="",
        doubtful=0.1,
        sentence="{value} of the measurement's variance is not explained",
        remedy="keep other inputs constant, or use a larger amplitude",
        measure=_share,
    ),
    Check(
        name="left_out",
        title="Left out",
        what="share of the samples that the model was not fitted to, since no model fits them "
        "together with the others",
        unit="",
        doubtful=0.5,
        sentence="{value} of the record is left out as disturbed: the model rests on the others",
        remedy="repeat the test while nothing else acts on the process, on a computer with time "
        "for it",
        measure=_left_out,
    ),
    Check(
        name="limit_cycle",
        title="Limit cycle",
        what="period of the limit cycle that the same relay makes with the model, relative to the "
        "recorded one",
        unit="",
        doubtful=0.1,
        sentence="{detail}",
        remedy="look at the limit cycle in the report; a valve that sticks or a saturated "
        "actuator is not in the model",
        measure=_limit_cycle,
    ),
    Check(
        name="ultimate_gain",
        title="K_u",
        what="half width of the 95 % interval of K_u over K_u",
        unit="",
        doubtful=2.0,
        sentence="the 95 % interval of K_u reaches {value} of K_u to either side",
        remedy="run more cycles, or use a larger amplitude",
        measure=_ultimate,
    ),
    Check(
        name="beyond_record",
        title="Long times",
        what="longest time of the model over the length of the record, where K_u is not known "
        "within a fifth",
        unit="",
        doubtful=1.0,
        failed=10.0,
        sentence="a time of the model is {value} times as long as the record, which cannot show "
        "it, and K_u depends on it",
        remedy="record longer, or run a relay test, which shows K_u directly",
        measure=_beyond,
    ),
    Check(
        name="clipped",
        title="Clipping",
        what="share of their effect that commands surely lose on one side of a level; above 1 "
        "they act the other way there",
        unit="",
        doubtful=0.6,
        sentence="commands on one side of {detail} lose {value} of the effect that those on the "
        "other side have",
        remedy="keep the command where the actuator is not at its end, and give its ends as "
        "command_min and command_max",
        measure=_clipped,
    ),
    Check(
        name="halves_direction",
        title="Direction in halves",
        what="share of the models that one half of the record allows in which a higher command "
        "moves the measurement the other way",
        unit="",
        doubtful=0.5,
        failed=0.9,
        sentence="from {detail} the record also fits a process of the other direction",
        remedy="keep other inputs constant, or start the record from rest",
        measure=_halves_direction,
    ),
)

LOOP_CHECKS = (
    Check(
        name="models_around",
        title="Models around",
        what="Ms that 95 % of the models within the uncertainty stay below, over Ms on the model",
        unit="",
        doubtful=1.8,
        sentence="on models that the data allow Ms is up to {value} times as large",
        remedy="run more cycles, use a larger amplitude, or choose the rule robust",
        measure=_models_around,
    ),
    Check(
        name="visible_response",
        title="Visible response",
        what="difference between the model and the response that the record shows without any "
        "structure, over what the loop tolerates (1: it may be unstable), at the worst frequency",
        unit="",
        doubtful=0.6,
        sentence="the record shows another response than the model's: at {detail} the difference "
        "is {value} of what the loop tolerates",
        remedy="look at the model over the data; name another structure, or record from rest "
        "without other inputs",
        measure=_visible,
    ),
    Check(
        name="rivals",
        title="Rivals",
        what="Ms of the gains on the worst of the other models that explain the record as well, "
        "over Ms on the selected model",
        unit="",
        doubtful=2.0,
        sentence="{detail} explains the record as well, and on it Ms is {value} times as large",
        remedy="run a test that tells them apart: a biased relay, or a longer step",
        measure=_rivals,
    ),
    Check(
        name="halves",
        title="Halves",
        what="Ms that the gains exceed on nine of ten models that one half of the record allows, "
        "over Ms on the model",
        unit="",
        doubtful=2.0,
        sentence="{detail} of the record alone shows a process on which Ms is at least {value} "
        "times as large",
        remedy="see whether load, operating point or other inputs changed, and record again",
        measure=_halves,
    ),
    Check(
        name="plain",
        title="Plain models",
        what="Ms of the gains on the worst of one or two lags with dead time, where these explain "
        "the record as well, over Ms on the model",
        unit="",
        doubtful=2.0,
        sentence="{detail}, which is simpler and explains the record as well, has an Ms {value} "
        "times as large",
        remedy="name the structure that you expect, or record a larger or longer test",
        measure=_plain,
    ),
)

CHECKS = (*MODEL_CHECKS, *LOOP_CHECKS)
