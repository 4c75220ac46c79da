# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The manager of ros2_control: its controllers, which of them are in the way, and their switch."""

from __future__ import annotations

import importlib
import shlex
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

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
# Types that write the values they receive into their command interfaces, and nothing else.
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
    :param rate: of its updates [Hz]; 0: not reported.
    :param needs: the command interfaces that it writes, in its own order; (): not configured.
    :param claims: those that it owns now.
    :param reads: the state interfaces that it reads.
    """

    name: str
    type_name: str
    state: str
    rate: float
    needs: tuple[str, ...]
    claims: tuple[str, ...]
    reads: tuple[str, ...] = ()

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
            tuple(each.required_state_interfaces),
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


def broadcasting(
    controllers: Collection[ManagedController], names: Collection[str]
) -> tuple[str, ...]:
    """Return the active controllers that command nothing, and publish the states of a chain.

    Such as a joint_state_broadcaster, which reads all states, those that controllers export, too.
    A manager does not switch off a controller that is chained while another one reads its states,
    unless that one is switched off, or started again, in the same request.

    :param controllers: all that are loaded.
    :param names: of those that are switched off.
    """
    chained = {name for name in names if above(controllers, [name])}
    return tuple(
        each.name
        for each in controllers
        if each.is_active
        and not each.needs
        and any(state.partition("/")[0] in chained for state in each.reads)
    )


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


@contextmanager
def opened(
    manager: ControllerManager, forward: str, former: Sequence[str], then: Callable[[], object]
) -> Iterator[None]:
    """Pass commands to a joint, whose controllers are off until the end of the block.

    One strict switch does both, and starts again what publishes their states. At the end of the
    block, however it ends, the former controllers are active again, as the manager's list shows.

    :param manager: the manager.
    :param forward: name of the controller that passes commands on.
    :param former: names of those that are switched off.
    :param then: called when they are active again.
    :raises LoopError: with what to type, if they are not.
    """
    error = None
    try:
        again = broadcasting(manager.controllers(), former)
        # An answer that is lost need not be a refusal.
        manager.switch([forward, *again], [*former, *again])
        yield
    except BaseException as raised:
        error = raised
        raise
    finally:
        try:
            close(manager, forward, former)
            then()
        except LoopError as left:
            raise LoopError(f"{error}; and {left}" if error else str(left)) from error


def close(manager: ControllerManager, forward: str, former: Sequence[str]) -> None:
    """Activate the former controllers of a joint, and look until they are active.

    :param manager: the manager.
    :param forward: name of the controller that is switched off.
    :param former: names of those that are activated.
    :raises LoopError: with what to type, if they are not.
    """
    deadline = time.monotonic() + _BACK_WITHIN
    problem = ""
    while (left := deadline - time.monotonic()) > 0.0:
        try:
            states = {each.name: each.state for each in manager.controllers(left)}
            lacking = [name for name in former if states.get(name) != _ACTIVE]
            extra = [forward] if states.get(forward) == _ACTIVE else []
            if not lacking and not extra:
                return
            # A strict switch is refused as a whole for one that is in its state already.
            manager.switch(lacking, extra, deadline - time.monotonic())
        except LoopError as error:
            problem = str(error)
            manager.client.rest(_AGAIN)
    raise LoopError(
        f"{', '.join(former)} could not be activated again"
        f"{f' ({problem})' if problem else ''}: see to the joint, then type: "
        f"{manager.command_for(former, [forward])}"
    )
