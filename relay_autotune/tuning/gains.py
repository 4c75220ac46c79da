"""Controller gains, in the form in which they are computed, with what is predicted of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from relay_autotune.errors import TuningError
from relay_autotune.models import TransferFunction


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
        """Return the controller from measurement to command, without its sign."""
        if self.ti > 0.0 and self.td == self.tf == 0.0:
            # The form that is asked for a hundred times, once for each model of an ensemble.
            return TransferFunction(self.kc / self.ti, (self.ti,), (), 1)
        bottom = [0.5 * self.tf**2, self.tf, 1.0]
        if self.ti > 0.0:
            top = [self.kc * self.td * self.ti, self.kc * self.ti, self.kc]
            return TransferFunction.from_polynomials(top, [self.ti * c for c in bottom] + [0.0])
        return TransferFunction.from_polynomials([self.kc * self.td, self.kc], bottom)

    def loop(self, model: TransferFunction) -> TransferFunction:
        """Return controller times process.

        :param model: the process.
        """
        c = self.transfer_function()
        return TransferFunction(
            c.gain * model.gain,
            c.zeros + model.zeros,
            c.time_constants + model.time_constants,
            c.integrators + model.integrators,
            c.dead_time + model.dead_time,
        )


@dataclass(frozen=True, kw_only=True)
class Performance:
    """What a controller does on a model.

    :param ms: largest magnitude of the sensitivity function.
    :param mt: largest magnitude of the complementary sensitivity function.
    :param gain_margin: factor by which the loop's gain may grow.
    :param phase_margin: rad.
    :param delay_margin: dead time that may be added [s].
    :param iae_load: integral of the absolute error after a unit step of the load at the
        process input [y s/u].
    """

    ms: float
    mt: float
    gain_margin: float
    phase_margin: float
    delay_margin: float
    iae_load: float


@dataclass(frozen=True, kw_only=True)
class Gains(Controller, Performance):
    """The controller that one rule gives, with what it does on the identified model.

    The fields are those of :class:`Controller` and :class:`Performance`, and

    :param rule: name in the registry.
    :param ms_95: Ms that 95 % of the models within the uncertainty stay below.
    :param reason: why this rule and these gains, a sentence for people.
    """

    rule: str
    ms_95: float
    reason: str
    form: str = "isa"

    @classmethod
    def of(
        cls,
        rule: str,
        controller: Controller,
        performance: Performance,
        *,
        ms_95: float,
        reason: str,
    ) -> Gains:
        """Join a controller and its performance.

        :param rule: name in the registry.
        :param controller: the gains.
        :param performance: what they do on the model.
        :param ms_95: Ms that 95 % of the models within the uncertainty stay below.
        :param reason: why this rule and these gains.
        """
        return cls(**vars(controller), **vars(performance), rule=rule, ms_95=ms_95, reason=reason)
