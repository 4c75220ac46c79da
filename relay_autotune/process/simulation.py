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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.process.response import Coordinates, Modes
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.cycles import cycle_from_samples
from relay_autotune.record.record import Cycle, PiecewiseConstant, RelaySettings
from relay_autotune.scalar import root


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
        kick, late = 2.0 * amplitude * model.process_sign, half_period - model.dead_time
        kicked = modes.moved(modes.stepped(modes.rest(), kick), late)
        before = modes.mirrored(kicked, half_period)
        after = modes.stepped(modes.moved(before, model.dead_time), -kick)
        self._states = before, after
        self._later = modes.moved(after, late)
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
        denominator = np.poly(np.exp(np.array(self._poles) * self.half_period)).real
        # Its powers of 1/lambda, lowest first, are those of lambda, highest first.
        roots = np.roots(np.convolve(rates, denominator)[:n])
        return float(np.max(np.abs(roots))) if roots.size else 0.0


# More switches than this count as chatter.
_MOST_SWITCHES = 20_000
_QUADRATURE = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True)
class RelayRun:
    """Result of an ideal relay experiment.

    :param command: the command with its exact switch instants.
    :param cycles: every whole cycle, with exact times, peaks and means.
    :param output: returns the noise-free measurement at instants of the run [y].
    """

    command: PiecewiseConstant
    cycles: tuple[Cycle, ...]
    output: Callable[[FloatArray], FloatArray]


def _at_zero(function: Callable[[float], float], grid: FloatArray, i: int) -> float:
    # The tolerance is relative to the cell, because the root may lie at or near zero.
    return root(function, grid[i], grid[i + 1], 1e-16 * grid[i + 1])


class _Piece:
    """The motion between two changes of the delayed input, or up to a switch.

    :param modes: of the process.
    :param rates: the same, of the rate of its output.
    :param states: their states at the beginning.
    :param level: measurement at rest [y].
    :param corners: the shortest time constant [s], and the fastest oscillation [rad/s].
    :param begin: when it begins [s].
    """

    def __init__(
        self,
        modes: Modes,
        rates: Modes,
        states: Sequence[Coordinates],
        level: float,
        corners: tuple[float, float],
        begin: float,
    ) -> None:
        self.begin, self.length = begin, 0.0
        self._modes, self._rates, self._states = modes, rates, states
        self._level, self._corners = level, corners
        # A smaller difference from a threshold is rounding.
        self._rounding = 8.0 * np.finfo(float).eps * (abs(level) + modes.size_of(states))

    def output(self, time: ArrayLike) -> FloatArray:
        at = np.atleast_1d(np.asarray(time, dtype=np.float64))
        return np.asarray(self._level + self._modes.outputs(self._states, at)[0])

    def _slope(self, time: float) -> float:
        return float(self._rates.outputs(self._states, np.array([time]))[0, 0])

    def instants(self, length: float) -> FloatArray:
        """Return times up to a length, between which the output only rises or only falls."""
        fastest, oscillation = self._corners
        parts = [np.linspace(0.0, length, 33)]
        if 1e-3 * fastest < length:
            count = int(12.0 * math.log(length / (1e-3 * fastest))) + 2
            parts.append(np.geomspace(1e-3 * fastest, length, count))
        if oscillation > 0.0:
            parts.append(np.linspace(0.0, length, min(int(length * oscillation * 4) + 2, 100_000)))
        # Each cell holds at most one extremum.
        grid = np.unique(np.concatenate(parts))
        slope = self._rates.outputs(self._states, grid)[0]
        cells = np.flatnonzero(slope[:-1] * slope[1:] < 0.0)
        return np.unique(np.append(grid, [_at_zero(self._slope, grid, i) for i in cells.tolist()]))

    def first_crossing(self, threshold: float, side: int, length: float) -> float:
        """First time at which the output passes a threshold, up (1) or down (-1); nan: never."""
        at = self.instants(length)
        f = side * (self.output(at) - threshold)
        cells = np.flatnonzero((f[:-1] <= self._rounding) & (f[1:] > self._rounding))
        if cells.size == 0:
            return math.nan
        i = int(cells[0])
        if f[i] >= -self._rounding:
            return float(at[i])
        return _at_zero(lambda time: float(self.output(time)[0]) - threshold, at, i)


def simulate_relay(
    model: TransferFunction,
    settings: RelaySettings,
    *,
    cycles: int,
    operating_point: float | None = None,
    kick: float | None = None,
    kept: int | None = None,
) -> RelayRun:
    """Run an ideal relay on a process, from switch to switch, without a time step.

    At t = 0 the process rests at its operating point and the relay takes the level that moves
    the measurement upwards. The relay then switches exactly where the measurement leaves the
    hysteresis band; each switch instant is solved for to machine precision. The command
    reaches the process after the model's dead time plus ``settings.extra_delay``.

    :param model: the process.
    :param settings: levels, set-point, hysteresis.
    :param cycles: whole cycles to run.
    :param operating_point: measurement at rest [y]; default: the set-point.
    :param kick: how far above the set-point the measurement must rise before the first
        switch [y]; default: the hysteresis.
    :param kept: number of cycles to return, the last ones; default: all of them.
    :raises ModelError: if the measurement never reaches a switching level, or the relay chatters.
    """
    dead_time = model.dead_time + settings.extra_delay
    modes = Modes.of(model)
    rates = modes.rates
    constants = [abs(t) for t in model.time_constants] or [max(dead_time, 1e-9)]
    oscillation = max((abs((1.0 / t).imag) for t in model.time_constants), default=0.0)
    corners = (min(constants), oscillation)
    level = settings.setpoint if operating_point is None else operating_point

    states, now = modes.rest(), 0.0
    # The first level moves the measurement up, to its first threshold.
    side, threshold = 1, settings.setpoint + (settings.hysteresis if kick is None else kick)
    if threshold == level and dead_time == 0.0:
        # Which way the first switch goes would be rounding.
        raise _no_delay(0.0)
    switches = [(0.0, settings.low if settings.reverse_acting else settings.high)]
    # When the process sees the command change, and by how much.
    on_the_way = deque([(dead_time, switches[0][1] - settings.baseline)])
    pieces: list[_Piece] = []
    # The half cycle from rest and the one after it come before the first whole cycle.
    while len(switches) < 2 * cycles + 3:
        while on_the_way and on_the_way[0][0] <= now:
            states = modes.stepped(states, on_the_way.popleft()[1])
        slowest = max(*constants, dead_time, 1e-12)
        length = on_the_way[0][0] - now if on_the_way else 60.0 * slowest
        piece = _Piece(modes, rates, states, level, corners, now)
        crossing = piece.first_crossing(threshold, side, length)
        switching = not math.isnan(crossing)
        if not switching and not on_the_way:
            raise ModelError(
                f"the measurement never reaches {threshold:g}, where the relay would switch: "
                "there is no limit cycle; the amplitude must exceed what the hysteresis and the "
                "set-point ask for"
            )
        step = crossing if switching else length
        if step > 0.0:
            piece.length = step
            pieces.append(piece)
            states, now = modes.moved(states, step), now + step
        if switching:
            if now <= switches[-1][0]:
                raise _no_delay(now)
            side = -side
            threshold = settings.setpoint + side * settings.hysteresis
            before = switches[-1][1]
            switches.append((now, settings.low if before == settings.high else settings.high))
            on_the_way.append((now + dead_time, switches[-1][1] - before))
            if len(switches) > _MOST_SWITCHES:
                raise ModelError(
                    f"{_MOST_SWITCHES} switches by t = {now:g} s: the relay chatters on this "
                    "process; a dead time or a hysteresis is needed for a limit cycle"
                )
    times, levels = (np.array(column) for column in zip(*switches, strict=True))
    command = PiecewiseConstant(times, levels, settings.baseline)
    first = 0 if kept is None else max(cycles - kept, 0)
    found = tuple(_cycle(k, command, pieces, settings) for k in range(first, cycles))
    ends = np.array([piece.begin for piece in pieces[1:]] + [now])

    def output(at: FloatArray) -> FloatArray:
        number, y = np.searchsorted(ends, at), np.empty(at.size)
        for k in np.unique(number).tolist():
            y[number == k] = pieces[k].output(at[number == k] - pieces[k].begin)
        return y

    return RelayRun(command, found, output)


def _no_delay(time: float) -> ModelError:
    return ModelError(
        f"the relay switches twice at t = {time:g} s: without dead time and hysteresis it needs a "
        "kick to leave the set-point"
    )


def _cycle(
    index: int, command: PiecewiseConstant, pieces: list[_Piece], settings: RelaySettings
) -> Cycle:
    """Return a whole cycle by samples that hold its switches and extremes."""
    first = 2 * index + (1 if settings.reverse_acting else 2)
    begin, end = command.times[[first, first + 2]]
    times, values, area = [], [], 0.0
    nodes, weights = _QUADRATURE
    for piece in pieces:
        if begin <= piece.begin < end:
            at = piece.instants(piece.length)
            times.append(piece.begin + at)
            values.append(piece.output(at))
            cell = 0.5 * np.diff(at)[:, None]
            inner = piece.output((at[:-1, None] + cell * (nodes + 1.0)).ravel())
            area += float(np.sum(inner.reshape(-1, nodes.size) * weights * cell))
    time = np.concatenate(times)
    cycle = cycle_from_samples(
        index,
        time,
        np.concatenate(values),
        command(time[:-1]),
        middle=settings.baseline + settings.bias,
        reverse_acting=settings.reverse_acting,
    )
    return replace(cycle, mean_measurement=area / (end - begin))
