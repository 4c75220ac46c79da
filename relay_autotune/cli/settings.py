# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a tune has to know of a loop: each setting with its flag, its question and its parameters.

A setting is declared once. The command line, the questions on a terminal, the form of the page and
the parameters of relay_node follow from its row.
"""

from __future__ import annotations

import argparse
import math
import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from relay_autotune.cli.arguments import finite, flag_of, step_height
from relay_autotune.cli.terminal import BACK, UNITS, GoBack, asked, number_of, pair_of
from relay_autotune.errors import SelectionError
from relay_autotune.loop.laws import LAWS
from relay_autotune.quantities import Quantity
from relay_autotune.text import unit_of

NOT_GIVEN = math.nan


class Kind(Enum):
    """What a loop has: nodes that run, two topics alone, or a joint of ros2_control.

    A joint's controller stays active in a tune, or is switched off for it.
    """

    NODES = "nodes"
    TOPICS = "topics"
    JOINT = "joint"
    OPENED = "opened joint"


_JOINTS = (Kind.JOINT, Kind.OPENED)
_ALL = (Kind.NODES, *_JOINTS, Kind.TOPICS)
_COMMAND = (*_JOINTS, Kind.TOPICS, Kind.NODES)
# The relay commands the actuator itself.
_COMMANDING = (Kind.OPENED, Kind.TOPICS)


@dataclass(frozen=True)
class Setting(Quantity):
    """One of the settings of a loop; a default of () stands for a range.

    :param loops: which take it; the last one has its flag in the help.
    :param metavar: what its flag takes; empty: it follows from the unit.
    :param question: how it is asked for; empty: nobody asks for it.
    :param example: what may be typed.
    :param parameters: of relay_node that it sets, for a range the lower and the upper one.
    :param number: returns the number of the text behind its flag.
    """

    loops: tuple[Kind, ...] = (Kind.TOPICS,)
    metavar: str = ""
    question: str = ""
    example: str = ""
    parameters: tuple[str, ...] = ()
    number: Callable[[str], float] = finite

    @property
    def ends(self) -> int:
        """How many numbers it takes: two for a range."""
        return 2 if self.default == () else 1

    def problem(self, value: Any) -> str | None:
        """Return what is wrong with a value, or None if it is allowed."""
        if self.ends > 1 and not value[0] < value[1]:
            low, high = value
            return f"{self.name} is {low:g} {high:g}, expected the lower number first"
        return super().problem(value)

    @property
    def read(self) -> Callable[[str], Any]:
        """Return the value of a text; None: it has none."""
        return pair_of if self.ends > 1 else number_of

    @property
    def unset(self) -> Any:
        """The value without its flag."""
        # A proof may be wanted, not wanted, or asked for.
        no_value = self.default in ("", (), NOT_GIVEN) or self.name == "verify"
        return None if no_value else self.default

    def is_given(self, options: argparse.Namespace) -> bool:
        """Return whether its flag was given."""
        return bool(getattr(options, self.name) not in (None, self.unset))

    def add_to(self, group: argparse._ActionsContainer) -> None:
        """Add its flag to some others."""
        default, how = self.default, dict[str, Any](default=self.unset)
        if self.ends > 1:
            how |= {"nargs": 2, "type": finite, "metavar": ("LOW", "HIGH")}
        elif isinstance(default, bool):
            asks = self.unset is None
            how["action"] = argparse.BooleanOptionalAction if asks else "store_true"
        elif self.choices:
            how |= {"choices": self.choices, "metavar": self.metavar}
        else:
            how["metavar"] = self.metavar or self.unit.upper()
            if self.is_number:
                how["type"] = self.number
        group.add_argument(flag_of(self), dest=self.name, help=self.description, **how)

    def values(self, given: Any) -> dict[str, Any]:
        """Return the parameters of relay_node that a value sets."""
        if self.ends > 1:
            return dict(zip(self.parameters, given, strict=True))
        return dict.fromkeys(self.parameters, given)


SETTINGS = (
    Setting("dry_run", False, loops=_COMMAND).means(
        "only ask whether a tune could start, and how"
    ),
    Setting("namespace", "", metavar="NS", loops=_COMMAND).means(
        "namespace of the loop; with --web several, separated by commas"
    ),
    Setting("node", "relay_node", metavar="NAME", loops=(Kind.NODES,)).means(
        "name of the relay_node (%(default)s)"
    ),
    Setting("record_only", False, loops=_COMMAND).means(
        "tune without an identifier_node: a recording, and no model"
    ),
    Setting("wait", 5.0, "s", 0.0, loops=_COMMAND).means(
        "how long to wait for the nodes [s] (%(default)s)"
    ),
    Setting("report", "", metavar="FILE", loops=_COMMAND).means(
        "write a report: .html, or a picture: .png, .svg or .pdf"
    ),
    Setting("json", False, loops=_COMMAND).means("print the result as JSON"),
    Setting(
        "amplitude", 0.0, "u", 0.0, parameters=("amplitude",), loops=_COMMAND,
        question="half the distance of the relay's two commands; 0: found by the tune",
    ).means("half the distance of the two commands [u]; default: the node's parameter"),
    Setting("measurement", "", metavar="TOPIC", loops=_COMMANDING).means("topic that measures"),
    Setting("command", "", metavar="TOPIC").means("topic that commands the actuator"),
    Setting(
        "field", "data", metavar="PATH", parameters=("measurement_field",), loops=_COMMANDING
    ).means("the number in the messages of --measurement (%(default)s)"),
    Setting("command_field", "data", metavar="PATH", parameters=("command_field",)).means(
        "the number in the messages of --command, such as linear.x"
    ),
    Setting(
        "command_message", "", metavar="YAML", parameters=("command_message",),
        loops=_COMMANDING,
    ).means(
        "what stands in their other elements, such as '{data: [0.0, 1.5]}'"
    ),
    Setting("command_period", NOT_GIVEN, "s", 0.0, parameters=("command_period",)).means(
        "send the last command again after this time, for an actuator that stops without"
    ),
    Setting(
        "measurement_timeout", NOT_GIVEN, "s", 0.0, parameters=("measurement_timeout",),
        loops=_ALL,
    ).means(
        "longest silence of the measurement; default: five of its intervals, and at least 1 s"
    ),
    Setting(
        "at", NOT_GIVEN, "u", question="present command, at which the process rests",
        # The safe command also where a controller_node in front of it has ended.
        example="2.5", parameters=("baseline", "safe_command"), loops=(Kind.NODES, *_COMMANDING),
    ).means(
        "the present command, at which the process rests; where nodes run it becomes their "
        "baseline, as limits become theirs"
    ),
    Setting(
        "within", (), "y", question="lowest and highest measurement that the process may see",
        example="30 50", parameters=("measurement_min", "measurement_max"), loops=_ALL,
    ).means("the tune ends where the measurement leaves these [y]"),
    Setting(
        "command_within", (), "u", question="lowest and highest command of the actuator",
        example="0 5", parameters=("command_min", "command_max"), loops=(Kind.NODES, *_COMMANDING),
    ).means("no command beyond these is sent [u]"),
    Setting("law", "", choices=tuple(LAWS), metavar="LAW").means(
        "design the gains for the law of another program, such as simple_pid, and prove them with "
        "that law"
    ),
    Setting("sample_period", NOT_GIVEN, "s", 0.0, open_ended=True).means(
        "time between two runs of that program [s]; default: that of the measurement"
    ),
    Setting("verify", False).means(
        "prove the gains with a step of the set-point, by a controller_node of its own; without "
        "either flag it asks, with --yes it does not"
    ),
    Setting("step", NOT_GIVEN, "y", number=step_height).means(
        "height of that step [y]; default: half of the swing of the tune, at least twenty times "
        "the noise (forty if that is within a third of the way to a limit), as far as --within "
        "and --command-within allow"
    ),
    Setting("yes", False, loops=_ALL).means(
        "do not ask, for scripts; gains are then proven with --verify alone"
    ),
    Setting("export", "", flag="output", metavar="FILE", loops=(*_JOINTS, Kind.TOPICS)).means(
        "write the gains for controller_node, the program of --law, or the controller of the "
        "joint; an existing file is refused at once"
    ),
    Setting("accept_doubtful", False, loops=(*_JOINTS, Kind.TOPICS)).means(
        "with --output: also gains that are doubtful, or whose proof has not passed"
    ),
    Setting("controller", "", metavar="NAME", loops=_JOINTS).means(
        "an active pid_controller, or with --open a joint_trajectory_controller; of several "
        "robots with its namespace, such as /robot1/wheel_pid"
    ),
    Setting("joint", "", metavar="NAME", loops=_JOINTS).means("the joint, or degree of freedom"),
    Setting("controller_manager", "", metavar="NAME", loops=_JOINTS).means(
        "full name of the controller_manager; default: the only one that is there"
    ),
    Setting("open", False, loops=_JOINTS).means(
        "switch its controllers off for the tune, and command the joint itself; default: the "
        "controller stays active, and its reference is moved"
    ),
    Setting("forward", "", metavar="NAME", loops=(Kind.OPENED,)).means(
        "with --open: the controller that passes commands on; default: found"
    ),
    Setting("keep_gains", False, loops=_JOINTS).means(
        "leave the gains of the controller as they are"
    ),
)  # fmt: skip
SETTING = {each.name: each for each in SETTINGS}
# By the parameter that they set: flags, and names.
FLAGS = {name: flag_of(each) for each in SETTINGS for name in each.parameters}
NAMES = {name: each.name for each in SETTINGS for name in each.parameters}


def as_flags(text: str) -> str:
    """Return an error's text with the flags in place of the parameters of the same meaning."""
    for parameter, flag in FLAGS.items():
        text = re.sub(rf"\b{parameter}\b", flag, text)
    return text


class AnswerError(SelectionError):
    """An answer cannot be.

    :param said: what was found and expected.
    :param setting: name of the setting.
    """

    def __init__(self, said: str, setting: str) -> None:
        super().__init__(said)
        self.setting = setting


@dataclass
class Answers:
    """What is known of a loop, where it comes from, and what is asked for.

    :param options: as the command line gives them; answers are kept there, too.
    :param measured: the present measurement [y]; NaN: not known.
    """

    options: argparse.Namespace
    measured: float = math.nan
    _from: dict[str, str] = field(default_factory=dict)
    _asked: list[Setting] = field(default_factory=list)

    def __getitem__(self, name: str) -> Any:
        """Return the value of a setting; None: it is not known."""
        return getattr(self.options, name)

    def take(self, given: Mapping[str, Any], source: str = "") -> None:
        """Take values, all of them or none.

        :param given: numbers and ranges by the names of their settings.
        :param source: where they come from; empty: each is named by its question.
        :raises AnswerError: if one of them is impossible with the others.
        """
        wanted = replace(self, options=argparse.Namespace(**vars(self.options)))
        for name, value in given.items():
            found, ends = _numbers(value), SETTING[name].ends
            if len(found) != ends or found != sorted(set(found)):
                expected = "two numbers, the lower one first" if ends > 1 else "one number"
                raise AnswerError(f"{SETTING[name].question}: expected {expected}", name)
            # A page sends whole numbers as such, which ROS does not take for a double.
            setattr(wanted.options, name, found if ends > 1 else found[0])
        for name, value in given.items():
            if why := wanted.why_impossible(name, wanted[name]):
                whose = source or SETTING[name].question
                numbers = " ".join(map("{:g}".format, _numbers(value)))
                raise AnswerError(f"{whose} {numbers}: {why}", name)
        vars(self.options).update(vars(wanted.options))
        self._from.update(dict.fromkeys(given, source))

    def source(self, name: str) -> str:
        """Return where a value comes from: its flag, unless something else was said."""
        return self._from.get(name) or flag_of(SETTING[name])

    def now(self, name: str) -> str:
        """Return what is known of a setting's quantity now; empty: nothing."""
        value = self._seen(name)
        if name == "amplitude" or math.isnan(value):
            return ""
        present = f"{value:.4g} {SETTING[name].unit}"
        # The command is not measured.
        return f"{present} now" if name == "within" else f"the present one given as {present}"

    def _seen(self, name: str) -> float:
        """Return the present value of a setting's quantity; NaN: it is not known."""
        at = math.nan if self["at"] is None else float(self["at"])
        return self.measured if name == "within" else at

    def why_impossible(self, name: str, value: Any) -> str:
        """Return why a value cannot be, as far as is known now; empty: it can.

        :param name: of the setting.
        :param value: that is given.
        """
        if name == "amplitude":
            return "" if value >= 0.0 else "expected at least 0"
        if name == "at" and (limits := self["command_within"]):
            low, high = limits
            problem = f"expected a command from {low:g} to {high:g}, the limits of the actuator"
            return "" if low <= value <= high else problem
        what = {
            "within": "the measurement is {:.6g} now",
            "command_within": "the present command is {:.6g}",
        }.get(name)
        seen = self._seen(name)
        if what is None or math.isnan(seen) or value[0] <= seen <= value[1]:
            return ""
        return f"{what.format(seen)}: give limits around it"

    def read(self, values: Mapping[str, Any]) -> None:
        """Take the settings that relay_node has.

        :param values: its parameters by name.
        """
        for each in SETTINGS:
            found = [values[name] for name in each.parameters[: each.ends] if name in values]
            if len(found) == each.ends and all(map(math.isfinite, found)):
                setattr(self.options, each.name, found if each.ends > 1 else found[0])

    def ask(self, *questions: Setting) -> None:
        """Ask for what is not known yet, and refuse what cannot be; `<` goes back to the last one.

        What is given is looked at before anything is asked for.

        :param questions: the settings in their order.
        :raises SelectionError: if what is given cannot be.
        :raises LoopError: if nobody can be asked.
        """
        for each in questions:
            if (given := self[each.name]) is not None:
                self.take({each.name: given}, self.source(each.name))
        self._asked = [each for each in questions if self.lacks(each.name)]
        hints = ["u is the command's unit, y the measurement's"] * (len(UNITS) < 2)
        hints += [f"{BACK} at a question goes back to the one before"] * (len(self._asked) > 1)
        if sys.stdin.isatty() and self._asked and hints:
            print("; ".join(hints), file=sys.stderr)
        self._ask_from(0)

    def ask_again(self) -> list[str]:
        """Ask for the last answer again, and return the names of the settings that were asked."""
        self._ask_from(len(self._asked) - 1)
        return [each.name for each in self._asked]

    @property
    def may_go_back(self) -> bool:
        """Whether something was asked for."""
        return bool(self._asked)

    def _ask_from(self, place: int) -> None:
        while place < len(self._asked):
            each = self._asked[place]
            # Neither it nor what comes after it speaks against another value.
            for later in self._asked[place:]:
                setattr(self.options, later.name, None)
            try:
                self._ask(each, back=place > 0)
                place += 1
            except GoBack:
                place -= 1

    def _ask(self, setting: Setting, *, back: bool) -> None:
        name, example, seen = setting.name, setting.example, self.now(setting.name)
        if setting.ends > 1 and seen:
            example = "{:g} {:g}".format(*_around(self._seen(name)))

        def read(text: str) -> Any:
            if (value := setting.read(text)) is None:
                found = "two numbers, the lower one first" if setting.ends > 1 else "a number"
                raise SelectionError(f"expected {found}, such as {example}")
            if unit := unit_of(text):
                UNITS[setting.unit] = unit
            if why := self.why_impossible(name, value):
                raise SelectionError(why)
            return value

        lacking = ", ".join(flag_of(each) for each in self._asked if self[each.name] is None)
        what = f"{setting.question} [{setting.unit}]" + f", {seen}" * bool(seen)
        value = asked(what, lacking, "", example, read, back=back)
        self.take({name: value}, "typed")

    def form(self, names: Sequence[str], *, needed: bool) -> Iterator[dict[str, Any]]:
        """Yield each of some settings as a form shows it.

        :param names: of the settings.
        :param needed: whether each must have a value.
        """
        for name in names:
            setting, value = SETTING[name], self[name]
            yield {
                "name": name,
                "question": setting.question,
                "unit": setting.unit,
                "values": value if setting.ends > 1 else [value],
                "ends": setting.ends,
                # The form holds the present command itself.
                "now": self.now(name) if name == "within" or "at" not in names else "",
                "needed": needed,
            }

    def lacks(self, name: str) -> bool:
        """Return whether a setting has no value yet and needs one.

        :param name: of the setting.
        """
        # An amplitude that is given is not searched for between the limits of the command.
        return self[name] is None and not (name == "command_within" and self["amplitude"])

    def parameters(self, names: Collection[str] = tuple(SETTING)) -> dict[str, Any]:
        """Return the parameters of relay_node that the known values set."""
        found: dict[str, Any] = {}
        for name in names:
            if (value := self[name]) is not None:
                found |= SETTING[name].values(value)
        return found


def _around(value: float) -> tuple[float, float]:
    """Return a range of round numbers with room about a value, from 0 on."""
    if value == 0.0:
        return -1.0, 1.0
    most = 2.0 * abs(value)
    power = 10.0 ** math.floor(math.log10(most))
    end = next((n * power for n in (1.0, 2.0, 5.0) if n * power >= most), 10.0 * power)
    return (0.0, end) if value > 0.0 else (-end, 0.0)


def _numbers(value: Any) -> list[float]:
    return [float(each) for each in (value if isinstance(value, Sequence) else [value])]


# The groups of flags: those of all loops stand before them.
_GROUPS = {
    Kind.TOPICS: (
        "a loop without nodes",
        "with --measurement and --command it starts relay_node and identifier_node itself, asks "
        "for what it must know, shows the plan, tunes, and ends them",
    ),
    Kind.OPENED: (
        "a joint of ros2_control",
        "with --controller and --joint it finds topics, limits and gains by itself, tunes, and "
        "applies and verifies the gains",
    ),
}


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add the flags of all loops.

    :param parser: of tune_loop.
    """
    groups = {kind: parser.add_argument_group(*heading) for kind, heading in _GROUPS.items()}
    for each in SETTINGS:
        each.add_to(groups.get(each.loops[-1], parser))
    # The name that --output had in scripts of before.
    parser.add_argument("--export", help=argparse.SUPPRESS)


def kind_of(options: argparse.Namespace) -> Kind:
    """Return which kind of loop is to be tuned.

    :param options: with the flags of `add_settings`.
    :raises SelectionError: if the flags do not go together.
    """
    kind = Kind.NODES
    lacking = [f"--{name}" for name in ("measurement", "command") if not getattr(options, name)]
    if options.controller or options.joint:
        kind = Kind.OPENED if options.open else Kind.JOINT
        _require_joint(options)
    elif not lacking:
        kind = Kind.TOPICS
    for each in SETTINGS:
        if kind in each.loops or not each.is_given(options):
            continue
        if each.loops == (Kind.NODES,):
            purpose = "nodes that run already: leave it out"
        elif kind in _JOINTS:
            what = "--open" if Kind.OPENED in each.loops else "a loop of two topics"
            purpose = f"{what}: leave it out, since the controller tells it"
        elif Kind.TOPICS in each.loops:
            purpose = f"a loop without nodes: give {' and '.join(lacking)}, too"
            if each.name in ("verify", "step") and len(lacking) == 2:
                where = ["--namespace", options.namespace] * bool(options.namespace)
                how = shlex.join(["apply_gains", *where])
                purpose += f"; where nodes run already, prove the gains with: {how}"
        else:
            purpose = "a joint: give --controller and --joint, too"
        raise SelectionError(f"{flag_of(each)} is for {purpose}")
    return kind


def _require_joint(options: argparse.Namespace) -> None:
    if not (options.controller and options.joint):
        raise SelectionError("--controller and --joint go together: give both")
    if options.namespace:
        controller = options.controller.rpartition("/")[2]
        raise SelectionError(
            f"--namespace {options.namespace} is that of nodes, not of a robot: leave it out, and "
            f"name the robot's controller by --controller "
            f"/{options.namespace.strip('/')}/{controller}"
        )
    if options.json and not (options.keep_gains or options.dry_run):
        raise SelectionError(
            "the gains of a joint are applied after a question: leave out --json, or give "
            "--keep-gains"
        )
