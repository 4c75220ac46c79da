# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a design rule is given: the process, the models within its uncertainty, and the options."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller, Performance
from relay_autotune.loop.laws import LAWS, OWN_LAW, Law, SampledLaw
from relay_autotune.loop.sampled_loop import SampledLoop, sampled_grid
from relay_autotune.process.response import HeldProcess
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint
from relay_autotune.quantities import check, quantity

_Constants = Sequence[tuple[complex, ...]]


class ModelSet:
    """Similar models, such as those within an uncertainty.

    :param models: m of them, at least one.
    :ivar integrators: of each model, shape (m,).
    :ivar unstable_poles: how many each has in the right half plane, shape (m,).
    """

    def __init__(self, models: Sequence[TransferFunction]) -> None:
        self.models = tuple(models)
        self.integrators = np.array([m.integrators for m in self.models])
        self.unstable_poles = np.array(
            [sum(t.real < 0.0 for t in m.time_constants) for m in self.models]
        )
        alike = defaultdict(list)
        for k, model in enumerate(self.models):
            alike[len(model.zeros), len(model.time_constants), model.integrators].append(k)
        self._groups = [(integrators, np.array(of)) for (_, _, integrators), of in alike.items()]
        # Frequencies and responses in one, for several threads.
        self._known: tuple[FloatArray, ComplexArray] | None = None

    def __call__(self, frequency: FloatArray) -> ComplexArray:
        """Return the response of each model at each frequency.

        The values at the frequencies of the first call are kept, since the grids for the loops
        of one process have most of their frequencies in common.

        :param frequency: rad/s, shape (n,), increasing.
        :return: y/u, shape (n, m).
        """
        if self._known is None:
            self._known = frequency, self._evaluate(frequency)
        known, responses = self._known
        place = np.minimum(np.searchsorted(known, frequency), known.size - 1)
        found = responses[place]
        new = known[place] != frequency
        found[new] = self._evaluate(frequency[new])
        return found

    def _evaluate(self, frequency: FloatArray) -> ComplexArray:
        w = frequency[:, None]
        s = 1j * w
        found = np.empty((frequency.size, len(self.models)), dtype=np.complex128)
        for integrators, of in self._groups:
            models = [self.models[k] for k in of]
            lag = np.array([m.dead_time for m in models]) * w
            gain = np.array([m.gain for m in models])
            values = np.empty(lag.shape, dtype=np.complex128)
            # Much faster than a complex exponential.
            values.real, values.imag = gain * np.cos(lag), -gain * np.sin(lag)
            if integrators:
                values *= s ** float(-integrators)
            for zero in _columns([m.zeros for m in models]):
                values *= 1.0 + zero * s
            for constant in _columns([m.time_constants for m in models]):
                values /= 1.0 + constant * s
            found[:, of] = values
        return found


def _columns(constants: _Constants) -> ComplexArray:
    """Return the first constant of each model, then the second, and so on, shape (p, m)."""
    return np.array(constants, dtype=np.complex128).T


@dataclass(frozen=True)
class HeldSet:
    """Models between hold and sampler, for the exact loops of a law.

    :param models: with the dead time of the loop, but none for the hold.
    :param law: the law.
    :param period: of the samples [s].
    """

    models: tuple[TransferFunction, ...]
    law: Law
    period: float

    @cached_property
    def _held(self) -> list[HeldProcess]:
        return [HeldProcess(model, self.period) for model in self.models]

    @cached_property
    def _known(self) -> dict[tuple[float, int], ComplexArray]:
        """Responses of the models, by the begin and the size of the grid."""
        return {}

    def loops(self, controller: Controller) -> tuple[ComplexArray, NDArray[np.bool_]]:
        """Return the loops on a grid, shape (n, m), and which of them are unstable, shape (m,).

        :param controller: the gains, as far as the law can have them.
        """
        law = self.law.at(controller, self.period)
        grid = sampled_grid(self.models[0], controller, self.period)
        z, key = np.exp(1j * grid * self.period), (float(grid[0]), grid.size)
        if key not in self._known:
            self._known[key] = np.column_stack([held(z) for held in self._held])
        values = law.from_measurement(z)[:, None] * self._known[key]
        each = zip(self.models, self._held, values.T, strict=True)
        unstable = [SampledLoop(law, m, h).unstable_from(grid, v) != 0.0 for m, h, v in each]
        return values, np.array(unstable)


CONTROLLERS = ("auto", "pi", "pid")
MS_RANGE = (1.2, 4.0)
# A bound may be exceeded by this factor without a warning.
_HELD = 1.01
# +2 dB is Luyben's bound on the resonance of the level of a vessel (2003).
MT_SELF_REGULATING, MT_INTEGRATING = 1.4, 1.26


@dataclass(frozen=True, kw_only=True)
class DesignOptions:
    """Options of a design, the same for every rule; each rule reads what it needs.

    >>> from relay_autotune import DesignOptions
    >>> options = DesignOptions(controller="pi", ms=1.6, sample_period=0.1)
    >>> options.ms, options.added_delay
    (1.6, 0.05)

    :raises TuningError: if a value is out of its range.
    """

    controller: str = quantity("auto", choices=CONTROLLERS).means(
        "What is designed; auto: PI, unless the rule finds PID worth it."
    )
    ms: float = quantity(1.4, "", *MS_RANGE).means("Largest Ms, for robust and unstable.")
    mt: float = quantity(math.nan, lower=1.0, open_ended=True).means(
        "Largest Mt, above 1, for robust; NaN: 1.4, of an integrating process 1.26."
    )
    setpoint_weight: float = quantity(math.nan, lower=0.0, upper=1.0).means(
        "Set-point weight b; NaN: the rule's own."
    )
    sample_period: float = quantity(0.0, "s", lower=0.0).means(
        "Sampling period of the controller, half of which counts as dead time; 0: the "
        "recording's, or continuous where there is no recording."
    )
    loop_delay: float = quantity(0.0, "s", lower=0.0).means(
        "Dead time that the controller's loop adds to the process."
    )
    noise_std: float = quantity(math.nan, "y", lower=0.0).means(
        "Standard deviation of the measurement noise; NaN: the recording's, or not known."
    )
    amplitude: float = quantity(math.nan, "u", lower=0.0).means(
        "How far the command may move; NaN: the relay's amplitude, or not known."
    )
    noise_share: float = quantity(0.1, lower=0.0, open_ended=True).means(
        "Largest standard deviation of the noise in the command that derivative action may cause, "
        "as a fraction of the amplitude."
    )
    filter_ratio: float = quantity(10.0, lower=0.0, open_ended=True).means("Largest td/tf.")
    closed_loop_time: float = quantity(
        math.nan, "s", lower=0.0, open_ended=True, flag="lambda"
    ).means("Lambda of imc, simc and unstable; NaN: the rule's own.")
    phase_peak: float = quantity(
        math.radians(-120.0), "rad", lower=-math.pi, upper=-0.5 * math.pi, open_ended=True
    ).means("Phase of the loop at its peak, for luyben2003.")
    resonance: float = quantity(2.0, "dB", lower=0.0, open_ended=True).means(
        "Closed-loop resonance, for luyben2003."
    )
    law: str = quantity("", choices=("", *LAWS)).means(
        "Law that the gains are for, exact at the sampling period, such as pid_controller; not "
        "given: controller_node's, with half a period as dead time."
    )

    def __post_init__(self) -> None:
        check(self, TuningError)

    @property
    def given_closed_loop_time(self) -> float | None:
        """Lambda as it was given [s]; None: the rule decides."""
        return None if math.isnan(self.closed_loop_time) else self.closed_loop_time

    @property
    def added_delay(self) -> float:
        """Dead time that the loop adds to the process: half a period of the hold, and its own [s].

        A sample that is held for a period lags by half of it on average.
        """
        held = LAWS[self.law or OWN_LAW].lag(self.sample_period)
        return held + self.loop_delay

    @property
    def runs(self) -> Law | None:
        """The law that the gains are for; None: none was named.

        :raises TuningError: if it was named without a sampling period.
        """
        if self.law == "":
            return None
        if self.sample_period == 0.0:
            raise TuningError(
                f"{self.law} runs at a sampling period, and none is known: give sample_period"
            )
        return LAWS[self.law]

    def largest_mt(self, model: TransferFunction) -> float:
        """Return the bound on Mt for a process.

        :param model: the process; integrating processes have their own default.
        """
        if not math.isnan(self.mt):
            return self.mt
        return MT_INTEGRATING if model.integrators > 0 else MT_SELF_REGULATING


@dataclass(frozen=True, kw_only=True)
class DesignTask:
    """A process for which a controller is to be designed.

    :param model: the process.
    :param options: what is asked for.
    :param simple: the FOPDT that fits best, for rules that need one; None: not known.
    :param models: models within the uncertainty; empty: the uncertainty is not known.
    :param describing: K_u and w_u by the describing function from the limit cycle; None: not
        known.
    """

    model: TransferFunction
    options: DesignOptions = field(default_factory=DesignOptions)
    simple: TransferFunction | None = None
    models: tuple[TransferFunction, ...] = ()
    describing: UltimatePoint | None = None

    def in_loop(self, model: TransferFunction) -> TransferFunction:
        """Return a process with the dead time that the loop adds to it.

        :param model: the process, or a model within its uncertainty.
        """
        return replace(model, dead_time=model.dead_time + self.options.added_delay)

    def held(self, model: TransferFunction) -> TransferFunction:
        """Return a process with the loop's own delay, but no dead time for the hold.

        :param model: the process, or a model within its uncertainty.
        """
        return replace(model, dead_time=model.dead_time + self.options.loop_delay)

    def runs(self, controller: Controller) -> SampledLaw | None:
        """Return the law that will run, with what it can do of a controller; None: not named.

        :param controller: the gains that a rule gives.
        """
        law, period = self.options.runs, self.options.sample_period
        return None if law is None else law.at(law.best(controller, period), period)

    def set_of(self, models: Sequence[TransferFunction]) -> ModelSet | HeldSet:
        """Return models as the loop has them.

        :param models: such as those within the uncertainty.
        """
        law = self.options.runs
        if law is None:
            return ModelSet([self.in_loop(model) for model in models])
        held = tuple(self.held(model) for model in models)
        return HeldSet(held, law, self.options.sample_period)

    @cached_property
    def around(self) -> ModelSet:
        """The models within the uncertainty, with the dead time that the loop adds to them."""
        return ModelSet([self.in_loop(model) for model in self.models])

    @cached_property
    def exact(self) -> ModelSet | HeldSet:
        """The models within the uncertainty, as the law that was named has them."""
        return self.around if self.options.runs is None else self.set_of(self.models)


def cautions(performance: Performance, task: DesignTask) -> tuple[str, ...]:
    """Return what the user must know before using gains, a sentence each.

    :param performance: of the gains on the model.
    :param task: what was asked for.
    """
    options, found = task.options, []
    bounds = {
        "Ms": (performance.ms, options.ms),
        "Mt": (performance.mt, options.largest_mt(task.model)),
    }
    for name, (value, asked) in bounds.items():
        if value > _HELD * asked:
            found.append(
                f"{name} is {value:.3g}, above the {asked:g} asked for; choose another rule, or "
                f"allow more by {name.lower()}"
            )
    noise = performance.noise_gain * options.noise_std
    known = options.sample_period > 0.0 and options.amplitude > 0.0
    if known and noise > _HELD * options.noise_share * options.amplitude:
        found.append(
            f"the noise alone moves the command by {noise:.3g} (standard deviation), "
            f"{100.0 * noise / options.amplitude:.0f} % of the relay's amplitude; filter the "
            "measurement, or ask for PI"
        )
    return tuple(found)
