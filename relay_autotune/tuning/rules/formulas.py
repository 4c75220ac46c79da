# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Rules for a process ``K exp(-D s)/(tau s + 1)``, or ``K exp(-D s)/(tau s - 1)``, by its model.

The unstable one: internal model control by Rotstein and Lewin, "Simple PI and PID Tuning for
Open-Loop Unstable Systems", Ind. Eng. Chem. Res. 30, 1991. With ``T = lambda (lambda/tau + 2)``

    PI:   kc = tau T/(K lambda^2),           ti = T;
    PID:  kc = tau (T + D/2)/(K lambda^2),   ti = T + D/2,   td = T (D/2)/(T + D/2).

The paper reads lambda from charts. Here it is the fastest one that keeps to the Ms that is asked
for, on the exact loop. Where none does, it is the fastest within 1.15 times the smallest Ms that
the rule attains. Of the published rules for this process it is the sound one: on the exact loop
its smallest Ms is 4 to 10 % above that of any PI or PID for D/tau up to 0.5, whereas De Paor and
O'Malley's PI (1989) and Visioli's PID (2001) have an Ms of 6 and more at any D/tau.

Rules for the ultimate point, by the model's phase or by the limit cycle of a relay.

The model's own point is where its phase is -180 degrees. The other is what the describing function
reads from the limit cycle of a relay of amplitude h, ``K_u = 4 h/(pi a)`` and ``P_u = P``; on a
FOPDT process its K_u is off by -19 % (D/tau = 0.05) to +22 % (D/tau = 10). The papers' examples
take the latter, and so do the rules whose name ends in ``_cycle``.

What any rule may ask of its task, and the sentences with which it refuses, stand first.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from relay_autotune.errors import ModelError, TuningError
from relay_autotune.identification.limit_cycle.shape import shape_of_half_cycle
from relay_autotune.loop.gains import Controller
from relay_autotune.process.simulation import HalfCycle
from relay_autotune.process.structures import FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint, ultimate_point
from relay_autotune.record.record import CycleFeatures
from relay_autotune.scalar import minimum_near, root
from relay_autotune.tuning.task import DesignTask


@dataclass(frozen=True)
class Reduced:
    """A process of first or second order with a dead time, for which a rule has formulas.

    :param gain: K; of an integrating process the rate per unit step [y/u, y/(u s)].
    :param lag: tau, the only or the larger time constant [s]; inf: it integrates.
    :param delay: D, with what the loop adds to it [s].
    :param second: the smaller time constant [s]; 0: first order.
    :param note: what the reason must say of it; empty where it is the model itself.
    """

    gain: float
    lag: float
    delay: float
    second: float = 0.0
    note: str = ""

    @property
    def ratio(self) -> float:
        """D/tau."""
        return self.delay / self.lag


def named(model: TransferFunction) -> str:
    """Return in words what a model is, for a refusal."""
    if model.structure != "general":
        return model.structure
    kind = "an integrating" if model.integrators > 0 else "a stable"
    if model.grows:
        kind = "an unstable"
    return f"{kind} process of order {model.order} with {len(model.zeros)} zeros"


def fopdt_of(rule: str, task: DesignTask) -> Reduced:
    """Return the FOPDT process on which a rule designs: the model, or else the simple one.

    :param rule: name of the rule.
    :raises TuningError: if the model is no stable FOPDT and none that stands for it is known. For
        a process that integrates none does: its time constant would be that of the record.
    """
    delay = task.options.added_delay
    model, note = task.model, ""
    if not FOPDT.holds(model):
        if model.grows:
            raise TuningError(
                f"the rule {rule} is for a stable FOPDT process, found {named(model)}, which is "
                "unstable: use robust or unstable"
            )
        if model.integrators or task.simple is None or not FOPDT.holds(task.simple):
            raise TuningError(
                f"the rule {rule} is for a stable FOPDT process, found {named(model)}: use a "
                "rule for that structure, or robust"
            )
        model = task.simple
        tau = model.time_constants[0].real
        note = (
            f"; designed on the FOPDT {model.gain:.4g} e^(-{model.dead_time:.4g} s)/({tau:.4g} s "
            "+ 1), judged on the model"
        )
    return Reduced(model.gain, model.time_constants[0].real, model.dead_time + delay, note=note)


def own_point(rule: str, task: DesignTask) -> UltimatePoint:
    """Return the ultimate point of the model itself.

    :param rule: name of the rule.
    :raises TuningError: if it has none, or is unstable.
    """
    model = task.process
    if model.grows:
        raise TuningError(
            f"the rule {rule} is for processes that are stable or integrate, found "
            f"{named(model)}, which is unstable: use robust or unstable"
        )
    point = ultimate_point(model)
    if point is None:
        raise TuningError(
            f"the rule {rule} needs an ultimate point and the model has none (no proportional "
            "controller makes it oscillate): use imc or robust"
        )
    return point


def wants_pid(rule: str, task: DesignTask, *, pid: bool = True) -> bool:
    """Return whether the rule's PID is asked for rather than its PI.

    :param rule: name of the rule.
    :param pid: whether it gives PID gains.
    :raises TuningError: if it gives none where they are asked for.
    """
    asked = task.options.controller == "pid"
    if asked and not pid:
        raise TuningError(f"the rule {rule} gives no PID gains: ask for pi, or use another rule")
    return asked


def controller(
    task: DesignTask, kc: float, ti: float, td: float = 0.0, b: float = 1.0
) -> Controller:
    """Return a controller with the filter that derivative action needs, ``tf = td/filter_ratio``.

    :param kc: proportional gain [u/y].
    :param ti: integral time [s].
    :param td: derivative time [s].
    :param b: weight of the set-point.
    """
    return Controller(kc, ti, td, td / task.options.filter_ratio, b)


_REACH = np.geomspace(1.0, 4.0, 60)
_AT_SWITCH = np.zeros(1)


def half_cycle(model: TransferFunction) -> HalfCycle | None:
    """Return half a period of the limit cycle under an ideal relay of amplitude 1.

    The half period is the one nearest to ``pi/w_u`` at which the output passes zero upward at the
    switch.

    :param model: the process.
    :return: None if it has no ultimate point or no such oscillation.
    """
    point = ultimate_point(model)
    if point is None:
        return None

    def level(half_period: float) -> float:
        return float(HalfCycle(model, half_period)(_AT_SWITCH)[0])

    middle, least = math.pi / point.frequency, model.dead_time * (1.0 + 1e-9)
    for near, far in itertools.pairwise(_REACH):
        for low, high in ((middle * near, middle * far), (middle / far, middle / near)):
            low = max(low, least)
            with suppress(ModelError, np.linalg.LinAlgError):
                if low < high and level(low) * level(high) <= 0.0:
                    cycle = HalfCycle(model, root(level, low, high))
                    if cycle.slope(_AT_SWITCH)[0] > 0.0:
                        return cycle
    return None


def describing_point_of(model: TransferFunction) -> UltimatePoint | None:
    """Return K_u and w_u that an ideal relay test of a model would give.

    ``K_u = 4 h/(pi a)``, ``w_u = 2 pi/P`` (Chang, Shen and Yu 1992, eqs 1 and 2), with the exact
    amplitude and period of the limit cycle.

    :param model: the process.
    :return: None if it has no limit cycle.
    """
    cycle = half_cycle(model)
    if cycle is None:
        return None
    a = shape_of_half_cycle(cycle).amplitude
    return UltimatePoint(model.process_sign * 4.0 / (math.pi * a), math.pi / cycle.half_period)


def describing_point_of_cycle(
    cycle: CycleFeatures, relay: float, sign: float
) -> UltimatePoint | None:
    """Return K_u and w_u that the describing function reads from a limit cycle that was recorded.

    ``K_u = 4 h/(pi a) sin(pi T_high/P)``: the first harmonic of the relay's wave over the
    amplitude; the sine is 1 for an unbiased relay.

    :param cycle: the limit cycle.
    :param relay: h [u].
    :param sign: of the process.
    :return: None if the measurement does not move.
    """
    if not cycle.amplitude > 0.0:
        return None
    gain = 4.0 * relay / (math.pi * cycle.amplitude)
    gain *= math.sin(math.pi * cycle.period_high / cycle.period)
    return UltimatePoint(math.copysign(gain, sign), 2.0 * math.pi / cycle.period)


@dataclass(frozen=True)
class _UltimateRule:
    """A rule for the ultimate point.

    :param title: its name for people.
    :param pi: kc/K_u and ti/P_u.
    :param pid: kc/K_u, ti/P_u and td/P_u.
    :param formulas: the same for people, PI first.
    """

    title: str
    pi: tuple[float, float]
    pid: tuple[float, float, float]
    formulas: tuple[str, str]


_ULTIMATE = {
    # Ziegler and Nichols, "Optimum Settings for Automatic Controllers", Trans. ASME 64, 1942.
    "ziegler_nichols": _UltimateRule(
        "Ziegler-Nichols",
        (0.45, 1.0 / 1.2),
        (0.6, 0.5, 0.125),
        ("0.45 K_u and P_u/1.2", "0.6 K_u, P_u/2 and P_u/8"),
    ),
    # PI: Tyreus and Luyben, Ind. Eng. Chem. Res. 31, 1992; Thyagarajan and Yu 2003, eqs 31 and 32.
    # PID: Luyben and Luyben, "Essentials of Process Control", 1997.
    "tyreus_luyben": _UltimateRule(
        "Tyreus-Luyben",
        (1.0 / 3.2, 2.2),
        (1.0 / 2.2, 2.2, 1.0 / 6.3),
        ("K_u/3.2 and 2.2 P_u", "K_u/2.2, 2.2 P_u and P_u/6.3"),
    ),
}


def _by_ultimate_point(name: str, task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of a rule for the ultimate point.

    :param name: of the rule; one that ends in ``_cycle`` takes the point of the limit cycle by
        the describing function, else it is that of the model itself.
    :param task: a stable or integrating process with an ultimate point.
    :raises TuningError: for any other, or if the limit cycle is not known.
    """
    row = _ULTIMATE[name.removesuffix("_cycle")]
    point, whose = own_point(name, task), "model itself"
    if name not in _ULTIMATE:
        if task.describing is None:
            raise TuningError(
                f"the rule {name} needs the limit cycle of an unbiased relay and none is known: "
                f"use {name.removesuffix('_cycle')}, which takes the model's own ultimate point"
            )
        point, whose = task.describing, "limit cycle by the describing function"
    pid = wants_pid(name, task)
    gain, *times = row.pid if pid else row.pi
    gains = controller(task, gain * point.gain, *(share * point.period for share in times))
    said = f"K_u = {point.gain:.4g} and P_u = {point.period:.4g} s"
    return gains, f"{row.title}: {row.formulas[pid]} with {said} of the {whose}"


ziegler_nichols, ziegler_nichols_cycle, tyreus_luyben, tyreus_luyben_cycle = (
    partial(_by_ultimate_point, f"{name}{end}") for name in _ULTIMATE for end in ("", "_cycle")
)


ITAE_RANGE = (0.1, 1.0)
_ROUNDING = 1e-9


def itae(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of minimum ITAE after a set-point step, by Rovira.

    PI: ``kc = 0.586/K (D/tau)^-0.916``, ``ti = tau/(1.03 - 0.165 D/tau)`` (Thyagarajan and Yu
    2003, eqs 33 and 34). PID: ``kc = 0.965/K (D/tau)^-0.85``, ``ti = tau/(0.796 - 0.147 D/tau)``,
    ``td = 0.308 tau (D/tau)^0.929``. Source: Rovira, Murrill and Smith, Instruments and Control
    Systems 42, 1969; Smith and Corripio, "Principles and Practice of Automatic Process Control".

    :param task: a stable FOPDT process with 0.1 <= D/tau <= 1.
    :raises TuningError: for any other.
    """
    process = fopdt_of("itae", task)
    ratio, k, tau = process.ratio, process.gain, process.lag
    low, high = ITAE_RANGE
    if not low * (1.0 - _ROUNDING) <= ratio <= high * (1.0 + _ROUNDING):
        raise TuningError(
            f"the ITAE rule holds for 0.1 <= D/tau <= 1, found {ratio:.3g}: use tyreus_luyben "
            "below, imc above, or thyagarajan to have it chosen"
        )
    if wants_pid("itae", task):
        kc, td = 0.965 / k * ratio**-0.85, 0.308 * tau * ratio**0.929
        gains = controller(task, kc, tau / (0.796 - 0.147 * ratio), td)
    else:
        gains = controller(task, 0.586 / k * ratio**-0.916, tau / (1.03 - 0.165 * ratio))
    return gains, f"minimum ITAE (Rovira) for D/tau = {ratio:.3g}{process.note}"


def imc(task: DesignTask, name: str = "imc") -> tuple[Controller, str]:
    """Return the gains of internal model control, with lambda free.

    PI: ``kc = (tau + D/2)/(K lambda)``, ``ti = tau + D/2``, by default
    ``lambda = max(1.7 D, 0.2 tau)`` (Thyagarajan and Yu 2003, eqs 35 to 37; their Table 4 prints
    ``tau + D`` in kc, which is wrong). PID: ``kc = (tau + D/2)/(K (lambda + D/2))``, the same
    ti, ``td = tau D/(2 tau + D)``, by default ``lambda = max(0.8 D, 0.2 tau)``. Source: Rivera,
    Morari and Skogestad, Ind. Eng. Chem. Process Des. Dev. 25, 1986.

    Chang, Shen and Yu (1992, Fig 5) ask of 1.65 exp(-10 s)/(20 s + 1) a closed loop with a time
    constant of 20 s, that of the process: so does ``imc_chang``.

    :param task: a stable FOPDT process; its ``closed_loop_time`` is lambda.
    :param name: of the rule.
    :raises TuningError: for any other.
    """
    process, pid = fopdt_of(name, task), wants_pid(name, task)
    tau, half = process.lag, 0.5 * process.delay
    closed, given = task.options.closed_loop(max((0.8 if pid else 1.7) * process.delay, 0.2 * tau))
    why = f"lambda = {closed:.4g} s{given}"
    if name == "imc_chang":
        closed, why = tau, f"lambda = tau = {tau:.4g} s (Chang, Shen and Yu)"
    ti, td = tau + half, 0.0
    if pid:
        closed, td = closed + half, tau * half / (tau + half)
    return controller(task, ti / (process.gain * closed), ti, td), f"IMC with {why}{process.note}"


imc_chang = partial(imc, name="imc_chang")

RELAXED = 1.15

_LAMBDAS = np.geomspace(0.3, 100.0, 30)
_UNSTABLE = 1e3


def unstable(task: DesignTask) -> tuple[Controller, str]:
    """Return the gains of Rotstein and Lewin for an unstable process.

    A second, stable lag counts as dead time in the formulas, not in the choice of lambda. The
    set-point weight is 0, which for PI is the prefilter 1/(ti s + 1) that the authors advise. With
    ``controller`` "auto" it is PI where PI attains the Ms asked for, else PID.

    :param task: an unstable process of one or two real lags; its ``closed_loop_time`` is lambda.
    :raises TuningError: for any other, or where no lambda makes the loop stable.
    """
    model = task.process
    lags = sorted((t for t in model.time_constants), key=lambda t: t.real)
    first_order = len(lags) == 1 and lags[0].real < 0.0
    second_order = len(lags) == 2 and lags[0].real < 0.0 < lags[1].real
    if model.integrators or model.zeros or not (first_order or second_order):
        raise TuningError(
            "the rule unstable is for K e^(-D s)/(tau s - 1), with one more stable lag at most; "
            f"found {named(task.model)}: use a rule for that structure, or robust"
        )
    tau = -lags[0].real
    late = model.dead_time + sum(t.real for t in lags[1:])

    def gains(closed: float, pid: bool) -> Controller:
        t, half = closed * (closed / tau + 2.0), 0.5 * late if pid else 0.0
        kc = tau * (t + half) / (abs(model.gain) * model.process_sign * closed * closed)
        return controller(task, kc, t + half, t * half / (t + half), b=0.0)

    asked = task.options.ms
    closed, given = task.options.closed_loop(math.nan)
    if given:
        pid = wants_pid("unstable", task)
        return gains(closed, pid), f"Rotstein-Lewin with lambda = {closed:.4g} s{given}"
    if not late > 0.0:
        raise TuningError(
            "the rule unstable has no bound on the gain of a process without dead time: give the "
            "closed-loop time constant lambda, or the loop's own delay"
        )
    kinds = {"pi": (False,), "pid": (True,), "auto": (False, True)}[task.options.controller]

    def fastest(pid: bool) -> tuple[float, float, bool]:
        return *_fastest(lambda closed: task.loop(gains(closed, pid)).ms(), late, asked), pid

    tried = [fastest(pid) for pid in kinds]
    closed, least, pid = next((t for t in tried if t[1] <= asked), tried[-1])
    if least >= _UNSTABLE:
        raise TuningError(
            f"no {'PID' if pid else 'PI'} gains of Rotstein and Lewin hold this process: its dead "
            f"time over its unstable time constant is {late / tau:.3g}, and "
            f"{'2' if pid else '1'} is the limit of any"
        )
    held = f"with Ms <= {asked:g}"
    if least > asked:
        held = (
            f"with Ms <= {RELAXED * least:.3g}, {RELAXED:g} times the least that the rule "
            f"attains: {asked:g} is out of its reach at D/tau = {late / tau:.3g}"
        )
    return gains(closed, pid), f"Rotstein-Lewin with lambda = {closed:.4g} s, the fastest {held}"


def _fastest(ms: Callable[[float], float], late: float, asked: float) -> tuple[float, float]:
    """Return the fastest lambda within the bound on Ms, and the least Ms of any.

    :param ms: Ms of a lambda [s].
    :param late: dead time [s].
    :param asked: the bound; where no lambda keeps it, a bound above the least takes its place.
    """

    def peak(log_lambda: float) -> float:
        return min(ms(math.exp(log_lambda)), _UNSTABLE)

    grid = np.log(late * _LAMBDAS)
    peaks = [peak(float(x)) for x in grid]
    top = int(np.argmin(peaks))
    at, least = minimum_near(peak, grid, top, 1e-5)
    least, at = min((least, at), (peaks[top], float(grid[top])))
    bound = asked if least <= asked else RELAXED * least
    before = [float(x) for x, p in zip(grid, peaks, strict=True) if x < at and p > bound]
    if not before or least >= _UNSTABLE:
        return math.exp(at), least
    return math.exp(root(lambda x: peak(x) - bound, before[-1], at, 1e-9)), least
