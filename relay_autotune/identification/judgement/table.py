"""The table of checks. Adding a check is adding a row, and the function that measures it.

Each function returns a number that is the larger the worse, or None where the check does not
apply. The limits were set on simulated records of right and of wrong models; how often each row
speaks on either is in docs/verdict.md.
"""

from __future__ import annotations

import math

from relay_autotune.confidence import NORMAL_95
from relay_autotune.identification.judgement.evidence import Evidence
from relay_autotune.identification.judgement.quality import misfit, noise_of, unexplained_share
from relay_autotune.verdict import Check, Measured


def _direction(evidence: Evidence) -> Measured | None:
    other = evidence.other
    if other is None:
        return None
    sign = other.model.process_sign
    raises, lowers = ("raises", "lowers") if sign > 0 else ("lowers", "raises")
    return Measured(
        other.lead,
        f"the relay took it that a higher command {lowers} the measurement, but the record goes "
        f"as well with a process where it {raises} it in the end, after a first answer the other "
        f"way: have the relay work in the other direction (process_gain_sign {sign}; 0: it is "
        "found)",
    )


def _open_dead_time(evidence: Evidence) -> Measured | None:
    found = evidence.found
    high = dict(zip(found.parameters, found.ci95_high, strict=True)).get("dead_time", math.nan)
    if math.isnan(high):
        return None
    return Measured(float(high) / evidence.record.duration)


def _residual(evidence: Evidence) -> Measured | None:
    noise = noise_of(evidence.record)
    value = misfit(evidence.found, evidence.record, noise=noise)
    return None if math.isnan(value) else Measured(value)


def _share(evidence: Evidence) -> Measured | None:
    if math.isnan(evidence.found.fit.residual_rms):
        return None
    return Measured(unexplained_share(evidence.found, evidence.record))


def _limit_cycle(evidence: Evidence) -> Measured | None:
    validation = evidence.found.validation
    if validation is None:
        return None
    return Measured(
        math.inf if validation.reason else abs(validation.period),
        f" ({validation.reason})" if validation.reason else "",
    )


def _ultimate(evidence: Evidence) -> Measured | None:
    found = evidence.found
    if not math.isfinite(found.ultimate_gain) or math.isnan(found.ultimate_gain_std):
        return None
    return Measured(NORMAL_95 * found.ultimate_gain_std / abs(found.ultimate_gain))


def _models_around(evidence: Evidence) -> Measured | None:
    loop = evidence.loop
    return None if loop is None else Measured(loop.ms_95 / loop.ms)


MODEL_CHECKS = (
    Check(
        name="direction",
        title="Direction",
        what="criterion of the best model in the relay's direction minus that of the best one in "
        "the other (6 is odds of e^3)",
        unit="",
        failed=-6.0,
        sentence="{detail}",
        remedy="or test again when nothing drifts",
        measure=_direction,
    ),
    Check(
        name="dead_time_open",
        title="Dead time",
        what="upper end of the dead time's interval over the length of the record",
        unit="",
        failed=1.0,
        sentence="the record goes with a dead time of any length, so that it bounds no gain",
        remedy="record a relay test, or a step that stands clear of the noise",
        measure=_open_dead_time,
    ),
    Check(
        name="residual",
        title="Residual",
        what="residual over the larger of 1.3 times the noise and 2 % of the measurement's spread",
        unit="",
        doubtful=4.0,
        sentence="the model leaves {value} times what noise and a simple structure may leave",
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
        name="limit_cycle",
        title="Limit cycle",
        what="period of the limit cycle that the same relay makes with the model, relative to the "
        "recorded one",
        unit="",
        doubtful=0.1,
        sentence="the same relay on the model swings with another period, {value} off{detail}",
        remedy="look at the limit cycle in the report; a valve that sticks or a saturated "
        "actuator is not in the model",
        measure=_limit_cycle,
    ),
    Check(
        name="ultimate_gain",
        title="K_u",
        what="half width of the 95 % interval of K_u over K_u",
        unit="",
        doubtful=0.5,
        sentence="K_u is known to {value} of itself only",
        remedy="run more cycles, or use a larger amplitude",
        measure=_ultimate,
    ),
)

LOOP_CHECKS = (
    Check(
        name="models_around",
        title="Models around",
        what="Ms that 95 % of the models within the uncertainty stay below, over Ms on the model",
        unit="",
        doubtful=1.8,
        sentence="the gains are {value} times as fragile on models that the data allow",
        remedy="run more cycles, use a larger amplitude, or choose the rule robust",
        measure=_models_around,
    ),
)

CHECKS = (*MODEL_CHECKS, *LOOP_CHECKS)
