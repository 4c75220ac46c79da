# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains as files that other programs load, by the table of laws, and as plain YAML.

`ros2 param load` parses a file as YAML, turns each value into text and parses that again. A number
must look like a floating-point number both times: `2` would be read as an integer, `0.00001` as
the text 1e-05, and the parameter would be refused.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from relay_autotune.errors import ParameterError, SelectionError
from relay_autotune.loop.gains import Gains
from relay_autotune.loop.laws import LAWS, OWN_LAW, ProgramLaw
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import result_fields
from relay_autotune.text import NAME_OF_ROS, digits, in_units, percent

_DIGITS = 10
LAUNCH = "launch"
_FILES = {"yaml": "gains.yaml", LAUNCH: "gains.launch.py"}
EXPORTS = (*LAWS, "yaml", LAUNCH)
_DOF = re.compile(r"[\w.-]+(/[\w.-]+)*\Z", re.ASCII)
# Names that YAML reads as text without quotes.
_PLAIN = re.compile(r"[A-Za-z_]\w*(/\w+)*\Z", re.ASCII)


@dataclass(frozen=True)
class Target:
    """Where gains for a controller of ros2_controllers go.

    :param node: name of the controller's node, with its namespace.
    :param dof: name of the degree of freedom, a key of the parameter `gains`.
    :param command_min: lower clamp of the command [u]; -inf: none.
    :param command_max: upper clamp of the command [u]; inf: none.
    :param present: the command at which the process rests [u]; NaN: not known.
    :param recorded: the lowest and the highest command of the record [u]; NaN: not known.
    :param noise_std: standard deviation of the measurement's noise [y]; NaN: not known.
    :param parameters: of a controller_node by name, besides gains and limits of the command.
    :param topics: names of the topics of a controller_node, by their names without a remapping.
    :param model: the process, with the delay of its loop; None: not known.
    :param units: of the measurement, by "y", and of the command, by "u", as far as known.
    :param is_set_up: True if the gains are for its rate and its strategy against windup, which a
        joint_trajectory_controller cannot change while it runs.
    :raises SelectionError: if a name cannot be that of a node or parameter, or a clamp is NaN or
        above the other.
    """

    node: str = "/pid_controller"
    dof: str = "joint"
    command_min: float = -math.inf
    command_max: float = math.inf
    present: float = math.nan
    recorded: tuple[float, float] = (math.nan, math.nan)
    noise_std: float = math.nan
    model: TransferFunction | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    topics: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    is_set_up: bool = False

    def __post_init__(self) -> None:
        if not NAME_OF_ROS.match(self.node):
            raise SelectionError(f"{self.node!r} is not a node name, such as /pid_controller")
        if not _DOF.match(self.dof):
            raise SelectionError(
                f"{self.dof!r} is not a name of a degree of freedom, such as heater or joint1"
            )
        if not self.command_min < self.command_max:
            raise SelectionError(
                f"--command-min {self.command_min:g} is not below --command-max "
                f"{self.command_max:g}"
            )

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of the command [u]; those that were not given are 0 and 100 of one in %.

        One that was below 0 goes to -100; one that was beyond these has no limit there.
        """
        low, high = self.command_min, self.command_max
        if self.units.get("u") == "%":
            found = [x for x in (*self.recorded, self.present, low, high) if math.isfinite(x)]
            if low == -math.inf:
                low = next(x for x in (0.0, -100.0, low) if min(found, default=0.0) >= x)
            if high == math.inf and max(found, default=0.0) <= 100.0:
                high = 100.0
        return low, high


def exported(
    gains: Gains, how: str, target: Target, *, doubt: str = "", unproven: str = ""
) -> str:
    """Return gains as the text of a file.

    :param gains: what is to be loaded.
    :param how: a law of :data:`~relay_autotune.loop.laws.LAWS`, "yaml" or "launch".
    :param target: for a controller of ros2_controllers: where they go.
    :param doubt: what to look at before they are used; empty: they are trusted.
    :param unproven: why a proof of them has not passed; empty: it has, or none was made.
    :raises SelectionError: if they are for another law.
    """
    text = in_units(_file(gains, how, target), target.units)
    for what, why in (("DOUBTFUL", doubt), ("NOT PROVEN", unproven)):
        if why:
            remark = LAWS[how].remark if how in LAWS else "#"
            text = f"{remark} {what}: {' '.join(why.split())}\n{text}"
    return text


def _file(gains: Gains, how: str, target: Target) -> str:
    if how not in exports_of(gains.law):
        runs = gains.law or "controller_node, as a continuous controller"
        raise SelectionError(f"the gains are for {runs}: give --law {how} to export them for it")
    written = {"yaml": plain, LAUNCH: launch_file, OWN_LAW: controller_file}.get(how)
    return written(gains, target) if written else settings(gains, LAWS[how], target)


def exports_of(law: str) -> tuple[str, ...]:
    """Return how gains for a law can be written, the usual way first.

    :param law: its name; empty: none was named.
    """
    if law not in ("", OWN_LAW):
        return law, "yaml"
    return OWN_LAW, "yaml", LAUNCH


def file_name(how: str) -> str:
    """Return the name of a file that gains are written into.

    :param how: as of :func:`exported`.
    """
    return f"{how}.{LAWS[how].ending}" if how in LAWS else _FILES[how]


def settings(gains: Gains, law: ProgramLaw, target: Target) -> str:
    """Return gains as the settings of a law, a line each, in the words of its program.

    :param gains: what they are for.
    :param law: the law.
    :param target: where they go.
    """
    remarks, values = _remarks_and_values(gains, law, target)
    parts = [
        *_comments(gains, target, (gains.reason and f"{gains.reason}.", *remarks), law.remark),
        law.head.format(node=_key(target.node), dof=_key(target.dof)),
        *(law.line.format(name=name, value=value) for name, value in values),
        law.tail,
    ]
    return "\n".join(filter(None, parts)) + "\n"


def _remarks_and_values(
    gains: Gains, law: ProgramLaw, target: Target
) -> tuple[tuple[str, ...], list[tuple[str, str]]]:
    """Return what is to be known of a law's settings, and these with their values as texts."""
    low, high = limits = target.limits
    of_command = "" if law.command == "any" else f" Its command is the {law.command}."
    if law.unset and not all(map(math.isfinite, limits)):
        raise SelectionError(
            f"{law.name} always limits its command, and to {law.unset} where nothing else is set: "
            "give the lowest and the highest command, --command-min and --command-max of replay "
            "or tune"
        )
    if limits != (target.command_min, target.command_max):
        to_scale = ": scale them for the output" * bool(law.unset)
        of_command += (
            f" Commands are in %, from {low:g} to {high:g} (0 to 100 unless others are given)"
            f"{to_scale}."
        )
    full = _full_command(law, target)
    scale = law.full / full if full else 1.0
    if law.turned and gains.kc < 0.0:
        scale = -scale
        of_command += f" {law.turned}."
    if full:
        of_command += (
            f" It is {law.full:g} where the command is {full:g} u, so gains are divided by "
            f"{full / law.full:g}."
        )
    low, high = sorted(scale * limit for limit in limits)
    where = ""
    if law.bounds is None:
        ends = (f"{limit:g}" if math.isfinite(limit) else "none" for limit in (low, high))
        known = math.isfinite(low) or math.isfinite(high)
        set_there = f"; set them to {' and '.join(ends)}" if known else ""
        where = f"Limits of the command are set in the program{set_there}. "
    remarks: tuple[str, ...] = (
        f"For {law.program}.{of_command}",
        f"{where}At the limits of the command: {law.limits}.",
    )
    if law.scale:
        remarks += (law.scale,)
    if law.sign:
        sign = law.sign.format(sign="positive" if gains.kc < 0.0 else "negative")
        remarks += (f"{sign}, with kc {gains.kc:.6g}.",)
    elif law.form == "parallel" and scale * gains.kc < 0.0:
        remarks += ("All gains are negative, since a higher command lowers the measurement.",)
    at = law.at(replace(gains, kc=scale * gains.kc), gains.law_period)
    stays = ("antiwindup_strategy",) if target.is_set_up else ()
    values = [(each.name, each.of(at)) for each in law.settings if each.name not in stays]
    if law.bounds is not None:
        values += law.bounds(low, high)
    if law.start is not None:
        known = not math.isnan(target.present)
        present, rest = scale * target.present, f" The process rested at {target.present:.6g} u."
        if not known:
            # Code begins at the command next to 0, and says so.
            present = min(max(0.0, low), high)
            done = f": put it in place of {present:g}" if law.start.needs else ", and is left out"
            rest = f" It is not known here{done}." * bool(law.start.name)
        remarks += (f"Start without a bump: {law.start.words}{rest}",)
        if law.start.name and (known or law.start.needs):
            values.append((law.start.name, law.start.value(at, present)))
    written = [(name, value) for name, value in values if value is not None]
    return remarks, [(n, v if isinstance(v, str) else number(v)) for n, v in written]


def _full_command(law: ProgramLaw, target: Target) -> float:
    """Return the command that is the largest of a program [u]; 0: commands are already its own.

    :raises SelectionError: if commands are beyond the program's, and of what they are a share is
        not known.
    """
    if not law.full:
        return 0.0
    if target.units.get("u") == "%":
        return 100.0
    limits = [abs(x) for x in (target.command_min, target.command_max) if math.isfinite(x)]
    others = (abs(x) for x in (target.present, *target.recorded) if math.isfinite(x))
    reach = max((*limits, *others), default=0.0)
    if reach <= law.full:
        return 0.0
    if not math.isfinite(target.command_max):
        raise SelectionError(
            f"the command of {law.name} is the {law.command}, and commands here go to {reach:g}: "
            "say which is the largest, such as --command-max 255, and the lowest with "
            "--command-min, or that they are in %, in the name of the column, such as 'out (%)'"
        )
    return max(limits)


# The section of a file for controller_node that no node has, for the names of topics.
TOPICS = "/topics"


def controller_file(gains: Gains, target: Target) -> str:
    """Return the parameters of a controller_node as a file that it is started with.

    ROS itself takes the parameters alone; `controller_node --gains FILE` takes the topics, too.

    :param gains: that it runs.
    :param target: its other parameters, its topics, and limits and present value of its command.
    """
    law = LAWS[OWN_LAW]
    more = [
        law.line.format(name=name, value=number(value) if isinstance(value, float) else value)
        for name, value in target.parameters.items()
    ]
    # A recording does not tell which topics are those of the controller.
    names = " --ros-args -r measurement:=TOPIC -r controller_command:=TOPIC"
    if target.topics:
        names, more = "", [*more, f"{TOPICS}:", "  ros__parameters:"]
    more += [law.line.format(name=n, value=json.dumps(to)) for n, to in target.topics.items()]
    text = "\n".join([settings(gains, law, target).rstrip(), *more])
    return f"{law.remark} {OWN_LAW} --gains FILE{names}\n{text}\n"


def controller_values(gains: Gains, target: Target) -> dict[str, Any]:
    """Return the parameters of a controller_node that runs gains.

    :param gains: that it runs.
    :param target: as of :func:`controller_file`.
    """
    _, values = _remarks_and_values(gains, LAWS[OWN_LAW], target)
    return {name: float(value) for name, value in values} | dict(target.parameters)


def launch_file(gains: Gains, target: Target) -> str:
    """Return a launch file that starts a controller_node with gains.

    :param gains: of its own law.
    :param target: its topics, and the limits and the present value of its command.
    """
    values = controller_values(gains, target)
    shown = [f"                    {json.dumps(n)}: {v!r}," for n, v in values.items()]
    topics = [f"                    {(name, to)!r}," for name, to in target.topics.items()]
    lines = [
        *_comments(gains, target, (gains.reason and f"{gains.reason}.", "ros2 launch FILE"), "#"),
        "from launch import LaunchDescription",
        "from launch_ros.actions import Node",
        "",
        "",
        "def generate_launch_description():",
        "    return LaunchDescription(",
        "        [",
        "            Node(",
        '                package="relay_autotune",',
        '                executable="controller_node",',
        "                parameters=[{",
        *shown,
        "                }],",
        "                remappings=[",
        *topics,
        "                ],",
        "            ),",
        "        ]",
        "    )",
    ]
    return "\n".join(lines) + "\n"


def plain(gains: Gains, target: Target) -> str:
    """Return gains as lines of `key: value`, which is YAML.

    :param gains: what is written.
    :param target: what is known of the loop.
    """
    lines = [*_comments(gains, target, (), "#"), f"rule: {gains.rule}", f"form: {gains.form}"]
    numbers = (f for f in result_fields(Gains) if f.kind is float)
    for each in (f for f in numbers if not f.optional):
        value = getattr(gains, each.name)
        unit = f"  # {each.unit}" if each.unit else ""
        lines.append(f"{each.name}: {number(value) if math.isfinite(value) else 'null'}{unit}")
    lines.append(f"reason: {json.dumps(gains.reason, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """Return a finite number so that YAML, and `ros2 param load` after it, reads a double.

    :param value: rounded to ten digits, or to as many more as it takes.
    :raises ParameterError: if it is not finite.
    """
    if not math.isfinite(value):
        raise ParameterError(f"a file of gains cannot hold {value:g}; expected a finite number")
    rounded = float(f"{value:.{_DIGITS}g}")
    text = repr(rounded if math.isfinite(rounded) else float(value))
    while "." not in text:
        # In YAML 1.1 a floating-point number needs a point: 1.0000000000000002e-05.
        rounded = math.nextafter(rounded, math.copysign(math.inf, rounded))
        text = repr(rounded)
    return text


def _key(name: str) -> str:
    # YAML 1.1 reads these as booleans and as null.
    special = name.lower() in ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
    return f"'{name}'" if special or not _PLAIN.match(name.lstrip("/")) else name


def _comments(gains: Gains, target: Target, more: Sequence[str], remark: str) -> list[str]:
    lines = [
        f"Gains by the rule {gains.rule} of relay_autotune: Ms {gains.ms:.3g}, Mt {gains.mt:.3g}.",
        f"ISA form: kc {gains.kc:.6g} u/y, ti {gains.ti:.6g} s, td {gains.td:.6g} s, "
        f"tf {gains.tf:.6g} s, b {gains.b:g}.",
    ]
    if gains.law:
        lines.append(f"Designed for {gains.law} every {gains.law_period:.6g} s.")
        if not target.is_set_up:
            lines[-1] += " If it runs at another period, export again with --sample-period."
    lines += [*_predicted(gains, target), *gains.warnings]
    return [f"{remark} {' '.join(line.split())}" for line in (*lines, *more) if line]


def _predicted(gains: Gains, target: Target) -> list[str]:
    """Return sentences on what gains do on the model; those that are not known are left out."""
    found, noise_std = list[str](), target.noise_std
    if math.isfinite(gains.settling_time):
        # Here, for it loads scipy: a tune asks where gains go, and begins before that.
        from relay_autotune.loop.analysis import Loop, as_run

        law = as_run(gains, gains)
        found.append(
            "Without noise and limits, a step of the set-point overshoots by "
            f"{percent(gains.overshoot)} %, settles within 2 % after "
            f"{digits(gains.settling_time, 3)} s, and moves the command at once by "
            f"{digits(law.jump, 3)} u/y."
        )
        if target.model and gains.settling_time and math.isfinite(target.present):
            moves = Loop(law, target.model).command_range(2.0 * gains.settling_time)
            rooms = [limit - target.present for limit in target.limits]
            spans = [[room / move for room in rooms] for move in moves if move]
            ends = ("down to", max(map(min, spans))), ("up to", min(map(max, spans)))
            met = [f"{how} {digits(end, 2)}" for how, end in ends if math.isfinite(end)]
            sentence = f"From {target.present:.6g} u steps {' and '.join(met)} y meet no limit."
            found += [sentence] * bool(met)
    if gains.noise_gain * noise_std > 0.0:
        found.append(
            f"Noise of {digits(noise_std, 2)} y in the measurement makes one of "
            f"{digits(gains.noise_gain * noise_std, 2)} u in the command (standard deviations)."
        )
    elif math.isfinite(gains.noise_gain):
        found.append(
            f"The command has {digits(gains.noise_gain, 3)} u/y times the measurement's noise."
        )
    return found
