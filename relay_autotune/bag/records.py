# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The records in a recording, for programs that need nothing else of it."""

from __future__ import annotations

from pathlib import Path

from relay_autotune.bag.reader import Selection, read_experiments
from relay_autotune.record.record import Record


def read_records(
    path: Path | str,
    *,
    measurement: str | None = None,
    command: str | None = None,
    time: str | None = None,
    start: float | None = None,
    end: float | None = None,
) -> tuple[Record, ...]:
    """Return the experiments in a recording.

    >>> from relay_autotune import read_records
    >>> read_records("bags/heater.csv")
    (<Record: 450 samples over 898 s, recorded elsewhere>,)
    >>> (record,) = read_records("bags/step_test", measurement="/reactor/temperature",
    ...                          command="/reactor/heater")

    :param path: a rosbag2 directory, an MCAP file, or a CSV file with a header line.
    :param measurement: topic or column of the measurement; None: found.
    :param command: topic or column of the command; None: found.
    :param time: column of the time [s] in a CSV file; None: the first.
    :param start: beginning of the part to use [s from the first sample]; None: all.
    :param end: end of the part to use [s from the first sample]; None: all.
    :raises BagError: if it cannot be read, or the choice of topics or columns does not fit.
    """
    wanted = Selection(measurement, command, time, start, end)
    return read_experiments(path, wanted).experiments
