"""The samples of a running experiment."""

from __future__ import annotations

from array import array

import numpy as np

from relay_autotune.record.record import FloatArray


class Samples:
    """Columns that grow by one sample at a time, cheaply, and give arrays of any part."""

    def __init__(self) -> None:
        self.time = array("d")
        """Instants [s from the first sample]."""
        self.measurement = array("d")
        """Measurements [y]."""
        self.command = array("d")
        """Answers [u]; one fewer while a sample is being answered."""

    def __len__(self) -> int:
        return len(self.time)

    @property
    def interval(self) -> float:
        """Mean interval between samples [s]; 0 for fewer than two."""
        return self.time[-1] / (len(self.time) - 1) if len(self.time) > 1 else 0.0

    def columns(self, first: int, stop: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return copies of time, measurement and command of the samples first to stop - 1.

        While a sample is being answered, a part that ends with it has no command for it.
        """
        time, measurement, command = (
            # An array on the memory of a column would keep the column from growing.
            np.array(column[first:stop], dtype=np.float64)
            for column in (self.time, self.measurement, self.command)
        )
        return time, measurement, command
