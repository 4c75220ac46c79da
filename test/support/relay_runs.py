# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Ideal relay experiments with samples of them, as records."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from relay_autotune.arrays import FloatArray
from relay_autotune.process import simulation
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome, Record, RelaySettings


@dataclass(frozen=True)
class RelayRun(simulation.RelayRun):
    """An ideal relay experiment, sampled.

    :param settings: the relay.
    :param time: sample times [s], shape (n,).
    """

    settings: RelaySettings
    time: FloatArray

    @cached_property
    def measurement(self) -> FloatArray:
        """The noise-free measurement at the sample times [y], shape (n,)."""
        return self.output(self.time)

    def record(self, *, noise_std: float = 0.0, rng: np.random.Generator | None = None) -> Record:
        """Return the samples as a record, with noise that the relay did not see.

        :param noise_std: standard deviation of white Gaussian noise [y].
        :param rng: its source; needed if ``noise_std`` > 0.
        """
        y = self.measurement
        if noise_std > 0.0:
            assert rng is not None
            y = y + noise_std * rng.standard_normal(y.size)
        starts = [c.start for c in self.cycles]
        if self.cycles:
            starts.append(starts[-1] + self.cycles[-1].period)
        boundaries = np.unique(np.searchsorted(self.time, starts))
        return Record(
            time=self.time,
            measurement=y,
            command=self.command(self.time),
            settings=self.settings,
            noise_std=noise_std,
            cycle_start=tuple(int(b) for b in boundaries if b < self.time.size),
            outcome=Outcome.COMPLETED,
            held_input=self.command,
        )


def simulate_relay(
    model: TransferFunction,
    settings: RelaySettings,
    *,
    time: ArrayLike | int = (),
    **options: Any,
) -> RelayRun:
    """Run an ideal relay on a process and sample it.

    :param model: the process.
    :param settings: of the relay.
    :param time: instants of the samples [s], not decreasing, shape (n,), of which those after the
        end of the last cycle are left out; or how many, evenly spaced up to the last switch.
    :param options: of :func:`relay_autotune.process.simulation.simulate_relay`.
    """
    run = simulation.simulate_relay(model, settings, **options)
    end = float(run.command.times[-1])
    samples = np.linspace(0.0, end, time) if isinstance(time, int) else np.asarray(time)
    inside = samples[(samples >= 0.0) & (samples <= end)]
    return RelayRun(**vars(run), settings=settings, time=inside)
