"""What a controller does on a model: stability, robustness, load response."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import simpson
from scipy.optimize import brentq, minimize_scalar

from relay_autotune.errors import TuningError
from relay_autotune.models import TransferFunction
from relay_autotune.tuning.gains import Controller, Performance
from relay_autotune.ultimate import phase_crossings, unstable_poles

FloatArray = NDArray[np.float64]

_POINTS = 4096
_MOST_POINTS = 1 << 18
_IAE_TOLERANCE = 2e-4
_RINGING = 2.5


def is_stable(controller: Controller, model: TransferFunction) -> bool:
    """Return whether the closed loop is stable.

    :param controller: the gains.
    :param model: the process.
    """
    loop = controller.loop(model)
    # A gain against the process is positive feedback, which integral action cannot survive.
    return loop.process_sign > 0 and unstable_poles(loop) == 0


def frequencies(loop: TransferFunction) -> FloatArray:
    """Return a grid on which the loop's magnitude and phase change little between points.

    :param loop: controller times process.
    :return: rad/s, increasing.
    """
    corners = [1.0 / abs(c) for c in (*loop.zeros, *loop.time_constants)]
    if loop.dead_time > 0.0:
        corners.append(1.0 / loop.dead_time)
    corners = corners or [1.0]
    low, high = min(corners) * 1e-3, max(corners) * 1e2
    parts = [np.geomspace(low, high, 50 * max(int(math.log10(high / low)), 1))]
    if loop.dead_time > 0.0:
        parts.append(np.arange(0.05, 12.0 * math.pi, 0.05) / loop.dead_time)
    for c in (*loop.zeros, *loop.time_constants):
        if c.imag > 0.0:
            centre, width = 1.0 / abs(c), abs(c.real) / abs(c)
            parts.append(np.abs(centre * (1.0 + width * np.linspace(-8.0, 8.0, 65))) + low)
    return np.unique(np.concatenate(parts))


def sensitivity_on(loop: TransferFunction, grid: FloatArray) -> FloatArray:
    """Return the magnitude of ``1/(1 + L)`` on a grid of frequencies.

    :param loop: L, controller times process.
    :param grid: rad/s, shape (n,).
    """
    return np.asarray(np.abs(1.0 / (1.0 + loop(1j * grid))))


def sensitivity_peaks(loop: TransferFunction, grid: FloatArray) -> tuple[float, float]:
    """Return (Ms, Mt), the largest magnitudes of ``1/(1 + L)`` and ``L/(1 + L)``.

    :param loop: L, controller times process.
    :param grid: frequencies near which the peaks are sought [rad/s].
    """
    values = loop(1j * grid)
    s = np.abs(1.0 / (1.0 + values))
    peaks = []
    for magnitude, complementary in ((s, False), (s * np.abs(values), True)):
        i = int(np.argmax(magnitude))
        low, high = grid[max(i - 1, 0)], grid[min(i + 1, grid.size - 1)]

        def negative(log_w: float, complementary: bool = complementary) -> float:
            value = complex(loop(1j * math.exp(log_w)))
            return -abs((value if complementary else 1.0) / (1.0 + value))

        best = minimize_scalar(
            negative,
            bounds=(math.log(low), math.log(high)),
            method="bounded",
            options={"xatol": 1e-9},
        )
        peaks.append(max(float(magnitude[i]), -float(best.fun)))
    return peaks[0], peaks[1]


def _gain_crossovers(loop: TransferFunction, grid: FloatArray) -> list[float]:
    def excess(w: float) -> float:
        return math.log(abs(complex(loop(1j * w))))

    above = np.log(np.abs(loop(1j * grid)))
    cells = np.flatnonzero(above[:-1] * above[1:] < 0.0)
    return [float(brentq(excess, grid[i], grid[i + 1], rtol=1e-14)) for i in cells]


def load_response(
    controller: Controller, model: TransferFunction, duration: float, points: int = _POINTS
) -> tuple[FloatArray, FloatArray]:
    r"""Return the error after a unit step of the load at the process input.

    ``E(s) = -(1/s) G/(1 + C G)`` is inverted by a fast Fourier transform along Re s = sigma
    (Dubner and Abate 1968); the dead time enters exactly.

    :param controller: the gains, of a stable loop.
    :param model: the process.
    :param duration: s.
    :param points: frequencies of the transform; twice as many instants.
    :return: times [s] and errors [y per unit of u], shape (n,).
    """
    period = 2.0 * duration
    sigma = math.log(1e8) / period
    w = np.arange(points) * (2.0 * math.pi / period)
    s = sigma + 1j * w
    transform = -model(s) / (1.0 + controller.loop(model)(s)) / s
    # Lanczos' factors take away the ringing that the cut at the last frequency leaves.
    transform = transform * np.sinc(np.arange(points) / points)
    padded = np.concatenate((transform, np.zeros(points)))
    padded[0] *= 0.5
    time = np.arange(2 * points, dtype=np.float64) * (period / (2 * points))
    series = np.fft.ifft(padded).real * (2 * points)
    error = 2.0 / period * np.exp(sigma * time) * series
    inside = time <= duration
    return time[inside], error[inside]


def load_iae(controller: Controller, model: TransferFunction, *, settles: bool = False) -> float:
    """Return the integral of the absolute error after a unit step of the load [y s/u].

    :param controller: the gains, of a stable loop, with integral action.
    :param model: the process.
    :param settles: True: an error that dies away too slowly to be followed does not ring, and its
        integral is ti/kc, as for any error of one sign.
    :raises TuningError: if the integral does not settle.
    """
    slowest = max((abs(t) for t in model.time_constants), default=0.0)
    reset = controller.ti / abs(controller.kc * model.gain) if model.is_stable else 0.0
    duration = 8.0 * (model.dead_time + slowest + controller.ti + reset)
    before, points = math.nan, _POINTS
    while points <= _MOST_POINTS:
        time, error = load_response(controller, model, duration, points)
        iae = float(simpson(np.abs(error), x=time))
        if abs(iae - before) <= _IAE_TOLERANCE * iae:
            return iae
        before, duration, points = iae, 2.0 * duration, 2 * points
    if settles and controller.ti > 0.0:
        return max(before, controller.ti / abs(controller.kc))
    raise TuningError("the error after a load step does not die away in any reasonable time")


def analyse_loop(controller: Controller, model: TransferFunction) -> Performance:
    """Return what a controller does on a model.

    :param controller: the gains, with integral action.
    :param model: the process.
    :raises TuningError: if the closed loop is unstable.
    """
    if not is_stable(controller, model):
        raise TuningError(
            f"kc = {controller.kc:.4g}, ti = {controller.ti:.4g} s makes an unstable loop with "
            "the identified model: use another rule"
        )
    loop = controller.loop(model)
    grid = frequencies(loop)
    ms, mt = sensitivity_peaks(loop, grid)
    above = [c.gain for c in phase_crossings(loop) if c.gain > 1.0]
    crossovers = _gain_crossovers(loop, grid)
    lag = [math.remainder(float(loop.phase(w)) + math.pi, 2.0 * math.pi) for w in crossovers]
    delays = [m % (2.0 * math.pi) / w for m, w in zip(lag, crossovers, strict=True)]
    return Performance(
        ms=ms,
        mt=mt,
        gain_margin=min(above) if above else math.inf,
        phase_margin=min((abs(m) for m in lag), default=math.pi),
        delay_margin=min(delays, default=math.inf),
        iae_load=load_iae(controller, model, settles=ms < _RINGING),
    )
