# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the step response of a model tells rules that were made for step tests."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from relay_autotune.errors import TuningError
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant
from relay_autotune.tuning.rules.applicability import is_first_order, named

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
