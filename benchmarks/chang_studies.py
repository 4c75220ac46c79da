# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The studies of Chang, Shen and Yu 1992: `python3 benchmarks/chang_studies.py [--quick]`.

Its Figures 2 to 6 as tables, with the errata: errors of the original ATV and of the exact
equations over frequency, dead time and error of the dead time, and their effect on a controller;
and the effect of a hysteresis on the equations without one.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from markdown import table

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.methods.chang import ultimate_estimate
from relay_autotune.identification.methods.lags import (
    EXACT,
    FIRST,
    MIXED,
    Wave,
    equal,
    solutions,
    with_amplitude,
)
from relay_autotune.process.structures import SOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.process.virtual_process import Plant
from relay_autotune.record.record import RelaySettings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))
from sampled_relay import exact_limit_cycle

EXAMPLE = TransferFunction.fopdt(1.65, 20.0, 10.0)
# As the paper reads them off its chart; its amplitude of 0.26 lacks a zero.
READ_PERIOD, READ_AMPLITUDE, RELAY = 33.26, 0.026, 0.04

FREQUENCIES = (0.01, 0.03, 0.1, 0.1837, 0.3, 0.5, 1.0)
FOPDT_DEAD_TIMES = (0.1, 0.3, 1.0, 3.0, 10.0, 20.0, 40.0, 60.0)
SOPDT_DEAD_TIMES = (0.1, 0.3, 1.0, 3.0, 10.0)
SOPDT_ERRORS = (-0.5, -0.25, -0.1, 0.0, 0.1, 0.25, 0.5)
FOPDT_ERRORS = (-0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05, 0.1)
HYSTERESES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
CLOSED_LOOP = 20.0


def ultimate(model: TransferFunction) -> tuple[float, float]:
    """Return (K_u, w_u) of a model."""
    point = ultimate_point(model)
    assert point is not None
    return point.gain, point.frequency


def limit_cycle(model: TransferFunction, hysteresis: float = 0.0) -> tuple[float, float]:
    """Return period and amplitude under a relay of amplitude 1."""
    cycle = exact_limit_cycle(
        model, RelaySettings(0.0, 0.0, 1.0, 0.0, hysteresis), tolerance=1e-10
    )
    return cycle.period, cycle.peak_max


def percent(found: Sequence[float], truth: Sequence[float]) -> list[str]:
    """Return relative errors in per cent."""
    errors = [100.0 * (f / t - 1.0) for f, t in zip(found, truth, strict=True)]
    # Rounding of the limit cycle does not count as an error of a method.
    return [f"{e:+.2f}" if abs(e) > 1e-4 else "0" for e in errors]


def errors_of(
    make: Callable[..., TransferFunction], truth: tuple[float, float], *arguments: object
) -> list[str]:
    """Return the errors of K_u and w_u of the model that a function makes, if it makes one."""
    try:
        return percent(ultimate(make(*arguments)), truth)
    except IdentificationError:
        return ["no model", "no model"]


def figure_2() -> str:
    """Return the multiplicative error over frequency."""
    gain, dead_time = EXAMPLE.gain, EXAMPLE.dead_time
    cycle = SymmetricCycle(READ_PERIOD, READ_AMPLITUDE, RELAY, 0.0, dead_time)
    constants = {
        "eq 8": equal(1, cycle)[1],
        "eq 13": equal(1, cycle, wave=FIRST)[1],
        "eq 21": with_amplitude((1.0,), READ_PERIOD, READ_AMPLITUDE / (gain * RELAY), FIRST)[0],
    }
    rows = []
    for w in FREQUENCIES:
        truth = complex(EXAMPLE(1j * w))
        cells = [f"{w:g}"]
        for tau in constants.values():
            model = complex(TransferFunction.fopdt(gain, tau, dead_time)(1j * w))
            cells.append(f"{100.0 * abs((truth - model) / model):.2f}")
        rows.append(cells)
    return table(["w [rad/s]", *(f"{n}, tau = {t:.2f} s" for n, t in constants.items())], rows)


def figure_3() -> str:
    """Return the errors of K_u and w_u for one lag over the dead time."""
    rows = []
    for dead_time in FOPDT_DEAD_TIMES:
        model = TransferFunction.fopdt(1.65, 20.0, dead_time)
        truth, (period, amplitude) = ultimate(model), limit_cycle(model)
        read = float(f"{period:.4g}")

        def by_period(period: float, dead_time: float = dead_time) -> TransferFunction:
            _, tau = equal(1, SymmetricCycle(period, 1.0, 1.0, 0.0, dead_time), 1.0)
            return TransferFunction.fopdt(1.65, tau, dead_time)

        rows.append(
            [
                f"{dead_time:g}",
                *percent(
                    ultimate_estimate(SymmetricCycle(period, amplitude, 1.0, 0.0, 0.0)), truth
                ),
                *errors_of(by_period, truth, period),
                *errors_of(by_period, truth, read),
            ]
        )
    exact = ["eq 8: K_u", "w_u"]
    return table(["D [s]", "ATV: K_u", "w_u", *exact, "eq 8, P to 4 digits: K_u", "w_u"], rows)


def two_lags(dead_time: float) -> TransferFunction:
    """Return the paper's second-order process."""
    return TransferFunction.sopdt(37.3, (7200.0, 2.0), dead_time)


def two_lags_of(period: float, dead_time: float, amplitude: float, wave: Wave) -> TransferFunction:
    """Return two lags of the paper's gain by eqs 11 and 24."""
    cycle = SymmetricCycle(period, amplitude, 1.0, 0.0, dead_time)
    _, *lags = solutions(SOPDT, cycle, 37.3, wave)[0]
    return TransferFunction.sopdt(37.3, tuple(lags), dead_time)


def figure_4() -> str:
    """Return the errors of K_u and w_u for two lags over the dead time."""
    rows = []
    for dead_time in SOPDT_DEAD_TIMES:
        model = two_lags(dead_time)
        truth, (period, amplitude) = ultimate(model), limit_cycle(model)
        cells = [
            f"{dead_time:g}",
            *percent(ultimate_estimate(SymmetricCycle(period, amplitude, 1.0, 0.0, 0.0)), truth),
        ]
        for wave in (MIXED, EXACT):
            found = two_lags_of(period, dead_time, amplitude, wave)
            cells += percent(ultimate(found), truth)
        rows.append(cells)
    headings = ["D [s]", "ATV: K_u", "w_u", "eqs 11, 24: K_u", "w_u", "all harmonics: K_u", "w_u"]
    return table(headings, rows)


def internal_model_control(
    model: TransferFunction, process: TransferFunction, period: float, duration: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return time and measurement after a unit step of the set-point.

    The controller is the model's inverse without its dead time, behind a lag of ``CLOSED_LOOP``:
    u = (1/K)(tau s + 1)/(lambda s + 1) (r - y + y_model).
    """
    gain, tau = model.gain, model.time_constants[0].real
    real, internal = Plant(process), Plant(model)
    time = np.arange(round(duration / period) + 1) * period
    decay = math.exp(-period / CLOSED_LOOP)
    y, u, filtered = np.empty(time.size), 0.0, 0.0
    for k, t in enumerate(time.tolist()):
        y[k] = real.advance(t, u)
        wanted = 1.0 - y[k] + internal.advance(t, u)
        u = (tau / CLOSED_LOOP * wanted + (1.0 - tau / CLOSED_LOOP) * filtered) / gain
        filtered = wanted + (filtered - wanted) * decay
    return time, y


def figure_5(period: float) -> str:
    """Return how IMC with each model follows the trajectory that it was designed for."""
    cycle = SymmetricCycle(*limit_cycle(EXAMPLE), 1.0, 0.0, 10.0)
    _, by_phase = equal(1, cycle, wave=FIRST)
    (by_magnitude,) = with_amplitude((1.0,), cycle.period, cycle.amplitude / 1.65, FIRST)
    models = {
        "the process itself": 20.0,
        "eq 8": equal(1, cycle)[1],
        "ATV, mean of eqs 13 and 21": 0.5 * (by_phase + by_magnitude),
    }
    rows = []
    for name, tau in models.items():
        model = TransferFunction.fopdt(1.65, tau, 10.0)
        time, y = internal_model_control(model, EXAMPLE, period, 250.0)
        wanted = 1.0 - np.exp(-np.maximum(time - 10.0, 0.0) / CLOSED_LOOP)
        rising = slice(0, int(np.argmax(y > 0.9)))
        reached = float(np.interp(1.0 - math.exp(-1.0), y[rising], time[rising]))
        outside = np.flatnonzero(np.abs(y - 1.0) > 0.02)
        rows.append(
            [
                name,
                f"{tau:.2f}",
                f"{reached:.1f}",
                f"{time[outside[-1]]:.0f}",
                f"{100.0 * float(np.max(np.abs(y - wanted))):.1f}",
                f"{100.0 * max(float(np.max(y)) - 1.0, 0.0):.1f}",
            ]
        )
    headings = [
        *("model", "tau [s]", "63 % at [s]", "within 2 % from [s]"),
        *("largest distance from the trajectory [%]", "overshoot [%]"),
    ]
    return table(headings, rows)


def figure_6() -> str:
    """Return the errors of K_u and w_u over an error of the dead time, for two lags."""
    model = two_lags(1.0)
    truth, (period, amplitude) = ultimate(model), limit_cycle(model)
    atv = percent(ultimate_estimate(SymmetricCycle(period, amplitude, 1.0, 0.0, 0.0)), truth)
    rows = []
    for error in SOPDT_ERRORS:
        dead_time = 1.0 + error

        literal, exact = (
            errors_of(two_lags_of, truth, period, dead_time, amplitude, wave)
            for wave in (MIXED, EXACT)
        )
        rows.append([f"{100.0 * error:+.0f}", *atv, *literal, *exact])
    headings = ["ATV: K_u", "w_u", "eqs 11, 24: K_u", "w_u", "all harmonics: K_u", "w_u"]
    return table(["error of D [%]", *headings], rows)


def figure_6_one_lag() -> str:
    """Return the same for one lag with a short dead time, as the paper's text has it."""
    model = TransferFunction.fopdt(1.65, 20.0, 1.0)
    truth, (period, amplitude) = ultimate(model), limit_cycle(model)
    atv = percent(ultimate_estimate(SymmetricCycle(period, amplitude, 1.0, 0.0, 0.0)), truth)
    rows = []
    for error in FOPDT_ERRORS:
        dead_time = 1.0 + error
        try:
            _, tau = equal(1, SymmetricCycle(period, 1.0, 1.0, 0.0, dead_time), 1.0)
            found = percent(ultimate(TransferFunction.fopdt(1.65, tau, dead_time)), truth)
            rows.append([f"{100.0 * error:+.0f}", *atv, f"{tau:.2f}", *found])
        except IdentificationError:
            rows.append([f"{100.0 * error:+.0f}", *atv, "none", "", ""])
    return table(["error of D [%]", "ATV: K_u", "w_u", "eq 8: tau [s]", "K_u", "w_u"], rows)


def hysteresis() -> str:
    """Return the errors due to a hysteresis, of eq 8 as printed and with it on the right side."""
    truth = ultimate(EXAMPLE)
    ideal = limit_cycle(EXAMPLE)[1]
    rows = []
    for share in HYSTERESES:
        epsilon = share * ideal
        period, amplitude = limit_cycle(EXAMPLE, epsilon)

        def by_period(level: float, period: float = period) -> TransferFunction:
            _, tau = equal(1, SymmetricCycle(period, 1.0, 1.0, level, 10.0), 1.0)
            return TransferFunction.fopdt(1.65, tau, 10.0)

        rows.append(
            [
                f"{100.0 * share:g}",
                *percent(
                    ultimate_estimate(SymmetricCycle(period, amplitude, 1.0, 0.0, 0.0)), truth
                ),
                *errors_of(by_period, truth, 0.0),
                *errors_of(by_period, truth, epsilon / 1.65),
            ]
        )
    headings = ["ATV: K_u", "w_u", "eq 8 as printed: K_u", "w_u", "with eps/(K h): K_u", "w_u"]
    return table(["eps [% of the ideal amplitude]", *headings], rows)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="coarser steps in time")
    quick = parser.parse_args().quick
    one, two = "1.65 e^(-D s)/(20 s + 1)", "37.3 e^(-D s)/((7200 s + 1)(2 s + 1))"
    print(f"Figure 2: 100 |(G - G_model)/G_model| for {one}, D = 10 s, from P = 33.26 s and\n"
          "a = 0.026 as the paper reads them off:\n")  # fmt: skip
    print(figure_2())
    print(f"\nFigure 3: errors of K_u and w_u in % for {one}:\n")
    print(figure_3())
    print(f"\nFigure 4: errors of K_u and w_u in % for {two}:\n")
    print(figure_4())
    print(f"\nFigure 5: IMC with a closed-loop time constant of 20 s on {one}, D = 10 s:\n")
    print(figure_5(0.1 if quick else 0.01))
    print(f"\nFigure 6: errors of K_u and w_u in % for {two}, D = 1 s, where D is misread:\n")
    print(figure_6())
    print(f"\nThe same for {one}, D = 1 s:\n")
    print(figure_6_one_lag())
    print(f"\nErrors in % with a hysteresis, for {one}, D = 10 s:\n")
    print(hysteresis())


if __name__ == "__main__":
    main()
