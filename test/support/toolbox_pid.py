# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""control_toolbox::Pid of branch jazzy, each of its strategies against windup, written anew."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass
class ToolboxPid:
    """u = p e + I + d e', limited to the clamps; what it has in memory are the last two."""

    p: float
    i: float
    d: float
    antiwindup_strategy: str
    u_clamp_min: float = -math.inf
    u_clamp_max: float = math.inf
    i_clamp_min: float = -math.inf
    i_clamp_max: float = math.inf
    tracking_time_constant: float = 0.0
    integral: float = 0.0
    error: float = 0.0

    @property
    def memory(self) -> dict[str, float]:
        return {"integral": self.integral, "error": self.error}

    def reset(self, *, save_integral: bool) -> None:
        self.error = 0.0
        self.integral *= save_integral

    def step(self, error: float, period: float, rate: float | None = None) -> float:
        """Return the command; the error's rate is its difference where it is not given."""
        if rate is None:
            rate, self.error = (error - self.error) / period, error
        added = period * self.i * error
        if self.antiwindup_strategy == "legacy":
            self.integral = self._clamped(self.integral + added)
        wanted = self.p * error + self.integral + self.d * rate
        command = min(max(wanted, self.u_clamp_min), self.u_clamp_max)
        if self.antiwindup_strategy == "back_calculation" and self.i:
            self.integral += added + period * (command - wanted) / self.tracking()
        elif self.antiwindup_strategy == "conditional_integration":
            if command == wanted or error * wanted <= 0.0:
                self.integral += added
        elif self.antiwindup_strategy == "none":
            self.integral += added
        self.integral = self._clamped(self.integral)
        return command

    def _clamped(self, integral: float) -> float:
        return min(max(integral, self.i_clamp_min), self.i_clamp_max)

    def tracking(self) -> float:
        if self.tracking_time_constant:
            return self.tracking_time_constant
        return math.sqrt(self.d / self.i) if self.d else self.p / self.i
