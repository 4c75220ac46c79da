"""What the user knows of the process before it is identified."""

from __future__ import annotations

import math
from dataclasses import dataclass

from relay_autotune.errors import ParameterError

LOSSES = ("squares", "huber", "tukey")


@dataclass(frozen=True)
class Known:
    """Facts about the process that a method may need and a record may not tell.

    :param gain: static gain, or integrating gain of an integrating process [y/u, y/(u s)];
        NaN: not known.
    :param dead_time: dead time [s]; NaN: not known.
    :param structure: structure to be fitted; empty: the method's own choice.
    :param order: number of equal lags; 0: not known.
    :param loss: what the waveform fit minimises: "squares"; "huber" or "tukey" where the
        sensor's noise has many outliers.
    :raises ParameterError: if the gain is zero or infinite, the dead time negative, or there is
        no such loss.
    """

    gain: float = math.nan
    dead_time: float = math.nan
    structure: str = ""
    order: int = 0
    loss: str = LOSSES[0]

    def __post_init__(self) -> None:
        if self.gain == 0.0 or math.isinf(self.gain):
            raise ParameterError(f"a known gain must be finite and not zero, found {self.gain:g}")
        if self.dead_time < 0.0 or math.isinf(self.dead_time):
            raise ParameterError(
                f"a known dead time must be finite and >= 0 s, found {self.dead_time:g} s"
            )
        if self.order < 0:
            raise ParameterError(
                f"an order must be at least 1, or 0: not known; found {self.order}"
            )
        if self.loss not in LOSSES:
            raise ParameterError(f"unknown loss {self.loss!r}; known: {', '.join(LOSSES)}")


NOTHING = Known()
