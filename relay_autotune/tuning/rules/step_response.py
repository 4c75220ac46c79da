# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Rules for a step response: what it tells, and Åström and Hägglund's AMIGO.

Åström and Hägglund, "Revisiting the Ziegler-Nichols step response method for PID control",
J. Process Control 14, 2004, and "Advanced PID Control", ISA 2006: approximate M-constrained
integral gain, fitted to designs of Ms = 1.4 on a batch of processes. With gain K, apparent time
constant T and apparent delay L,

    PI:   kc = 0.15/K + (0.35 - L T/(L + T)^2) T/(K L),
          ti = 0.35 L + 13 L T^2/(T^2 + 12 L T + 7 L^2);
    PID:  kc = (0.2 + 0.45 T/L)/K,   ti = L (0.4 L + 0.8 T)/(L + 0.1 T),
          td = 0.5 L T/(0.3 L + T);

and of an integrating process ``K exp(-L s)/s``

    PI:   kc = 0.35/(K L),   ti = 13.4 L;
    PID:  kc = 0.45/(K L),   ti = 8 L,   td = 0.5 L.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant
from relay_autotune.tuning.rules.applicability import (
    controller,
    is_first_order,
    named,
    process_of,
    wants_pid,
)
from relay_autotune.tuning.task import DesignTask

_POINTS = 4000
# One and a third of a time constant of a first-order rise.
_THIRD, _WHOLE = 1.0 - math.exp(-1.0 / 3.0), 1.0 - math.exp(-1.0)
_SETTLED = 1e-3
_MONOTONE = 0.02


@dataclass(frozen=True)
class ReactionCurve:
    """Gain, lag and delay of a step response.

    :param gain: K; of an integrating process the rate per unit step [y/u, y/(u s)].
    :param lag: T, to 63 % of the way after the delay [s]; inf: it integrates.
    :param delay: L, where the steepest tangent meets the initial value [s].
    """

    gain: float
    lag: float
    delay: float


def step_response(model: TransferFunction) -> ReactionCurve:
    """Return K, T and L of a process, from its own exact step response.

    :param model: a process with one integrator at most.
    :raises TuningError: if it is unstable, integrates twice, or does not rise steadily.
    """
    if model.grows or model.integrators not in (0, 1):
        raise TuningError(
            "a step response is told by its gain, lag and delay where the process is stable or "
            f"integrates once; found {named(model)}: use robust"
        )
    if model.integrators:
        # The tangent in the long run begins to rise after all delays and lags.
        shift = sum(t.real for t in model.time_constants) - sum(z.real for z in model.zeros)
        return ReactionCurve(model.gain, math.inf, model.dead_time + shift)
    if is_first_order(model):
        return ReactionCurve(model.gain, model.time_constants[0].real, model.dead_time)
    return _measured(model)


def two_point_fopdt(model: TransferFunction) -> TransferFunction:
    """Return the FOPDT process through 28 and 63 % of a step response.

    ``tau = 1.5 (t63 - t28)``, ``D = t63 - tau`` (Smith and Corripio, "Principles and Practice of
    Automatic Process Control", 1997), for models that come without a record to be fitted.

    :param model: a stable process whose step response rises steadily.
    :raises TuningError: for any other.
    """
    if not model.is_stable or not model.time_constants:
        raise TuningError(
            f"only a stable process with a lag has a FOPDT for it, found {named(model)}"
        )
    rise = _Rise(model)
    late = rise.time_of(_WHOLE)
    tau = 1.5 * (late - rise.time_of(_THIRD))
    return TransferFunction.fopdt(model.gain, tau, max(late - tau, 0.0))


class _Rise:
    """A step response that rises steadily."""

    def __init__(self, model: TransferFunction) -> None:
        self._model = model
        self._step = PiecewiseConstant(np.zeros(1), np.ones(1), 0.0)
        end = model.dead_time + 12.0 * sum(abs(t) for t in model.time_constants)
        self.time = np.linspace(0.0, end, _POINTS)
        self.y = y = response(model, self.time, self._step) / model.gain
        if abs(y[-1] - 1.0) > _SETTLED or y.min() < -_MONOTONE or y.max() > 1.0 + _MONOTONE:
            raise TuningError(
                "a step response must rise steadily for this; that of the model, "
                f"{named(model)}, goes from {100.0 * y.min():.3g} to {100.0 * y.max():.3g} % of "
                "its final value, and 2 % beyond either end is the limit: use robust"
            )

    def time_of(self, share: float) -> float:
        """Return when the response reaches a share of its final value [s]."""

        def missing(t: float) -> float:
            y = response(self._model, np.array([t]), self._step)
            return float(y[0]) / self._model.gain - share

        first = int(np.flatnonzero(self.y >= share)[0])
        return float(brentq(missing, self.time[first - 1], self.time[first], rtol=1e-12))


def _measured(model: TransferFunction) -> ReactionCurve:
    rise = _Rise(model)
    slopes = np.gradient(rise.y, rise.time)
    top = int(np.argmax(slopes))
    delay = float(rise.time[top] - rise.y[top] / slopes[top])
    return ReactionCurve(model.gain, rise.time_of(_WHOLE) - delay, max(delay, 0.0))


def amigo(task: DesignTask) -> tuple[Controller, str]:
    """Return the PI or PID gains of Åström and Hägglund.

    The set-point weight of PID is theirs: 0 where L is shorter than T, else 1.

    :param task: a process that integrates once, or is stable with a step response that rises
        without much overshoot or inverse response.
    :raises TuningError: for any other, or without delay.
    """
    step = step_response(process_of(task))
    k, t, delay = step.gain, step.lag, step.delay
    pid = wants_pid("amigo", task)
    if not delay > 0.0:
        raise TuningError(
            "the rule amigo divides by the apparent delay, and the step response has none: its L "
            "must be above 0 s; use imc, or give the loop's own delay"
        )
    said = f"L = {delay:.4g} s"
    if math.isinf(t):
        if pid:
            gains = controller(task, 0.45 / (k * delay), 8.0 * delay, 0.5 * delay, b=0.0)
        else:
            gains = controller(task, 0.35 / (k * delay), 13.4 * delay)
        return gains, f"AMIGO for an integrating process with {said}"
    if pid:
        gains = controller(
            task,
            (0.2 + 0.45 * t / delay) / k,
            delay * (0.4 * delay + 0.8 * t) / (delay + 0.1 * t),
            0.5 * delay * t / (0.3 * delay + t),
            b=0.0 if delay <= t else 1.0,
        )
    else:
        kc = 0.15 / k + (0.35 - delay * t / (delay + t) ** 2) * t / (k * delay)
        ti = 0.35 * delay + 13.0 * delay * t * t / (t * t + 12.0 * delay * t + 7.0 * delay**2)
        gains = controller(task, kc, ti)
    return gains, f"AMIGO with T = {t:.4g} s and {said}"
