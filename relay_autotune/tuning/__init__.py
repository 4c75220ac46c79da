"""Controller design: rules by name, and what their gains do on the model."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from relay_autotune.errors import TuningError
from relay_autotune.identification.result import Identification
from relay_autotune.models import TransferFunction
from relay_autotune.tuning.analysis import analyse_loop, is_stable
from relay_autotune.tuning.ensemble import ensemble, ensemble_ms
from relay_autotune.tuning.gains import Controller, Gains, Performance
from relay_autotune.tuning.rules import imc, itae, thyagarajan, tyreus_luyben

Rule = Callable[[TransferFunction], tuple[Controller, str]]

RULES: dict[str, Rule] = {
    "thyagarajan": thyagarajan,
    "tyreus_luyben": tyreus_luyben,
    "itae": itae,
    "imc": imc,
}
DEFAULT_RULE = "thyagarajan"

__all__ = [
    "DEFAULT_RULE",
    "RULES",
    "Controller",
    "Gains",
    "Performance",
    "analyse_loop",
    "ensemble",
    "is_stable",
    "tune",
]


def rule_named(name: str) -> Rule:
    """Return a rule by its name.

    :raises TuningError: if there is none of that name; the message lists those there are.
    """
    if name not in RULES:
        raise TuningError(f"unknown rule {name!r}; known: {', '.join(RULES)}")
    return RULES[name]


def tune(
    identification: Identification,
    rule: str,
    models: Sequence[TransferFunction] = (),
    simple: TransferFunction | None = None,
) -> Gains:
    """Return the gains of a rule, judged on the model and on the models around it.

    :param identification: the model and its uncertainty.
    :param rule: one of ``RULES``.
    :param models: models within the uncertainty, from :func:`ensemble`.
    :param simple: the FOPDT that fits best, on which a rule for FOPDT designs where the model is
        of another structure; its gains are judged on the model all the same.
    :raises TuningError: if the rule does not apply, or its loop is unstable on the model or on
        more than 5 % of ``models``.
    """
    controller, reason = _design(rule_named(rule), identification.model, simple)
    performance = analyse_loop(controller, identification.model)
    if not models:
        reason += "; the uncertainty of the model is not known, so that Ms_95 is Ms"
        return Gains.of(rule, controller, performance, ms_95=performance.ms, reason=reason)
    ms_95 = max(ensemble_ms(controller, models), performance.ms)
    return Gains.of(rule, controller, performance, ms_95=ms_95, reason=reason)


def _design(
    rule: Rule, model: TransferFunction, simple: TransferFunction | None
) -> tuple[Controller, str]:
    try:
        return rule(model)
    except TuningError:
        if simple is None:
            raise
    controller, reason = rule(simple)
    return controller, f"{reason}; designed on the FOPDT that fits best, judged on the model"
