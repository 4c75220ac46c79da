# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Exact steady oscillation of a model under a symmetric relay.

Between two switches the state moves freely, except for the delayed step of the command that
arrives a dead time D after the first of them. In the limit cycle of half period T each half
mirrors the one before, x(T) = -x(0), which is one linear system for the state at the switch:

    (Phi(T) + 1) z_0 = 2 h Phi(T - D) b.

The output at the switch, y(0), is the level at which a relay must switch to sustain the period:
zero for an ideal relay (HG(T, -1) = 0 in the notation of Chang, Shen and Yu 1992), the
hysteresis for one that has it.
"""

from __future__ import annotations

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.process.modes import Coordinates, Modes
from relay_autotune.process.transfer_function import TransferFunction


class HalfCycle:
    """Half a period of the output, from the switch that turns it down to the next switch.

    :param model: the process; its oscillation is described as if it were direct-acting.
    :param half_period: T, longer than the dead time [s].
    :param amplitude: of the relay, h [u].
    :raises ModelError: if the half period is not longer than the dead time.
    """

    def __init__(
        self, model: TransferFunction, half_period: float, amplitude: float = 1.0
    ) -> None:
        if not half_period > model.dead_time:
            raise ModelError(
                f"a half period of {half_period:g} s is not longer than the dead time of "
                f"{model.dead_time:g} s: a switch takes effect only after the dead time, so that "
                "the relay cannot switch sooner"
            )
        self.half_period = half_period
        self.dead_time = model.dead_time
        self._poles = [-1.0 / t for t in model.time_constants] + [0j] * model.integrators
        horizon = max(len(self._poles), 2) * half_period
        self._modes = modes = Modes.of(model, horizon)
        kick = 2.0 * amplitude * model.process_sign * modes.input_direction
        whole, early, late = modes.propagators(
            np.array([half_period, model.dead_time, half_period - model.dead_time])
        )
        before = np.linalg.solve(whole + np.eye(modes.size), late @ kick)
        after = early @ before - kick
        self._weights = modes.weights(before), modes.weights(after)
        self._slopes = tuple(modes.slope_weights(w) for w in self._weights)
        self._rates = modes.slope_weights(modes.weights(late @ after))

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the output's deviation at times after the switch.

        :param time: s, shape (n,).
        :return: y, shape (n,).
        """
        return self._unfolded(time, *self._weights)

    def slope(self, time: FloatArray) -> FloatArray:
        """Return the rate of the output at times after the switch.

        :param time: s, shape (n,).
        :return: y/s, shape (n,).
        """
        return self._unfolded(time, *self._slopes)

    def _unfolded(
        self, time: FloatArray, before: list[Coordinates], after: list[Coordinates]
    ) -> FloatArray:
        turns = np.floor(time / self.half_period)
        within = time - turns * self.half_period
        early = within < self.dead_time
        y = np.where(
            early,
            self._modes.outputs(before, np.where(early, within, 0.0))[:, 0],
            self._modes.outputs(after, np.where(early, 0.0, within - self.dead_time))[:, 0],
        )
        return np.asarray(np.where(turns % 2.0 == 0.0, y, -y))

    def multiplier(self) -> float:
        r"""Return the factor by which a deviation from the limit cycle shrinks in half a period.

        A deviation of the state at a switch moves with the process and shifts the next switch,
        x -> (1 - xdot c'/(c' xdot)) Phi x. The eigenvalues of this map are the zeros of

            sum_k r_k lambda^-k,   r_k = c' Phi^k xdot,

        where r_k is the rate of the output k half periods after the switch if the relay did not
        switch again. The sum is a polynomial of degree n - 1 in 1/lambda over
        ``prod(1 - phi_i/lambda)``. This form is accurate also for many equal lags, whose matrix
        is badly conditioned.
        """
        n = len(self._poles)
        if n < 2:
            return 0.0
        at = np.arange(n, dtype=np.float64) * self.half_period
        rates = self._modes.outputs(self._rates, at)[:, 0]
        denominator = np.ones(1, dtype=np.complex128)
        for pole in self._poles:
            denominator = np.convolve(denominator, [1.0, -np.exp(pole * self.half_period)])
        # Its powers of 1/lambda, lowest first, are those of lambda, highest first.
        roots = np.roots(np.convolve(rates, denominator.real)[:n])
        return float(np.max(np.abs(roots))) if roots.size else 0.0
