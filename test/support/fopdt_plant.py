# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A first-order process with dead time in closed form, as independent truth for the tests.

Between changes of the delayed input, y(t) = K u + (y(t0) - K u) exp(-(t - t0)/tau). It shares no
code with the package.
"""

from __future__ import annotations

import math
from collections import deque


class FopdtPlant:
    """K exp(-D s)/(tau s + 1), at rest at command 0; with K and tau negative an unstable one."""

    def __init__(self, gain: float, time_constant: float, dead_time: float) -> None:
        self.gain, self.time_constant, self.dead_time = gain, time_constant, dead_time
        self.time = self.output = self.arrived = self.command = 0.0
        self.on_the_way: deque[tuple[float, float]] = deque()

    def advance(self, time: float, command: float) -> float:
        """Hold the command from now on and return the output at ``time``."""
        if command != self.command:
            self.on_the_way.append((self.time + self.dead_time, command))
            self.command = command
        now = self.time
        while self.on_the_way and self.on_the_way[0][0] <= time:
            change, level = self.on_the_way.popleft()
            self.output = self._after(change - now)
            now, self.arrived = change, level
        self.output = self._after(time - now)
        self.time = time
        return self.output

    def _after(self, span: float) -> float:
        target = self.gain * self.arrived
        return target + (self.output - target) * math.exp(-span / self.time_constant)


def wang_limit_cycle(gain, time_constant, dead_time, amplitude, bias, hysteresis):
    """Return T_u1, T_u2, A_u, A_d of Wang, Hang & Zou 1997, eqs 2 to 5."""
    k, mu, mu0, eps = gain, amplitude, bias, hysteresis
    decay = math.exp(-dead_time / time_constant)
    up = (mu0 + mu) * k * (1 - decay) + eps * decay
    down = (mu0 - mu) * k * (1 - decay) - eps * decay
    high = time_constant * math.log(
        (2 * mu * k / decay + mu0 * k - mu * k + eps) / (mu * k + mu0 * k - eps)
    )
    low = time_constant * math.log(
        (2 * mu * k / decay - mu * k - mu0 * k + eps) / (mu * k - mu0 * k - eps)
    )
    return high, low, up, down


def run(experiment, plant, period, *, noise=None, offset=0.0, samples=200_000):
    """Feed an experiment from a plant until it ends; return the number of samples.

    :param noise: called for each sample, returns the noise to add.
    :param offset: measurement at rest.
    """
    command = experiment.safe_command
    for k in range(samples):
        y = offset + plant.advance(k * period, command - experiment.safe_command)
        if noise is not None:
            y += noise()
        command = experiment.step(k * period, y)
        if experiment.finished:
            return k + 1
    return samples
