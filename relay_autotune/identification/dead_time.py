"""The dead time of a process, as the record of a relay test shows it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.cycle_scatter import Stretch
from relay_autotune.identification.known import Known
from relay_autotune.identification.symmetric_cycle import half_cycles
from relay_autotune.kick import ResponseDetector
from relay_autotune.record import Record, RelaySettings
from relay_autotune.settling import RestState

FloatArray = NDArray[np.float64]

# Thyagarajan and Yu 2003: time from the peak to 0.9 of it over that to half of it. A FOPDT process
# has 0.18 to 0.20 at any dead time, smooth peaks 0.37 and more.
_SHARP = 0.25
_BINS = 100


@dataclass(frozen=True)
class DeadTime:
    """Where the dead time of the process comes from.

    :param value: s; NaN: the time from the switch to the peak of each cycle, less ``extra``.
    :param extra: dead time that the relay added [s].
    :param source: a sentence for the user; empty: it was given.
    """

    value: float
    extra: float
    source: str

    def of(self, stretch: Stretch) -> float:
        """Return the dead time of the process by one stretch [s]."""
        if not math.isnan(self.value):
            return self.value
        return max(time_to_peak(stretch) - self.extra, 0.0)


def time_to_peak(stretch: Stretch) -> float:
    """Return the mean time from a switch to the peak after it [s]."""
    return 0.5 * (stretch.cycle.time_to_peak_max + stretch.cycle.time_to_peak_min)


def read_dead_time(stretch: Stretch, record: Record, known: Known) -> DeadTime:
    """Return the dead time that is known, or read it from the record.

    One lag turns at once when the command arrives, so that the time from a switch to the peak is
    the dead time; it is taken where the peaks are sharp. Otherwise it is the time from the first
    kick to the first sample outside the noise.

    :param stretch: the cycles.
    :param record: the whole record, with the samples before the kick.
    :param known: a known dead time.
    :raises IdentificationError: if it is not known and the record does not show it.
    """
    extra = stretch.settings.extra_delay
    if not math.isnan(known.dead_time):
        return DeadTime(known.dead_time, extra, "")
    if _peaks_are_sharp(stretch):
        value = time_to_peak(stretch) - extra
        source = (
            f"the dead time of {value:.4g} s was read as the time from the switch to the sharp "
            "peak; give it where it is known better, since these equations are sensitive to it"
        )
        return DeadTime(math.nan, extra, source)
    first = _first_response(record, stretch.settings)
    if math.isnan(first):
        raise IdentificationError(
            "the dead time is not known, and neither sharp peaks nor a first kick from rest show "
            "it in the record: give the dead time, or use the method waveform"
        )
    value = max(first - extra, 0.0)
    source = (
        f"the dead time of {value:.4g} s was read from the first response to the kick, which a "
        "slow beginning or noise delays; give it where it is known better"
    )
    return DeadTime(value, extra, source)


def _first_response(record: Record, settings: RelaySettings) -> float:
    """Return the time from the first kick to the response; NaN: there was no kick from rest."""
    u = record.input()
    resting = abs(u.initial - settings.baseline) < 0.5 * settings.amplitude
    if u.times.size == 0 or not resting or u.times[0] < record.time[0]:
        return math.nan
    kick = float(u.times[0])
    before = record.measurement[record.time <= kick]
    if before.size == 0:
        return math.nan
    noise = record.noise_std
    if math.isnan(noise):
        noise = float(np.std(before)) if before.size >= 10 else 0.0
    # Without noise rounding is what is left.
    floor = 1e-9 * float(np.ptp(record.measurement))
    rest = RestState(
        mean=float(np.mean(before)),
        slope=0.0,
        noise_std=max(noise, floor),
        span=float(kick - record.time[0]),
        samples=before.size,
        range_seen=float(np.ptp(before)),
    )
    detector = ResponseDetector(rest, kick)
    for time, y in zip(record.time.tolist(), record.measurement.tolist(), strict=True):
        if time > kick and detector.add(time, y):
            return 0.5 * (detector.last_inside + detector.first_outside) - kick
    return math.nan


def _peaks_are_sharp(stretch: Stretch) -> bool:
    since, y = half_cycles(stretch)
    if y.size < 4:
        return False
    half = 0.5 * stretch.cycle.period
    bins = min(_BINS, max(y.size // 4, 4))
    number = np.minimum((since / half * bins).astype(np.int64), bins - 1)
    count = np.bincount(number, minlength=bins)
    used = count > 0
    level = np.bincount(number, y, bins)[used] / count[used]
    time = np.bincount(number, since, bins)[used] / count[used]
    top = int(np.argmax(level))
    falling, after = level[top:] / level[top], time[top:] - time[top]
    if not falling[-1] < 0.5 or not level[top] > 0.0:
        return False

    def reached(share: float) -> float:
        k = int(np.argmax(falling < share))
        return float(np.interp(-share, -falling[k - 1 : k + 1], after[k - 1 : k + 1]))

    return reached(0.9) < _SHARP * reached(0.5)
