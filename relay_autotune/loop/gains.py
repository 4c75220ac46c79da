"""Controller gains, with their predicted performance."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import TuningError
from relay_autotune.process.transfer_function import TransferFunction

ComplexArray = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True)
class Controller:
    r"""A PI or PID controller in ISA form with a second-order filter on the measurement.

    ``u = kc (b r - yf + (1/ti) int (r - yf) dt - td dyf/dt)``, with
    ``yf = y/(1 + tf s + (tf s)^2/2)``; error = set-point - measurement.

    :param kc: proportional gain, with the sign of the process [u/y].
    :param ti: integral time [s]; 0: no integral action.
    :param td: derivative time [s].
    :param tf: time constant of the filter [s]; 0: none.
    :param b: set-point weight.
    :raises TuningError: if a value is not finite, kc is zero or a time is negative.
    """

    kc: float
    ti: float
    td: float = 0.0
    tf: float = 0.0
    b: float = 1.0

    def __post_init__(self) -> None:
        numbers = (self.kc, self.ti, self.td, self.tf, self.b)
        if not all(math.isfinite(n) for n in numbers) or self.kc == 0.0 or min(numbers[1:4]) < 0.0:
            raise TuningError(
                "a controller needs a gain other than zero and times >= 0 s, all finite; found "
                f"kc = {self.kc:g}, ti = {self.ti:g}, td = {self.td:g}, tf = {self.tf:g}"
            )

    def __str__(self) -> str:
        more = f", td = {self.td:.4g} s" if self.td > 0.0 else ""
        return f"kc = {self.kc:.4g}, ti = {self.ti:.4g} s{more}"

    @property
    def p(self) -> float:
        """Proportional gain of the parallel form [u/y]."""
        return self.kc

    @property
    def i(self) -> float:
        """Integral gain of the parallel form, kc/ti [u/(y s)]."""
        return self.kc / self.ti if self.ti > 0.0 else 0.0

    @property
    def d(self) -> float:
        """Derivative gain of the parallel form, kc td [u s/y]."""
        return self.kc * self.td

    def transfer_function(self) -> TransferFunction:
        """Return the controller from measurement to command, without its sign.

        :raises ModelError: if it has a derivative without a filter.
        """
        gain, zeros, lags, integrators = self._factors()
        return TransferFunction(gain, zeros, lags, integrators)

    def loop(self, model: TransferFunction) -> TransferFunction:
        """Return controller times process.

        :param model: the process.
        :raises ModelError: if it has a derivative without a filter, and the process no lag.
        """
        gain, zeros, lags, integrators = self._factors()
        return TransferFunction(
            gain * model.gain,
            zeros + model.zeros,
            lags + model.time_constants,
            integrators + model.integrators,
            model.dead_time,
        )

    def characteristic(self, model: TransferFunction) -> tuple[TransferFunction, ...]:
        """Return the terms L_k of the characteristic equation ``1 + sum L_k(s) = 0``.

        :param model: the process.
        """
        return (self.loop(model),)

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return -command per measurement at complex frequencies [u/y].

        :param s: rad/s, any shape.
        """
        ideal = self.kc * (1.0 + self.td * s)
        if self.ti > 0.0:
            ideal = ideal + self.kc / (self.ti * s)
        return np.asarray(ideal / (1.0 + self.tf * s + 0.5 * (self.tf * s) ** 2))

    def from_setpoint(self, s: ComplexArray) -> ComplexArray:
        """Return command per set-point at complex frequencies [u/y].

        :param s: rad/s, any shape.
        """
        integral = self.kc / (self.ti * s) if self.ti > 0.0 else 0.0 * s
        return np.asarray(self.kc * self.b + integral)

    def _factors(self) -> tuple[float, tuple[complex, ...], tuple[complex, ...], int]:
        """Return gain, zeros, time constants and integrators of the controller."""
        half = 0.5 * self.tf
        lags = (complex(half, half), complex(half, -half)) if self.tf > 0.0 else ()
        if self.ti == 0.0:
            return self.kc, (complex(self.td),), lags, 0
        # 1 + ti s + ti td s^2: compute the larger constant first, since the smaller one may lose
        # its digits by cancellation.
        root = cmath.sqrt(1.0 - 4.0 * self.td / self.ti)
        first = 0.5 * self.ti * (1.0 + root)
        return self.kc / self.ti, (first, self.ti * self.td / first), lags, 1


@dataclass(frozen=True, kw_only=True)
class Performance:
    """Performance of a controller on a model.

    :param ms: largest magnitude of the sensitivity function.
    :param mt: largest magnitude of the complementary sensitivity function.
    :param gain_margin: factor by which the loop's gain may grow.
    :param phase_margin: rad.
    :param delay_margin: dead time that may be added [s].
    :param iae_load: integral of the absolute error after a unit step of the load at the
        process input [y s/u]; infinite without integral action.
    :param gain_margin_low: factor to which the loop's gain may fall; 0: any. NaN: not computed,
        here and below.
    :param iae_setpoint: integral of the absolute error after a unit step of the set-point [s].
    :param overshoot: after a step of the set-point, relative to it.
    :param settling_time: until the measurement stays within 2 % of a new set-point [s].
    :param effort_setpoint: total variation of the command after a unit step of the set-point
        [u/y].
    :param effort_load: total variation of the command after a unit step of the load.
    :param noise_gain: standard deviation of the command per standard deviation of white noise on
        the samples; without a sampling period the largest gain at any frequency [u/y].
    :raises TuningError: if a number is negative, or a number that must be known is NaN.
    """

    ms: float
    mt: float
    gain_margin: float
    phase_margin: float
    delay_margin: float
    iae_load: float
    gain_margin_low: float = math.nan
    iae_setpoint: float = math.nan
    overshoot: float = math.nan
    settling_time: float = math.nan
    effort_setpoint: float = math.nan
    effort_load: float = math.nan
    noise_gain: float = math.nan

    def __post_init__(self) -> None:
        for name in _PREDICTED:
            value = getattr(self, name)
            if value < 0.0 or (math.isnan(value) and name in _ALWAYS):
                raise TuningError(f"{name} of the gains is {value:g}, expected a number >= 0")


_ALWAYS = ("ms", "mt", "gain_margin", "phase_margin", "delay_margin", "iae_load")
_PREDICTED = (
    *(*_ALWAYS, "gain_margin_low", "iae_setpoint", "overshoot", "settling_time"),
    *("effort_setpoint", "effort_load", "noise_gain"),
)
# Names of the numbers of gains in messages, documents and files.
NUMBERS = (
    *("kc", "ti", "td", "tf", "b", "p", "i", "d"),
    *("ms", "ms_95", "mt", "gain_margin", "phase_margin", "delay_margin", "iae_load"),
    *("gain_margin_low", "iae_setpoint", "overshoot", "settling_time"),
    *("effort_setpoint", "effort_load", "noise_gain"),
)


@dataclass(frozen=True, kw_only=True)
class Gains(Controller, Performance):
    """The controller of one rule, with its performance on the identified model.

    The fields are those of :class:`Controller` and :class:`Performance`, and

    :param rule: name in the registry.
    :param ms_95: value of Ms not exceeded by 95 % of the models within the uncertainty.
    :param reason: why this rule and these gains, a sentence for people.
    :param warnings: what the user must know before using them.
    """

    rule: str
    ms_95: float
    reason: str
    form: str = "isa"
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        Controller.__post_init__(self)
        Performance.__post_init__(self)

    @classmethod
    def of(
        cls,
        rule: str,
        controller: Controller,
        performance: Performance,
        *,
        ms_95: float,
        reason: str,
        warnings: tuple[str, ...] = (),
    ) -> Gains:
        """Join a controller and its performance.

        :param rule: name in the registry.
        :param controller: the gains.
        :param performance: their performance on the model.
        :param ms_95: value of Ms not exceeded by 95 % of the models within the uncertainty.
        :param reason: why this rule and these gains.
        :param warnings: what the user must know.
        """
        return cls(
            **vars(controller),
            **vars(performance),
            rule=rule,
            ms_95=ms_95,
            reason=reason,
            warnings=warnings,
        )
