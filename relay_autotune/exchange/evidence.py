# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Checks of a model and of gains against the experiment that they are said to be of.

Anybody who may publish on a topic can publish a model or gains. The record shows the response of
the process at the frequency of its oscillation, and its direction. A model that contradicts it,
and gains that do not go with that frequency, are refused.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.errors import IdentificationError, ModelError, ParameterError, TuningError
from relay_autotune.experiment.early_end import FitProgress
from relay_autotune.identification.limit_cycle.fourier import FrequencyPoint, frequency_point
from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.cycles import is_switched
from relay_autotune.record.record import Outcome, Record

# Largest ratio of the responses of model and record, and largest difference of phase [rad].
_FACTOR = 10.0
_TURN = 2.0
# Largest ratio where the response is known by peak to peak alone, for lack of a whole cycle.
_ROUGH_FACTOR = 30.0
# Least and largest gain of the loop at the frequency of the oscillation.
_LEAST_LOOP, _LARGEST_LOOP = 1e-3, 10.0
# Least and largest time of a controller, in periods of the oscillation.
_LEAST_TIME, _LARGEST_TIME = 1e-3, 1e4
# Largest number of poles: no structure that is fitted has more.
_LARGEST_ORDER = 30


@dataclass(frozen=True)
class ExperimentFacts:
    """What is known of one experiment.

    :param outcome: how it ended; UNKNOWN: it still runs, or it is not known.
    :param duration: of the record [s].
    :param frequency: of the oscillation [rad/s]; NaN: the record has none.
    :param answer: G at that frequency [y/u], where ``whole``; else its magnitude alone.
    :param whole: True if there is a whole cycle.
    :param sign: sign of the process's gain that the relay assumed; 0: not known.
    """

    outcome: Outcome
    duration: float
    frequency: float = math.nan
    answer: complex = complex(math.nan)
    whole: bool = False
    sign: int = 0

    @classmethod
    def of(cls, record: Record) -> ExperimentFacts:
        """Return the facts of a record.

        :param record: of the experiment.
        """
        moved = float(np.ptp(record.command))
        swing = float(np.ptp(record.measurement))
        sign, settings = 0, record.settings
        if settings is not None:
            sign = -1 if settings.reverse_acting else int(is_switched(record))
        found = cls(record.outcome, record.duration, sign=sign)
        if not (moved > 0.0 and swing > 0.0):
            return found
        point, whole = _fundamental(record), True
        frequency, answer = point.frequency, point.value
        if not abs(answer) > 0.0:
            changes = record.input().times
            frequency = math.pi / float(np.diff(changes)[-1]) if changes.size > 1 else math.nan
            answer, whole = complex(swing / moved), False
        if not (frequency > 0.0 and 0.0 < abs(answer) < math.inf):
            return found
        return replace(found, frequency=frequency, answer=answer, whole=whole)

    @property
    def period(self) -> float:
        """Period of the oscillation [s]; NaN: the record has none."""
        return 2.0 * math.pi / self.frequency

    def require_completed(self) -> None:
        """Refuse gains of an experiment that was not completed.

        :raises TuningError: if it was not.
        """
        if self.outcome is not Outcome.COMPLETED:
            how = "is still running" if self.outcome is Outcome.UNKNOWN else "did not complete"
            raise TuningError(
                f"the experiment {how} ({self.outcome.name}): gains come of completed ones alone"
            )

    def check_model(self, model: TransferFunction) -> None:
        """Refuse a model that cannot be of this experiment.

        :param model: said to be its model.
        :raises ModelError: if the record contradicts it.
        """
        if model.order > _LARGEST_ORDER:
            raise ModelError(
                f"the model has {model.order} poles, expected {_LARGEST_ORDER} or less"
            )
        if model.dead_time > max(self.duration, 0.0):
            raise ModelError(
                f"the model's dead time is {model.dead_time:g} s, longer than the whole "
                f"experiment, {self.duration:g} s"
            )
        if self.sign and model.process_sign != self.sign:
            raise ModelError(
                f"the model's gain is {model.gain:g}, of the other sign than the process had in "
                f"the experiment"
            )
        if math.isnan(self.frequency):
            return
        with np.errstate(all="ignore"):
            said = complex(model(1j * self.frequency))
        ratio = said / self.answer if self.whole else abs(said) / abs(self.answer)
        factor = _FACTOR if self.whole else _ROUGH_FACTOR
        # A ratio that is not a number is refused, too.
        if not 1.0 / factor <= abs(ratio) <= factor:
            raise ModelError(
                f"the model answers with {abs(said):.3g} y/u at {self.frequency:.3g} rad/s, where "
                f"the experiment measured {abs(self.answer):.3g} y/u"
            )
        if self.whole and abs(math.atan2(ratio.imag, ratio.real)) > _TURN:
            raise ModelError(
                f"the model's answer at {self.frequency:.3g} rad/s is turned by "
                f"{math.degrees(math.atan2(ratio.imag, ratio.real)):.0f} degrees from that which "
                f"the experiment measured"
            )

    def check_gains(self, gains: Controller, model: TransferFunction) -> None:
        """Refuse gains that cannot be of this experiment and its model.

        :param gains: said to be of it.
        :param model: that passed :meth:`check_model`.
        :raises TuningError: if the experiment did not complete, or they make no stable loop of
            the right sign and size.
        """
        self.require_completed()
        if math.copysign(1.0, gains.kc) != model.process_sign:
            raise TuningError(
                f"kc is {gains.kc:g}, expected the sign of the process, whose gain is "
                f"{model.gain:g}: this would drive the loop away"
            )
        if math.isnan(self.frequency):
            raise TuningError(
                "the experiment shows no oscillation that gains could be compared with"
            )
        for name in ("ti", "td", "tf"):
            parts = getattr(gains, name) / self.period
            least = _LEAST_TIME if name == "ti" and gains.ti > 0.0 else 0.0
            if not least <= parts <= _LARGEST_TIME:
                raise TuningError(
                    f"{name} is {getattr(gains, name):g} s, which does not go with a period of "
                    f"{self.period:.3g} s in the experiment"
                )
        if not 0.0 <= gains.b <= 1.0:
            raise TuningError(f"the weight of the set-point is {gains.b:g}, expected 0 to 1")
        with np.errstate(all="ignore"):
            s = np.array([1j * self.frequency])
            size = float(np.abs(gains(s) * self.answer)[0])
        if not _LEAST_LOOP <= size <= _LARGEST_LOOP:
            raise TuningError(
                f"kc {gains.kc:g} makes a loop gain of {size:.3g} at the frequency of the "
                f"oscillation, {self.frequency:.3g} rad/s; expected {_LEAST_LOOP:g} to "
                f"{_LARGEST_LOOP:g}"
            )


def _fundamental(record: Record) -> FrequencyPoint:
    """Return the process at the frequency of the oscillation; NaN: the record has none.

    The first half of the cycles may still be settling.
    """
    ends = record.time[list(record.cycle_start[len(record.cycle_start) // 2 - 1 :])]
    if ends.size > 1 and ends[-1] > ends[0]:
        with suppress(IdentificationError):
            return frequency_point(record, ends)
    return FrequencyPoint(math.nan, complex(math.nan))


def check_finding(
    found: FitProgress, *, sign: int, amplitude: float = math.nan, relay: float = math.nan
) -> None:
    """Refuse a finding that contradicts a running experiment.

    :param found: the finding.
    :param sign: that of the process; 0: not known.
    :param amplitude: half of peak to peak of its last cycle [y]; NaN: there is none.
    :param relay: half the distance of its levels [u]; NaN: not known.
    :raises ParameterError: if K_u has the other sign, or is far from that of the describing
        function, 4 mu/(pi a).
    """
    gain = found.ultimate_gain
    if math.isnan(gain):
        return
    if sign and gain * sign <= 0.0:
        raise ParameterError(
            f"K_u is {gain:g}, of the other sign than the process has in the experiment"
        )
    rough = 4.0 * relay / (math.pi * amplitude) if amplitude > 0.0 else math.nan
    if rough > 0.0 and not 1.0 / _ROUGH_FACTOR <= abs(gain) / rough <= _ROUGH_FACTOR:
        raise ParameterError(
            f"K_u is {gain:.3g} u/y, where the oscillation shows about {sign * rough:.3g} u/y"
        )
