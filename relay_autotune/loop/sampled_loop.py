# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""A loop of a law and a process at a sampling period, exact in z.

The law runs once for each sample, the process is exact between samples and sees a held command:
``L(z) = C(z) G(z)`` on ``z = exp(j w h)``, w up to pi/h. Nothing is approximated by a dead time of
half a period.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import (
    LONGEST,
    NO_OFFSET,
    StepResponse,
    figures_of,
    has_settled,
    horizon,
    performance_of,
)
from relay_autotune.loop.gains import Controller, Performance, StepFigures
from relay_autotune.loop.laws import SampledLaw
from relay_autotune.loop.stability import MOST_PIECES, LoopMargins, margins, peaks
from relay_autotune.process.response import HeldProcess
from relay_autotune.process.transfer_function import TransferFunction

_PER_DECADE = 60
_MOST_TURNS = 800.0 * math.pi
# Distance of the grid's end from half the sampling frequency, relative to it.
_BEFORE_END = 1e-9
# Largest step of the phase that can be followed, and largest number of divisions of a cell.
_CLEAR, _MOST_DIVISIONS = 1.0, 40
_ANGLES = 4096
# Least and largest number of samples of a response.
_LEAST_SAMPLES, _MOST_SAMPLES = 256, 1 << 19
_DECAY = math.log(1e8)


def sampled_grid(model: TransferFunction, gains: Controller, period: float) -> FloatArray:
    """Return frequencies up to half the sampling frequency that show the loop [rad/s].

    :param model: the process, with the dead time of the loop.
    :param gains: of the law.
    :param period: of the samples [s].
    """
    constants = (*model.zeros, *model.time_constants)
    times = [abs(c) for c in constants] + [gains.ti, gains.td, gains.tf, model.dead_time]
    top = math.pi / period
    low = 1e-3 * min(top, *(1.0 / t for t in times if t > 0.0))
    # Loops of one process have the same grid for most gains.
    low = 10.0 ** math.floor(math.log10(low))
    count = int(_PER_DECADE * math.log10(top / low))
    parts = [np.geomspace(low, top, count), top * (1.0 - np.geomspace(1e-6, 0.5, 80))]
    if model.dead_time > 0.0:
        last = min(top * model.dead_time, _MOST_TURNS)
        fine = min(last, 12.0 * math.pi)
        parts.append(np.arange(0.05, fine, 0.05) / model.dead_time)
        parts.append(np.arange(fine, last, 0.2) / model.dead_time)
    for c in constants:
        if c.imag > 0.0:
            width = abs(c.real) / abs(c)
            parts.append(np.abs(1.0 + width * np.linspace(-8.0, 8.0, 65)) / abs(c) + low)
    grid = np.unique(np.concatenate(parts))
    return np.asarray(np.append(grid[grid < top * (1.0 - 1e-7)], top * (1.0 - _BEFORE_END)))


def circle(samples: int) -> ComplexArray:
    """Return the half circle outside the unit circle for :func:`step_response`, shape (n + 1,).

    :param samples: n, those of the response.
    """
    decay = _DECAY / (2.0 * samples)
    return np.exp(decay + 1j * np.arange(samples + 1) * (math.pi / samples))


def step_response(values: ComplexArray) -> FloatArray:
    """Return the response to a unit step at the first sample, shape (..., n).

    :param values: of a function of z on the :func:`circle` of n samples, shape (..., n + 1).
    """
    samples = values.shape[-1] - 1
    step = 1.0 / (1.0 - 1.0 / circle(samples))
    grown = np.exp(_DECAY / (2.0 * samples) * np.arange(samples))
    return np.asarray(np.fft.irfft(values * step, axis=-1)[..., :samples] * grown)


class SampledLoop:
    """A law and a process at the law's sampling period.

    :param law: with its gains.
    :param model: the process, with the dead time of the loop, but none for the hold.
    :param process: the same between hold and sampler, where it is known already.
    """

    def __init__(
        self, law: SampledLaw, model: TransferFunction, process: HeldProcess | None = None
    ) -> None:
        self.law = law
        self.process = process or HeldProcess(model, law.period)
        self._integrators = model.integrators + (1 if law.gains.ti > 0.0 else 0)

    @cached_property
    def grid(self) -> FloatArray:
        """Frequencies that show the loop [rad/s], shape (n,)."""
        return sampled_grid(self.process.model, self.law.gains, self.law.period)

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return L at ``z = exp(s h)``.

        :param s: rad/s, shape (n,).
        """
        z = np.exp(np.asarray(s) * self.law.period)
        return np.asarray(self.law.from_measurement(z) * self.process(z))

    @cached_property
    def unstable(self) -> float:
        """Number of closed-loop poles outside the unit circle; infinite: one on it."""
        return self.unstable_from(self.grid, self(1j * self.grid))

    def unstable_from(self, grid: FloatArray, loop: ComplexArray) -> float:
        """Return the same from values of the loop that are known.

        :param grid: such as :attr:`grid`, shape (n,).
        :param loop: L there, shape (n,).
        """

        def risen(w: FloatArray, value: ComplexArray) -> ComplexArray:
            rise = 1.0 - np.exp(-1j * w * self.law.period)
            return np.asarray((1.0 + value) * rise ** float(self._integrators))

        turned = _turning(lambda w: risen(w, self(1j * w)), grid, risen(grid, loop))
        if turned is None:
            return math.inf
        return self.process.unstable_poles - round(turned / math.pi)

    @property
    def _end(self) -> float:
        """L at half the sampling frequency, a real number."""
        return float(self(np.array([1j * math.pi / self.law.period]))[0].real)

    def ms(self) -> float:
        """Return the largest magnitude of the sensitivity function; infinite: unstable."""
        if self.unstable != 0:
            return math.inf
        return max(peaks(self, self.grid)[0][0], 1.0 / abs(1.0 + self._end))

    def margins(self) -> LoopMargins:
        """Return the margins of the loop, which must be stable.

        The delay margin is the phase margin over its frequency, as of a continuous loop.
        """
        at_rest = None
        if self._integrators == 0:
            at_rest = self.law.gains.kc * self.process.model.gain
        found = margins(self, self.grid, at_rest)
        end, more = self._end, vars(found).copy()
        if 1.0 / abs(1.0 + end) > found.ms:
            more |= {"ms": 1.0 / abs(1.0 + end), "ms_frequency": math.pi / self.law.period}
        more["mt"] = max(found.mt, abs(end / (1.0 + end)))
        if end < 0.0:
            limit = "gain_margin" if end > -1.0 else "gain_margin_low"
            nearer = min if end > -1.0 else max
            more[limit] = nearer(more[limit], -1.0 / end)
        return LoopMargins(**more)

    def noise_gain(self) -> float:
        """Return the standard deviation of the command per that of white noise [u/y]."""
        z = np.exp(1j * (np.arange(_ANGLES) + 0.5) * (math.pi / _ANGLES))
        law = self.law.from_measurement(z)
        return float(np.sqrt(np.mean(np.abs(law / (1.0 + law * self.process(z))) ** 2)))

    def figures(self, frequency: float) -> StepFigures:
        """Return the features of the responses at the samples.

        :param frequency: about which the loop is closed [rad/s].
        :raises TuningError: if the responses do not die away in any reasonable time.
        """
        period, gains = self.law.period, self.law.gains
        rest = np.exp(np.array([1e-7 * min(frequency * period, 1.0)], dtype=np.complex128))
        final, offset = 1.0, 0.0
        if gains.i == 0.0:
            to_setpoint, to_load, *_ = self._closed(rest)
            final, offset = float(to_setpoint[0].real), float(to_load[0].real)
        duration = horizon(gains, self.process.model, frequency)
        longest = LONGEST * duration
        while True:
            samples = max(_LEAST_SAMPLES, 1 << int(duration / period).bit_length())
            if samples > _MOST_SAMPLES or duration > longest:
                raise TuningError(
                    "the responses of the closed loop do not die away in any reasonable time, "
                    f"which would be {samples} samples"
                )
            setpoint, load = self.step_responses(samples)
            tails = (setpoint.measurement - final, load.measurement - offset)
            if all(has_settled(tail) for tail in tails):
                break
            duration *= 2.0
        iae_setpoint = math.inf
        if abs(1.0 - final) < NO_OFFSET:
            whole = (1.0 - self._closed(rest)[0]) / (1.0 - 1.0 / rest)
            iae_setpoint = period * float(whole[0].real)
        iae_load = 1.0 / gains.i if gains.i else math.inf
        first = abs(float(setpoint.command[0]))
        return figures_of(setpoint, load, final, (iae_setpoint, iae_load), first)

    def step_responses(self, samples: int) -> tuple[StepResponse, StepResponse]:
        """Return the responses to unit steps of set-point and load at the first sample.

        They are inverted by a fast Fourier transform on a circle outside the unit circle.

        :param samples: number of samples.
        """
        time = np.arange(samples) * self.law.period
        y_r, y_d, u_r, u_d = map(step_response, self._closed(circle(samples)))
        return StepResponse(time, y_r, u_r), StepResponse(time, y_d, u_d)

    def _closed(self, z: ComplexArray) -> tuple[ComplexArray, ...]:
        """Return measurement and command from set-point and load: y/r, y/d, u/r, u/d."""
        process, law = self.process(z), self.law.from_measurement(z)
        forward, rest = self.law.from_setpoint(z), 1.0 + law * process
        return process * forward / rest, process / rest, forward / rest, -law * process / rest


def _turning(
    function: Callable[[FloatArray], ComplexArray], grid: FloatArray, values: ComplexArray
) -> float | None:
    """Return the growth of a function's phase over a grid; None: it is not certain.

    Cells in which it turns too far to be followed are divided.

    :param function: of the frequency.
    :param grid: frequencies [rad/s], shape (n,).
    :param values: of the function there, shape (n,).
    """
    low, high, begins, ends = grid[:-1], grid[1:], values[:-1], values[1:]
    total = 0.0
    for _ in range(_MOST_DIVISIONS):
        with np.errstate(divide="ignore", invalid="ignore"):
            turns = np.angle(ends / begins)
        clear = np.abs(turns) < _CLEAR
        total += float(turns[clear].sum())
        low, high, begins, ends = low[~clear], high[~clear], begins[~clear], ends[~clear]
        if not low.size:
            return total
        if low.size > MOST_PIECES:
            return None
        middle = 0.5 * (low + high)
        between = function(middle)
        low, high = np.concatenate((low, middle)), np.concatenate((middle, high))
        begins, ends = np.concatenate((begins, between)), np.concatenate((between, ends))
    return None


def analyse_sampled(law: SampledLaw, model: TransferFunction) -> Performance:
    """Return the performance of a law with its gains on a model, exact at its sampling period.

    :param law: with its gains.
    :param model: the process, with the dead time of the loop, but none for the hold.
    :raises TuningError: if the closed loop is unstable, or its responses do not die away.
    """
    loop = SampledLoop(law, model)
    if loop.unstable != 0:
        raise TuningError(
            f"{law.gains} makes an unstable loop with the model where {law.law.name} runs it "
            f"every {law.period:g} s: use another rule, or a shorter sample_period"
        )
    found = loop.margins()
    figures = loop.figures(found.ms_frequency)
    return performance_of(found, figures, loop.noise_gain())
