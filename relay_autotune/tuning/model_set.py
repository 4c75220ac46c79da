# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Frequency responses of many models at once."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.laws import Law
from relay_autotune.loop.sampled_loop import SampledLoop, sampled_grid
from relay_autotune.process.response import HeldProcess
from relay_autotune.process.transfer_function import TransferFunction

_Constants = Sequence[tuple[complex, ...]]


class ModelSet:
    """Similar models, such as those within an uncertainty.

    :param models: m of them, at least one.
    :ivar integrators: of each model, shape (m,).
    :ivar unstable_poles: how many each has in the right half plane, shape (m,).
    """

    def __init__(self, models: Sequence[TransferFunction]) -> None:
        self.models = tuple(models)
        self.integrators = np.array([m.integrators for m in self.models])
        self.unstable_poles = np.array(
            [sum(t.real < 0.0 for t in m.time_constants) for m in self.models]
        )
        alike = defaultdict(list)
        for k, model in enumerate(self.models):
            alike[len(model.zeros), len(model.time_constants), model.integrators].append(k)
        self._groups = [(integrators, np.array(of)) for (_, _, integrators), of in alike.items()]
        # Frequencies and responses in one, for several threads.
        self._known: tuple[FloatArray, ComplexArray] | None = None

    def __call__(self, frequency: FloatArray) -> ComplexArray:
        """Return the response of each model at each frequency.

        The values at the frequencies of the first call are kept, since the grids for the loops
        of one process have most of their frequencies in common.

        :param frequency: rad/s, shape (n,), increasing.
        :return: y/u, shape (n, m).
        """
        if self._known is None:
            self._known = frequency, self._evaluate(frequency)
        known, responses = self._known
        place = np.minimum(np.searchsorted(known, frequency), known.size - 1)
        found = responses[place]
        new = known[place] != frequency
        found[new] = self._evaluate(frequency[new])
        return found

    def _evaluate(self, frequency: FloatArray) -> ComplexArray:
        w = frequency[:, None]
        s = 1j * w
        found = np.empty((frequency.size, len(self.models)), dtype=np.complex128)
        for integrators, of in self._groups:
            models = [self.models[k] for k in of]
            lag = np.array([m.dead_time for m in models]) * w
            gain = np.array([m.gain for m in models])
            values = np.empty(lag.shape, dtype=np.complex128)
            # Much faster than a complex exponential.
            values.real, values.imag = gain * np.cos(lag), -gain * np.sin(lag)
            if integrators:
                values *= s ** float(-integrators)
            for zero in _columns([m.zeros for m in models]):
                values *= 1.0 + zero * s
            for constant in _columns([m.time_constants for m in models]):
                values /= 1.0 + constant * s
            found[:, of] = values
        return found


def _columns(constants: _Constants) -> ComplexArray:
    """Return the first constant of each model, then the second, and so on, shape (p, m)."""
    return np.array(constants, dtype=np.complex128).T


@dataclass(frozen=True)
class HeldSet:
    """Models between hold and sampler, for the exact loops of a law.

    :param models: with the dead time of the loop, but none for the hold.
    :param law: the law.
    :param period: of the samples [s].
    """

    models: tuple[TransferFunction, ...]
    law: Law
    period: float

    @cached_property
    def _held(self) -> list[HeldProcess]:
        return [HeldProcess(model, self.period) for model in self.models]

    @cached_property
    def _known(self) -> dict[tuple[float, int], ComplexArray]:
        """Responses of the models, by the begin and the size of the grid."""
        return {}

    def loops(self, controller: Controller) -> tuple[ComplexArray, NDArray[np.bool_]]:
        """Return the loops on a grid, shape (n, m), and which of them are unstable, shape (m,).

        :param controller: the gains, as far as the law can have them.
        """
        law = self.law.at(controller, self.period)
        grid = sampled_grid(self.models[0], controller, self.period)
        z, key = np.exp(1j * grid * self.period), (float(grid[0]), grid.size)
        if key not in self._known:
            self._known[key] = np.column_stack([held(z) for held in self._held])
        values = law.from_measurement(z)[:, None] * self._known[key]
        each = zip(self.models, self._held, values.T, strict=True)
        unstable = [SampledLoop(law, m, h).unstable_from(grid, v) != 0.0 for m, h, v in each]
        return values, np.array(unstable)
