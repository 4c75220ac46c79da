# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Relay tests beside the exact one: a relay that acts at its samples, and where any relay ends."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
from relay_runs import simulate_relay

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Plant
from relay_autotune.record.record import Cycle, Outcome, Record, RelaySettings


def simulate_sampled_relay(
    model: TransferFunction,
    settings: RelaySettings,
    *,
    period: float,
    noise: FloatArray,
    relay_sees_noise: bool = True,
    operating_point: float | None = None,
) -> Record:
    """Run a relay that looks at the measurement every ``period`` and holds in between.

    Sample k is taken at ``k period``; the relay answers it at once, and its answer reaches the
    process after ``settings.extra_delay`` and the process's own dead time. It starts with the
    level that moves the measurement upwards.

    :param model: the process, at rest before the first sample.
    :param settings: levels, set-point, hysteresis.
    :param period: time between samples [s], > 0.
    :param noise: noise added to each sample [y], shape (n,); it sets the number of samples.
    :param relay_sees_noise: False: the relay acts on the noise-free output, the record still
        holds the noisy one.
    :param operating_point: measurement at rest [y]; default: the set-point.
    :raises ModelError: if the period is not positive.
    """
    if not period > 0.0:
        raise ModelError(f"the sample period must be > 0 s, found {period:g} s")
    rest = settings.setpoint if operating_point is None else operating_point
    delayed = TransferFunction(
        model.gain,
        model.zeros,
        model.time_constants,
        model.integrators,
        model.dead_time + settings.extra_delay,
    )
    plant = Plant(delayed, initial_command=settings.baseline)
    direct = not settings.reverse_acting
    is_high = direct
    command = settings.baseline
    times = np.arange(noise.size, dtype=np.float64) * period
    measurement, commands, starts = np.empty(noise.size), np.empty(noise.size), []
    for k, time in enumerate(times):
        y = rest + plant.advance(float(time), command)
        measurement[k] = y + noise[k]
        seen = measurement[k] if relay_sees_noise else y
        was_high, seeks_rise = is_high, is_high == direct
        if seeks_rise and seen > settings.setpoint + settings.hysteresis:
            is_high = not direct
        elif not seeks_rise and seen < settings.setpoint - settings.hysteresis:
            is_high = direct
        if is_high and not was_high:
            starts.append(k)
        command = settings.high if is_high else settings.low
        commands[k] = command
    return Record(
        time=times,
        measurement=measurement,
        command=commands,
        settings=settings,
        noise_std=float(np.std(noise)),
        cycle_start=tuple(starts),
        outcome=Outcome.COMPLETED,
    )


@cache
def exact_limit_cycle(
    model: TransferFunction,
    settings: RelaySettings,
    *,
    tolerance: float = 1e-12,
    most_cycles: int = 2000,
) -> Cycle:
    """Return the limit cycle to which an ideal relay experiment converges.

    :param model: the process.
    :param settings: the relay.
    :param tolerance: relative change of the half periods from cycle to cycle that counts as
        converged.
    :param most_cycles: largest number of cycles before it must have converged.
    :raises ModelError: if there is no limit cycle, or it does not converge.
    """
    count = 8
    while True:
        run = simulate_relay(model, settings, cycles=count, kept=3)
        first, second = (_change(*pair) for pair in pairwise(run.cycles[-3:]))
        last = run.cycles[-1]
        if second <= tolerance * last.period:
            return replace(last, converged=True)
        if count >= most_cycles:
            raise ModelError(
                f"the limit cycle still changes by {second / last.period:g} of its period after "
                f"{count} cycles"
            )
        # Deviations decay geometrically.
        more = 3 * count
        if second < first:
            left = math.log(tolerance * last.period / second) / math.log(second / first)
            more = min(math.ceil(left) + 2, more)
        count = min(count + more, most_cycles)


def _change(a: Cycle, b: Cycle) -> float:
    return abs(a.period_high - b.period_high) + abs(a.period_low - b.period_low)
