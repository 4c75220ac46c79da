r"""Integrating processes with inverse response, from three numbers of a step response.

Luyben, "Identification and Tuning of Integrating Processes with Deadtime and Inverse Response",
Ind. Eng. Chem. Res. 2003. The process is K (1 - tau1 s) exp(-D s)/(s (tau2 s + 1)). All times here
count from the end of the dead time; y is the deviation from before the step of height du.

The paper solves its eqs 4 to 6 by iteration in three unknowns, with a program whose third equation
has a divisor tau2 too many (its printed example follows from that). With
r = (tau1 + tau2)/tau2 and z = t2/tau2 they are in closed form but for one monotone equation:

    t1 = tau2 ln r,   r = z/(1 - exp(-z)),   t2/t1 = z/ln r,   y_ext = du K (t1 - tau1).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from relay_autotune.errors import IdentificationError

FloatArray = NDArray[np.float64]

_SMALL = 1e-3
_LARGEST = 1e8


def step_response(
    time: FloatArray, gain: float, tau1: float, tau2: float, step: float
) -> FloatArray:
    """Return the response to a step (eq 2) [y].

    :param time: since the end of the dead time, >= 0 [s], shape (n,).
    :param gain: K [y/(u s)].
    :param tau1: of the inverse response [s].
    :param tau2: of the lag [s].
    :param step: du [u].
    """
    ramp = time - (tau1 + tau2) * -np.expm1(-time / tau2)
    return np.asarray(step * gain * ramp)


def step_features(
    gain: float, tau1: float, tau2: float, step: float
) -> tuple[float, float, float]:
    """Return time t1 and height of the extremum, and the return to zero t2 (eqs 4 to 6).

    :param gain: K [y/(u s)].
    :param tau1: > 0 [s].
    :param tau2: > 0 [s].
    :param step: du [u].
    :return: t1 [s], t2 [s], y_ext [y].
    """
    r = 1.0 + tau1 / tau2
    t1 = tau2 * math.log1p(tau1 / tau2)
    # z/(1 - exp(-z)) exceeds both 1 + z/2 and z.
    low, high = r - 1.0, min(2.0 * (r - 1.0), r)
    z = float(brentq(lambda z: _r_less_1(z) - (r - 1.0), low, high, xtol=1e-300, rtol=1e-15))
    return t1, tau2 * z, step * gain * (t1 - tau1)


def from_step(t1: float, t2: float, extremum: float, step: float) -> tuple[float, float, float]:
    """Return (K, tau1, tau2) of the process (eqs 4 to 6 in closed form).

    :param t1: when the extremum is reached, a minimum or a maximum [s].
    :param t2: when y is back where it was before the step [s].
    :param extremum: height of the extremum, from before the step [y].
    :param step: du [u].
    :return: K [y/(u s)], of the sign that has the extremum on the side away from K du; tau1 and
        tau2 [s].
    :raises IdentificationError: unless 0 < 2 t1 < t2, or if the extremum or the step is zero.
    """
    if extremum == 0.0 or step == 0.0 or not math.isfinite(extremum) or not math.isfinite(step):
        raise IdentificationError(
            f"an inverse response of {extremum:g} to a step of {step:g} tells nothing: both must "
            "be finite and not zero"
        )
    if not 0.0 < 2.0 * t1 < t2:
        raise IdentificationError(
            f"the extremum comes after {t1:g} s and the return after {t2:g} s, but an integrator "
            "with inverse response takes more than twice as long to return; both count from the "
            "end of the dead time"
        )
    ratio = t2 / t1

    def excess(z: float) -> float:
        return _ratio(z) - ratio

    high = 1.0
    while excess(high) < 0.0:
        high *= 4.0
        if high > _LARGEST:
            raise IdentificationError(
                f"a return {ratio:g} times later than the extremum is no response of this "
                "structure: its lag would vanish"
            )
    z = float(brentq(excess, 0.0, high, xtol=1e-16, rtol=1e-15))
    if z == 0.0:
        raise IdentificationError(
            "the return comes at just twice the time of the extremum, so that the inverse "
            "response would vanish beside the lag: read the times more closely"
        )
    tau2 = t2 / z
    tau1 = tau2 * _r_less_1(z)
    # t1 - tau1 = tau2 (ln r - (r - 1))
    return extremum / (step * (t1 - tau1)), tau1, tau2


def _r_less_1(z: float) -> float:
    """Return z/(1 - exp(-z)) - 1 without cancellation."""
    if z < _SMALL:
        return z / 2.0 + z * z / 12.0 - z**4 / 720.0
    return (z + math.expm1(-z)) / -math.expm1(-z)


def _ratio(z: float) -> float:
    """Return t2/t1 = z/ln r, which rises from 2 at z = 0."""
    return z / math.log1p(_r_less_1(z)) if z > 0.0 else 2.0
