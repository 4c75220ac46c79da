# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Analysis of a closed loop: responses to set-point and load, noise in the command, robustness.

The transforms are inverted by a fast Fourier transform along ``Re s = sigma`` (Dubner and Abate
1968); dead times enter exactly. A truncated transform cannot follow a jump at t = 0, so the jump
is removed before the inversion and added after it. Integrals of an error are computed as
``int |e| = |int e| + 2 int (the part of the other sign)``: the first is the transform at s = 0,
so that a slow tail needs no computation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.loop.gains import ControlLaw, Controller, Performance, StepFigures
from relay_autotune.loop.sampled import filter_matrices
from relay_autotune.loop.stability import (
    LoopMargins,
    closed_loop_unstable_poles,
    frequencies,
    margins,
    sensitivity_peaks,
)
from relay_autotune.process.transfer_function import TransferFunction

_POINTS = 4096
_MOST_POINTS = 1 << 18
_DECAY = math.log(1e8)
_TURNS, _RESETS, LONGEST = 6.0, 8.0, 64.0
# The horizon is long enough if the tail of a response is below this part of the whole.
_SETTLED = 1e-3
# A smaller final error counts as zero.
NO_OFFSET = 1e-3
BAND = 0.02


@dataclass(frozen=True)
class StepResponse:
    """Deviations after a unit step of set-point or load at t = 0.

    :param time: s, shape (n,), equally spaced.
    :param measurement: y, shape (n,).
    :param command: u, shape (n,); after a load step without the load itself.
    """

    time: FloatArray
    measurement: FloatArray
    command: FloatArray


def abscissae(duration: float | FloatArray, points: int) -> ComplexArray:
    """Return the values of s for the transform of :func:`inverted` [rad/s].

    They lie on a line right of the imaginary axis (Dubner and Abate 1968).

    :param duration: s; or one of each function, shape (k, 1).
    :param points: number of instants of the function.
    :return: shape (points + 1,), or (k, points + 1).
    """
    return _DECAY / (2.0 * duration) + 1j * np.arange(points + 1) * (math.pi / duration)


def inverted(values: ComplexArray, duration: float | FloatArray, jump: float = 0.0) -> FloatArray:
    """Return the function of a Laplace transform at equally spaced times from 0 on.

    :param values: the transform at :func:`abscissae`, shape (..., points + 1); it must not have
        poles right of the imaginary axis.
    :param duration: s; the last instant is one step before it; or one of each function, shape
        (k, 1).
    :param jump: value just after t = 0.
    :return: shape (..., points).
    """
    points = values.shape[-1] - 1
    step, decay = duration / points, 20.0 / duration
    time = np.arange(points) * step
    if jump:
        values = values - jump / (abscissae(duration, points) + decay)
    # Lanczos' factors remove the ringing caused by the cut at the last frequency.
    values = values * np.sinc(np.arange(points + 1) / points)
    found = np.fft.irfft(values)[..., :points] * np.exp(_DECAY / (2.0 * duration) * time) / step
    return np.asarray(found + jump * np.exp(-decay * time) if jump else found)


def measurement_from_load(
    law: ControlLaw, model: TransferFunction, s: ComplexArray
) -> ComplexArray:
    """Return ``G/(1 + C G)`` of a closed loop.

    :param law: the controller.
    :param model: the process, with all dead time of the loop.
    :param s: rad/s, any shape.
    """
    g = model(s)
    return np.asarray(g / (1.0 + law(s) * g))


def _first_command(law: ControlLaw, model: TransferFunction) -> float:
    """Return the command just after a unit step of the set-point [u]."""
    constants = [abs(c) for t in law.characteristic(model) for c in t.time_constants]
    shortest = min([c for c in (*constants, model.dead_time) if c > 0.0], default=1.0)
    return float(law.from_setpoint(np.array([1e9 / shortest], dtype=np.complex128))[0].real)


def integral_gain(law: ControlLaw, frequency: float) -> float:
    """Return the limit of ``s C(s)`` for s -> 0, 0 without integral action [u/(y s)].

    :param law: the controller.
    :param frequency: about which the loop is closed [rad/s].
    """
    s = frequency * np.array([1e-6, 2e-6], dtype=np.complex128)
    once, twice = (s * law(s)).real
    gain = float(2.0 * once - twice)
    proportional = abs(complex(law(np.array([1j * frequency]))[0]))
    return gain if abs(gain) > 1e-9 * frequency * proportional else 0.0


def horizon(law: ControlLaw, model: TransferFunction, frequency: float) -> float:
    """Return a first guess of how long the responses last [s].

    :param law: the controller.
    :param model: the process, with all dead time of the loop.
    :param frequency: about which the loop is closed [rad/s].
    """
    integral = abs(integral_gain(law, frequency))
    reset = max((abs(t) for t in model.time_constants), default=0.0)
    if integral > 0.0:
        reset = abs(complex(law(np.array([1j * frequency]))[0])) / integral
        if model.is_stable:
            # With a small gain, the integral alone brings the process to its set-point.
            reset += 1.0 / (integral * abs(model.gain))
    return _RESETS * reset + _TURNS * 2.0 * math.pi / frequency


def step_responses(
    law: ControlLaw, model: TransferFunction, duration: float, points: int = _POINTS
) -> tuple[StepResponse, StepResponse]:
    """Return the responses to a unit step of the set-point, and to one of the load.

    :param law: the controller of a stable loop.
    :param model: the process, with all dead time of the loop.
    :param duration: s.
    :param points: number of instants.
    """
    s = abscissae(duration, points)
    # All four responses follow from these three functions at the same frequencies.
    g, c, f = model(s), law(s), law.from_setpoint(s)
    rest = 1.0 + c * g
    time = np.arange(points) * (duration / points)

    def step(values: ComplexArray, jump: float = 0.0) -> FloatArray:
        return inverted(values / s, duration, jump)

    return (
        StepResponse(time, step(g / rest * f), step(f / rest, _first_command(law, model))),
        StepResponse(time, step(g / rest), step(-c * g / rest)),
    )


def step_figures(law: ControlLaw, model: TransferFunction, frequency: float) -> StepFigures:
    """Return the features of the responses to unit steps.

    :param law: the controller of a stable loop.
    :param model: the process, with all dead time of the loop.
    :param frequency: about which the loop is closed [rad/s].
    :raises TuningError: if the responses do not die away in any reasonable time.
    """
    rest = np.array([1e-9 * frequency], dtype=np.complex128)
    to_load = measurement_from_load(law, model, rest)
    to_setpoint = to_load * law.from_setpoint(rest)
    integral = integral_gain(law, frequency)
    final, offset = 1.0, 0.0
    if integral == 0.0:
        final, offset = float(to_setpoint[0].real), float(to_load[0].real)
    duration = horizon(law, model, frequency)
    # Twenty instants per period of this frequency, if the number of points allows it.
    finest = min(int(20.0 * duration * frequency / (2.0 * math.pi)), _MOST_POINTS // 8)
    points = max(_POINTS, 1 << finest.bit_length())
    longest = LONGEST * duration
    while True:
        setpoint, load = step_responses(law, model, duration, points)
        tails = (setpoint.measurement - final, load.measurement - offset)
        if all(has_settled(tail) for tail in tails):
            break
        duration, points = 2.0 * duration, min(2 * points, _MOST_POINTS)
        if duration > longest:
            raise TuningError(
                "the responses of the closed loop do not die away in any reasonable time"
            )
    iae_load = 1.0 / integral if integral else math.inf
    iae_setpoint = math.inf
    if abs(1.0 - final) < NO_OFFSET:
        iae_setpoint = float(((1.0 - to_setpoint) / rest)[0].real)
    first = abs(_first_command(law, model))
    return figures_of(setpoint, load, final, (iae_setpoint, iae_load), first)


def figures_of(
    setpoint: StepResponse,
    load: StepResponse,
    final: float,
    integrals: tuple[float, float],
    first_command: float,
) -> StepFigures:
    """Return the features of responses that have settled.

    :param setpoint: to a unit step of the set-point.
    :param load: to a unit step of the load.
    :param final: measurement at the end of the first.
    :param integrals: of the error after each [y s]; infinite where an error remains.
    :param first_command: size of the command's own jump at the step of the set-point [u].
    """
    error = final - setpoint.measurement
    step = float(setpoint.time[1])
    iae_setpoint, iae_load = (
        _iae(whole, e, step) if math.isfinite(whole) else math.inf
        for whole, e in zip(integrals, (error, load.measurement), strict=True)
    )
    return StepFigures(
        iae_load=iae_load,
        iae_setpoint=iae_setpoint,
        overshoot=max(float(np.max(-error / final)), 0.0),
        settling_time=_settling_time(setpoint.time, error, BAND * abs(final)),
        effort_setpoint=first_command + _variation(setpoint.command),
        effort_load=_variation(load.command),
    )


def has_settled(tail: FloatArray) -> bool:
    """Return True if the late part of a deviation is negligible, shape (n,)."""
    late = tail[3 * tail.size // 4 : -tail.size // 16]
    return float(np.abs(late).max()) <= _SETTLED * float(np.abs(tail).max())


def _variation(values: FloatArray) -> float:
    return float(np.abs(np.diff(values)).sum())


def _settling_time(time: FloatArray, error: FloatArray, band: float) -> float:
    outside = np.flatnonzero(np.abs(error) > band)
    if not outside.size:
        return 0.0
    last = int(outside[-1])
    if last + 1 >= time.size:
        return float(time[-1])
    before, after = abs(error[last]), abs(error[last + 1])
    return float(time[last] + (before - band) / (before - after) * (time[1] - time[0]))


def _iae(whole: float, error: FloatArray, step: float) -> float:
    """Return the integral of |error| from the integral of the error and its part of other sign."""
    other = np.maximum(-math.copysign(1.0, whole) * error, 0.0)
    return abs(whole) + 2.0 * float(other.sum()) * step


_ANGLES = 2048

# Grid of filter time constant over sampling period, for interpolation.
_RATIOS = np.geomspace(1e-3, 1e4, 141)


@lru_cache(maxsize=1)
def _moments() -> FloatArray:
    """Return var(yf), cov(yf, h yf') and var(h yf') for each of ``_RATIOS``, shape (3, n)."""
    motions = [filter_matrices(float(ratio), 1.0) for ratio in _RATIOS]
    turn, past, present = (np.array(part) for part in zip(*motions, strict=True))
    # Scaled to the filter's time constant, both states have one order of magnitude.
    size = np.stack((np.ones(_RATIOS.size), _RATIOS), axis=1)
    turn, past, present = turn * size[:, :, None] / size[:, None, :], past * size, present * size
    # State and next sample are correlated only by the sample before.
    shared = _outer((turn @ present[..., None])[..., 0], past)
    drive = _outer(past, past) + _outer(present, present) + shared + shared.swapaxes(1, 2)
    twice = turn[:, :, None, :, None] * turn[:, None, :, None, :]
    operator = np.eye(4) - twice.reshape(-1, 4, 4)
    covariance = np.linalg.solve(operator, drive.reshape(-1, 4, 1))
    return covariance[:, [0, 1, 3], 0].T / np.stack((size[:, 0], _RATIOS, _RATIOS**2))


def _outer(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the outer products of vectors, shape (n, 2, 2)."""
    return np.asarray(left[:, :, None] * right[:, None, :])


def open_noise_gain(td: FloatArray, tf: FloatArray, period: float) -> FloatArray:
    """Return the standard deviation of ``yf + td dyf/dt`` per that of white sampled noise.

    Multiplied by kc it is the standard deviation of the command, without the integral part and
    without feedback through the loop.

    :param td: derivative times [s], shape (k,).
    :param tf: time constants of the filter [s], shape (k,).
    :param period: period of the samples [s].
    """
    at = np.log(np.maximum(tf / period, _RATIOS[0]))
    value, mixed, slope = (np.interp(at, np.log(_RATIOS), row) for row in _moments())
    lead = td / period
    return np.sqrt(value + 2.0 * lead * mixed + lead**2 * slope)


def filter_for(td: FloatArray, largest: FloatArray, period: float) -> FloatArray:
    """Return the least time constant of the filter that keeps the noise gain within a limit.

    :param td: derivative times [s], shape (k,).
    :param largest: largest allowed :func:`open_noise_gain`, shape (k,).
    :param period: period of the samples [s].
    :return: s, shape (k,); infinite: no usable time constant is enough.
    """
    value, mixed, slope = _moments()
    lead = (td / period)[:, None]
    gains = np.sqrt(value + 2.0 * lead * mixed + lead**2 * slope)
    # Beyond some time constant the noise gain only falls.
    keeps = gains <= largest[:, None]
    first = np.where(keeps.any(axis=1), keeps.argmax(axis=1), _RATIOS.size)
    inside = np.clip(first, 1, _RATIOS.size - 1)
    rows = np.arange(td.size)
    above, below = np.log(gains[rows, inside - 1]), np.log(gains[rows, inside])
    share = np.clip((above - np.log(largest)) / np.maximum(above - below, 1e-300), 0.0, 1.0)
    steps = np.log(_RATIOS)
    found = np.exp(steps[inside - 1] + share * (steps[inside] - steps[inside - 1])) * period
    found = np.where(first == 0, 0.0, found)
    return np.where(first == _RATIOS.size, math.inf, found)


def noise_gain(controller: ControlLaw, model: TransferFunction, period: float) -> float:
    """Return the standard deviation of the command per that of white measurement noise.

    The noise of the samples reaches the command directly and around the loop, in which the command
    is held for a period. A PI or PID controller is computed as
    :class:`~relay_autotune.loop.sampled.SampledPid` runs it.

    :param controller: the controller of a stable loop.
    :param model: the process, with all dead time of the loop, that of the hold included.
    :param period: period of the samples [s]; 0: the largest magnitude from noise to command, an
        upper bound for every period.
    :return: u/y.
    """
    if period == 0.0:
        grid = frequencies(*controller.characteristic(model))
        s = 1j * grid
        return float(np.abs(controller(s) / (1.0 + controller(s) * model(s))).max())
    angle = (np.arange(_ANGLES) + 0.5) * (math.pi / _ANGLES)
    s = 1j * angle / period
    sampled = _sampled(controller, angle, period)
    held = model(s) * np.sinc(angle / (2.0 * math.pi))
    return float(np.sqrt(np.mean(np.abs(sampled / (1.0 + sampled * held)) ** 2)))


def _sampled(controller: ControlLaw, angle: FloatArray, period: float) -> ComplexArray:
    if not isinstance(controller, Controller):
        return controller(1j * angle / period)
    turn, past, present = filter_matrices(controller.tf, period)
    z = np.exp(1j * angle)
    # Transform of the state, by Cramer's rule.
    first, second = (past[k] + present[k] * z for k in (0, 1))
    (f11, f12), (f21, f22) = turn.tolist()
    determinant = (z - f11) * (z - f22) - f12 * f21
    value = ((z - f22) * first + f12 * second) / determinant
    slope = ((z - f11) * second + f21 * first) / determinant
    integral = controller.i * period * z / (z - 1.0)
    return np.asarray(controller.kc * (value + controller.td * slope) + integral * value)


__all__ = ["analyse_loop", "frequencies", "is_stable", "ms_on", "sensitivity_peaks"]


def is_stable(controller: ControlLaw, model: TransferFunction) -> bool:
    """Return whether the closed loop is stable.

    :param controller: the gains, or any other linear controller.
    :param model: the process.
    """
    return closed_loop_unstable_poles(controller.characteristic(model)) == 0


def analyse_loop(
    controller: ControlLaw, model: TransferFunction, sample_period: float = 0.0
) -> Performance:
    """Return the performance of a controller on a model.

    :param controller: the gains, or any other linear controller.
    :param model: the process, with all dead time of the loop.
    :param sample_period: period of the measurement, for its noise [s]; 0: continuous.
    :raises TuningError: if the closed loop is unstable, or its responses do not die away.
    """
    if not is_stable(controller, model):
        raise TuningError(f"{controller} makes an unstable loop with the model: use another rule")
    terms = controller.characteristic(model)
    found = margins(lambda s: controller(s) * model(s), frequencies(*terms), _at_rest(terms))
    figures = step_figures(controller, model, found.ms_frequency)
    noise = noise_gain(controller, model, sample_period)
    return performance_of(found, figures, noise)


def performance_of(found: LoopMargins, figures: StepFigures, noise: float) -> Performance:
    """Join what was found of a loop.

    :param found: its margins.
    :param figures: of its responses.
    :param noise: gain from noise to command [u/y].
    """
    known = {name: value for name, value in vars(found).items() if name != "ms_frequency"}
    return Performance(**known, **vars(figures), noise_gain=noise)


def ms_on(controller: ControlLaw, model: TransferFunction) -> float:
    """Return Ms of a controller on any model; infinite where the loop is unstable.

    :param controller: the gains, or any other linear controller.
    :param model: the process, with all dead time of the loop.
    """
    try:
        if not is_stable(controller, model):
            return math.inf
    except RelayAutotuneError:
        # Stability could not be decided; count it as unstable.
        return math.inf
    grid = frequencies(*controller.characteristic(model))
    return sensitivity_peaks(lambda s: controller(s) * model(s), grid)[0]


def _at_rest(terms: tuple[TransferFunction, ...]) -> float | None:
    """Return the loop's gain at s = 0, for a single term without integral action; else None."""
    if len(terms) != 1 or terms[0].integrators != 0:
        return None
    return terms[0].gain
