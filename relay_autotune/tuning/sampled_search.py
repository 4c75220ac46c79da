# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The search for gains of a law that runs at a sampling period, with its exact loop.

On the unit circle, with ``w' = (2/h) tan(w h/2)``, the integral of any law is

    I = 1/(j w') + lead h/2,   lead 1 if it is advanced before the output, -1 after it,

so that with ``kp' = kp + lead ki h/2`` the loop is ``V G (kp' + kp' td' S/V + ki/(j w'))``. This
is the form of :mod:`~relay_autotune.tuning.frontier`, with w' in place of w: the largest integral
gain has the same closed form, exact at the sampling period. Candidates hold kp' and td'; the
gains follow from them at the end.

A law that cannot do all that our own can, with its filter and weights, costs what is said last.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray, IntArray
from relay_autotune.loop.gains import Controller, Performance
from relay_autotune.loop.laws import OWN_LAW, Law, Rational, SampledLaw, Slope
from relay_autotune.loop.sampled_loop import SampledLoop, circle, sampled_grid, step_response
from relay_autotune.loop.stability import peaks
from relay_autotune.process.response import HeldProcess
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.candidates import Candidates, stable_gains
from relay_autotune.tuning.frontier import Bounds, Responses, design_grid, envelope, first_crossing
from relay_autotune.tuning.search import Search

_ALL = slice(None)
# The range of gains of the continuous loop is left by this factor.
_WIDER = 1.6
# An integral that is advanced before the output takes at most this part of kp' from kp.
_SHARE = 0.95
# Samples of a load response, and samples in an ultimate period above which the loop is as good as
# continuous.
_SAMPLES, _CONTINUOUS = 2048, 100.0
# Time constants of a filter that are tried, in periods.
_FILTERS = np.concatenate(([0.0], np.geomspace(1.05, 1e3, 80)))
# The response of a filter to an impulse has ended after so many time constants.
_SETTLED = 12.0
# Functions of at most so many coefficients are evaluated together.
_SHORT = 8


def _each(function: Callable[[float], Rational], tf: FloatArray, z: ComplexArray) -> ComplexArray:
    """Return the values of a function of tf for each tf, shape (k, n)."""
    some, place = np.unique(tf, return_inverse=True)
    found = [function(float(t)) for t in some]
    if max(len(each.top) for each in found) > _SHORT:
        return np.array([each(z) for each in found])[place]
    tops, bottoms = (
        np.array(list(zip_longest(*parts, fillvalue=0.0))).T
        for parts in ([each.top for each in found], [each.bottom for each in found])
    )
    powers = z ** -np.arange(float(_SHORT))[:, None]
    # A product of matrices would wake the threads of BLAS.
    above, below = (np.einsum("un,nz->uz", c, powers[: c.shape[1]]) for c in (tops, bottoms))
    return np.asarray((above / below)[place])


class SampledResponses(Responses):
    """Frequency responses of held processes on one grid, for a law at its sampling period.

    :param law: the law.
    :param period: of the samples [s].
    :param models: with the dead time of the loop, but none for the hold.
    :param grid: rad/s, up to half the sampling frequency, shape (n,), increasing.
    :param crossover: frequency about which loops are closed [rad/s].
    """

    def __init__(
        self,
        law: Law,
        period: float,
        models: Sequence[TransferFunction],
        grid: FloatArray,
        crossover: float,
    ) -> None:
        self._law, self._period = law, period
        self._held = [HeldProcess(m, period, law.delay) for m in models]
        super().__init__(models, grid, crossover)

    def _evaluate(self, grid: FloatArray) -> ComplexArray:
        z = np.exp(1j * grid.astype(np.float64) * self._period)
        return np.array([self._sign / held(z) for held in self._held])

    def add(self, frequencies: FloatArray) -> None:
        """Add frequencies to the grid, with neighbours on either side.

        :param frequencies: rad/s, shape (k,).
        """
        # The neighbours, too, have to be below half the sampling frequency.
        super().add(np.minimum(frequencies, 0.99 * math.pi / self._period))

    def largest_ki(
        self,
        bounds: Bounds,
        kp: FloatArray,
        td: FloatArray,
        tf: FloatArray,
        of: IntArray | slice = _ALL,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the largest integral gains that the bounds leave, and how far they may fall.

        :param bounds: on the sensitivities.
        :param kp: kp', positive, shape (k,).
        :param td: td' [s], shape (k,).
        :param tf: time constants of the filter [s], shape (k,).
        :param of: which models, m of them.
        :return: as for :class:`~relay_autotune.tuning.frontier.Responses`.
        """
        h, smoothing = self._period, self._law.smoothing
        if not kp.size:
            # No filter keeps the limit of the noise.
            return (np.empty((0, self._poles[of].size)),) * 2
        z = np.exp(1j * self.grid * h)
        w = (2.0 / h) * np.tan(0.5 * h * self.grid)
        value = _each(lambda t: smoothing.value(t, h), tf, z)
        own = np.ones(value.shape, dtype=np.complex128)
        if np.any(td):
            own += td[:, None] * _each(lambda t: smoothing.slope(t, h), tf, z) / value
        own *= kp[:, None]
        base, lead = own.real[:, None, :], own.imag[:, None, :]
        inverse = self.inverse[of][None] / value[:, None, :]
        x, y = np.ascontiguousarray(inverse.real), np.ascontiguousarray(inverse.imag)
        loops = own[:, None, :] / inverse
        # A loop that begins left of -1 has a real pole there, which moves with the phase.
        # The inverse of its loop hardly changes from there to the grid, the loop itself may.
        at_rest = self._at_rest[of] & (base[..., 0] + inverse[..., 0].real > 0.0)
        begun = np.where(at_rest, np.sign(loops[..., 0].imag), 0.0)
        count = self._poles[of] + _gained(loops) + begun
        with np.errstate(invalid="ignore"):
            crossing = first_crossing(base + x, w * (lead + y), kp)
        stable = np.where(count == 0, crossing, 0.0)
        return envelope(bounds, (base, lead), w, (x, y), stable)


def _gained(loops: ComplexArray) -> FloatArray:
    """Return how many poles come outside the unit circle as the loops' gain grows to 1.

    A pair for each crossing of the negative real axis left of -1 with falling phase, one pair less
    with rising phase, and one pole where the loop ends left of -1 at half the sampling frequency.

    :param loops: on a grid up to that frequency, shape (..., n).
    """
    real, imaginary = loops.real, loops.imag
    before, after = imaginary[..., :-1], imaginary[..., 1:]
    crosses = (before > 0.0) != (after > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = before / (before - after)
        at = real[..., :-1] + share * (real[..., 1:] - real[..., :-1])
    left = crosses & (at < -1.0)
    pairs = np.where(left, np.where(after > 0.0, 2, -2), 0).sum(axis=-1)
    ends = np.where(real[..., -1] < -1.0, -np.sign(imaginary[..., -1]), 0.0)
    return np.asarray(pairs + ends)


@dataclass(frozen=True, kw_only=True)
class SampledSearch(Search):
    """A search with the exact loop of a law; the model has a dead time for hold and delay.

    :param law: the law.
    :param period: of the samples [s].
    :param held: the process without the dead time for hold and delay.
    :param held_models: the same of each model within its uncertainty.
    """

    law: Law
    period: float
    held: TransferFunction
    held_models: tuple[TransferFunction, ...] = ()

    @property
    def differentiates(self) -> bool:
        """True if the law has a derivative."""
        return self.law.slope is not Slope.NONE

    @cached_property
    def responses(self) -> Responses:
        """Response of the process, at the frequencies where bounds are tested."""
        top = math.pi / self.period
        grid = design_grid(self.model, self.frequency)
        more = sampled_grid(self.held, Controller(1.0, 1.0 / self.frequency), self.period)
        more = more[more > 10.0 * self.frequency] if top > 20.0 * self.frequency else more
        grid = np.unique(np.concatenate((grid[grid < 0.999 * top], more[:-1])))
        grid = grid[grid > 1e-3 * self.frequency]
        return self._responses((self.held,), grid)

    def _responses(self, models: Sequence[TransferFunction], grid: FloatArray) -> Responses:
        return SampledResponses(self.law, self.period, models, grid, self.frequency)

    def _responses_of_models(self, grid: FloatArray) -> Responses:
        return self._responses(self.held_models, np.append(grid, self.responses.grid[-1]))

    @cached_property
    def _beyond(self) -> float:
        # The grid ends where all frequencies do.
        return math.inf

    def _span(self, td: float) -> tuple[float, float] | None:
        # The range of gains of the continuous loop may be due to higher frequencies.
        grid = design_grid(self.model, self.frequency)
        span = stable_gains(self.model, grid, td, td / self.filter_ratio)
        return None if span is None else (span[0] / _WIDER, span[1] * _WIDER)

    def _controller(self, best: Candidates) -> Controller:
        kp, ki, kd = best.kp[0], best.ki[0], best.kp[0] * best.td[0]
        kp -= self.law.integral.value * 0.5 * self.period * ki
        tf = self.law.smoothing.setting(float(best.tf[0]), self.period)
        sign = self.model.process_sign
        return Controller(sign * float(kp), float(kp / ki), float(kd / kp), tf)

    def _peaks(self, controller: Controller) -> tuple[tuple[float, float], tuple[float, float]]:
        loop = SampledLoop(self.law.at(controller, self.period), self.held)
        return peaks(loop, loop.grid)

    def _ceiling(self, kp: FloatArray) -> FloatArray | float:
        # kp has to remain positive.
        lead = self.law.integral.value
        return _SHARE * 2.0 * kp / (lead * self.period) if lead > 0.0 else math.inf

    def _filters(self, kp: FloatArray, td: FloatArray) -> FloatArray:
        smoothing, h = self.law.smoothing, self.period
        if smoothing.on_measurement:
            return super()._filters(kp, td)
        tried = _FILTERS * h if smoothing.adjustable else np.zeros(1)
        largest = np.full(kp.shape, math.inf) if self.noise is None else self.noise.gain / kp
        first, power = self._moments
        gains = np.sqrt(1.0 + td[:, None] * (2.0 * first + td[:, None] * power))
        keeps = gains <= largest[:, None]
        if smoothing.adjustable:
            # A filter as fast as one period is none.
            least = td / self.filter_ratio
            keeps &= tried >= np.where(least > h, least, 0.0)[:, None]
        return np.where(keeps.any(axis=1), tried[keeps.argmax(axis=1)], math.inf)

    @cached_property
    def _moments(self) -> tuple[FloatArray, FloatArray]:
        """Return first and squared sum of the derivative's impulse response for each filter."""
        smoothing, h = self.law.smoothing, self.period
        found = []
        for tf in _FILTERS * h if smoothing.adjustable else np.zeros(1):
            slope = smoothing.slope(float(tf), h)
            taps = np.array(slope.top)
            if len(slope.bottom) > 1:
                decay = (-slope.bottom[1]) ** np.arange(int(_SETTLED * tf / h) + 2)
                taps = np.convolve(taps, decay)[: decay.size]
            found.append((taps[0], float(taps @ taps)))
        return tuple(np.array(found).T)

    def _iaes(self, c: Candidates) -> FloatArray:
        if 2.0 * math.pi / self.frequency > _CONTINUOUS * self.period:
            return super()._iaes(c)
        z, process = self._circle
        h, smoothing = self.period, self.law.smoothing
        value = _each(lambda t: smoothing.value(t, h), c.tf, z)
        p, d, i = c.kp[:, None], (c.kp * c.td)[:, None], c.ki[:, None]
        law = value * (p + i * 0.5 * h * (z + 1.0) / (z - 1.0))
        if np.any(c.td):
            law = law + d * _each(lambda t: smoothing.slope(t, h), c.tf, z)
        y = step_response(process / (1.0 + law * process))
        return np.asarray(1.0 / c.ki + 2.0 * h * np.maximum(-y, 0.0).sum(axis=1))

    @cached_property
    def _circle(self) -> tuple[ComplexArray, ComplexArray]:
        """Return z on a circle outside the unit circle, and the process there."""
        z = circle(_SAMPLES)
        held = HeldProcess(self.held, self.period, self.law.delay)
        return z, self.model.process_sign * held(z)


# Less than this is not worth a sentence: factors, and a difference of overshoots.
_ERROR, _NOISE, _OVERSHOOT = 1.05, 1.2, 0.03
_MS = 1.01


def cost_of(law: SampledLaw, found: Performance, own: Performance | None) -> tuple[str, ...]:
    """Return a sentence on what a law costs beside controller_node; none if that is little.

    :param law: with its gains.
    :param found: what it does on the model.
    :param own: what controller_node does there with gains of the same rule; None: not known.
    """
    name = law.law.name
    if own is None or name == OWN_LAW:
        return ()
    costs = []
    if found.ms > _MS * own.ms:
        costs.append(f"Ms {found.ms:.3g} instead of {own.ms:.3g}")
    if math.isfinite(own.iae_load) and found.iae_load > _ERROR * own.iae_load:
        costs.append(
            f"{found.iae_load / own.iae_load:.2f} times the error after a step of the load"
        )
    if found.noise_gain > _NOISE * own.noise_gain > 0.0:
        costs.append(f"{found.noise_gain / own.noise_gain:.1f} times the noise in the command")
    if found.overshoot > own.overshoot + _OVERSHOOT:
        costs.append(
            f"an overshoot of {100.0 * found.overshoot:.0f} % instead of "
            f"{100.0 * own.overshoot:.0f} % after a step of the set-point"
        )
    if not costs:
        return ()
    return (f"{name} costs, beside {OWN_LAW}: {', '.join(costs)}; {_lacking(law)}",)


def _lacking(law: SampledLaw) -> str:
    """Return what the law cannot do."""
    row = law.law
    lacks = []
    if row.slope is Slope.NONE:
        lacks.append("no derivative")
    elif not row.smoothing.adjustable:
        lacks.append("no filter to set")
    elif not row.smoothing.on_measurement:
        lacks.append("a filter on the derivative alone")
    if row.weights:
        lacks.append(f"a set-point weight of {' or '.join(f'{w:g}' for w in row.weights)} only")
    if row.delay:
        lacks.append(f"a command that acts {row.delay} sample later")
    return f"it has {', '.join(lacks)}"
