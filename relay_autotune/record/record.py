# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The record of one experiment: samples, settings, cycles."""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import RecordError
from relay_autotune.quantities import LARGEST, result_field
from relay_autotune.reasons import NONE, Reason
from relay_autotune.text import counted

# Difference of equal slopes, relative to the steepest one.
_STRAIGHT = 1e-12


_P = ParamSpec("_P")
_T = TypeVar("_T")


def one_record(given: object, caller: str) -> Record:
    """Return what was given, if it is a record.

    :param given: to a function for one record.
    :param caller: name of that function, for the message.
    :raises RecordError: if it is something else, such as the tuple of ``read_records``.
    """
    if isinstance(given, Record):
        return given
    if isinstance(given, tuple | list) and all(isinstance(each, Record) for each in given):
        raise RecordError(
            f"{caller} takes one record, found a {type(given).__name__} of {len(given)}: give "
            f"one of them, such as records[0], or all tests of one process to analyse_jointly"
        )
    raise RecordError(
        f"{caller} takes a Record, found {type(given).__name__}: make one with read_records, or "
        "with Record(time=..., measurement=..., command=...)"
    )


def cached_on_record(
    question: Callable[Concatenate[Record, _P], _T],
) -> Callable[Concatenate[Record, _P], _T]:
    """Let a record, which cannot change, remember the answer to a question.

    :param question: a function of a record, and of arguments that can be compared.
    """

    @wraps(question)
    def ask(record: Record, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        key = (question, args, tuple(kwargs.items()))
        if key not in record.answers:
            record.answers[key] = question(record, *args, **kwargs)
        answer: _T = record.answers[key]
        return answer

    return ask


def usual_before_moves(time: FloatArray, values: FloatArray) -> float:
    """Return the usual time from a value to one that differs from it [s].

    Where values were left out the one before may be long ago: the usual time counts then.

    :param time: s, not decreasing, shape (n,).
    :param values: at least two of them differ, shape (n,).
    """
    gaps = np.diff(time)
    return min(float(np.median(gaps)), float(np.median(gaps[np.diff(values) != 0.0])))


def roughness(y: FloatArray, used: np.ndarray | None = None) -> float:
    """Estimate white noise from second differences, which are small in a smooth signal [y].

    :param y: samples, shape (n,).
    :param used: which of the second differences are used, shape (n - 2,); None: all.
    """
    second = np.diff(y, 2)
    if used is not None:
        second = second[used]
    return (
        0.0 if second.size == 0 else float(np.median(np.abs(second))) / (0.6745 * math.sqrt(6.0))
    )


class Outcome(enum.IntEnum):
    """How an experiment ended; the values are those of RelayExperiment.msg.

    >>> from relay_autotune import Outcome
    >>> [outcome.name for outcome in Outcome]
    ['UNKNOWN', 'COMPLETED', 'ABORTED', 'FAILED']
    """

    UNKNOWN = 0
    COMPLETED = 1
    ABORTED = 2
    FAILED = 3

    @property
    def words(self) -> str:
        """How it ended, for people."""
        return "recorded elsewhere" if self is Outcome.UNKNOWN else self.name.lower()


@dataclass(frozen=True)
class RelaySettings:
    """The relay's settings in an experiment.

    >>> from relay_autotune import RelaySettings
    >>> relay = RelaySettings(setpoint=40.0, baseline=2.0, amplitude=1.0, bias=0.5)
    >>> relay.low, relay.high
    (1.5, 3.5)

    The command is ``baseline + bias + amplitude`` (high) or ``baseline + bias - amplitude``
    (low); a direct-acting relay goes low when the measurement rises to
    ``setpoint + hysteresis`` and high when it falls to ``setpoint - hysteresis``.
    """

    setpoint: float = result_field("y", nan=True, lower=-LARGEST, upper=LARGEST)
    """Measurement about which the relay switches."""
    baseline: float = result_field("u", lower=-LARGEST, upper=LARGEST)
    """Command of the operating point."""
    amplitude: float = result_field("u", lower=0.0, upper=LARGEST)
    """Half the distance of the two levels, mu."""
    bias: float = result_field("u", 0.0, lower=-LARGEST, upper=LARGEST)
    """Offset of their middle from the baseline, mu0."""
    hysteresis: float = result_field("y", 0.0, nan=True, lower=0.0, upper=LARGEST)
    """Half width of the switching band, epsilon."""
    extra_delay: float = result_field("s", 0.0, lower=0.0, upper=LARGEST)
    """Dead time that the relay added."""
    sample_period: float = result_field("s", 0.0, lower=0.0, upper=LARGEST)
    """Nominal period of the samples; 0: by their stamps."""
    reverse_acting: bool = result_field("", False)
    """True if a higher command lowers the measurement."""

    @property
    def high(self) -> float:
        """The upper command level [u]."""
        return self.baseline + self.bias + self.amplitude

    @property
    def low(self) -> float:
        """The lower command level [u]."""
        return self.baseline + self.bias - self.amplitude


@dataclass(frozen=True)
class CycleFeatures:
    """Features of a cycle, or their averages over several cycles.

    The times with the command high and low are T_u1 and T_u2 of Wang et al.
    """

    period: float = result_field("s", nan=True)
    """Whole period."""
    period_high: float = result_field("s", nan=True)
    """Time with the command high."""
    period_low: float = result_field("s", nan=True)
    """Time with the command low."""
    peak_max: float = result_field("y", nan=True)
    """Highest measurement, absolute."""
    peak_min: float = result_field("y", nan=True)
    """Lowest measurement, absolute."""
    time_to_peak_max: float = result_field("s", nan=True)
    """From the switch that turns the measurement down to the maximum."""
    time_to_peak_min: float = result_field("s", nan=True)
    """From the switch that turns the measurement up to the minimum."""
    mean_measurement: float = result_field("y", nan=True, message=None)
    """Time average of the measurement."""
    mean_command: float = result_field("u", nan=True, message=None)
    """Time average of the command."""

    @property
    def amplitude(self) -> float:
        """Half the swing of the measurement [y]."""
        return 0.5 * (self.peak_max - self.peak_min)


@dataclass(frozen=True)
class Cycle(CycleFeatures):
    """One whole cycle, from a switch to the high level to the next such switch."""

    index: int = result_field()
    """Number of the cycle in its experiment, from 0."""
    start: float = result_field("s", message=None)
    """Time of the switch that begins it, on the record's time axis."""
    converged: bool = result_field("", False)
    """True if it agrees with the cycles before it."""
    disturbed: bool = result_field("", False)
    """True if it should be left out of averages."""


@dataclass(frozen=True, eq=False)
class PiecewiseConstant:
    """A signal that holds ``values[k]`` from ``times[k]`` on, and ``initial`` before ``times[0]``.

    >>> from relay_autotune import PiecewiseConstant
    >>> valve = PiecewiseConstant(times=[10.0, 20.0], values=[3.0, 1.0], initial=2.0)
    >>> valve([0.0, 10.0, 25.0]).tolist()
    [2.0, 3.0, 1.0]

    :param times: instants of change, strictly increasing [s], shape (m,).
    :param values: level from each instant on, shape (m,).
    :param initial: level before the first instant.
    """

    times: FloatArray
    values: FloatArray
    initial: float

    def __post_init__(self) -> None:
        times = np.ascontiguousarray(self.times, dtype=np.float64)
        values = np.ascontiguousarray(self.values, dtype=np.float64)
        if times.ndim != 1 or times.shape != values.shape:
            raise RecordError(
                f"a piecewise-constant signal needs times and values of one shape (m,), "
                f"found {times.shape} and {values.shape}"
            )
        if times.size > 1 and not bool(np.all(np.diff(times) > 0.0)):
            raise RecordError("the instants of a piecewise-constant signal must increase strictly")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)

    @classmethod
    def from_samples(
        cls, times: FloatArray, values: FloatArray, before: float | None = None
    ) -> PiecewiseConstant:
        """Keep the changes of a held signal given by all its samples.

        :param times: instants of the samples, not decreasing [s], shape (n,), n >= 1; of equal
            instants the last one counts.
        :param values: the level from each instant on, shape (n,).
        :param before: the level before the first instant, which counts as one of change even
            where it is the same; None: not known.
        """
        times = np.asarray(times, dtype=np.float64)
        values = np.asarray(values, dtype=np.float64)
        last, initial = np.append(np.diff(times) > 0.0, True), float(values[0])
        times, values = times[last], values[last]
        if before is not None:
            initial = before
        # A change at the first instant of all is known by two values there.
        changed = np.diff(values, prepend=initial) != 0.0
        changed[0] |= before is not None
        return cls(times[changed], values[changed], initial)

    @property
    def levels(self) -> FloatArray:
        """The level before the first instant and from each on, shape (m + 1,)."""
        return np.append(self.initial, self.values)

    @property
    def steps(self) -> FloatArray:
        """By how much it steps at each instant, shape (m,)."""
        return np.diff(self.levels)

    def __call__(self, t: FloatArray) -> FloatArray:
        """Return the level in force at each time ``t`` [s], any shape."""
        return self.levels[np.searchsorted(self.times, t, side="right")]

    def slewed(self, rate: float) -> PiecewiseLinear:
        """Return what follows this signal no faster than at some rate.

        :param rate: per second.
        """
        times, slopes, level = [], [], self.initial
        following = np.append(self.times[1:], np.inf).tolist()
        for time, target, then in zip(
            self.times.tolist(), self.values.tolist(), following, strict=True
        ):
            slope = math.copysign(rate, target - level)
            arrives = time + (target - level) / slope
            times.append(time)
            slopes.append(slope)
            if arrives < then:
                times.append(arrives)
                slopes.append(0.0)
            level = target if arrives < then else level + slope * (then - time)
        distinct = np.append(np.diff(times) > 0.0, True)[: len(times)]
        return PiecewiseLinear(np.array(times)[distinct], np.array(slopes)[distinct], self.initial)


@dataclass(frozen=True)
class PiecewiseLinear:
    """A signal of straight lines, constant before the first instant and after the last.

    :param times: instants at which the slope changes, strictly increasing [s], shape (m,).
    :param slopes: per second from each instant on, shape (m,).
    :param initial: level before the first instant.
    """

    times: FloatArray
    slopes: FloatArray
    initial: float

    @property
    def steps(self) -> FloatArray:
        """By how much its slope steps at each instant [1/s], shape (m,)."""
        return np.diff(self.slopes, prepend=0.0)

    @classmethod
    def from_samples(cls, times: FloatArray, values: FloatArray) -> PiecewiseLinear:
        """Connect all samples of a continuous signal.

        :param times: instants of the samples, not decreasing [s], shape (n,), n >= 1; of equal
            instants the last one counts.
        :param values: the level at each instant, shape (n,).
        """
        last = np.append(np.diff(times) > 0.0, True)
        times, values = times[last], values[last]
        slopes = np.append(np.diff(values) / np.diff(times), 0.0)
        change = np.abs(np.diff(slopes, prepend=0.0))
        kept = change > _STRAIGHT * float(np.abs(slopes).max())
        return cls(times[kept], slopes[kept], float(values[0]))


# The input of a process.
Input = PiecewiseConstant | PiecewiseLinear


# Kinds of numpy's types that hold real numbers: booleans, integers, floats, Python's own numbers.
_REAL = "biufO"


def _as_column(name: str, value: object, length: int | None) -> FloatArray:
    given = np.asarray(value)
    if given.dtype.kind not in _REAL:
        raise RecordError(
            f"{name} of a record must hold real numbers, found {given.dtype}: give times in "
            "seconds, such as (t - t[0])/numpy.timedelta64(1, 's') of dates"
        )
    array = np.array(given, dtype=np.float64)
    if array.ndim != 1 or (length is not None and array.size != length):
        expected = "(n,)" if length is None else f"({length},)"
        raise RecordError(f"{name} of a record must have shape {expected}, found {array.shape}")
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Unthinned:
    """Properties of a record before its samples were averaged in blocks.

    :param interval: median time between its samples [s].
    :param noise: standard deviation of the noise of each [y].
    :param remark: what was done, a sentence.
    """

    interval: float
    noise: float
    remark: str


@dataclass(frozen=True, repr=False, eq=False)
class Record:
    """The immutable record of one experiment.

    >>> from relay_autotune import Record
    >>> Record(time=[0.0, 0.5, 1.0], measurement=[40.0, 40.2, 40.1], command=[2.0, 3.0, 3.0])
    <Record: 3 samples over 1 s, recorded elsewhere>

    ``command[i]`` is the answer to ``measurement[i]``; it was sent at ``command_time[i]`` and
    held until the next one. Rows of a table, where that is ``time[i]``, do not tell when since
    the row before it moved: gains allow for each instant, unless ``held_input`` has it.

    :param time: when each sample was taken, on the sensor's clock [s from the first sample],
        shape (n,), not decreasing.
    :param measurement: the samples [y], shape (n,), finite.
    :param command: the answers [u], shape (n,), finite.
    :param receive_time: when each sample arrived, on the relay's clock [s], shape (n,);
        default: ``time``.
    :param command_time: when each answer left, on the relay's clock [s], shape (n,);
        default: ``receive_time``.
    :param settings: the relay's settings; None where the record is no relay experiment.
    :param noise_std: standard deviation of the measurement noise [y]; NaN: not estimated.
    :param cycle_start: index of the first sample of each cycle; the last entry begins the cycle
        that was not finished, so m + 1 entries bound m whole cycles.
    :param outcome: how the experiment ended.
    :param reason: why it ended so, a sentence for people.
    :param why: the same for programs; its code is NONE where that is not known.
    :param experiment_id: the id that every message of the experiment carries.
    :param start: time of the first sample [s since the epoch]; 0: unknown.
    :param lost_samples: samples that the middleware is known to have lost.
    :param held_input: the command at its own instants [s on the axis of ``time``], for records
        whose commands do not answer samples (a foreign recording, an ideal relay); None: it
        follows from ``command`` and ``command_time``.
    :param continuous_command: True: the command moved along straight lines between its instants,
        as from an analogue controller; False: it was held.
    :param unseen: how long before its instant a change of the command may have come [s]; NaN: the
        time between rows in a table, else 0.
    :param unthinned: what it was before it was thinned; None: it was not.
    :param units: of the measurement, by "y", and of the command, by "u", as far as known.
    :ivar answers: answers that the record remembers, see :func:`cached_on_record`.
    :raises RecordError: if shapes differ, a value is not finite or beyond ``LARGEST``, the time
        goes backwards, or the noise or what is unseen is negative.
    """

    time: FloatArray
    measurement: FloatArray
    command: FloatArray
    receive_time: FloatArray = field(default_factory=lambda: np.empty(0))
    command_time: FloatArray = field(default_factory=lambda: np.empty(0))
    settings: RelaySettings | None = None
    noise_std: float = math.nan
    cycle_start: tuple[int, ...] = ()
    outcome: Outcome = Outcome.UNKNOWN
    reason: str = ""
    why: Reason = NONE
    experiment_id: str = ""
    start: float = 0.0
    lost_samples: int = 0
    held_input: PiecewiseConstant | None = None
    continuous_command: bool = False
    unseen: float = math.nan
    unthinned: Unthinned | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    answers: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        time = _as_column("time", self.time, None)
        n = time.size
        if n == 0:
            raise RecordError("a record needs at least one sample, found none")
        receive = self.receive_time if len(self.receive_time) else time
        sent = self.command_time if len(self.command_time) else receive
        columns = {
            "time": time,
            "measurement": _as_column("measurement", self.measurement, n),
            "command": _as_column("command", self.command, n),
            "receive_time": _as_column("receive_time", receive, n),
            "command_time": _as_column("command_time", sent, n),
        }
        for name, column in columns.items():
            wrong = np.flatnonzero(~(np.abs(column) <= LARGEST))
            if wrong.size:
                where, value = int(wrong[0]), float(column[wrong[0]])
                what = f"beyond {LARGEST:g}" if math.isfinite(value) else "not finite"
                raise RecordError(f"{name}[{where}] of the record is {value}, {what}")
            object.__setattr__(self, name, column)
        if bool(np.any(np.diff(time) < 0.0)):
            where = int(np.flatnonzero(np.diff(time) < 0.0)[0])
            raise RecordError(
                f"the time of the record goes backwards after sample {where}: "
                f"{time[where]:g} s, then {time[where + 1]:g} s"
            )
        starts = tuple(int(i) for i in self.cycle_start)
        if any(not 0 <= i < n for i in starts) or any(
            b <= a for a, b in itertools.pairwise(starts)
        ):
            raise RecordError(
                f"cycle_start must hold increasing sample numbers below {n}, found {starts}"
            )
        object.__setattr__(self, "cycle_start", starts)
        if math.isnan(self.unseen):
            object.__setattr__(self, "unseen", self._between_rows())
        if not 0.0 <= self.unseen <= LARGEST:
            raise RecordError(
                f"unseen of the record is {self.unseen:g} s, expected a time from 0 to {LARGEST:g}"
            )
        if self.noise_std < 0.0 or self.noise_std > LARGEST:
            raise RecordError(
                f"noise_std of the record is {self.noise_std:g}, expected a number from 0 to "
                f"{LARGEST:g}, or NaN where it was not measured"
            )

    def __getstate__(self) -> dict[str, Any]:
        # A copy begins without answers.
        return {**self.__dict__, "answers": {}}

    def __len__(self) -> int:
        return int(self.time.size)

    def __repr__(self) -> str:
        """Return what the record is, on one line; its samples are in its fields."""
        name = f" of {self.experiment_id}" if self.experiment_id else ""
        length = f"{counted(len(self), 'sample')} over {self.duration:.4g} s"
        return f"<Record{name}: {length}, {self.outcome.words}>"

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    @cached_on_record
    def interval(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def mean_interval(self) -> float:
        """Mean time between samples, gaps included [s]."""
        return self.duration / max(len(self) - 1, 1)

    @property
    def is_table(self) -> bool:
        """True if the command is known at the samples only, as in a table of rows."""
        own = self.settings is None and self.held_input is None and not self.continuous_command
        return own and bool(np.array_equal(self.command_time, self.time))

    def _between_rows(self) -> float:
        """Return the time between the rows of a table about changes of the command [s]; or 0."""
        if not (self.is_table and np.any(np.diff(self.command))):
            return 0.0
        if not self.is_of_changes:
            return usual_before_moves(self.time, self.command)
        gaps = np.diff(self.time)
        return float(np.min(gaps, where=gaps > 0.0, initial=self.interval))

    @property
    def is_of_changes(self) -> bool:
        """True if each row was written when one of its values changed, as in an archive.

        There the measurement moves by less in each row that the command made than in any other.
        """
        moved, by = np.diff(self.command) != 0.0, np.abs(np.diff(self.measurement))
        some = bool(np.any(moved)) and not np.all(moved)
        return some and bool(by[moved].max() < by[~moved].min())

    @property
    @cached_on_record
    def noise(self) -> float:
        """The noise measured before the test, or else estimated from second differences [y]."""
        return self.noise_std if math.isfinite(self.noise_std) else roughness(self.measurement)

    def part(self, low: int, high: int, known: int = 0) -> Record:
        """Return some of the samples; the command's history is kept.

        Without what came before, the process would seem to begin at rest.

        :param low: index of the first sample to keep.
        :param high: index of the first one after it not to keep.
        :param known: index of the sample before which the command is not known.
        """
        if low == 0 and high == len(self):
            return self
        origin = float(self.time[low])
        held = self.held_input
        if low > 0 or held is not None:
            whole = self.input()
            if known:
                past = int(np.searchsorted(whole.times, self.time[known], side="right"))
                whole = PiecewiseConstant(
                    whole.times[past:], whole.values[past:], float(whole.levels[past])
                )
            held = PiecewiseConstant(whole.times - origin, whole.values, whole.initial)
        kept = slice(low, high)
        return replace(
            self,
            time=self.time[kept] - origin,
            measurement=self.measurement[kept],
            command=self.command[kept],
            receive_time=self.receive_time[kept] - origin,
            command_time=self.command_time[kept] - origin,
            cycle_start=tuple(i - low for i in self.cycle_start if low <= i < high),
            start=self.start + origin if self.start else 0.0,
            held_input=held,
        )

    @cached_on_record
    def input(self) -> PiecewiseConstant:
        """Return the command at the process, on the clock of the samples.

        Sensor and relay may run on different clocks, so only the relay's own interval between
        receiving and answering is used. The smallest lag from stamp to arrival is taken as the
        offset of the clocks. So a constant transport delay counts as dead time of the loop, as
        a controller in place of the relay would see it.
        """
        if self.held_input is not None:
            return self.held_input
        return PiecewiseConstant.from_samples(self._sent(), self.command)

    def _sent(self) -> FloatArray:
        """Return when each command reached the process, on the clock of the samples [s]."""
        offset = float(np.min(self.receive_time - self.time))
        return np.maximum.accumulate(self.command_time - offset)

    def drive(self) -> Input:
        """Return the input of the process: :meth:`input`, or straight lines between its points.

        For a command that is held between its instants, the staircase is exact. A command that
        moves between its samples is half an interval ahead of that staircase.
        """
        if not self.continuous_command:
            return self.input()
        held = self.held_input
        if held is not None:
            return PiecewiseLinear.from_samples(held.times, held.values)
        return PiecewiseLinear.from_samples(self._sent(), self.command)
