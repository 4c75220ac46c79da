# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The table of checks. Adding a check is adding a row, and the function that measures it.

Each function returns a number that is the larger the worse, or None where the check does not
apply. How often each row speaks on right and on wrong gains, of records of many kinds, is counted
by benchmarks/verdicts.py and shown in docs/verdict.md.
"""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.identification.estimate import student_95
from relay_autotune.identification.judgement.assessment import unexplained_share
from relay_autotune.identification.judgement.checks import read_backward
from relay_autotune.identification.judgement.evidence import Evidence
from relay_autotune.process.response import response
from relay_autotune.record.cycles import limit_cycle
from relay_autotune.record.excitation import LEAST_SAMPLES
from relay_autotune.record.moves import MOST_GROWTH
from relay_autotune.text import digits
from relay_autotune.verdict import Check, Measured, not_known

# Ms over the asked one from which gains are bad on a model.
_FAR_ABOVE = 1.25
# Frequency at which the integral action alone is left, times the record's duration [rad].
_LOW = 1e-6
# How much longer than the record a record is that shows half a period of any loop.
_LONGER = 1e4
# Residual of a model over that of the steady answer to one sine, up to which other motions show
# what the process is: the model explains 90 % of their variance. Of 30 simulated processes without
# a rest before their sine none is below it; six were trusted with gains that are unstable on them.
_BESIDE_A_SINE = 0.32
# Share of bad ones from which gains are more likely bad than good.
_LIKELY_BAD = 0.5


def _fed_back(evidence: Evidence) -> Measured | None:
    found, record = evidence.found, evidence.record
    fitted = found.fitted
    if len(fitted) != len(record):
        # A method that looks at cycles alone, as of a relay.
        if found.model.grows:
            return None
        fitted = response(found.model, record.time, record.input())
    share = read_backward(record, found.model, fitted)
    return None if share is None else Measured(share)


def _resolution(evidence: Evidence) -> Measured | None:
    model = evidence.found.model
    answer = model.response_time
    return Measured(evidence.record.interval / answer) if answer > 0.0 else None


def _share(evidence: Evidence) -> Measured | None:
    found, difference = evidence.found, evidence.difference
    # What a response beside the model's explains is in the risk.
    left = found.fit.residual_rms if difference is None else difference.residual
    if math.isnan(left):
        return None
    share = unexplained_share(found, evidence.record, left)
    return Measured(share if difference is None else min(share, difference.unexplained))


def _limit_cycle(evidence: Evidence) -> Measured | None:
    validation = evidence.found.validation
    if validation is None or not evidence.settled or evidence.found.friction:
        # The same relay on the model alone moves without the friction.
        return None
    if validation.reason:
        away, said = math.inf, f"does not oscillate as recorded: {validation.reason}"
    else:
        seen = limit_cycle(evidence.record)
        count = len(seen.cycles)
        scatter = student_95(count - 1) * seen.period_std / math.sqrt(count)
        # What the scatter of the recorded periods does not explain.
        away = max(abs(validation.period) - scatter / seen.period, 0.0)
        than = "longer" if validation.period > 0.0 else "shorter"
        part = digits(100.0 * abs(validation.period), 3)
        said = f"oscillates with a period {part} % {than} than the recorded one"
    first = ""
    if evidence.found.began_away:
        first = "the test did not begin at rest, so that the baseline may be wrong, and "
    return Measured(away, f"{first}the same relay on the model {said}")


def _growth(evidence: Evidence) -> Measured | None:
    growth = evidence.growth
    return Measured(growth) if growth > 0.0 else None


def _risk(evidence: Evidence) -> Measured | None:
    loop = evidence.loop
    if loop is None or not loop.ms_around.size:
        return None
    share = float(np.mean(loop.ms_around > _FAR_ABOVE * loop.asked))
    # The design leaves models of the other direction out, on which no gains are stable.
    sign, draws = evidence.found.model.process_sign, evidence.found.draws
    against = float(np.mean([m.process_sign != sign for m in draws])) if draws else 0.0
    share = against + (1.0 - against) * share
    n = len(evidence.record)
    if share <= _LIKELY_BAD and n < LEAST_SAMPLES:
        return not_known(f"{n} samples show too little of the process; {LEAST_SAMPLES} are needed")
    left = evidence.left_by_one_sine
    if share <= _LIKELY_BAD and evidence.found.fit.residual_rms > _BESIDE_A_SINE * left:
        return not_known(
            "the command is one sine, and the measurement little but the steady answer to it, "
            "which tells two numbers of the process",
            "record steps, or a sine that begins at rest",
        )
    return Measured(share)


def _pace(evidence: Evidence) -> Measured | None:
    loop, model = evidence.loop, evidence.found.model
    if loop is None or loop.pace_asked or model.integrators or model.grows:
        return None
    # After a step the error lasts 1/(K k_i), whatever else the loop does; by itself the process
    # takes its dead time and the time constants of its decays.
    low = _LOW / evidence.record.duration
    lasting = 1.0 / (abs(model.gain) * low * float(abs(loop.controller(np.array([1j * low]))[0])))
    alone = model.dead_time + sum(1.0 / (1.0 / t).real for t in model.time_constants)
    return Measured(lasting / alone) if alone > 0.0 else None


def _beyond(evidence: Evidence) -> Measured | None:
    loop, shown = evidence.loop, evidence.shown
    if loop is None or not shown > 0.0:
        return None
    times = shown * np.geomspace(1.0, _LONGER, 1000)
    s = 1j * (math.pi / times)
    gain = abs(evidence.found.model(s) * loop.controller(s))
    needed = float(np.max(times[gain < 1.0], initial=shown))
    detail = f"{digits(shown, 3)} s after the first change of the command, {digits(needed, 3)} s"
    return Measured(1.0 / float(gain[0]), detail) if gain[0] > 0.0 else None


def _direction(evidence: Evidence) -> Measured | None:
    found, relay = evidence.found, evidence.record.settings is not None
    sign = -found.model.process_sign
    raises, lowers = ("raises", "lowers") if sign > 0 else ("lowers", "raises")
    as_well = "also fits a process of the other direction"
    said = f"the record {as_well}"
    if relay:
        said = (
            f"the relay assumed that a higher command {lowers} the measurement; a process where "
            f"it first {lowers} and then {raises} it fits the record as well: test with "
            f"process_gain_sign {sign} (0: it is found)"
        )
    shares = [
        (part.share_against(found.model), f"{part.span} {as_well}")
        for part in found.parts
        if part.contradicts
    ]
    if found.draws:
        shares.append((float(np.mean([m.process_sign == sign for m in found.draws])), said))
    if found.opposed:
        said = "a process of the other direction explains the record about as well"
        shares.append((found.opposed, said))
    return Measured(*max(shares)) if shares else None


def _left_out(evidence: Evidence) -> Measured:
    fitted = evidence.found.fitted
    return Measured(float(np.isnan(fitted).mean()) if len(fitted) else 0.0)


def _clipped(evidence: Evidence) -> Measured:
    weak, strong = sorted(evidence.found.effects)
    return Measured(1.0 - weak / strong, f"{evidence.found.middle:.4g}")


MODEL_CHECKS = (
    Check(
        name="direction",
        title="Direction",
        what="largest share of models of the other direction that the record, or a part of it, "
        "allows; or how well one that answers before the model does explains as much; or, in a "
        "closed loop, how clearly a growing one explains more",
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
        what="part of the command's power on which the model is the inverse of its controller's "
        "law, by how far noise and loads outweigh there what came from outside",
        unit="",
        failed=0.5,
        sentence="the command follows the measurement, and {value} of the model is that "
        "controller, read backward",
        remedy="move the set-point while recording, or let a relay work in place of the "
        "controller",
        measure=_fed_back,
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
        name="explained",
        title="Fit",
        what="share of the measurement's variance beside drift, past and load that neither a "
        "response to the command nor noise explains; where that is less, beside a line in each "
        "60/w_u",
        unit="",
        doubtful=0.1,
        failed=0.5,
        sentence="{value} of the measurement's variance is not explained",
        remedy="keep other inputs constant, see that the actuator reaches its commands, use a "
        "larger amplitude, or --loss tukey where a sensor dropped out",
        measure=_share,
    ),
    Check(
        name="left_out",
        title="Left out",
        what="share of the record that the model was not fitted to, since no model fits it "
        "together with the rest",
        unit="",
        doubtful=0.5,
        sentence="{value} of the record is left out, and the model rests on the rest of it",
        remedy="repeat the test while nothing else acts on the process, and look whether the "
        "actuator goes as far as its command",
        measure=_left_out,
    ),
    Check(
        name="limit_cycle",
        title="Limit cycle",
        what="how far the period of the limit cycle that the same relay makes with the model is "
        "from the recorded one for certain, as a part of that",
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
        what="share of their effect that commands lose on one side of their middle",
        unit="",
        doubtful=0.6,
        sentence="commands on one side of {detail} lose {value} of the effect that those on the "
        "other side have",
        remedy="keep the command within limits at which the actuator is not at its end, or record "
        "what the actuator gets",
        measure=_clipped,
    ),
)

LOOP_CHECKS = (
    Check(
        name="risk",
        title="Risk",
        what="share of the processes that the record allows, each a model and what the record "
        "shows beside it, on which the gains are unstable or have an Ms of more than 1.25 times "
        "what was asked",
        unit="",
        doubtful=0.1,
        failed=_LIKELY_BAD,
        sentence="on {value} of the models that the record allows the loop is unstable or nearly "
        "so",
        remedy="run more cycles, use a larger amplitude, or record a longer test",
        measure=_risk,
    ),
    Check(
        name="beyond",
        title="Beyond",
        what="1 over the loop's gain at the frequency of which the record shows half a period, "
        "from the first change of the command to the last sample that was fitted",
        unit="",
        doubtful=1.0,
        # Feedback of a tenth changes nothing that the record shows by more than a tenth.
        failed=10.0,
        sentence="the record is too short for so slow a loop: it ends {detail} are needed",
        remedy="record for longer",
        measure=_beyond,
    ),
    Check(
        name="pace",
        title="Pace",
        what="integral of the error after a step of the set-point, over the time that the process "
        "takes by itself",
        unit="",
        doubtful=5.0,
        sentence="with these gains an error lasts {value} times as long as the process takes by "
        "itself, since they have to hold on all models that the record allows",
        remedy="test with a larger amplitude or more cycles, or on a process at rest",
        measure=_pace,
    ),
)

CHECKS = (*MODEL_CHECKS, *LOOP_CHECKS)
