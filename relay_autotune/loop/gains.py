# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Controllers: PI and PID gains with their predicted performance, and others that are linear.

The three forms of a PID controller, and the exact conversions to the series form and back.

All computations use the ISA form; the others are the parallel and the series form:

    kc (1 + 1/(ti s) + td s),    p + i/s + d s,    kc (1 + 1/(ti s)) (1 + td s).

Only the numbers differ: the filter on the measurement, of time constant tf, is the same factor in
all three. Luyben (2003, eq 11) writes the filter of the series form as ``1/(alpha td s + 1)``,
alpha typically 0.1. Here ``alpha = tf/td``, and the second-order filter of :class:`Controller`
replaces his first-order one; both have the same delay.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from relay_autotune.arrays import ComplexArray
from relay_autotune.errors import TuningError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import derived, result_field, result_fields


@dataclass(frozen=True)
class Controller:
    r"""A PI or PID controller in ISA form with a second-order filter on the measurement.

    >>> from relay_autotune import Controller
    >>> controller = Controller(kc=0.6, ti=20.0, td=4.0)
    >>> print(controller)
    kc = 0.6, ti = 20 s, td = 4 s
    >>> print(f"p {controller.p:g} u/y, i {controller.i:g} u/(y s), d {controller.d:g} u s/y")
    p 0.6 u/y, i 0.03 u/(y s), d 2.4 u s/y

    ``u = kc (b r - yf + (1/ti) int (r - yf) dt - td dyf/dt)``, with
    ``yf = y/(1 + tf s + (tf s)^2/2)``; error = set-point - measurement.

    :raises TuningError: if a value is not finite, kc is zero or a time is negative.
    """

    kc: float = result_field("u/y", column=1)
    """Proportional gain, with the sign of the process."""
    ti: float = result_field("s", lower=0.0, column=1)
    """Integral time; 0: no integral action."""
    td: float = result_field("s", 0.0, lower=0.0, column=1)
    """Derivative time."""
    tf: float = result_field("s", 0.0, lower=0.0, column=1)
    """Time constant of the filter; 0: none."""
    b: float = result_field("", 1.0, column=1)
    """Set-point weight."""
    period: ClassVar[float] = 0.0
    """Sampling period: that of a continuous controller [s]."""

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
    @derived("u/y", after="b", column=1)
    def p(self) -> float:
        """Proportional gain of the parallel form [u/y]."""
        return self.kc

    @property
    @derived("u/(y s)", after="p", column=1)
    def i(self) -> float:
        """Integral gain of the parallel form, kc/ti [u/(y s)]."""
        return self.kc / self.ti if self.ti > 0.0 else 0.0

    @property
    @derived("u s/y", after="i", column=1)
    def d(self) -> float:
        """Derivative gain of the parallel form, kc td [u s/y]."""
        return self.kc * self.td

    @property
    def times(self) -> tuple[float, ...]:
        """Times at which it changes its effect [s]."""
        return (self.ti, self.td, self.tf)

    @property
    def tracking(self) -> float:
        """Time in which back-calculation draws the integral to a limit, sqrt(ti td) [s].

        Without derivative action it is ti; 0: there is no integral.
        """
        return math.sqrt(self.ti * self.td) or self.ti

    @property
    def jump(self) -> float:
        """Command just after a unit step of the set-point [u/y]."""
        return self.kc * self.b

    def transfer_function(self) -> TransferFunction:
        """Return the controller from measurement to command, without its sign.

        :raises ModelError: if it has a derivative without a filter.
        """
        return TransferFunction(*self._factors())

    def loop(self, model: TransferFunction) -> TransferFunction:
        """Return controller times process.

        :param model: the process.
        :raises ModelError: if it has a derivative without a filter, and the process no lag.
        """
        return model.after(*self._factors())

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
class Margins:
    """Margins of a stable loop."""

    ms: float = result_field(lower=0.0, column=1)
    """Largest magnitude of the sensitivity function."""
    mt: float = result_field(lower=0.0, column=1)
    """Largest magnitude of the complementary sensitivity function."""
    gain_margin: float = result_field(lower=0.0, null=math.inf, column=1)
    """Factor by which the loop's gain may grow; inf: any."""
    phase_margin: float = result_field("rad", lower=0.0, null=math.inf, column=1)
    """Phase that the loop may lose."""
    delay_margin: float = result_field("s", lower=0.0, null=math.inf, column=1)
    """Dead time that may be added; inf: any."""
    gain_margin_low: float = result_field("", math.nan, lower=0.0, after="iae_load")
    """Factor to which the loop's gain may fall; 0: any. NaN: not computed, here and below."""


@dataclass(frozen=True, kw_only=True)
class StepFigures:
    """Features of the responses of a loop to unit steps."""

    iae_load: float = result_field("y s/u", lower=0.0, null=math.inf, column=1)
    """Integral of the absolute error after a unit step of the load at the process input; inf:
    without integral action."""
    iae_setpoint: float = result_field("s", math.nan, lower=0.0)
    """Integral of the absolute error after a unit step of the set-point."""
    overshoot: float = result_field("", math.nan, lower=0.0)
    """After a step of the set-point, relative to it."""
    settling_time: float = result_field("s", math.nan, lower=0.0)
    """Until the measurement stays within 2 % of a new set-point."""
    effort_setpoint: float = result_field("u/y", math.nan, lower=0.0)
    """Total variation of the command after a unit step of the set-point."""
    effort_load: float = result_field("", math.nan, lower=0.0)
    """Total variation of the command after a unit step of the load."""


@dataclass(frozen=True, kw_only=True)
class Performance(StepFigures, Margins):
    """Performance of a controller on a model.

    :raises TuningError: if a number is negative, or one that is always computed is NaN.
    """

    noise_gain: float = result_field("u/y", math.nan, lower=0.0)
    """Standard deviation of the command over that of white noise in the samples of the
    measurement; without a sampling period the largest gain at any frequency."""

    def __post_init__(self) -> None:
        for each in result_fields(type(self)):  # type: ignore[arg-type]
            if each.kind is float and not each.derived:
                problem = each.problem(getattr(self, each.name))
                if problem is not None:
                    raise TuningError(f"{each.name} of the gains {problem}")


@dataclass(frozen=True, kw_only=True)
class Gains(Performance, Controller):
    """The controller that one rule gives, with what it does on the identified model.

    >>> from relay_autotune import TransferFunction, tune
    >>> gains = tune(TransferFunction.fopdt(1.65, 20.0, 10.0), rule="imc")
    >>> print(gains)
    kc = 0.8913, ti = 25 s
    >>> print(f"Ms {gains.ms:.2f}, gain margin {gains.gain_margin:.2f}")
    Ms 1.95, gain margin 2.25
    """

    rule: str = result_field(after="", word=True, column=1)
    """Name in the registry."""
    form: str = result_field("", "isa", after="rule")
    """Form in which the rule is stated."""
    ms_95: float = result_field(nan=True, after="ms", column=1)
    """Ms that 95 % of the models within the uncertainty stay below; NaN: not estimated."""
    law: str = result_field("", "", word=True, optional=True)
    """Law that they are for; left out: controller_node's, as a continuous controller."""
    law_period: float = result_field("s", 0.0, lower=0.0, optional=True)
    """Sampling period at which that law runs; left out: no law was named."""
    bare: Performance | None = result_field("", None, message=None, optional=True)
    """What p, i and d do alone, in a controller with neither filter nor set-point weight; left
    out: the same, for another law, or an unstable loop."""
    reason: str = result_field()
    """Why this rule and these gains, a sentence for people."""
    warnings: tuple[str, ...] = result_field("", ())
    """What the user must know before using them."""

    def __post_init__(self) -> None:
        Controller.__post_init__(self)
        Performance.__post_init__(self)

    @property
    def softeners(self) -> str:
        """What there is beside p, i and d, for a sentence: filter, set-point weight, or both."""
        there = {"filter tf": self.tf > 0.0, "weight b": self.b != 1.0}
        return " and ".join(name for name, is_there in there.items() if is_there)


@dataclass(frozen=True)
class InternalModelLaw:
    r"""A controller that feeds its own command back through an internal model.

    ``u = forward (r - y) + inside u``, so that from error to command it is
    ``forward/(1 - inside)``: with internal model control ``forward`` is the controller Q and
    ``inside`` is Q times the model.

    :param forward: from error to command [u/y].
    :param inside: from command to command.
    """

    forward: TransferFunction
    inside: TransferFunction
    period: ClassVar[float] = 0.0
    """Sampling period: that of a continuous controller [s]."""

    @property
    def i(self) -> float:
        """Integral gain [u/(y s)]."""
        inside = self.inside
        if inside.gain != 1.0 or inside.integrators:
            return 0.0
        lag = sum(inside.time_constants) - sum(inside.zeros) + inside.dead_time
        return float(self.forward.gain / complex(lag).real)

    @property
    def times(self) -> tuple[float, ...]:
        """Times at which it changes its effect [s]."""
        terms = (self.forward, self.inside)
        constants = [c for t in terms for c in (*t.zeros, *t.time_constants)]
        return (*(abs(c) for c in constants), self.inside.dead_time)

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return -command per measurement at complex frequencies [u/y].

        :param s: rad/s, any shape.
        """
        return np.asarray(self.forward(s) / (1.0 - self.inside(s)))

    def from_setpoint(self, s: ComplexArray) -> ComplexArray:
        """Return command per set-point at complex frequencies [u/y].

        :param s: rad/s, any shape.
        """
        return self(s)

    def characteristic(self, model: TransferFunction) -> tuple[TransferFunction, ...]:
        """Return the terms L_k of the characteristic equation ``1 + sum L_k(s) = 0``.

        :param model: the process.
        """
        first = self.forward
        through = model.after(
            first.gain, first.zeros, first.time_constants, first.integrators, first.dead_time
        )
        return replace(self.inside, gain=-self.inside.gain), through


FORMS = ("isa", "parallel", "series")

_ROUNDING = 1e-12


@dataclass(frozen=True)
class SeriesForm:
    """Gains of the series form, ``kc (1 + 1/(ti s)) (1 + td s)`` (Luyben 2003, eq 11).

    :param kc: proportional gain of the PI part [u/y].
    :param ti: integral time [s]; 0: no integral action.
    :param td: derivative time [s]; 0: no derivative action.
    :param alpha: time constant of the filter over ``td``; 0: no filter.
    """

    kc: float
    ti: float
    td: float = 0.0
    alpha: float = 0.1

    def isa(self) -> Controller:
        """Return the same controller in ISA form.

        ``kc' = kc (1 + td/ti)``, ``ti' = ti + td``, ``td' = ti td/(ti + td)``.
        """
        tf = self.alpha * self.td
        if self.ti == 0.0:
            return Controller(self.kc, 0.0, self.td, tf)
        total = self.ti + self.td
        return Controller(self.kc * total / self.ti, total, self.ti * self.td / total, tf)


def series_form(controller: Controller) -> SeriesForm:
    """Return a controller in series form.

    With ``r = sqrt(1 - 4 td/ti)``: ``ti' = ti (1 + r)/2``, ``td' = ti (1 - r)/2``,
    ``kc' = kc (1 + r)/2``.

    :raises TuningError: if ti < 4 td, where the zeros of the controller are complex, or if there
        is a filter without derivative action, for which alpha has no value.
    """
    ti, td = controller.ti, controller.td
    if td == 0.0 and controller.tf > 0.0:
        raise TuningError(
            "the series form has a filter only with derivative action: td = 0 and "
            f"tf = {controller.tf:g} s have none; use the ISA or the parallel form"
        )
    if ti == 0.0:
        alpha = controller.tf / td if td else 0.0
        return SeriesForm(controller.kc, 0.0, td, alpha)
    squared = 1.0 - 4.0 * td / ti
    if squared < -_ROUNDING:
        raise TuningError(
            f"ti = {ti:g} s is less than 4 td = {4.0 * td:g} s: the controller has complex zeros "
            "and no series form; use the ISA or the parallel form"
        )
    half = 0.5 * (1.0 + math.sqrt(max(squared, 0.0)))
    lead = td / half
    return SeriesForm(controller.kc * half, ti * half, lead, controller.tf / lead if lead else 0.0)
