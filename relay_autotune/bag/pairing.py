# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which of a bag's signals could be the measurement and the command of one loop."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.bag.signals import Signal

_WORDS = {
    "set-point": "setpoint reference ref target desired goal",
    "command": "command cmd commands u actuator heater valve pump voltage pwm duty effort drive",
    "measurement": "measurement measured measure y pv sensor feedback temperature temp level flow "
    "pressure speed velocity position angle rpm height",
}

# Largest number of levels of a signal that steps between them.
_MOST_LEVELS = 12

# Least number of samples that can show a response.
_FEWEST_SAMPLES = 10


@dataclass(frozen=True)
class Character:
    """What a signal looks like.

    :param kind: ``empty``, ``constant``, ``two-level``, ``steps`` or ``varies``.
    :param text: the same as text.
    """

    kind: str
    text: str


@dataclass(frozen=True)
class Pair:
    """A measurement and a command that may belong to one loop, and why."""

    measurement: Signal
    command: Signal
    reason: str


def characterise(signal: Signal) -> Character:
    """Return what a signal looks like, by its values alone."""
    n = len(signal)
    if n == 0:
        return Character("empty", "no messages")
    finite = signal.values[np.isfinite(signal.values)]
    levels = np.unique(finite).size
    switches = int(np.count_nonzero(np.diff(signal.values)))
    if levels <= 1:
        return Character("constant", f"constant in {n} messages")
    if levels == 2:
        return Character("two-level", f"two levels, {switches} switches in {n} messages")
    if levels <= _MOST_LEVELS:
        return Character("steps", f"steps between {levels} levels in {n} messages")
    return Character("varies", f"varies over {levels} values in {n} messages")


def role_by_name(name: str) -> str | None:
    """Return what a topic's name says: set-point, command, measurement, or None."""
    last = name.rstrip("/").rsplit("/", 1)[-1].lower()
    if last == "controller_command":
        # What a controller wants is not what the process gets.
        return "set-point"
    words = set(re.split(r"[^a-z]+", last))
    for role, known in _WORDS.items():
        if words & set(known.split()) or (role == "set-point" and {"set", "point"} <= words):
            return role
    return None


def plausible_pairs(signals: Sequence[Signal], given: str | None = None) -> list[Pair]:
    """Return the pairs that look like measurement and command of one loop, likeliest kind only.

    A pair whose names tell its roles comes before one whose names do not; then a pair within one
    namespace comes before one across two.

    :param signals: the recording's numeric signals.
    :param given: name of a signal that the user chose; it may look like anything.
    """
    looks = {signal.name: characterise(signal) for signal in signals}
    found = []
    for measurement, command in itertools.permutations(signals, 2):
        names = (measurement.name, command.name)
        if given is not None and given not in names:
            continue
        if (
            (names[0] == given or _may_be_measurement(measurement, looks[names[0]].kind))
            and (names[1] == given or _may_be_command(command, looks[names[1]].kind))
            and _overlap(measurement, command)
        ):
            named = (role_by_name(names[0]) == "measurement") + (
                role_by_name(names[1]) == "command"
            )
            together = _namespace(names[0]) == _namespace(names[1])
            reason = "; ".join(f"{name} {looks[name].text}" for name in names)
            found.append(((named, together), Pair(measurement, command, reason)))
    best = max((rank for rank, _ in found), default=None)
    return [pair for rank, pair in found if rank == best]


def _may_be_measurement(signal: Signal, kind: str) -> bool:
    role = role_by_name(signal.name)
    if role not in ("measurement", None) or len(signal) < _FEWEST_SAMPLES:
        return False
    return kind in ("steps", "varies") or (kind == "two-level" and role == "measurement")


def _may_be_command(signal: Signal, kind: str) -> bool:
    role = role_by_name(signal.name)
    if role not in ("command", None):
        return False
    return kind in ("two-level", "steps") or (kind == "varies" and role == "command")


def _overlap(measurement: Signal, command: Signal) -> bool:
    # A command holds, so that one before the first sample counts as well.
    if len(measurement) == 0 or len(command) == 0:
        return False
    return bool(command.time_ns[0] <= measurement.time_ns[-1])


def _namespace(name: str) -> str:
    return name.rsplit("/", 1)[0]
