# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The three forms of a PID controller, and the exact conversions to the series form and back.

All computations use the ISA form; the others are the parallel and the series form:

    kc (1 + 1/(ti s) + td s),    p + i/s + d s,    kc (1 + 1/(ti s)) (1 + td s).

The gains of the parallel form are those of :class:`~relay_autotune.loop.gains.Controller`.

Only the numbers differ: the filter on the measurement, of time constant tf, is the same factor in
all three. Luyben (2003, eq 11) writes the filter of the series form as ``1/(alpha td s + 1)``,
alpha typically 0.1. Here ``alpha = tf/td``, and the second-order filter of
:class:`~relay_autotune.loop.gains.Controller` replaces his first-order one; both have the same
delay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction

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

    def isa(self, b: float = 1.0) -> Controller:
        """Return the same controller in ISA form.

        ``kc' = kc (1 + td/ti)``, ``ti' = ti + td``, ``td' = ti td/(ti + td)``.

        :param b: weight of the set-point.
        """
        tf = self.alpha * self.td
        if self.ti == 0.0:
            return Controller(self.kc, 0.0, self.td, tf, b)
        total = self.ti + self.td
        return Controller(self.kc * total / self.ti, total, self.ti * self.td / total, tf, b)

    def transfer_function(self) -> TransferFunction:
        """Return eq 11 as Luyben wrote it, with its first-order filter.

        ``Gc = kc (ti s + 1)/(ti s) (td s + 1)/(alpha td s + 1)``.
        """
        lag = (self.alpha * self.td,)
        if self.ti == 0.0:
            return TransferFunction(self.kc, (self.td,), lag)
        return TransferFunction(self.kc / self.ti, (self.ti, self.td), lag, 1)


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
