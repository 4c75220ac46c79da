# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The checks before a tune, each with what it found and what to type if it failed."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TypeVar

import numpy as np
from rclpy.node import Node

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.experiment.narration import motion
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.settling import CONSTANT_SAMPLES, RestState, rest_state
from relay_autotune.nodes import quality
from relay_autotune.nodes.readiness import NotReadyError
from relay_autotune.record.record import Cycle
from relay_autotune.text import duration

_T = TypeVar("_T")

# Free space below which a recording is said to be at risk [bytes].
_LITTLE = 100_000_000
_NAME_WIDTH = 12
# The last samples that are kept, and the time that they may cover [s].
_KEPT, _WINDOW = 2000, 10.0


class Mark(Enum):
    """How a check ended: passed, passed with something to know, or a reason not to start."""

    OK = "ok"
    NOTE = "note"
    NO = "NO"


@dataclass(frozen=True)
class ChecklistLine:
    """One line of the checklist.

    :param mark: how it ended.
    :param name: what was looked at.
    :param found: what was found, and what to type if it failed.
    """

    mark: Mark
    name: str
    found: str

    def __str__(self) -> str:
        return f"{self.mark.value:<4}  {self.name:<{_NAME_WIDTH}}  {self.found}"


class Checklist:
    """Collect checks.

    :param node: full name of the node, for what to type.
    :param stops: True: the first check that fails raises its error; False: all checks are made.
    """

    def __init__(self, node: str, *, stops: bool) -> None:
        self.checks: list[ChecklistLine] = []
        self.refusal: RelayAutotuneError | None = None
        """The first check that failed; None: all passed."""
        self._node = node
        self.stops = stops
        """True if the first check that fails raises its error."""

    @property
    def lines(self) -> list[str]:
        """One line for each check."""
        return [str(check) for check in self.checks]

    def do(self, name: str, work: Callable[[], _T], found: Callable[[_T], str]) -> _T | None:
        """Make a check.

        :param name: what is looked at.
        :param work: returns what it finds, or raises the reason not to start.
        :param found: says what was found.
        :return: what was found; None: it failed.
        """
        try:
            value = work()
        except RelayAutotuneError as error:
            if self.stops:
                raise
            self.refusal = self.refusal or error
            typed = error.typed if isinstance(error, NotReadyError) else ""
            self._add(Mark.NO, name, str(error), typed)
            return None
        self._add(Mark.OK, name, found(value))
        return value

    def tell(self, name: str, found: str, *, good: bool = True, typed: str = "") -> None:
        """Add a line that is no reason not to start.

        :param name: what was looked at.
        :param found: what was found.
        :param good: False: there is something to know.
        :param typed: parameter and value to set where it is not good.
        """
        self._add(Mark.OK if good else Mark.NOTE, name, found, "" if good else typed)

    def _add(self, mark: Mark, name: str, found: str, typed: str = "") -> None:
        if typed:
            found += f"; type: ros2 param set {self._node} {typed}"
        self.checks.append(ChecklistLine(mark, name, found))


class LastSamples:
    """Keep the last measurements with their time of arrival."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, float]] = deque(maxlen=_KEPT)

    def add(self, value: float) -> None:
        """Take a measurement [y] that has arrived now."""
        self._kept.append((time.monotonic(), value))

    def forget(self) -> None:
        """Start again, since the command will change."""
        self._kept.clear()

    @property
    def interval(self) -> float:
        """Mean interval of the samples [s]; 0: not known."""
        if len(self._kept) < 2:
            return 0.0
        return (self._kept[-1][0] - self._kept[0][0]) / (len(self._kept) - 1)

    @property
    def newest(self) -> float | None:
        """The newest measurement [y]; None: none has come."""
        return self._kept[-1][1] if self._kept else None

    def _recent(self) -> list[tuple[float, float]]:
        since = time.monotonic() - _WINDOW
        return [sample for sample in self._kept if sample[0] >= since]

    def before(self) -> list[float]:
        """Return the measurements of the last seconds, or the last 20 of a slow sensor [y]."""
        recent = self._recent()
        if len(recent) < CONSTANT_SAMPLES:
            recent = list(self._kept)[-CONSTANT_SAMPLES:]
        return [value for _, value in recent]

    def rest(self) -> RestState | None:
        """Return how the measurement rested over the last seconds; None: there are too few."""
        recent = np.array(self._recent())
        if len(recent) < CONSTANT_SAMPLES:
            return None
        return rest_state(recent[:, 0] - recent[0, 0], recent[:, 1], len(recent))


def look_at_rest(checks: Checklist, samples: LastSamples) -> None:
    """Say whether the measurement is at rest.

    :param checks: where it is told.
    :param samples: the last measurements.
    """
    rest = samples.rest()
    if rest is None:
        checks.tell("at rest", "not known yet, since few samples have come", good=False)
    elif rest.is_steady:
        checks.tell(
            "at rest",
            f"{rest.mean:.6g} y with noise of {rest.noise_std:.2g} y over {duration(rest.span)}",
        )
    else:
        checks.tell(
            "at rest",
            f"no: {motion(rest)} over {duration(rest.span)}; wait until the process rests, else "
            f"the tune waits for that",
            good=False,
        )


def look_at_limits(checks: Checklist, parameters: ExperimentParameters) -> None:
    """Say which limits of the measurement are missing.

    :param checks: where it is told.
    :param parameters: the experiment's parameters.
    """
    low, high = parameters.measurement_min, parameters.measurement_max
    missing = [
        name
        for name, value in (("measurement_min", low), ("measurement_max", high))
        if math.isinf(value)
    ]
    if not missing:
        checks.tell("limits", f"a tune ends where the measurement leaves {low:g} to {high:g} y")
    elif parameters.max_deviation > 0.0:
        checks.tell(
            "limits",
            f"a tune ends where the measurement is {parameters.max_deviation:g} y from its rest",
        )
    else:
        checks.tell(
            "limits",
            f"{' and '.join(missing)} not given: nothing ends a tune whose measurement goes "
            f"too far that way",
            good=False,
            typed=f"{missing[0]} LIMIT",
        )


def look_at_recording(checks: Checklist, directory: str) -> None:
    """Say whether a recording can be written.

    :param checks: where it is told.
    :param directory: folder of the recordings.
    """
    folder = Path(directory).expanduser()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    typed = "record_directory FOLDER"
    if not (there.is_dir() and os.access(there, os.W_OK)):
        found = f"{there} cannot be written to: the tune would go on without a recording"
        checks.tell("recording", found, good=False, typed=typed)
        return
    free = shutil.disk_usage(there).free
    found = f"in {folder}, {free / 1e9:.3g} GB free"
    checks.tell("recording", found, good=free > _LITTLE, typed=typed)


def look_at_identifier(checks: Checklist, node: Node, topic: str) -> None:
    """Say whether model and gains will come.

    :param checks: where it is told.
    :param node: the node that tunes.
    :param topic: resolved name of the gains' topic.
    """
    found = ", ".join(quality.who(end) for end in node.get_publishers_info_by_topic(topic))
    if found:
        checks.tell("model", f"from {found}")
        return
    there = node.get_namespace()
    named = "" if there == "/" else f" --ros-args -r __ns:={there}"
    checks.tell(
        "model",
        f"no identifier_node: a recording alone, without model and gains; type: ros2 run "
        f"relay_autotune identifier_node{named}",
        good=False,
    )


def expected(parameters: ExperimentParameters, last: tuple[float, Cycle] | None) -> str:
    """Say how far the measurement will swing, by the last tune of the node.

    :param parameters: the experiment's parameters.
    :param last: amplitude of the last tune [u], and its last cycle; None: there is none.
    """
    if last is None:
        return "how far the measurement swings is not known before the first tune"
    amplitude, cycle = last
    ratio = parameters.amplitude / amplitude if parameters.amplitude else 1.0
    swing = 0.5 * (cycle.peak_max - cycle.peak_min) * ratio
    return f"a swing of about {swing:.2g} y each way in {duration(cycle.period)}, as last time"
