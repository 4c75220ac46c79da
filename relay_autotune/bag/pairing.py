# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which signals of a bag could be the measurement and the command of one loop.

They are found by their names and values, those of a joint by its name in a robot's recording.
"""

from __future__ import annotations

import difflib
import itertools
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.bag.field_path import (
    NAME_LISTS,
    Element,
    Step,
    names_in,
    numeric_paths,
    reading,
    steps_of,
    written,
)
from relay_autotune.bag.limits import MOST_SEARCHED
from relay_autotune.bag.signals import Selection, Signal, flags_of
from relay_autotune.bag.topics import Topics, split_name
from relay_autotune.bag.words import SETPOINT, doubts_about, role_of
from relay_autotune.errors import FieldError, NotThereError, SelectionError, visible

# Largest number of levels of a signal that steps between them.
_MOST_LEVELS = 12

# Least number of samples that can show a response.
_FEWEST_SAMPLES = 10


# Names of a measurement and of a command that may belong to one loop, and why.
Pair = tuple[str, str, str]


def look_of(signal: Signal) -> tuple[int, str]:
    """Return how many finite values a signal takes, and what it looks like, as text."""
    n = len(signal)
    levels = int(np.unique(signal.values[np.isfinite(signal.values)]).size)
    if n == 0:
        return levels, "no messages"
    if levels <= 1:
        return levels, f"constant in {n} messages"
    if levels == 2:
        switches = int(np.count_nonzero(np.diff(signal.values)))
        return levels, f"two levels, {switches} switches in {n} messages"
    if levels <= _MOST_LEVELS:
        return levels, f"steps between {levels} levels in {n} messages"
    return levels, f"varies over {levels} values in {n} messages"


def role_by_name(name: str) -> str | None:
    """Return what a topic's name says: set-point, command, measurement, or None."""
    last = name.rstrip("/").rsplit("/", 1)[-1]
    # What a controller wants is not what the process gets.
    return SETPOINT if last.lower() == "controller_command" else role_of(last)


def pair_of(topics: Topics, wanted: Selection) -> tuple[tuple[str, str], list[str]]:
    """Return ``TOPIC[:FIELD]`` of measurement and command, and notes on how they were found.

    :param topics: the bag.
    :param wanted: the topics, as far as they are named, or the joint that they are of.
    :raises SelectionError: if the names do not fit, or more than one pair does.
    """
    measurement, command = wanted.measurement, wanted.command
    notes = doubts_about(*(n and n.rstrip("/").rsplit("/", 1)[-1] for n in (measurement, command)))
    if wanted.joint:
        measurement, command, why = named_pair(topics, wanted)
        notes += [f"using {flags_of(measurement, command)}: {why}"]
    if measurement is not None and command is not None:
        names = (
            _checked(topics, "measurement", measurement),
            _checked(topics, "command", command),
        )
        if names[0] == names[1]:
            raise SelectionError(
                f"{names[0]} was named as measurement and as command; expected two topics"
            )
        return names, notes
    role, named = ("command", command) if measurement is None else ("measurement", measurement)
    given = None if named is None else _checked(topics, role, named)
    if (count := len(topics.single_numbers())) > MOST_SEARCHED:
        raise SelectionError(
            f"{topics.path} has {count} topics whose messages are about one number, and "
            f"measurement and command are looked for among {MOST_SEARCHED} at most; name them "
            f"with --measurement TOPIC --command TOPIC"
        )
    signals = list(topics.signals().values())
    pairs = plausible_pairs(signals, **({} if given is None else {role: given}))
    chosen, reasons = _only(topics, pairs)
    return chosen, [*notes, *reasons]


def _checked(topics: Topics, role: str, wanted: str) -> str:
    types = topics.types()
    topic, part = split_name(wanted)
    if topic not in types and f"/{topic}" in types:
        topic = f"/{topic}"
    if topic not in types:
        raise NotThereError(
            f"{topics.path} has no topic {topic!r} for the {role}", f"it has {topics.listing()}"
        )
    return topics.field_of(topic, part)


def _only(topics: Topics, pairs: Sequence[Pair]) -> tuple[tuple[str, str], list[str]]:
    if len(pairs) == 1:
        ((y, u, reason),) = pairs
        return (y, u), [f"using {flags_of(y, u)}: {reason}"]
    if 0 < len(pairs) <= len(topics.signals()):
        raise SelectionError(
            f"{topics.path} holds {len(pairs)} pairs of topics that may be measurement and "
            "command; choose one:",
            [(flags_of(y, u), reason) for y, u, reason in pairs],
        )
    # More pairs than topics: the names say too little, and the topics are the shorter list.
    looks = {name: look_of(signal)[1] for name, signal in topics.signals().items()}
    number = f"{len(pairs)} pairs" if pairs else "no pair"
    raise SelectionError(
        f"{topics.path} holds no recorded experiment and {number} of topics that may be "
        f"measurement and command; it has {topics.listing(looks)}; name two "
        f"with --measurement TOPIC[:FIELD] --command TOPIC[:FIELD]"
        + ("; or name a joint with --joint" if has_joints(topics) else "")
    )


def plausible_pairs(
    signals: Sequence[Signal], *, measurement: str | None = None, command: str | None = None
) -> list[Pair]:
    """Return the pairs that look like measurement and command of one loop, likeliest kind only.

    A pair whose names tell its roles comes before one whose names do not; then a pair within one
    namespace comes before one across two.

    :param signals: the recording's numeric signals.
    :param measurement: name of the measurement that the user chose, which may look like anything.
    :param command: name of the command that the user chose.
    """
    looks = {signal.name: look_of(signal) for signal in signals}
    found = []
    for y, u in itertools.permutations(signals, 2):
        names = (y.name, u.name)
        (of_y, look_of_y), (of_u, look_of_u) = (looks[name] for name in names)
        if measurement not in (None, names[0]) or command not in (None, names[1]):
            continue
        if (
            (names[0] == measurement or _may_be_measurement(y, of_y))
            and (names[1] == command or _may_be_command(u, of_y, of_u))
            and _overlap(y, u)
        ):
            named = (role_by_name(names[0]) == "measurement") + (
                role_by_name(names[1]) == "command"
            )
            together = _namespace(names[0]) == _namespace(names[1])
            reason = f"{names[0]} {look_of_y}; {names[1]} {look_of_u}"
            found.append(((named, together), (*names, reason)))
    best = max((rank for rank, _ in found), default=None)
    return [pair for rank, pair in found if rank == best]


def _may_be_measurement(signal: Signal, levels: int) -> bool:
    """Return whether a signal of so many values may be a measurement."""
    role = role_by_name(signal.name)
    if role not in ("measurement", None) or len(signal) < _FEWEST_SAMPLES:
        return False
    return levels > 2 or (levels == 2 and role == "measurement")


def _may_be_command(signal: Signal, measurement_levels: int, levels: int) -> bool:
    """Return whether a signal may be the command of a measurement, by how many values each has."""
    role = role_by_name(signal.name)
    if role not in ("command", None):
        return False
    # A controller's command varies as its measurement does, and then what steps is a set-point.
    steps = 2 <= levels <= _MOST_LEVELS
    varies = levels > _MOST_LEVELS and (role == "command" or measurement_levels > _MOST_LEVELS)
    return steps or varies


def _overlap(measurement: Signal, command: Signal) -> bool:
    # A command holds, so that one before the first sample counts as well.
    if len(measurement) == 0 or len(command) == 0:
        return False
    return bool(command.time_ns[0] <= measurement.time_ns[-1])


def _namespace(name: str) -> str:
    return name.rsplit("/", 1)[0]


# A definition without a list or a field of names has no joints; a robot's bag has hundreds of
# types, and to parse all of them takes seconds.
_NAMING = re.compile(rb"\bstring\b[^\n]{0,40}\b(?:" + "|".join(NAME_LISTS).encode() + rb")\b")
_STATES = {
    "JointState", "MultiDOFStateStamped", "DynamicJointState", "JointTrajectoryControllerState"
}  # fmt: skip
_ARRAYS = ("std_msgs/msg/Float64MultiArray", "std_msgs/msg/Float32MultiArray")

# The role of fields, by their names, in topics whose names do not tell it.
_NEITHER = {"reference", "error", "error_dot", "desired", "values_dot", "feedback_dot"}
_MEASURED = {"feedback", "position", "positions", "velocity", "velocities"}
_COMMANDED = {"position", "positions", "velocity", "velocities", "effort", "values", "data"}
# The quantity that a command sets, by the names of topic and field, and what measures it.
_QUANTITIES = ({"position", "positions"}, {"velocity", "velocities"})
# Interfaces of a joint in messages that name these, too.
_INTERFACES = ("position", "velocity", "effort")

# Joint states come from several nodes: the first messages need not have all joints.
_LOOKED_AT = 50
_ROLES = ("measurement", "command")

# Largest number of joints that an error lists.
_LISTED = 20


@dataclass(frozen=True)
class _Candidate:
    topic: str
    path: str
    role: str
    # The steps, where the joint's name is one of them.
    steps: tuple[Step, ...] = ()

    @property
    def name(self) -> str:
        return f"{self.topic}:{self.path}" if self.path else self.topic

    @property
    def words(self) -> set[str]:
        return set(re.split(r"[^a-z]+", self.name.lower()))

    def fits(self, wanted: str) -> bool:
        """Return whether a user named it, perhaps without the element."""
        wanted = wanted if wanted.startswith("/") else f"/{wanted}"
        own = {self.name, f"/{self.name}", _bare(self.name), self.topic}
        return wanted in own or _bare(wanted) in own


def has_joints(topics: Topics) -> bool:
    """Return whether a bag has the states of joints, by its types."""
    return any(kind.rpartition("/")[2] in _STATES for kind in topics.types().values())


def named_pair(topics: Topics, wanted: Selection) -> tuple[str, str, str]:
    """Return ``TOPIC:FIELD`` of a joint's measurement and command, and the reason.

    :param topics: the bag.
    :param wanted: the joint, and what the user chose.
    :raises SelectionError: if they are not there, or not the only ones.
    """
    found, joints = _candidates(topics, wanted)
    if not any(c.steps or not c.path for c in found):
        raise _nowhere(topics, wanted.joint, joints)
    named = (wanted.measurement, wanted.command)
    fits = [_of_role(found, *each) for each in zip(_ROLES, named, strict=True)]
    signals = topics.signals({c.name for own in fits for c in own if c.role != "named"})
    still = {name for name, s in signals.items() if not len(s) or not np.ptp(s.values)}
    measured, commanded = _together(*([c for c in own if c.name not in still] for own in fits))
    if any(c.steps for c in commanded):
        commanded = [c for c in commanded if c.steps]
    if len(measured) > 1 and len(commanded) == 1:
        measured = _of_quantity(measured, commanded[0])
    if len(measured) != 1 or len(commanded) != 1:
        raise _unclear(topics, wanted, measured, commanded)
    (y,), (u,) = measured, commanded
    why = f"both name {wanted.joint}" if u.steps else f"{y.name} names {wanted.joint}"
    if u.path and not u.steps and not wanted.joint_order and wanted.command is None:
        _require_most_moved(topics, wanted.joint, y, u, joints)
        why += f", which moves most, and {u.path} alone changes"
    elif wanted.joint_order and not u.steps:
        why += f", and --joint-order puts it at {u.path}"
    return y.name, u.name, why


def _candidates(
    topics: Topics, wanted: Selection
) -> tuple[list[_Candidate], dict[str, list[str]]]:
    """Return what may belong to a joint, and the joints that each topic names."""
    found: list[_Candidate] = []
    joints: dict[str, list[str]] = {}
    for topic, kind in topics.types().items():
        if kind in _ARRAYS:
            found += _elements(topics, topic, wanted)
        elif _NAMING.search(topics.definition_of(topic)):
            for candidate, names in _by_name(topics, topic, wanted.joint):
                joints.setdefault(topic, []).extend(n for n in names if n not in joints[topic])
                if wanted.joint in names:
                    found.append(candidate)
    for topic in topics.single_numbers():
        if wanted.joint in topic:
            found.append(_Candidate(topic, "", role_by_name(topic) or ""))
    return found, joints


def _by_name(topics: Topics, topic: str, joint: str) -> Iterator[tuple[_Candidate, list[str]]]:
    """Yield the numbers of named elements in a topic, as of a joint, and the elements' names."""
    root = topics.root_of(topic)
    messages = topics.first_messages(topic, _LOOKED_AT)
    for path in numeric_paths(root):
        if "[" not in path:
            continue
        for interface in _INTERFACES:
            steps = _named(steps_of(root, path, topic), joint, interface)
            if steps is None:
                continue
            names = list(dict.fromkeys(n for m in messages for n in names_in(steps, m)))
            role = _role(topic, steps)
            if role and (joint not in names or any(_has(steps, m) for m in messages)):
                yield _Candidate(topic, written(steps), role, steps), names
            if interface not in (s.chosen for s in steps if isinstance(s, Element)):
                break


def _named(steps: Iterable[Step], joint: str, interface: str) -> tuple[Step, ...] | None:
    """Return the steps with the joint, and its interface, in place of the places."""
    found: list[Step] = []
    chosen = iter((joint, interface))
    for step in steps:
        if isinstance(step, Element):
            if step.names is None or (name := next(chosen, None)) is None:
                return None
            step = Element(name, step.names)
        found.append(step)
    return tuple(found)


def _has(steps: Sequence[Step], message: object) -> bool:
    try:
        reading(steps)(message)
    except FieldError:
        return False
    return True


def _role(topic: str, steps: Sequence[Step]) -> str:
    """Return the role of a number, "" where it is neither measurement nor command."""
    fields = [step for step in steps if isinstance(step, str)]
    chosen = [step.chosen for step in steps if isinstance(step, Element)]
    last = chosen[-1] if len(chosen) > 1 else fields[-1]
    if _NEITHER & set(fields):
        return ""
    role = role_by_name(topic)
    if role == "command":
        return "command" if last in _COMMANDED else ""
    if role == "set-point":
        return ""
    if "output" in fields:
        return "command"
    if last in _MEASURED or "feedback" in fields:
        return "measurement"
    if last != "values":
        return ""
    return "measurement" if role == "measurement" else "command"


def _elements(topics: Topics, topic: str, wanted: Selection) -> list[_Candidate]:
    """Return the elements of an array of commands that may be the joint's."""
    role = role_by_name(topic)
    first = topics.first_messages(topic, 1)
    if not first or role in ("set-point", "measurement"):
        return []
    count = len(first[0].data)
    if wanted.joint_order:
        if wanted.joint not in wanted.joint_order or count != len(wanted.joint_order):
            return []
        places: Iterable[int] = (wanted.joint_order.index(wanted.joint),)
    else:
        places = range(count)
    return [_Candidate(topic, f"data[{k}]", "command") for k in places]


def _of_role(found: Sequence[_Candidate], role: str, wanted: str | None) -> list[_Candidate]:
    if wanted is None:
        return [c for c in found if c.role == role]
    # The user's choice counts, whatever role its name tells.
    exact = [c for c in found if c.name.lstrip("/") == wanted.lstrip("/")]
    fits = exact or [c for c in found if c.fits(wanted)]
    topic, _, path = wanted.partition(":")
    own = [c for c in fits if c.role == role]
    return own or fits or [_Candidate(topic, path, "named")]


def _together(
    measured: list[_Candidate], commanded: list[_Candidate]
) -> tuple[list[_Candidate], list[_Candidate]]:
    """Keep feedback and output of one controller, where they are there: they have one stamp."""
    outputs = {c.topic for c in commanded if "output" in c.words}
    both = outputs & {c.topic for c in measured if "feedback" in c.words}
    if len(both) != 1:
        return measured, commanded
    return [c for c in measured if c.topic in both], [c for c in commanded if c.topic in both]


def _of_quantity(measured: list[_Candidate], command: _Candidate) -> list[_Candidate]:
    """Keep the measurement of the quantity that a command sets, where its name says which."""
    for names in _QUANTITIES:
        if names & command.words:
            return [c for c in measured if names & c.words] or measured
    return measured


def _require_most_moved(
    topics: Topics, joint: str, y: _Candidate, u: _Candidate, joints: dict[str, list[str]]
) -> None:
    """Refuse an element of commands without names unless it is this joint that moves."""
    if not y.steps or len(topics.first_messages(u.topic, 1)[0].data) == 1:
        return
    others = [
        f"{y.topic}:{written(_renamed(y.steps, joint, name))}"
        for name in joints[y.topic]
        if name != joint
    ]
    signals = topics.signals([y.name, *others])
    swing = {name: float(np.ptp(signal.values)) for name, signal in signals.items()}
    most = max(swing, key=lambda name: swing[name])
    if most != y.name:
        raise SelectionError(
            f"{u.path} is the only element of {u.topic} that changes, but {most} moves more than "
            f"{y.name}: say whose command it is with --joint-order, the joints in the order of "
            f"the controller's parameter joints, or with --command {u.name}"
        )


def _renamed(steps: Sequence[Step], joint: str, name: str) -> tuple[Step, ...]:
    return tuple(
        Element(name, s.names) if isinstance(s, Element) and s.chosen == joint else s
        for s in steps
    )


def _nowhere(topics: Topics, joint: str, joints: dict[str, list[str]]) -> SelectionError:
    known = list(dict.fromkeys(name for names in joints.values() for name in names))
    if not known:
        return SelectionError(
            f"{topics.path} has no topic whose messages name joints; it has {topics.listing()}"
        )
    near = difflib.get_close_matches(joint, known, n=1)
    meant = f"; write --joint {near[0]}" if near else ""
    listed = ", ".join(map(visible, known[:_LISTED])) + (", ..." if known[_LISTED:] else "")
    return SelectionError(
        f"{topics.path} has no joint {joint!r}; {', '.join(joints)} name {listed}{meant}"
    )


def _unclear(
    topics: Topics, wanted: Selection, measured: list[_Candidate], commanded: list[_Candidate]
) -> SelectionError:
    said = f"{topics.path}: of {wanted.joint}"
    chosen = dict(zip(_ROLES, (measured, commanded), strict=True))
    for role, found in chosen.items():
        if not found:
            return SelectionError(
                f"{said} no {role} is there that changes; name one with --{role} TOPIC[:FIELD]; "
                f"it has {topics.listing()}"
            )
    several = [(role, found) for role, found in chosen.items() if len(found) > 1]
    listed = "".join(
        f"\n  --{role} {shlex.quote(name)}"
        for role, found in several
        # Without the element, so that it can be used for several joints.
        for name in sorted({_bare(c.name) if c.steps else c.name for c in found})
    )
    hint = ""
    if len(commanded) > 1 and not any(c.steps for c in commanded):
        hint = (
            "\n  --joint-order JOINT,JOINT,...  (the joints of such commands, in the order of the "
            "controller's parameter joints)"
        )
    what = " and ".join(f"several {role}s" for role, _ in several)
    return SelectionError(f"{said} {what} change; choose by{listed}{hint}")


def _bare(name: str) -> str:
    """Return a name without elements."""
    return re.sub(r"\[[^\]]*\]", "", name)
