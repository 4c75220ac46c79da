# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Sentences on what an experiment waits for and what it sees, state by state.

Each function takes the facts of one state and returns one sentence without a full stop.
"""

from __future__ import annotations

import math

from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.settling import NOISE_SAMPLES, RestState, Settling
from relay_autotune.record.record import Cycle
from relay_autotune.text import duration

# Cycles that a tune usually takes beyond those that must agree.
_USUAL_EXTRA = 2
# Least difference of the periods of two cycles that is told, as a fraction.
_DIFFER = 0.001


def while_settling(
    settling: Settling, elapsed: float, interval: float, settle_time: float, limit: float
) -> str:
    """Say whether the measurement is at rest yet.

    :param settling: the looks at the measurement so far.
    :param elapsed: time since the first sample [s].
    :param interval: mean interval of the samples [s].
    :param settle_time: the user's time for it [s]; 0: until the measurement is steady.
    :param limit: longest time that it may take [s]; inf: no limit.
    """
    if settle_time > 0.0:
        return f"settling, {duration(elapsed)} of {duration(settle_time)}"
    rest = settling.rest
    end = settling.expected_end(interval)
    about = f" of about {duration(end)}" if end > elapsed else ""
    told = f"settling, {duration(elapsed)}{about}"
    if not rest.samples or rest.is_steady:
        count = round(elapsed / interval) + 1 if interval > 0.0 else 1
        return f"{told}: sample {count} of at least {NOISE_SAMPLES} for the noise"
    told += f": still {motion(rest)}"
    if about:
        return told
    return f"{told}, not slower than before; it may take {duration(limit)} in all"


def motion(rest: RestState) -> str:
    """Say how a measurement moves that is not at rest, such as "falling 0.2 y/s"."""
    return f"{'rising' if rest.slope > 0.0 else 'falling'} {abs(rest.slope):.2g} y/s"


def while_waiting_for_response(
    level: float, since: float, measurement: float, rest: float, band: float, limit: float
) -> str:
    """Say that the measurement has not answered the step yet.

    :param level: the command [u].
    :param since: time since the step [s].
    :param measurement: the last sample [y].
    :param rest: the measurement at rest [y].
    :param band: half width of the band that it must leave [y].
    :param limit: longest wait [s]; inf: no limit.
    """
    wait = f", for {duration(limit)} at most" if math.isfinite(limit) else ""
    return (
        f"stepped to {level:g}, no response after {duration(since)}: the measurement "
        f"{measurement:.6g} is to leave {rest:.6g} -/+ {band:.2g}{wait}"
    )


def while_finding_direction(
    response_time: float, side: int, level: float, measurement: float, left: float
) -> str:
    """Say that the process has responded, and that the sign of its gain is being found.

    :param response_time: time that the process took to respond [s].
    :param side: side to which the measurement went first, 1 or -1.
    :param level: the present command [u].
    :param measurement: the last sample [y].
    :param left: time after which this is given up [s].
    """
    way = "up" if side > 0 else "down"
    return (
        f"the measurement went {way} after {duration(response_time)}; at {level:g} it is "
        f"{measurement:.6g}, and shows whether it stays on that side, for "
        f"{duration(max(left, 0.0))} at most"
    )


def while_switching(
    cycles: list[Cycle],
    needed: int,
    *,
    level: float,
    since: float,
    measurement: float,
    target: float,
    rises: bool,
    limit: float,
    growing: bool,
) -> str:
    """Say how the oscillation goes.

    :param cycles: the whole cycles so far.
    :param needed: number of cycles that must agree.
    :param level: the present command [u].
    :param since: time since the last switch [s].
    :param measurement: the last sample [y].
    :param target: the measurement at which the relay switches [y].
    :param rises: True if the measurement has to rise to it.
    :param limit: longest time until the next switch [s].
    :param growing: True while the amplitude is being found.
    """
    count = len(cycles)
    if growing:
        told = "the amplitude is still growing"
    elif count == 0:
        told = "no whole cycle yet"
    elif count < needed:
        told = f"{count} of at least {needed} cycles"
    else:
        last, before = cycles[-1].period, cycles[-2].period
        differ = 100.0 * max(abs(last - before) / before if before > 0.0 else 0.0, _DIFFER)
        told = f"{count} cycles, the periods of the last two differ by {differ:.2g} %"
    patience = ""
    if count and since > cycles[-1].period:
        patience = f", longer than a cycle took; it may take {duration(limit)}"
    return (
        f"{told}; at {level:g} for {duration(since)}{patience}: the measurement "
        f"{measurement:.6g} is to {'rise' if rises else 'fall'} to {target:.6g}"
    )


def how_long(parameters: ExperimentParameters, interval: float, limit: float) -> str:
    """Say how long a tune may take, before it begins.

    :param parameters: the experiment's parameters.
    :param interval: mean interval of the samples [s]; 0: not known.
    :param limit: longest settling [s].
    """
    if parameters.settle_time > 0.0:
        settles = f"{duration(parameters.settle_time)} at rest"
    else:
        least = NOISE_SAMPLES * interval
        settles = f"{duration(least)} or more" if least > 0.0 else "some time"
        settles += f" until the measurement is steady, {duration(limit)} at most"
    usual = parameters.min_cycles + _USUAL_EXTRA
    told = f"it takes {settles}, then one step and about {usual} oscillations of the loop"
    if parameters.max_duration > 0.0:
        return f"{told}, {duration(parameters.max_duration)} at most in all"
    return told
