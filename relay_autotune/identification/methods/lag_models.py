# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Models 1 to 5 of Chang, Shen and Yu 1992, as the methods for a symmetric relay report them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.process.structures import (
    FOPDT,
    LAG_N,
    SOPDT,
    TWO_EQUAL_ONE,
    Structure,
    equal_lags,
)

MODEL_1, MODEL_4, MODEL_5 = FOPDT, SOPDT, TWO_EQUAL_ONE

# Their names in messages.
_TEXTS = {FOPDT: "one lag", SOPDT: "two lags", TWO_EQUAL_ONE: "two equal lags and one"}


def model_text(model: Structure) -> str:
    """Return the name of a model, with the paper's number where it has one."""
    numbers = {MODEL_1: 1, MODEL_4: 4, MODEL_5: 5}
    number = numbers.get(model, model.order if model.order in (2, 3) else 0)
    text = _TEXTS.get(model, f"{model.order} equal lags")
    return f"model {number} ({text})" if number else text


def require_equal_lags(model: Structure) -> None:
    """Refuse a model whose gain is not known, but for equal lags.

    :raises IdentificationError: if the model has two time constants.
    """
    if not model.equal_lags:
        raise IdentificationError(
            f"{model_text(model)} needs the gain of the process: its two time constants take "
            "both the period and the amplitude; give the gain, or use the method li"
        )


def lags_of(model: Structure, constants: tuple[float, ...]) -> tuple[float, ...]:
    """Return the time constants of all lags [s].

    :param model: one of the models.
    :param constants: tau, or tau1 and tau2 [s].
    """
    given = dict(zip(model.parameters[1:-1], constants, strict=True))
    return tuple(
        given[p] for f in model.factors for p in f.parameters for _ in range(f.multiplicity)
    )


@dataclass(frozen=True)
class Solution:
    """A model's numbers.

    :param gain: K > 0 [y/u].
    :param constants: tau, or tau1 and tau2 [s].
    :param others: the constants of other solutions [s].
    """

    gain: float
    constants: tuple[float, ...]
    others: tuple[tuple[float, ...], ...] = ()

    def values(self, sign: int, dead_time: float) -> FloatArray:
        """Return the values of the model's parameters.

        :param sign: of the gain.
        :param dead_time: of the process [s].
        """
        return np.array((sign * self.gain, *self.constants, dead_time))

    def __str__(self) -> str:
        return constants_text(self.constants)


def constants_text(constants: tuple[float, ...]) -> str:
    """Return time constants as text."""
    if len(constants) == 1:
        return f"tau = {constants[0]:.4g} s"
    return ", ".join(f"tau{i} = {c:.4g} s" for i, c in enumerate(constants, 1))


def model_asked_for(method: str, known: Known) -> Structure | None:
    """Return the model that is known, or None where the choice is the method's.

    :param method: its name, for the message.
    :param known: a known structure, a known order.
    :raises IdentificationError: if the method has no such model.
    """
    models = {model.name: model for model in (MODEL_1, MODEL_4, MODEL_5)}
    if known.structure in models:
        model = models[known.structure]
        if known.order not in (0, model.order):
            raise IdentificationError(
                f"the structure {known.structure} has {model.order} lags, but the order given is "
                f"{known.order}: leave one of the two out"
            )
        return model
    if known.structure not in ("", LAG_N.name):
        raise IdentificationError(
            f"{method} has no structure {known.structure!r}; it has fopdt, lag_n, sopdt and "
            "two_equal_one"
        )
    if known.order:
        return equal_lags(known.order)
    if known.structure:
        raise IdentificationError(
            "the structure lag_n needs its order, the number of equal lags: give it"
        )
    return None
