# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The loop of a joint, as the parameters of its controller tell it, in ros2_control.

Topics, types, fields, gains and limits.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree

from rcl_interfaces.srv import ListParameters
from std_msgs.msg import String

from relay_autotune.errors import LoopError
from relay_autotune.nodes.controller_manager import ControllerManager, above, interface_class
from relay_autotune.nodes.loop_client import LoopClient

PID_CONTROLLER = "pid_controller/PidController"
TRAJECTORY_CONTROLLER = "joint_trajectory_controller/JointTrajectoryController"
STATE_TYPE = "control_msgs/msg/MultiDOFStateStamped"
COMMAND_TYPE = "control_msgs/msg/MultiDOFCommand"
GAINS = ("p", "i", "d")

# For how long the controller's state is looked at, and how many messages are needed [s].
_LOOK, _LEAST = 0.3, 5
_DESCRIPTION_WITHIN = 2.0
# What a trajectory controller commands, by its field in the points of its state.
_POINTS = {"velocity": "velocities", "effort": "effort"}
# What is read of each degree of freedom, with the value that it has where it is not declared.
_OPTIONAL: dict[str, Any] = {
    "antiwindup_strategy": "legacy",
    "save_i_term": False,
    "feedforward_gain": 0.0,
    "ff_velocity_scale": 0.0,
    "angle_wraparound": False,
    "u_clamp_min": -math.inf,
    "u_clamp_max": math.inf,
}


@dataclass(frozen=True)
class DofState:
    """What the controller last reported of one degree of freedom.

    :param reference: its set-point [y]; NaN: none was given.
    :param feedback: its measurement [y].
    :param output: its command [u].
    """

    reference: float
    feedback: float
    output: float


@dataclass(frozen=True)
class _Parts:
    """What the parameters of a controller tell of its joints.

    :param joints: their names in the controller's state and references, in its own order.
    :param dofs: those in the command interfaces.
    :param keys: those in the parameter gains.
    :param commanded: what is commanded, such as ``effort``.
    :param measured: what is controlled, such as ``velocity``.
    :param has_rate: True if the derivative comes from the velocity of a second state interface.
    :param feeds: name of the parameter of the feed-forward; empty: there is none.
    :param unrolls: True if the errors of continuous joints are wrapped.
    :param kind: name of the message of the controller's state.
    :param state_of: the state of a joint by its name within one; None: it is not in there.
    """

    joints: tuple[str, ...]
    dofs: tuple[str, ...]
    keys: tuple[str, ...]
    commanded: str
    measured: str
    has_rate: bool
    feeds: str
    unrolls: bool
    kind: str
    state_of: Callable[[Any, str], DofState | None]


@dataclass(frozen=True)
class JointLoop(_Parts):
    """A joint, its controller, and what the controller computes from its gains.

    :param controller: name of the controller.
    :param node: full name of its node.
    :param joint: name of the joint, as the controller's state and reference have it.
    :param dof: its name in the parameter gains.
    :param follows: True if its references are trajectories.
    :param interface: the command interface, such as ``left_wheel/effort``.
    :param period: of the controller's updates [s].
    :param is_simulated: True if the robot runs on /clock.
    :param gains: p, i and d in force.
    :param strategy: against windup.
    :param save_i_term: True if the integral outlives a deactivation.
    :param feedforward: gain from the reference to the command [u/y]; 0: none.
    :param wraps: True if the error is wrapped to half a turn.
    :param clamps: limits of the command [u].
    :param above: names of the active controllers that write its references.
    :param states: of all joints, in the same order.
    :param within: limits of the measurement in robot_description [y]; None: not given.
    :param command_within: likewise of the command [u].
    """

    controller: str
    node: str
    joint: str
    dof: str
    follows: bool
    interface: str
    period: float
    is_simulated: bool
    gains: tuple[float, float, float]
    strategy: str
    save_i_term: bool
    feedforward: float
    wraps: bool
    clamps: tuple[float, float]
    above: tuple[str, ...]
    states: tuple[DofState, ...]
    within: tuple[float, float] | None
    command_within: tuple[float, float] | None

    @property
    def state(self) -> DofState:
        """That of the joint."""
        return self.states[self.joints.index(self.joint)]

    @property
    def law(self) -> str:
        """The law of control_toolbox, which all these controllers run, that the gains are for."""
        return f"control_toolbox_{self.strategy}{'_velocity' * self.has_rate}"

    @property
    def why_not_moved(self) -> str:
        """Why nobody else can move its references; empty: they come as messages."""
        if self.follows:
            return "its references are trajectories"
        return f"its references come from {', '.join(self.above)}" if self.above else ""

    @property
    def state_topic(self) -> str:
        """Topic of the controller's state."""
        return f"{self.node}/controller_state"

    @property
    def reference_topic(self) -> str:
        """Topic of the controller's references."""
        return f"{self.node}/reference"

    @property
    def state_field(self) -> str:
        """The joint's state within a message of that topic."""
        return f"dof_states[name={self.joint}]"

    @property
    def reference_field(self) -> str:
        """The joint's reference within a message."""
        return f"values[{self.joint}]"

    @property
    def places(self) -> dict[str, str]:
        """The controller's parameter for each gain that is set."""
        names = dict(zip(GAINS, GAINS, strict=True))
        if self.strategy == "back_calculation":
            # A pid_controller that runs takes it from new gains only where it is set with them.
            names["tracking"] = "tracking_time_constant"
        return {gain: f"gains.{self.dof}.{name}" for gain, name in names.items()}

    @property
    def reference_alone(self) -> str:
        """What stands beside the joint's reference: NaN leaves the others as they are.

        With a second interface the joint's rate is 0, as it is at a constant reference.
        """
        return self._references([0.0 if each == self.joint else math.nan for each in self.joints])

    @property
    def references(self) -> str:
        """The references of all joints, as they were; NaN leaves those that had none."""
        return self._references([state.reference for state in self.states])

    def _references(self, values: Sequence[float]) -> str:
        rates = [0.0 if math.isfinite(v) and self.has_rate else math.nan for v in values]
        columns = (f"[{', '.join(map(_yaml, numbers))}]" for numbers in (values, rates))
        names = json.dumps(list(self.joints))
        return "{{dof_names: {}, values: {}, values_dot: {}}}".format(names, *columns)


def joint_loop(
    client: LoopClient, manager: ControllerManager, controller: str, joint: str
) -> JointLoop:
    """Find the loop of a joint.

    :param client: a node of the graph.
    :param manager: the controller's manager.
    :param controller: name of the controller.
    :param joint: name of the joint.
    :raises LoopError: with what to type, if it cannot be tuned.
    """
    loaded = manager.controllers()
    found = next((each for each in loaded if each.name == controller), None)
    if found is None:
        there = ", ".join(f"{each.name} ({each.type_name})" for each in loaded) or "none"
        raise LoopError(f"{manager.name} has no controller {controller}: found {there}")
    if found.type_name not in _PARTS:
        raise LoopError(
            f"{controller} is a {found.type_name}, expected {' or '.join(_PARTS)}: for another "
            f"controller type tune_loop --measurement TOPIC --command TOPIC instead"
        )
    if not found.is_active:
        typed = manager.command_for([controller], [])
        raise LoopError(f"{controller} is {found.state}, expected active; type: {typed}")
    node = manager.node_of(controller)
    parts = _PARTS[found.type_name](client, node)
    joints, dofs = parts.joints, parts.dofs
    if joint not in (*joints, *dofs):
        raise LoopError(f"{controller} has no joint {joint}: expected one of {', '.join(joints)}")
    place = joints.index(joint) if joint in joints else dofs.index(joint)
    interface = f"{dofs[place]}/{parts.commanded}"
    if interface not in manager.command_interfaces() and interface not in found.claims:
        raise LoopError(
            f"{manager.name} lists no command interface {interface}: type: ros2 control "
            f"list_hardware_interfaces -c {manager.name}"
        )
    own = _of_dof(client, node, parts.keys[place])
    description = _description(client, manager.namespace)
    rate = found.rate or float(client.values(manager.name, ["update_rate"])["update_rate"])
    return JointLoop(
        **vars(parts),
        controller=controller,
        node=node,
        joint=joints[place],
        dof=parts.keys[place],
        follows=found.type_name == TRAJECTORY_CONTROLLER,
        interface=interface,
        period=1.0 / rate,
        is_simulated=client.values(node, ["use_sim_time"])["use_sim_time"],
        gains=(own["p"], own["i"], own["d"]),
        strategy=own["antiwindup_strategy"],
        save_i_term=own["save_i_term"],
        feedforward=own[parts.feeds] if parts.feeds else 0.0,
        wraps=own["angle_wraparound"]
        or (parts.unrolls and is_continuous(description, joints[place])),
        clamps=(own["u_clamp_min"], own["u_clamp_max"]),
        above=above(loaded, [controller]),
        states=_states(client, node, parts),
        within=limits_in(description, joints[place], parts.measured),
        command_within=limits_in(description, dofs[place], parts.commanded),
    )


def _of_pid(client: LoopClient, node: str) -> _Parts:
    names = (
        "dof_names",
        "reference_and_state_dof_names",
        "command_interface",
        "reference_and_state_interfaces",
        "enable_feedforward",
    )
    dofs, joints, commanded, measured, feeds = client.values(node, names).values()
    has_rate = len(measured) > 1
    return _Parts(
        tuple(joints or dofs),
        tuple(dofs),
        tuple(dofs),
        commanded,
        measured[0],
        has_rate,
        # With a second interface it multiplies the reference's rate, which is 0 at a step.
        "feedforward_gain" if feeds and not has_rate else "",
        False,
        "MultiDOFStateStamped",
        _pid_state_of,
    )


def _pid_state_of(message: Any, joint: str) -> DofState | None:
    dofs = [dof for dof in message.dof_states if dof.name == joint]
    return DofState(dofs[0].reference, dofs[0].feedback, dofs[0].output) if dofs else None


def _of_trajectories(client: LoopClient, node: str) -> _Parts:
    names = ("joints", "command_joints", "command_interfaces")
    joints, commands, kinds = client.values(node, names).values()
    is_open = False
    # Releases after Jazzy do not have it.
    with suppress(LoopError):
        is_open = client.values(node, ["open_loop_control"])["open_loop_control"]
    if len(kinds) != 1 or kinds[0] not in _POINTS or (is_open and kinds[0] == "velocity"):
        raise LoopError(
            f"{node} commands {', '.join(kinds)}{' in open loop' if is_open else ''}, where its "
            f"gains do nothing: they are used with velocity alone or effort alone"
        )
    # Fewer joints are commanded than measured: these have the same names.
    moved = joints if len(commands or joints) == len(joints) else commands
    field = _POINTS[kinds[0]]

    def state_of(message: Any, joint: str) -> DofState | None:
        if joint not in message.joint_names:
            return None
        place = list(message.joint_names).index(joint)
        output = getattr(message.output, field)
        told = message.reference.positions, message.feedback.positions, output
        # The output is left out where the interfaces cannot be read.
        return DofState(*(float(row[place]) if place < len(row) else math.nan for row in told))

    return _Parts(
        tuple(moved),
        tuple(commands or joints),
        tuple(moved),
        kinds[0],
        "position",
        True,
        "ff_velocity_scale",
        True,
        "JointTrajectoryControllerState",
        state_of,
    )


_PARTS = {PID_CONTROLLER: _of_pid, TRAJECTORY_CONTROLLER: _of_trajectories}


def _of_dof(client: LoopClient, node: str, dof: str) -> dict[str, Any]:
    """Return the parameters of a degree of freedom, without their prefix."""
    prefix = f"gains.{dof}"
    request = ListParameters.Request(prefixes=[prefix])
    there = set(client.call(ListParameters, f"{node}/list_parameters", request).result.names)
    names = [n for n in (*GAINS, *_OPTIONAL) if n in GAINS or f"{prefix}.{n}" in there]
    values = client.values(node, [f"{prefix}.{name}" for name in names])
    return _OPTIONAL | {name: values[f"{prefix}.{name}"] for name in names}


def _states(client: LoopClient, node: str, parts: _Parts) -> tuple[DofState, ...]:
    """Return the state of all joints: the mean of some messages, and the newest reference."""
    topic = f"{node}/controller_state"
    kind = interface_class("control_msgs", "msg", parts.kind)
    came = client.heard(kind, topic, lambda came: len(came) >= _LEAST, least=_LOOK)
    if len(came) < _LEAST:
        raise LoopError(
            f"{topic} has told {len(came)} states within some seconds, expected one for each "
            f"update; type: ros2 topic hz {topic}"
        )
    found = []
    for joint in parts.joints:
        states = [state for m in came if (state := parts.state_of(m, joint)) is not None]
        if not states:
            raise LoopError(f"{topic} does not tell the state of {joint}")
        found.append(
            replace(
                states[-1],
                feedback=sum(each.feedback for each in states) / len(states),
                output=sum(each.output for each in states) / len(states),
            )
        )
    return tuple(found)


def _description(client: LoopClient, namespace: str) -> str:
    """Return the robot's description; empty: none is published."""
    for topic in dict.fromkeys((f"{namespace}/robot_description", "/robot_description")):
        # Its publisher may be discovered after the manager.
        found = client.latched(String, topic, lambda m: m.data, _DESCRIPTION_WITHIN)
        if found is not None:
            return str(found.data)
    return ""


def _parsed(description: str) -> ElementTree.Element:
    """Return the root of a description; one without joints if it cannot be read."""
    try:
        return ElementTree.fromstring(description)
    except ElementTree.ParseError:
        return ElementTree.Element("robot")


def is_continuous(description: str, joint: str) -> bool:
    """Return whether a joint turns without end.

    :param description: the robot's description.
    :param joint: name of the joint.
    """
    found = _parsed(description).find(f"./joint[@name='{joint}']")
    return found is not None and found.get("type") == "continuous"


def limits_in(description: str, joint: str, interface: str) -> tuple[float, float] | None:
    """Return the limits of a joint's position, velocity or effort; None: not given.

    :param description: the robot's description, URDF with or without a part of ros2_control.
    :param joint: name of the joint.
    :param interface: what is limited.
    """
    root = _parsed(description)
    low, high = -math.inf, math.inf
    for limit in root.iterfind(f"./joint[@name='{joint}']/limit"):
        if interface == "position":
            low, high = (_number(limit.get(name), 0.0) for name in ("lower", "upper"))
        elif limit.get(interface):
            high = abs(_number(limit.get(interface), math.inf))
            low = -high
    path = f"./ros2_control/joint[@name='{joint}']/command_interface[@name='{interface}']/param"
    for parameter in root.iterfind(path):
        value = _number(parameter.text, math.nan)
        if parameter.get("name") == "min" and value > low:
            low = value
        if parameter.get("name") == "max" and value < high:
            high = value
    return (low, high) if math.isfinite(low) and math.isfinite(high) and low < high else None


def _yaml(value: float) -> str:
    return repr(float(value)) if math.isfinite(value) else ".nan"


def _number(text: str | None, otherwise: float) -> float:
    try:
        return float(text) if text is not None else otherwise
    except ValueError:
        return otherwise
