# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A controller of ros2_control and its joints: found, opened for a tune, and closed again.

A joint's loop is told by the parameters of its controller: topics, types, fields, gains, limits.
"""

from __future__ import annotations

import importlib
import json
import math
import shlex
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any
from xml.etree import ElementTree

from rcl_interfaces.srv import ListParameters
from std_msgs.msg import String

from relay_autotune.errors import LoopError
from relay_autotune.nodes.loop_client import ANSWER_WITHIN, LoopClient

# How long the manager may take for one switch, and until the former controllers are active [s].
_SWITCH_WITHIN = 5
_BACK_WITHIN = 15.0
# Interval of the looks at the controllers while a joint is tuned [s].
_LOOK_EVERY, _LOST_AFTER = 1.0, 5.0
# Pause after a switch back that failed [s].
_AGAIN = 0.2
_ACTIVE = "active"
_LIST = "/list_controllers"
# Types that write what they are told into their command interfaces, and nothing else.
_FORWARDING = {
    "forward_command_controller/ForwardCommandController",
    "forward_command_controller/MultiInterfaceForwardCommandController",
    "position_controllers/JointGroupPositionController",
    "velocity_controllers/JointGroupVelocityController",
    "effort_controllers/JointGroupEffortController",
}


@dataclass(frozen=True)
class ManagedController:
    """A controller as its manager lists it.

    :param name: its name.
    :param type_name: the class, such as ``pid_controller/PidController``.
    :param state: unconfigured, inactive, active or finalized.
    :param rate: of its updates [Hz]; 0: not told.
    :param needs: the command interfaces that it writes, in its own order; (): not configured.
    :param claims: those that it owns now.
    """

    name: str
    type_name: str
    state: str
    rate: float
    needs: tuple[str, ...]
    claims: tuple[str, ...]

    @property
    def is_active(self) -> bool:
        """True while it commands."""
        return self.state == _ACTIVE


def interface_class(package: str, kind: str, name: str) -> Any:
    """Return a message or service class of a package that need not be installed.

    :param package: such as ``controller_manager_msgs``.
    :param kind: ``msg`` or ``srv``.
    :param name: of the class.
    :raises LoopError: if the package is not there.
    """
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError):
        raise LoopError(
            f"{package}/{kind}/{name} is not installed here: source the workspace of your "
            f"robot, or type: sudo apt install ros-jazzy-{package.replace('_', '-')}"
        ) from None


class ControllerManager:
    """Ask a controller_manager.

    :param client: a node of the graph.
    :param name: full name of the manager; empty: the only one that is there.
    :param within: its namespace; None: any.
    :param patience: how long to wait for it [s].
    :raises LoopError: if it is not there, or its messages are not installed.
    """

    def __init__(self, client: LoopClient, name: str, within: str | None, patience: float) -> None:
        self.client = client
        """The node of the graph that asks it."""
        self._kinds = {
            kind: interface_class("controller_manager_msgs", "srv", kind)
            for kind in ("ListControllers", "ListHardwareInterfaces", "SwitchController")
        }
        self._wanted = f"/{name.strip('/')}" if name else ""
        self._within = within
        if not client.wait(lambda: bool(self._meant()), patience):
            where = self._wanted or (f"in {within or '/'}" if within is not None else "")
            there = ", ".join(client.owners(_LIST)) or "none"
            raise LoopError(
                f"no controller_manager {where} within {patience:g} s, of those that "
                f"list_controllers: {there}; type --controller-manager NAME"
            )
        self.require_alone()
        (self.name,) = self._meant()
        self.namespace = self.name.rpartition("/")[0]
        """Namespace of the manager and of its controllers."""

    def _meant(self) -> list[str]:
        """Return the full names of the managers that may be meant."""
        return [
            each
            for each in self.client.owners(_LIST)
            if self._wanted in ("", each) and self._within in (None, each.rpartition("/")[0])
        ]

    def require_alone(self) -> None:
        """Refuse to choose between several managers, the second of which may be found later.

        :raises LoopError: with their names.
        """
        if len(meant := self._meant()) > 1:
            raise LoopError(
                f"several controller_managers are there: {', '.join(meant)}; type "
                f"--controller-manager with one of them, or its namespace before the controller, "
                f"such as --controller {meant[0].rpartition('/')[0]}/NAME"
            )

    def node_of(self, name: str) -> str:
        """Return the full name of a node or a topic in the manager's namespace."""
        return f"{self.namespace}/{name}"

    def controllers(self, patience: float = ANSWER_WITHIN) -> tuple[ManagedController, ...]:
        """Return the controllers that are loaded.

        :param patience: how long to wait for the answer [s].
        :raises LoopError: if the manager does not answer.
        """
        return _listed(self._ask("ListControllers", patience=patience).controller)

    def command_interfaces(self) -> tuple[str, ...]:
        """Return the names of the command interfaces that the hardware offers.

        :raises LoopError: if the manager does not answer.
        """
        found = self._ask("ListHardwareInterfaces").command_interfaces
        return tuple(each.name for each in found if each.is_available)

    def switch(
        self,
        activate: Iterable[str],
        deactivate: Iterable[str],
        patience: float = ANSWER_WITHIN,
    ) -> None:
        """Switch controllers in one step of the manager, all of them or none.

        :param activate: their names.
        :param deactivate: likewise.
        :param patience: how long to wait for the answer [s].
        :raises LoopError: with the manager's reason, if it refuses or does not answer.
        """
        kind = self._kinds["SwitchController"]
        request = kind.Request(
            activate_controllers=list(activate),
            deactivate_controllers=list(deactivate),
            strictness=kind.Request.STRICT,
            activate_asap=True,
        )
        request.timeout.sec = _SWITCH_WITHIN
        answer = self._ask("SwitchController", request, patience)
        if not answer.ok:
            # Managers of older releases give no reason.
            why = getattr(answer, "message", "") or "its log says why"
            raise LoopError(f"{self.name} refuses to switch controllers: {why}")

    def still_active(self, controller: str) -> Callable[[], str]:
        """Return what tells during a tune why a controller is not active; empty: it is.

        It asks each second, and does not wait for the answer; something else spins the client.

        :param controller: the controller's name.
        """
        kind, service = self._kinds["ListControllers"], f"{self.name}{_LIST}"
        asked: Any = None
        next_at = 0.0

        def look() -> str:
            nonlocal asked, next_at
            if asked is not None and asked.done():
                found, asked = _listed(asked.result().controller), None
                state = {each.name: each.state for each in found}.get(controller, "not loaded")
                if state != _ACTIVE:
                    return (
                        f"{controller} is {state}: it was deactivated, and the log of {self.name} "
                        f"says when"
                    )
            # An answer that does not come is not waited for.
            if time.monotonic() >= next_at + (_LOST_AFTER if asked is not None else 0.0):
                next_at = time.monotonic() + _LOOK_EVERY
                asked = self.client.begin(kind, service, kind.Request())
            return ""

        return look

    def command_for(self, activate: Collection[str], deactivate: Collection[str]) -> str:
        """Return what to type to switch controllers by hand."""
        words = ["ros2", "control", "switch_controllers", "--strict", "-c", self.name]
        words += ["--activate", *activate] if activate else []
        return shlex.join([*words, *(["--deactivate", *deactivate] if deactivate else [])])

    def _ask(self, kind: str, request: Any = None, patience: float = ANSWER_WITHIN) -> Any:
        service = "".join(f"_{c.lower()}" if c.isupper() else c for c in kind).lstrip("_")
        asked = request if request is not None else self._kinds[kind].Request()
        return self.client.call(self._kinds[kind], f"{self.name}/{service}", asked, patience)


def _listed(found: Iterable[Any]) -> tuple[ManagedController, ...]:
    return tuple(
        ManagedController(
            each.name,
            each.type,
            each.state,
            # Managers of older releases do not tell it.
            float(getattr(each, "update_rate", 0)),
            tuple(each.required_command_interfaces),
            tuple(each.claimed_interfaces),
        )
        for each in found
    )


def above(controllers: Iterable[ManagedController], names: Iterable[str]) -> tuple[str, ...]:
    """Return the active controllers that write the references of some others.

    Those come first whose references others write, as a manager activates them.

    :param controllers: all that are loaded.
    :param names: of the others.
    """
    active = [each for each in controllers if each.is_active]
    below, found = set(names), list[str]()
    while more := [
        each.name
        for each in active
        if each.name not in below and any(c.partition("/")[0] in below for c in each.claims)
    ]:
        found += more
        below |= set(more)
    return tuple(found)


def in_the_way(
    controllers: Collection[ManagedController], interfaces: Iterable[str]
) -> tuple[str, ...]:
    """Return the active controllers that own any of some command interfaces.

    With them go those that write their references, since a chain is switched as a whole.

    :param controllers: all that are loaded.
    :param interfaces: the names of the command interfaces.
    """
    wanted = set(interfaces)
    own = [each.name for each in controllers if each.is_active and wanted & set(each.claims)]
    return (*own, *above(controllers, own))


def forwarding(
    controllers: Iterable[ManagedController],
    interface: str,
    name: str,
    beside: Collection[str] = (),
) -> ManagedController:
    """Return the controller that passes commands on to an interface.

    :param controllers: all that are loaded.
    :param interface: the command interface.
    :param name: that of the controller; empty: the one that writes the fewest interfaces.
    :param beside: interfaces that it has to write as well, if none is named.
    :raises LoopError: with what to type, if there is none.
    """
    fits = [
        each
        for each in controllers
        if interface in each.needs and (each.name == name or each.type_name in _FORWARDING)
    ]
    chosen = [
        each for each in fits if (each.name == name if name else set(beside) <= set(each.needs))
    ]
    if chosen:
        return min(chosen, key=lambda each: len(each.needs))
    kind = interface.rpartition("/")[2]
    written = tuple(beside) if beside and not name else (interface,)
    joints = ", ".join(each.rpartition("/")[0] for each in written)
    others = ", ".join(each.name for each in fits)
    raise LoopError(
        f"no configured controller {name or 'of type forward_command_controller'} writes "
        f"{', '.join(written)}"
        + (" (those that it does not write would be commanded 0)" if len(written) > 1 else "")
        + (f"; type --forward with one of {others}" if others else "")
        + f"; load one with the parameters {{joints: [{joints}], interface_name: {kind}}} and "
        f"type: ros2 run controller_manager spawner {name or 'forward_command_controller'} "
        f"--inactive --param-file FILE"
    )


class Opened:
    """A joint whose controllers are off while a forwarding one passes commands on.

    One strict switch does both. At the end of the block, however it ends, the former controllers
    are active again, which the manager's list has to show.

    :param manager: the manager.
    :param forward: name of the forwarding controller.
    :param former: names of those that are switched off.
    :param then: called when they are active again.
    """

    def __init__(
        self,
        manager: ControllerManager,
        forward: str,
        former: tuple[str, ...],
        then: Callable[[], object],
    ) -> None:
        self._manager, self._forward, self._former = manager, forward, former
        self._then = then

    def __enter__(self) -> Opened:
        try:
            self._manager.switch([self._forward], self._former)
        except BaseException:
            # An answer that is lost need not be a refusal.
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except LoopError as left:
            raise LoopError(f"{error}; and {left}" if error else str(left)) from error

    def close(self) -> None:
        """Activate the former controllers, and look until they are active.

        :raises LoopError: with what to type, if they are not.
        """
        manager = self._manager
        deadline = time.monotonic() + _BACK_WITHIN
        problem = ""
        while (left := deadline - time.monotonic()) > 0.0:
            try:
                states = {each.name: each.state for each in manager.controllers(left)}
                lacking = [name for name in self._former if states.get(name) != _ACTIVE]
                extra = [self._forward] if states.get(self._forward) == _ACTIVE else []
                if not lacking and not extra:
                    break
                # A strict switch is refused as a whole for one that is in its state already.
                manager.switch(lacking, extra, deadline - time.monotonic())
            except LoopError as error:
                problem = str(error)
                manager.client.rest(_AGAIN)
        else:
            typed = manager.command_for(self._former, [self._forward])
            raise LoopError(
                f"{', '.join(self._former)} could not be activated again"
                f"{f' ({problem})' if problem else ''}: see to the joint, then type: {typed}"
            )
        self._then()


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
    """What the controller last told of one degree of freedom.

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
    :param has_rate: True if the derivative comes from a second state interface.
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
    :param within: limits of the measurement in robot_description [y]; None: not told.
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
        return f"control_toolbox_{self.strategy}"

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
        told = (f"[{', '.join(map(_yaml, numbers))}]" for numbers in (values, rates))
        names = json.dumps(list(self.joints))
        return "{{dof_names: {}, values: {}, values_dot: {}}}".format(names, *told)


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
        _told_by_pid,
    )


def _told_by_pid(message: Any, joint: str) -> DofState | None:
    told = [dof for dof in message.dof_states if dof.name == joint]
    return DofState(told[0].reference, told[0].feedback, told[0].output) if told else None


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
        # The output is left out where the interfaces cannot be read.
        return DofState(
            *(
                float(values[place]) if place < len(values) else math.nan
                for values in (
                    message.reference.positions,
                    message.feedback.positions,
                    getattr(message.output, field),
                )
            )
        )

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
    came = client.heard(interface_class("control_msgs", "msg", parts.kind), topic, _LOOK, _LEAST)
    if len(came) < _LEAST:
        raise LoopError(
            f"{topic} has told {len(came)} states within some seconds, expected one for each "
            f"update; type: ros2 topic hz {topic}"
        )
    found = []
    for joint in parts.joints:
        told = [state for m in came if (state := parts.state_of(m, joint)) is not None]
        if not told:
            raise LoopError(f"{topic} does not tell the state of {joint}")
        found.append(
            replace(
                told[-1],
                feedback=sum(each.feedback for each in told) / len(told),
                output=sum(each.output for each in told) / len(told),
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


def _parsed(description: str) -> ElementTree.Element | None:
    try:
        return ElementTree.fromstring(description) if description else None
    except ElementTree.ParseError:
        return None


def is_continuous(description: str, joint: str) -> bool:
    """Return whether a joint turns without end.

    :param description: the robot's description.
    :param joint: name of the joint.
    """
    root = _parsed(description)
    found = None if root is None else root.find(f"./joint[@name='{joint}']")
    return found is not None and found.get("type") == "continuous"


def limits_in(description: str, joint: str, interface: str) -> tuple[float, float] | None:
    """Return the limits of a joint's position, velocity or effort; None: not told.

    :param description: the robot's description, URDF with or without a part of ros2_control.
    :param joint: name of the joint.
    :param interface: what is limited.
    """
    root = _parsed(description)
    if root is None:
        return None
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
