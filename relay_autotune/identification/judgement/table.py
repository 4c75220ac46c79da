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
    lost_effect,
    read_backward,
)
from relay_autotune.identification.judgement.evidence import MOST_GROWTH, Evidence, Loop
from relay_autotune.identification.result import NOT_AT_REST
from relay_autotune.identification.waveform.starts import latest_dead_time
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.text import digits
from relay_autotune.verdict import Check, Measured

_FREQUENCIES = 300
# Ms over the asked one from which gains are bad on a model.
_FAR_ABOVE = 1.25
# The same for a half of a record, which tells less: it has to contradict the gains.
_IN_HALF = 2.0


def _fed_back(evidence: Evidence) -> Measured | None:
    share = read_backward(evidence.record, evidence.found.model)
    return None if share is None else Measured(share)


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


def _risk(evidence: Evidence) -> Measured | None:
    loop, draws = evidence.loop, evidence.found.draws
    return Measured(_bad(loop, draws, _FAR_ABOVE)) if loop is not None and draws else None


def _bad(loop: Loop, models: Sequence[TransferFunction], times: float) -> float:
    """Return the share of models on which gains are unstable, or Ms is that many times the asked.

    A process of the other direction makes the loop unstable.
    """
    return float(np.mean(loop.ms_of(models) > times * loop.asked))


def _halves(evidence: Evidence) -> Measured | None:
    loop, halves = evidence.loop, evidence.found.halves
    if loop is None or not halves:
        return None
    # A half that tells little has models all around that of the whole, and excludes nothing.
    found = [(_bad(loop, p.models, _IN_HALF) * p.contradicts, p.span) for p in halves]
    return Measured(*max(found))


def _direction(evidence: Evidence) -> Measured | None:
    found, relay = evidence.found, evidence.record.settings is not None
    sign = -found.model.process_sign
    raises, lowers = ("raises", "lowers") if sign > 0 else ("lowers", "raises")
    said = "the record also fits a process of the other direction"
    if relay:
        said = (
            f"the relay assumed that a higher command {lowers} the measurement; a process where "
            f"it first {lowers} and then {raises} it fits the record as well: test with "
            f"process_gain_sign {sign} (0: it is found)"
        )
    models = [
        (said, found.draws),
        *(
            (f"{p.span} also fits a process of the other direction", p.models)
            for p in found.halves
            if p.contradicts
        ),
    ]
    shares = [
        (float(np.mean([m.process_sign == sign for m in draws])), words)
        for words, draws in models
        if draws
    ]
    return Measured(*max(shares)) if shares else None


def _left_out(evidence: Evidence) -> Measured | None:
    fitted = evidence.found.fitted
    return Measured(float(np.isnan(fitted).mean())) if len(fitted) else None


def _clipped(evidence: Evidence) -> Measured | None:
    found, record = evidence.found, evidence.record
    weak, strong = sorted(found.effects)
    if weak < strong:
        # Estimated with the model, about the first level.
        return Measured(1.0 - weak / strong, f"{record.input().initial:.4g}")
    lost = lost_effect(record, found.model, found.fitted)
    return None if lost is None else Measured(lost[0], f"{lost[1]:.4g}")


MODEL_CHECKS = (
    Check(
        name="direction",
        title="Direction",
        what="largest share of the models that the record, or one half of it, allows in which a "
        "higher command moves the measurement the other way",
        unit="",
        doubtful=0.5,
        failed=0.9,
        sentence="{detail}",
        remedy="test again when nothing drifts, with larger moves of the command",
        measure=_direction,
    ),
    Check(
        name="fed_back",
        title="Feedback",
        what="share of the command's changes that the measurement explains at once, times the "
        "share of the command's power on which the model is the inverse of that law",
        unit="",
        failed=0.5,
        sentence="the command follows the measurement, and {value} of the model is that "
        "controller, read backward",
        remedy="move the set-point while recording, or let a relay work in place of the "
        "controller",
        measure=_fed_back,
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
        what="share of the measurement's variance beside drift, past and load that neither model "
        "nor noise explains",
        unit="",
        doubtful=0.1,
        failed=0.5,
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
)

LOOP_CHECKS = (
    Check(
        name="risk",
        title="Risk",
        what="share of the models that the record allows on which the gains are unstable or have "
        "an Ms of more than 1.25 times what was asked",
        unit="",
        doubtful=0.1,
        failed=0.5,
        sentence="on {value} of the models that the record allows the loop is unstable or nearly "
        "so",
        remedy="run more cycles, use a larger amplitude, or record a longer test",
        measure=_risk,
    ),
    Check(
        name="halves",
        title="Halves",
        what="share of the models that one half of the record allows on which the gains are "
        "unstable or have an Ms of more than twice what was asked",
        unit="",
        doubtful=0.9,
        sentence="{detail} of the record alone shows another process: on {value} of its models "
        "the loop is unstable or nearly so",
        remedy="see whether load, operating point or other inputs changed, and record again",
        measure=_halves,
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
)

CHECKS = (*MODEL_CHECKS, *LOOP_CHECKS)
