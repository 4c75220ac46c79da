# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Relay experiments on a known process, exactly: the steady oscillation, and event by event.

Between two switches the state moves freely, except for the delayed step of the command that
arrives a dead time D after the first of them. In the limit cycle of half period T each half
mirrors the one before, x(T) = -x(0), which is one linear system for the state at the switch:

    (Phi(T) + 1) z_0 = 2 h Phi(T - D) b.

The output at the switch, y(0), is the level at which a relay must switch to sustain the period:
zero for an ideal relay (HG(T, -1) = 0 in the notation of Chang, Shen and Yu 1992), the
hysteresis for one that has it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.process.response import Coordinates, Modes
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Cycle, Outcome, PiecewiseConstant, Record, RelaySettings


class HalfCycle:
    """Half a period of the output, from the switch that turns it down to the next switch.

    :param model: the process; its oscillation is described as if it were direct-acting.
    :param half_period: T, longer than the dead time [s].
    :param amplitude: of the relay, h [u].
    :raises ModelError: if the half period is not longer than the dead time.
    """

    def __init__(
        self, model: TransferFunction, half_period: float, amplitude: float = 1.0
    ) -> None:
        if not half_period > model.dead_time:
            raise ModelError(
                f"a half period of {half_period:g} s is not longer than the dead time of "
                f"{model.dead_time:g} s: a switch takes effect only after the dead time, so that "
                "the relay cannot switch sooner"
            )
        self.half_period = half_period
        self.dead_time = model.dead_time
        self._poles = [-1.0 / t for t in model.time_constants] + [0j] * model.integrators
        horizon = max(len(self._poles), 2) * half_period
        self._modes = modes = Modes.of(model, horizon)
        kick = 2.0 * amplitude * model.process_sign * modes.input_direction
        whole, early, late = (
            modes.propagator(t)
            for t in (half_period, model.dead_time, half_period - model.dead_time)
        )
        before = np.linalg.solve(whole + np.eye(modes.size), late @ kick)
        after = early @ before - kick
        self._states = modes.split(before), modes.split(after)
        self._later = modes.split(late @ after)
        self._rates = modes.rates

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the output's deviation at times after the switch.

        :param time: s, shape (n,).
        :return: y, shape (n,).
        """
        return self._unfolded(time, self._modes)

    def slope(self, time: FloatArray) -> FloatArray:
        """Return the rate of the output at times after the switch.

        :param time: s, shape (n,).
        :return: y/s, shape (n,).
        """
        return self._unfolded(time, self._rates)

    def _unfolded(self, time: FloatArray, modes: Modes) -> FloatArray:
        before, after = self._states
        turns = np.floor(time / self.half_period)
        within = time - turns * self.half_period
        early = within < self.dead_time
        y = np.where(
            early,
            modes.outputs(before, np.where(early, within, 0.0))[0],
            modes.outputs(after, np.where(early, 0.0, within - self.dead_time))[0],
        )
        return np.asarray(np.where(turns % 2.0 == 0.0, y, -y))

    def multiplier(self) -> float:
        r"""Return the factor by which a deviation from the limit cycle shrinks in half a period.

        A deviation of the state at a switch moves with the process and shifts the next switch,
        x -> (1 - xdot c'/(c' xdot)) Phi x. The eigenvalues of this map are the zeros of

            sum_k r_k lambda^-k,   r_k = c' Phi^k xdot,

        where r_k is the rate of the output k half periods after the switch if the relay did not
        switch again. The sum is a polynomial of degree n - 1 in 1/lambda over
        ``prod(1 - phi_i/lambda)``. This form is accurate also for many equal lags, whose matrix
        is badly conditioned.
        """
        n = len(self._poles)
        if n < 2:
            return 0.0
        at = np.arange(n, dtype=np.float64) * self.half_period
        rates = self._rates.outputs(self._later, at)[0]
        denominator = np.ones(1, dtype=np.complex128)
        for pole in self._poles:
            denominator = np.convolve(denominator, [1.0, -np.exp(pole * self.half_period)])
        # Its powers of 1/lambda, lowest first, are those of lambda, highest first.
        roots = np.roots(np.convolve(rates, denominator.real)[:n])
        return float(np.max(np.abs(roots))) if roots.size else 0.0


_QUADRATURE = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True)
class RelayRun:
    """Result of an ideal relay experiment.

    :param settings: the relay.
    :param command: the command with its exact switch instants.
    :param cycles: every whole cycle, with exact times and peaks.
    :param time: sample times [s], shape (n,).
    :param measurement: noise-free measurement there [y], shape (n,).
    """

    settings: RelaySettings
    command: PiecewiseConstant
    cycles: tuple[Cycle, ...]
    time: FloatArray
    measurement: FloatArray

    def record(self, *, noise_std: float = 0.0, rng: np.random.Generator | None = None) -> Record:
        """Return the samples as a record, with noise that the relay did not see.

        :param noise_std: standard deviation of white Gaussian noise [y].
        :param rng: its source; needed if ``noise_std`` > 0.
        """
        y = self.measurement
        if noise_std > 0.0:
            if rng is None:
                raise ModelError("noise needs a random generator, found none")
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


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    ends = function(low), function(high)
    if ends[0] * ends[1] >= 0.0:
        # The change of sign in the vectorised evaluation was rounding.
        return low if abs(ends[0]) <= abs(ends[1]) else high
    # The tolerance is relative to the cell, because the root may lie at or near zero.
    return float(brentq(function, low, high, xtol=1e-16 * high, rtol=1e-15, maxiter=1000))


class _Segment:
    """The motion between two changes of the delayed input."""

    def __init__(
        self, modes: Modes, rates: Modes, z: Coordinates, level: float, corners: FloatArray
    ) -> None:
        self.modes, self.rates, self.level, self._corners = modes, rates, level, corners
        self.states = modes.split(z)
        # A smaller difference from a threshold is rounding.
        size = modes.size_of(self.states)
        self.rounding = 8.0 * np.finfo(float).eps * (abs(level) + size)

    def output(self, time: ArrayLike) -> FloatArray:
        at = np.atleast_1d(np.asarray(time, dtype=np.float64))
        return np.asarray(self.level + self.modes.outputs(self.states, at)[0])

    def slope(self, time: float) -> float:
        return float(self.rates.outputs(self.states, np.array([time]))[0, 0])

    def grid(self, length: float) -> FloatArray:
        """Return times dense enough that each cell holds at most one extremum."""
        fastest, oscillation = self._corners
        parts = [np.linspace(0.0, length, 33)]
        if 1e-3 * fastest < length:
            count = int(12.0 * math.log(length / (1e-3 * fastest))) + 2
            parts.append(np.geomspace(1e-3 * fastest, length, count))
        if oscillation > 0.0:
            parts.append(np.linspace(0.0, length, min(int(length * oscillation * 4) + 2, 100_000)))
        return np.unique(np.concatenate(parts))

    def turning_points(self, grid: FloatArray) -> FloatArray:
        """Return the times of the extrema between the grid's ends."""
        slope = self.rates.outputs(self.states, grid)[0]
        cells = np.flatnonzero(slope[:-1] * slope[1:] < 0.0)
        return np.array([_root(self.slope, grid[i], grid[i + 1]) for i in cells])

    def first_rise(self, excess: Callable[[FloatArray], FloatArray], grid: FloatArray) -> float:
        """First time at which ``excess(y)`` passes zero upwards; nan if it does not."""
        grid = np.unique(np.concatenate((grid, self.turning_points(grid))))
        f = excess(self.output(grid))
        cells = np.flatnonzero((f[:-1] <= self.rounding) & (f[1:] > self.rounding))
        if cells.size == 0:
            return math.nan
        i = int(cells[0])
        if f[i] >= -self.rounding:
            return float(grid[i])

        def crossing(time: float) -> float:
            return float(excess(self.output(time))[0])

        return _root(crossing, grid[i], grid[i + 1])


@dataclass
class _Half:
    """Data collected between two switches."""

    start: float
    level_is_high: bool
    end: float = 0.0
    peak_max: float = -math.inf
    peak_min: float = math.inf
    when_max: float = 0.0
    when_min: float = 0.0
    area: float = 0.0
    # Each piece of the motion with its length and its begin.
    pieces: list[tuple[_Segment, float, float]] = field(default_factory=list)

    def measure(self) -> None:
        """Find the peaks and the area."""
        for segment, length, begin in self.pieces:
            self._add(segment, segment.grid(length), begin)

    def _add(self, segment: _Segment, grid: FloatArray, begin: float) -> None:
        at = np.unique(np.concatenate((grid, segment.turning_points(grid))))
        y = segment.output(at)
        if y.max() > self.peak_max:
            self.peak_max, self.when_max = float(y.max()), begin + float(at[np.argmax(y)])
        if y.min() < self.peak_min:
            self.peak_min, self.when_min = float(y.min()), begin + float(at[np.argmin(y)])
        nodes, weights = _QUADRATURE
        half = np.diff(at)[:, None] / 2.0
        inner = at[:-1, None] + half * (nodes + 1.0)
        values = segment.output(inner.ravel()).reshape(inner.shape)
        self.area += float(np.sum(values * weights * half))


def simulate_relay(
    model: TransferFunction,
    settings: RelaySettings,
    *,
    cycles: int,
    time: ArrayLike = (),
    operating_point: float | None = None,
    kick: float | None = None,
    told: int | None = None,
    most_switches: int = 20_000,
) -> RelayRun:
    """Run an ideal relay on a process, from switch to switch, without a time step.

    At t = 0 the process rests at its operating point and the relay takes the level that moves
    the measurement upwards. The relay then switches exactly where the measurement leaves the
    hysteresis band; each switch instant is solved for to machine precision. The command
    reaches the process after the model's dead time plus ``settings.extra_delay``.

    :param model: the process.
    :param settings: levels, set-point, hysteresis.
    :param cycles: whole cycles to run.
    :param time: instants of the samples [s], not decreasing, shape (n,); those after the end of
        the last cycle are left out.
    :param operating_point: measurement at rest [y]; default: the set-point.
    :param kick: how far above the set-point the measurement must rise before the first
        switch [y]; default: the hysteresis.
    :param told: number of cycles to return, the last ones; default: all of them.
    :param most_switches: more switches than this count as chatter.
    :raises ModelError: if the measurement never reaches a switching level, or the relay chatters.
    """
    process = replace(model, dead_time=model.dead_time + settings.extra_delay)
    modes = Modes.of(process)
    rates = modes.rates
    constants = [abs(t) for t in model.time_constants] or [max(process.dead_time, 1e-9)]
    oscillation = max((abs((1.0 / t).imag) for t in model.time_constants), default=0.0)
    corners = np.array([min(constants), oscillation])
    level = settings.setpoint if operating_point is None else operating_point
    slowest = max(*constants, process.dead_time, 1e-12)
    samples = np.asarray(time, dtype=np.float64)
    measured = np.full(samples.shape, math.nan)

    z, now, arrived = modes.rest(), 0.0, settings.baseline
    direct = not settings.reverse_acting
    is_high = direct
    threshold = settings.setpoint + (settings.hysteresis if kick is None else kick)
    if threshold == level and process.dead_time == 0.0:
        # Which way the first switch goes would be rounding.
        raise ModelError(
            "the relay switches twice at t = 0 s: without dead time and hysteresis it needs a "
            "kick to leave the set-point"
        )
    switches = [(0.0, settings.high if is_high else settings.low)]
    on_the_way = deque([(process.dead_time, switches[0][1])])
    half = _Half(0.0, is_high)
    halves: list[_Half] = []
    segment = _Segment(modes, rates, z, level, corners)
    # The half cycle from rest and the one after it come before the first whole cycle.
    while sum(1 for h in halves[1:] if h.level_is_high != direct) <= cycles:
        length = on_the_way[0][0] - now if on_the_way else 60.0 * slowest
        rising = is_high == direct

        def excess(y: FloatArray, rising: bool = rising, at: float = threshold) -> FloatArray:
            return y - at if rising else at - y

        grid = segment.grid(length) if length > 0.0 else np.zeros(1)
        crossing = segment.first_rise(excess, grid) if length > 0.0 else math.nan
        switching = not math.isnan(crossing)
        if not switching and not on_the_way:
            raise ModelError(
                f"the measurement never reaches {threshold:g}, where the relay would switch: "
                "there is no limit cycle; the amplitude must exceed what the hysteresis and the "
                "set-point ask for"
            )
        step = crossing if switching else length
        if step > 0.0:
            half.pieces.append((segment, step, now))
            inside = (samples >= now) & (samples <= now + step) & np.isnan(measured)
            measured[inside] = segment.output(samples[inside] - now)
            z, now = modes.move(z, step), now + step
        if switching:
            if now <= switches[-1][0]:
                raise ModelError(
                    f"the relay switches twice at t = {now:g} s: without dead time and hysteresis "
                    "it needs a kick to leave the set-point"
                )
            half.end = now
            halves.append(half)
            is_high = not is_high
            half = _Half(now, is_high)
            threshold = settings.setpoint + (1 if is_high == direct else -1) * settings.hysteresis
            switches.append((now, settings.high if is_high else settings.low))
            on_the_way.append((now + process.dead_time, switches[-1][1]))
            if len(switches) > most_switches:
                raise ModelError(
                    f"{most_switches} switches by t = {now:g} s: the relay chatters on this "
                    "process; a dead time or a hysteresis is needed for a limit cycle"
                )
        while on_the_way and on_the_way[0][0] <= now:
            _, value = on_the_way.popleft()
            z = z + (value - arrived) * modes.input_direction
            arrived = value
        segment = _Segment(modes, rates, z, level, corners)
    times, levels = np.array([s[0] for s in switches]), np.array([s[1] for s in switches])
    command = PiecewiseConstant(times, levels, settings.baseline)
    known = ~np.isnan(measured)
    found = _whole_cycles(halves, settings, told)
    return RelayRun(settings, command, found, samples[known], measured[known])


def _whole_cycles(
    halves: list[_Half], settings: RelaySettings, told: int | None
) -> tuple[Cycle, ...]:
    # The first half starts from rest and belongs to no cycle.
    usable = halves[1:] if not settings.reverse_acting else halves
    usable = usable[next((i for i, h in enumerate(usable) if h.level_is_high), 0) :]
    if usable and usable[0].start == 0.0:
        usable = usable[2:]
    cycles = []
    whole = len(usable) // 2
    for index in range(0 if told is None else max(whole - told, 0), whole):
        high, low = usable[2 * index], usable[2 * index + 1]
        high.measure()
        low.measure()
        # The low level turns a direct-acting process down, the high level a reverse-acting one.
        down, up = (high, low) if settings.reverse_acting else (low, high)
        t_high, t_low = high.end - high.start, low.end - low.start
        period = t_high + t_low
        cycles.append(
            Cycle(
                index=index,
                start=high.start,
                period=period,
                period_high=t_high,
                period_low=t_low,
                peak_max=down.peak_max,
                peak_min=up.peak_min,
                time_to_peak_max=down.when_max - down.start,
                time_to_peak_min=up.when_min - up.start,
                mean_measurement=(high.area + low.area) / period,
                mean_command=(settings.high * t_high + settings.low * t_low) / period,
            )
        )
    return tuple(cycles)
