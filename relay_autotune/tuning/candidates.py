# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Controllers that a search compares, and the limit on the noise in their command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray
from relay_autotune.loop.gains import Controller


@dataclass(frozen=True)
class Candidates:
    """Controllers to compare, with positive gains whatever the sign of the process.

    :param kp: proportional gains, shape (k,).
    :param ki: integral gains, shape (k,).
    :param td: derivative times [s], shape (k,).
    :param tf: time constants of the filter [s], shape (k,).
    """

    kp: FloatArray
    ki: FloatArray
    td: FloatArray
    tf: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Candidates]) -> Candidates:
        """Return all of them, one after the other."""
        fields = zip(*((c.kp, c.ki, c.td, c.tf) for c in parts), strict=True)
        return cls(*(np.concatenate(field) for field in fields))

    def __getitem__(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Candidates:
        return Candidates(self.kp[index], self.ki[index], self.td[index], self.tf[index])

    def controller(self, k: int, sign: int) -> Controller:
        """Return controller k with the sign of the process."""
        kp, ki = float(self.kp[k]), float(self.ki[k])
        return Controller(sign * kp, kp / ki, float(self.td[k]), float(self.tf[k]))


@dataclass(frozen=True)
class Optimum:
    """The controller that a search found.

    :param controller: the gains.
    :param iae: IAE after a unit step of the load, as computed in the search [y s/u].
    """

    controller: Controller
    iae: float


@dataclass(frozen=True)
class NoiseLimit:
    """How much of the measurement noise may reach the command.

    :param gain: largest standard deviation of the command over that of the noise [u/y].
    :param period: of the samples [s].
    """

    gain: float
    period: float
