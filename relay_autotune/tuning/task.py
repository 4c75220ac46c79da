"""What a design rule is given: the process, what is known around it, and what is asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

from relay_autotune.errors import TuningError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint
from relay_autotune.tuning.model_set import ModelSet

CONTROLLERS = ("auto", "pi", "pid")
MS_RANGE = (1.2, 4.0)
# +2 dB is Luyben's bound on the resonance of the level of a vessel (2003).
MT_SELF_REGULATING, MT_INTEGRATING = 1.4, 1.26


@dataclass(frozen=True, kw_only=True)
class DesignOptions:
    """What is asked of a controller, the same for every rule; each rule reads what it needs.

    :param ms: largest magnitude of the sensitivity function that is allowed, 1.2 to 4.
    :param mt: largest magnitude of the complementary sensitivity function that is allowed, above
        1; None: 1.4, for an integrating process 1.26 (+2 dB).
    :param controller: "pi", "pid", or "auto": PI unless PID is worth it.
    :param sample_period: of the controller to be [s]; 0: continuous.
    :param loop_delay: dead time of the loop beside the process's own [s].
    :param noise_std: standard deviation of the measurement noise [y]; NaN: not known.
    :param amplitude: of the relay, the measure of what a command may move [u]; NaN: not known.
    :param noise_share: standard deviation of the noise in the command, over ``amplitude``, that
        derivative action may cause.
    :param filter_ratio: largest td/tf.
    :param closed_loop_time: lambda of internal model control and of the compensators [s]; None:
        the rule's default.
    :param phase_peak: phase of the loop at its peak (Luyben 2003) [rad].
    :param resonance: closed-loop resonance (Luyben 2003) [dB].
    :raises TuningError: if a value is out of its range.
    """

    ms: float = 1.4
    mt: float | None = None
    controller: str = "auto"
    sample_period: float = 0.0
    loop_delay: float = 0.0
    noise_std: float = math.nan
    amplitude: float = math.nan
    noise_share: float = 0.1
    filter_ratio: float = 10.0
    closed_loop_time: float | None = None
    phase_peak: float = math.radians(-120.0)
    resonance: float = 2.0

    def __post_init__(self) -> None:
        low, high = MS_RANGE
        if not low <= self.ms <= high:
            raise TuningError(f"ms must be from {low:g} to {high:g}, found {self.ms:g}")
        if self.mt is not None and not 1.0 < self.mt < math.inf:
            raise TuningError(f"mt must be above 1 and finite, found {self.mt:g}")
        if self.controller not in CONTROLLERS:
            raise TuningError(
                f"unknown controller {self.controller!r}; known: {', '.join(CONTROLLERS)}"
            )
        for name in ("sample_period", "loop_delay"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise TuningError(
                    f"{name} must be >= 0 s and finite, found {getattr(self, name):g} s"
                )
        for name in ("noise_std", "amplitude"):
            # NaN stands for what is not known.
            if getattr(self, name) < 0.0 or math.isinf(getattr(self, name)):
                raise TuningError(
                    f"{name} must be >= 0 and finite, or NaN where it is not known, "
                    f"found {getattr(self, name):g}"
                )
        for name in ("noise_share", "filter_ratio", "resonance"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise TuningError(f"{name} must be > 0 and finite, found {getattr(self, name):g}")
        if self.closed_loop_time is not None and not 0.0 < self.closed_loop_time < math.inf:
            raise TuningError(
                f"closed_loop_time must be > 0 s and finite, found {self.closed_loop_time:g} s"
            )
        if not -math.pi < self.phase_peak < -0.5 * math.pi:
            raise TuningError(
                "phase_peak must lie between -180 and -90 degrees, found "
                f"{math.degrees(self.phase_peak):g}"
            )

    @property
    def added_delay(self) -> float:
        """Dead time that the loop adds to the process: half a period of the hold, and its own [s].

        A sample that is held for a period lags by half of it on average.
        """
        return 0.5 * self.sample_period + self.loop_delay

    def largest_mt(self, model: TransferFunction) -> float:
        """Return the bound on Mt that holds for a process.

        :param model: the process; integrating ones have a default of their own.
        """
        if self.mt is not None:
            return self.mt
        return MT_INTEGRATING if model.integrators > 0 else MT_SELF_REGULATING


@dataclass(frozen=True, kw_only=True)
class DesignTask:
    """A process for which a controller is to be designed.

    :param model: the process.
    :param options: what is asked for.
    :param simple: the FOPDT that fits best, for rules that need one; None: not known.
    :param models: models within the uncertainty; empty: the uncertainty is not known.
    :param describing: K_u and w_u that the describing function reads from the limit cycle; None:
        not known.
    """

    model: TransferFunction
    options: DesignOptions = field(default_factory=DesignOptions)
    simple: TransferFunction | None = None
    models: tuple[TransferFunction, ...] = ()
    describing: UltimatePoint | None = None

    def in_loop(self, model: TransferFunction) -> TransferFunction:
        """Return a process with the dead time that the loop adds to it.

        :param model: the process, or one of those around it.
        """
        return replace(model, dead_time=model.dead_time + self.options.added_delay)

    @cached_property
    def around(self) -> ModelSet:
        """The models within the uncertainty, with the dead time that the loop adds to them."""
        return ModelSet([self.in_loop(model) for model in self.models])
