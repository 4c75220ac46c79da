# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""A process between hold and sampler: its exact transfer function in z.

A command is given at each sample and held until the next one. With the step response s, a dead
time D and the period h,

    G(z) = (1 - z^-1) sum_{m >= 1, m h >= D} s(m h - D) z^-m,

where the sum has a closed form, since s is the free motion of a linear system.
"""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.arrays import ComplexArray
from relay_autotune.process.modes import Modes
from relay_autotune.process.transfer_function import TransferFunction

# A dead time of a whole number of periods is recognised in spite of this relative rounding.
_ROUNDING = 1e-9


class HeldProcess:
    """A process whose input is held between samples, as a function of z.

    :param model: the process, with the dead time of the loop, but none for the hold.
    :param period: of the samples [s].
    :param delay: further samples until a command takes effect.
    """

    def __init__(self, model: TransferFunction, period: float, delay: int = 0) -> None:
        self.model = model
        self.period = period
        wait = max(math.ceil(model.dead_time / period * (1.0 - _ROUNDING)), 1)
        self._first = max(wait * period - model.dead_time, 0.0)
        self._wait = wait + delay
        self._modes = Modes.of(model)

    def __call__(self, z: ComplexArray) -> ComplexArray:
        """Return y/u at each z, shape (n,).

        :param z: on the unit circle or outside, no pole of the process, not 1 if it integrates.
        """
        moved = self._modes.step_transform(z, self._first, self.period)
        return np.asarray((1.0 - 1.0 / z) * z ** float(-self._wait) * moved)

    @property
    def unstable_poles(self) -> int:
        """Number of its poles outside the unit circle."""
        return sum(1 for t in self.model.time_constants if t.real < 0.0)
