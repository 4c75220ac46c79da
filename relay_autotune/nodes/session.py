# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""One experiment in relay_node: its time base, its stamps and its recording."""

from __future__ import annotations

import array
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

# numpy imports this at its first median; load it now, since it takes 20 ms in a tune.
import numpy.ma

from relay_autotune.exchange.messages import start_seconds
from relay_autotune.experiment.early_end import EarlyEnd
from relay_autotune.experiment.experiment import RelayExperiment, State
from relay_autotune.experiment.faults import ClockWatch
from relay_autotune.nodes.lockstep import QUIET_AFTER_GO
from relay_autotune.record.record import Record

# A measurement waits no longer than this for its callback, unless a clock was set back [ns].
_LONGEST_WAIT_NS = 1_000_000_000


class Session:
    """A relay experiment fed with the samples of a topic.

    The time of a sample is the first of these that applies: ``k * sample_period`` for sample k, if
    a sample period is given; the node's clock, if it is simulated; the time of arrival, if samples
    are repeated, so that samples and repeats are on one clock; the middleware's source stamp.

    :param experiment: the state machine.
    :param experiment_id: the id that every message of the experiment carries.
    :param sample_period: period of the samples [s]; 0: they are stamped.
    :param clock: the simulated clock [ns]; None: time is real.
    :param repeats: True if a measurement is a sample again while the sensor is silent.
    :param one_clock: True if the stamp of a sample is the time of the command, too.
    """

    def __init__(
        self,
        experiment: RelayExperiment,
        experiment_id: str,
        *,
        sample_period: float = 0.0,
        clock: Callable[[], int] | None = None,
        repeats: bool = False,
        one_clock: bool = False,
    ) -> None:
        self.experiment = experiment
        self.id = experiment_id
        self.start_ns = 0
        self.published_cycles = 0
        self.told_state = State.SETTLING
        self.early: EarlyEnd | None = None
        """Ends the experiment once an interval is narrow enough; None: not used."""
        self.lost_samples = 0
        self._step = experiment.step
        self._period = sample_period
        self._clock = clock
        self._one_clock = one_clock
        self._count = 0
        self._last = (0, 0, 0.0, 0.0)
        self._first_answer_ns = 0
        self._repeated_ns = 0
        self.may_be_no_repeat = False
        self._received_ns = array.array("q")
        self._sent_ns = array.array("q")
        self.clocks = ClockWatch()
        self._record_sample: Callable[[tuple[int, int, float, int, float]], None] | None = None
        if sample_period > 0.0:
            self.answer = self._answer_by_number
        elif clock is not None:
            self.answer = self._answer_by_clock
        elif repeats:
            self.answer = self._answer_by_arrival
        else:
            self.answer = self._answer_by_stamp

    answer: Callable[[float, Mapping[str, Any]], float | None]
    """Take a measurement and its message info; return the command, or None for no answer."""

    def record_with(self, sample: Callable[[tuple[int, int, float, int, float]], None]) -> None:
        """Hand each sample and its answer to ``sample``, once the answer is out."""
        self._record_sample = sample

    @property
    def sample_count(self) -> int:
        """Number of samples answered."""
        return self._count

    @property
    def has_news(self) -> bool:
        """True if a cycle or a state is not told yet, or the early end must be checked."""
        experiment = self.experiment
        if experiment.cycle_count != self.published_cycles:
            return True
        if experiment.state is not self.told_state:
            return True
        return self.early is not None and self.early.is_due(experiment)

    def repeat(self, measurement: float, ago: float = 0.0) -> float:
        """Take the last measurement for a sample again; return the command.

        :param measurement: the sensor's last value, possibly from before the tune [y].
        :param ago: age of the repeated sample [s].
        """
        now = self.now_ns() - round(1e9 * ago)
        if self._count == 0:
            self.start_ns = now
        self._count += 1
        self._repeated_ns = now
        command = self.experiment.repeat((now - self.start_ns) * 1e-9, measurement)
        self._last = (now, now, measurement, command)
        return command

    def now_ns(self) -> int:
        """Return the present time on the clock of the experiment [ns]."""
        return time.time_ns() if self._clock is None else self._clock()

    def answered(self) -> None:
        """Note that the last answer was sent; to be called right after sending."""
        received, source, measurement, command = self._last
        if self._period > 0.0 or self._one_clock:
            # Sample number and period, or the stamps, are the only clock of such an experiment.
            received = sent = source
        elif self._clock is not None:
            sent = self._clock()
        else:
            sent = time.time_ns()
        self._received_ns.append(received)
        self._sent_ns.append(sent)
        if self._record_sample is not None:
            self._record_sample((received, source, measurement, sent, command))

    def record(self) -> Record:
        """Return the whole record.

        :raises RecordError: if there was no sample.
        """
        received = (np.array(self._received_ns) - self.start_ns) * 1e-9
        sent = (np.array(self._sent_ns) - self.start_ns) * 1e-9
        by_number = self._period > 0.0
        return self.experiment.record(
            receive_time=None if by_number else received,
            command_time=None if by_number else sent,
            start=start_seconds(self.start_ns),
            lost_samples=self.lost_samples,
        )

    def _answer_by_stamp(self, measurement: float, info: Mapping[str, Any]) -> float:
        received = info["received_timestamp"] or time.time_ns()
        source = info["source_timestamp"] or received
        if self._one_clock:
            # A simulated robot's clock may run at another pace than ours.
            received = source
        if self._count == 0:
            self.start_ns = source
        self._count += 1
        command: float = self._step((source - self.start_ns) * 1e-9, measurement)
        # Relative to the first sample: a float of seconds since 1970 cannot hold microseconds.
        start = self.start_ns
        stepped = self.clocks.add((source - start) * 1e-9, (received - start) * 1e-9)
        if stepped:
            command = self.experiment.abort(stepped)
        self._last = (received, source, measurement, command)
        return command

    def _answer_by_arrival(self, measurement: float, info: Mapping[str, Any]) -> float:
        received = info["received_timestamp"] or time.time_ns()
        if self._count == 0:
            self.start_ns = received
        elif 0 < self._repeated_ns - received < _LONGEST_WAIT_NS:
            # The message waited in the queue while the value before it was repeated.
            received = self._repeated_ns
        self._count += 1
        command: float = self._step((received - self.start_ns) * 1e-9, measurement)
        self._last = (received, received, measurement, command)
        return command

    def _answer_by_clock(self, measurement: float, _: Mapping[str, Any]) -> float:
        assert self._clock is not None
        now = self._clock()
        if self._count == 0:
            self.start_ns = now
        self._count += 1
        command: float = self._step((now - self.start_ns) * 1e-9, measurement)
        self._last = (now, now, measurement, command)
        return command

    def _answer_by_number(self, measurement: float, info: Mapping[str, Any]) -> float | None:
        k = self._count
        if k == 0:
            self.start_ns = info["source_timestamp"] or time.time_ns()
        elif k == 1 and self._repeats(measurement, info["source_timestamp"]):
            return None
        self._count = k + 1
        sampled = k * self._period
        command: float = self._step(sampled, measurement)
        stamp = self.start_ns + round(sampled * 1e9)
        self._last = (stamp, stamp, measurement, command)
        if k == 0:
            self._first_answer_ns = time.time_ns()
        return command

    def _repeats(self, measurement: float, source: int | None) -> bool:
        if source is None:
            return False
        since_answer = (source - self._first_answer_ns) * 1e-9
        if since_answer < 0.0:
            return True
        crossed = measurement == self._last[2] and since_answer < 0.5 * QUIET_AFTER_GO
        self.may_be_no_repeat = crossed
        return crossed

    def answer_after_all(self) -> float | None:
        """Answer the sample that `answer` dropped as a repeat, if no sample has followed."""
        if not self.may_be_no_repeat or self._count != 1:
            return None
        self.may_be_no_repeat = False
        return self._answer_by_number(self._last[2], {"source_timestamp": None})
