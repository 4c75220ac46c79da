"""Models 1 to 5 of Chang, Shen and Yu 1992, as the methods for a symmetric relay report them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.process.transfer_function import TransferFunction

FloatArray = NDArray[np.float64]
Build = Callable[[FloatArray], TransferFunction]


@dataclass(frozen=True)
class LagModel:
    """One of the models: its structure, without its numbers.

    :param structure: "fopdt", "lag_n", "sopdt" or "two_equal_one".
    :param order: number of lags.
    """

    structure: str
    order: int

    @property
    def name(self) -> str:
        """Name for people, with the paper's number where it has one."""
        numbers = {"fopdt": 1, "sopdt": 4, "two_equal_one": 5}
        number = numbers.get(self.structure, self.order if self.order in (2, 3) else 0)
        text = {
            "fopdt": "one lag",
            "lag_n": f"{self.order} equal lags",
            "sopdt": "two lags",
            "two_equal_one": "two equal lags and one",
        }[self.structure]
        return f"model {number} ({text})" if number else text

    @property
    def equal(self) -> bool:
        """True for equal lags: models 1 to 3 and their likes."""
        return self.structure in ("fopdt", "lag_n")

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the values."""
        if self.equal:
            return ("gain", "time_constant", "dead_time")
        return ("gain", "time_constant_1", "time_constant_2", "dead_time")

    def lags(self, constants: tuple[float, ...]) -> tuple[float, ...]:
        """Return the time constants of all lags [s].

        :param constants: tau, or tau1 and tau2 [s].
        """
        if self.equal:
            return constants[:1] * self.order
        if self.structure == "sopdt":
            return constants
        return (constants[0], constants[0], constants[1])

    def build(self, values: FloatArray) -> TransferFunction:
        """Return the transfer function of values in the order of :attr:`parameters`."""
        gain, *constants, dead_time = (float(v) for v in values)
        if self.structure == "fopdt":
            return TransferFunction.fopdt(gain, constants[0], dead_time)
        if self.structure == "lag_n":
            return TransferFunction.lag_n(gain, constants[0], self.order, dead_time)
        if self.structure == "sopdt":
            return TransferFunction.sopdt(gain, constants, dead_time)
        return TransferFunction.two_equal_one(gain, constants[0], constants[1], dead_time)


@dataclass(frozen=True)
class Solution:
    """A model's numbers.

    :param gain: K > 0 [y/u].
    :param constants: tau, or tau1 and tau2 [s].
    :param others: further constants that the same numbers allow [s].
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
    """Return time constants for people."""
    if len(constants) == 1:
        return f"tau = {constants[0]:.4g} s"
    return ", ".join(f"tau{i} = {c:.4g} s" for i, c in enumerate(constants, 1))


MODEL_1 = LagModel("fopdt", 1)
MODEL_4 = LagModel("sopdt", 2)
MODEL_5 = LagModel("two_equal_one", 3)


def equal_lags(order: int) -> LagModel:
    """Return the model of n equal lags."""
    return MODEL_1 if order == 1 else LagModel("lag_n", order)


def model_asked_for(method: str, known: Known) -> LagModel | None:
    """Return the model that is known, or None where the choice is the method's.

    :param method: on whose behalf, for the message.
    :param known: a known structure, a known order.
    :raises IdentificationError: if the method has no such model.
    """
    models = {"fopdt": MODEL_1, "sopdt": MODEL_4, "two_equal_one": MODEL_5}
    if known.structure in models:
        model = models[known.structure]
        if known.order not in (0, model.order):
            raise IdentificationError(
                f"the structure {known.structure} has {model.order} lags, but the order given is "
                f"{known.order}: leave one of the two out"
            )
        return model
    if known.structure not in ("", "lag_n"):
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
