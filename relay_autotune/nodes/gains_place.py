# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Where gains act: in the controller of this node, or in another node.

Another node has them as parameters; its set-point is a topic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter, parameter_value_to_python

from relay_autotune.control.controller import Control, is_usable
from relay_autotune.control.gains_history import GainSet
from relay_autotune.errors import FieldError, LoopError, NotReadyError, ParameterError, TuningError
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.loop.law import LawRate
from relay_autotune.loop.laws import LAWS
from relay_autotune.nodes import quality
from relay_autotune.nodes.lifetime import STEADY, ServedNode
from relay_autotune.nodes.live_types import CommandMessage
from relay_autotune.nodes.loop_client import LoopClient
from relay_autotune.nodes.loop_ends import CommandPublisher
from relay_autotune.nodes.tables import (
    GAINS,
    MESSAGE_PARAMETERS,
    OWN_LAWS,
    parameters_of_law,
    rate_of,
)
from relay_autotune.reasons import Code

# Names of the gains that may be sent, of the ISA and of the parallel form, and the time constant
# of a back-calculation, which belongs to them.
NAMES = ("kc", "ti", "td", "tf", "b", "p", "i", "d", "tracking")

# Longest wait for an answer of another node [s].
TIMEOUT = 2.0
# Relative difference of two periods that are the same.
_SAME_RATE = 0.01


def mapping_of(text: str) -> dict[str, str]:
    """Return the parameter name for each gain.

    :param text: pairs such as ``p:gains.heater.p``, separated by commas.
    :raises ParameterError: if one is not such a pair.
    """
    found = {}
    for pair in map(str.strip, text.split(",")):
        name, _, target = pair.partition(":")
        if name not in NAMES or not target:
            raise ParameterError(
                f"apply_parameters has {pair!r}, expected GAIN:PARAMETER with a gain of "
                f"{', '.join(NAMES)}"
            )
        found[name] = target
    return found


def controller_of(gains: Mapping[str, float]) -> Controller:
    """Return the controller with gains given by name, in the ISA or the parallel form.

    :param gains: some of `NAMES`; defaults: no derivative, no filter, set-point weight 1.
    :raises RelayAutotuneError: if they are not enough for a controller.
    """
    proportional = gains.get("kc", gains.get("p"))
    if proportional is None or not {"ti", "i"} & set(gains):
        raise LoopError(
            f"only the gains {', '.join(gains)} are known, expected kc or p, and ti or i: name "
            "their parameters in apply_parameters"
        )
    integral, derivative = gains.get("i", 0.0), gains.get("d", 0.0)
    return Controller(
        proportional,
        gains.get("ti", proportional / integral if integral else 0.0),
        gains.get("td", derivative / proportional if proportional else 0.0),
        gains.get("tf", 0.0),
        gains.get("b", 1.0),
    )


def gains_at(client: LoopClient, node: str, places: Mapping[str, str]) -> Controller | None:
    """Return the gains that another node has; None: it has none.

    :param client: a node of the graph.
    :param node: the other node's full name.
    :param places: its parameter for each gain.
    :raises RelayAutotuneError: if it does not answer, or they are not enough for a controller.
    """
    values = client.values(node, list(places.values()))
    found = {gain: values[place] for gain, place in places.items()}
    return controller_of(found) if found.get("kc", found.get("p")) != 0.0 else None


def gains_text(gains: Mapping[str, float]) -> str:
    """Return gains in words, by the last part of their parameters."""
    return ", ".join(f"{n.rpartition('.')[2]} {value:.6g}" for n, value in gains.items())


def in_another_node(gains: Controller, rate: LawRate | None, feedforward: float) -> Control:
    """Return gains as another node runs them.

    :param gains: the gains.
    :param rate: its law; None: not known, our own stands for it.
    :param feedforward: its gain from the set-point to the command, added to these [u/y]; with
        ``kc (b r - y)`` it is a set-point weight ``b + feedforward/kc``, which no law has.
    """
    if rate is not None:
        rate = replace(rate, law=replace(rate.law, weights=()))
    weighted = replace(gains, b=gains.b + feedforward / gains.kc)
    return Control(weighted, rate, elsewhere=True)


class _Place:
    """Where gains act.

    :param name: of the controlling node, for people.
    :param mapping: its parameter name for each gain.
    :param rate: the law that it runs; None: that of controller_node.
    """

    outlives = False
    """True if the gains stay in force when this process ends."""

    def __init__(self, name: str, mapping: Mapping[str, str], rate: LawRate | None) -> None:
        self.name = name
        self._mapping = dict(mapping)
        self._rate = rate

    def set_of(self, controller: Controller) -> GainSet:
        """Return the parameters of a controller.

        :param controller: the gains.
        """
        return GainSet.of({t: getattr(controller, name) for name, t in self._mapping.items()})

    def controller_of(self, gains: GainSet) -> Controller:
        """Return the controller with these parameters.

        :param gains: the parameters.
        :raises RelayAutotuneError: if they are not enough for a controller.
        """
        values, names = gains.by_name(), set(self._mapping.values())
        if values.keys() != names:
            raise LoopError(f"{self.name} has the gains {', '.join(sorted(names))}")
        return controller_of({name: values[t] for name, t in self._mapping.items()})

    def control(self, gains: Controller) -> Control:
        """Return gains as they run there.

        :param gains: the gains.
        """
        return Control(gains, self._rate)


class OwnGains(_Place):
    """The controller of this node.

    :param use: puts gains in force; None: the command is held.
    :param rate: the law that it runs; None: its own.
    """

    def __init__(self, use: Callable[[GainSet | None], None], rate: LawRate | None) -> None:
        super().__init__("this node", {entry.name: entry.name for entry in GAINS}, rate)
        self._use = use

    def require_law(self, gains: Gains) -> None:
        """Refuse gains for another law than that of this node."""
        law, period, rate = gains.law, gains.law_period, self._rate
        own = law in OWN_LAWS
        runs = own if rate is None else law == rate.law.name
        if rate is not None and runs and not math.isclose(period, rate.period, rel_tol=_SAME_RATE):
            raise TuningError(
                f"they are for {law} every {period:g} s, and this node runs it every "
                f"{rate.period:g} s: give both the same time (sample_period of identifier_node, "
                f"law_period here)"
            )
        if runs:
            return
        if own:
            raise TuningError(
                "they are for this node's own law, and it was started with another one: start "
                "it without the parameter law, or design for that law"
            )
        given = (f"-p {n}:={v}" for n, v in parameters_of_law(law, period).items())
        raise TuningError(
            f"they are for the law {law}, which this node does not run: start it with "
            f"{' '.join(given)}, write them to a file with apply_gains --file, or tune without "
            f"that law"
        )

    async def read(self) -> GainSet | None:
        """Return None: no other node changes these gains."""
        return None

    async def put(self, gains: GainSet | None) -> None:
        """Put gains in force, or hold the command."""
        self._use(gains)

    def sentence(self, gains: GainSet | None) -> str:
        """Say which gains are in force."""
        if gains is None:
            return "no gains are in force, the command is held"
        return f"{controller_text(self.controller_of(gains))} in force"


def controller_text(gains: Controller | None) -> str:
    """Return gains in words."""
    if gains is None:
        return "no gains"
    return f"kc {gains.kc:.6g}, ti {gains.ti:.6g} s, td {gains.td:.6g} s"


class RemoteController(_Place):
    """Another node that controls: gains are parameters of it, and its set-point is a topic.

    Each service call is given up after `TIMEOUT`, because the other node may hang.

    :param node: this node.
    :param values: the parameters of controller_node.
    :param setpoints: writes a set-point into its message.
    :param disturbed: called with a sentence when a third node moves the set-point.
    """

    outlives = True

    def __init__(
        self,
        node: ServedNode,
        values: Mapping[str, Any],
        setpoints: CommandMessage,
        disturbed: Callable[[str], None],
    ) -> None:
        # Its law is known with the first gains that are for it.
        super().__init__(values["apply_to"], mapping_of(values["apply_parameters"]), None)
        self._node = node
        # Its gain from the set-point to the command, added to that of its gains [u/y].
        self._feedforward: float = values["apply_feedforward"]
        self.command = math.nan
        """The last command received [u]; NaN before the first."""
        self.setpoint: float = values["initial_setpoint"]
        """The set-point in force [y]; NaN: not known."""
        self.setpoints = CommandPublisher(node, setpoints, "setpoint", heard=True)
        """Where its set-points go out."""
        self._disturbed, self._offset = disturbed, 0.0
        quality.subscription(node, setpoints.kind, "setpoint", self._on_setpoint, quality.COMMAND)
        base = self.name.rstrip("/")
        # Answers must be handled while the callback that waits for them is still running.
        self._group = ReentrantCallbackGroup()
        self._get, self._set = (
            node.create_client(kind, f"{base}/{name}", callback_group=self._group)
            for kind, name in (
                (GetParameters, "get_parameters"),
                (SetParametersAtomically, "set_parameters_atomically"),
            )
        )

    def control(self, gains: Controller) -> Control:
        """Return gains as the other node runs them, by the law of the newest gains for it."""
        return in_another_node(gains, self._rate, self._feedforward)

    def require_law(self, gains: Gains) -> None:
        """Refuse gains for a program whose parameters are not the gains themselves."""
        if gains.law and not LAWS[gains.law].sets_gains:
            raise TuningError(
                f"they are for the law {gains.law}, which {self.name} does not run: write them "
                f"to a file with apply_gains --file, or tune without that law"
            )
        self._rate = rate_of(gains.law, gains.law_period)

    def sentence(self, gains: GainSet | None) -> str:
        """Say which gains are in force."""
        if gains is None:
            return f"{self.name} keeps its gains, since no earlier gains are known: check them"
        return f"{self.name} has {gains}"

    async def read(self) -> GainSet:
        """Return the present values of the parameters.

        :raises RelayAutotuneError: if the node does not answer, or lacks one of them.
        """
        names = list(self._mapping.values())
        answer = await self._ask(self._get, GetParameters.Request(names=names))
        found = map(parameter_value_to_python, answer.values)
        values = {n: v for n, v in zip(names, found, strict=False) if isinstance(v, float)}
        missing = [name for name in names if name not in values]
        if missing:
            raise LoopError(f"{self.name} has no number {', '.join(missing)}")
        return GainSet.of(values)

    async def put(self, gains: GainSet | None) -> None:
        """Set the parameters and read them back.

        :param gains: None: leave them as they are, since another node's command cannot be held.
        :raises RelayAutotuneError: if the values read back differ, or cannot be read.
        """
        if gains is None:
            return
        wanted = [Parameter(name, value=value).to_parameter_msg() for name, value in gains.values]
        answer = await self._ask(self._set, SetParametersAtomically.Request(parameters=wanted))
        if not answer.result.successful:
            raise LoopError(f"{self.name} refused the gains: {answer.result.reason}")
        found = await self.read()
        if not found.is_near(gains):
            raise LoopError(f"{self.name} did not take the gains: it has {found}, not {gains}")

    async def _ask(self, client: Any, request: Any) -> Any:
        if not client.service_is_ready():
            raise LoopError(Code.NODE_NOT_THERE(node=self.name))
        answer = client.call_async(request)

        def give_up() -> None:
            if not answer.done():
                answer.set_exception(LoopError(f"{self.name} did not answer within {TIMEOUT:g} s"))

        timer = self._node.create_timer(TIMEOUT, give_up, callback_group=self._group, clock=STEADY)
        try:
            return await answer
        finally:
            self._node.destroy_timer(timer)

    # Its loop.

    def require_ready(self) -> None:
        """Refuse a loop in which the effect of a set-point step could not be seen.

        :raises NotReadyError: with the reason.
        """
        topic, target = self.setpoints.topic, self.name
        if math.isnan(self.setpoint):
            raise NotReadyError(
                f"the set-point of {target} is not known: publish it on {topic}, or give "
                "initial_setpoint"
            )
        # One subscription is the node's own.
        if self.setpoints.publisher.get_subscription_count() < 2:
            raise NotReadyError(Code.NOBODY_TAKES(topic=topic, node=target))
        if math.isnan(self.command):
            raise NotReadyError(Code.NOT_HEARD(node=target))

    def move(self, offset: float) -> None:
        """Put a step on the set-point [y]; 0: none."""
        if offset == self._offset:
            return
        self._offset = offset
        self.setpoints.send(self.setpoint + offset)

    def _on_setpoint(self, message: Any) -> None:
        try:
            value = self.setpoints.messages.value(message)
        except FieldError as error:
            self._disturbed(f"another node set a set-point that cannot be read: {error}")
            return
        if self.setpoints.is_own(value) or not is_usable(value):
            return
        changed = value != self.setpoint + self._offset
        # The new set-point is in force already, so there is no step to take back.
        self.setpoint, self._offset = value, 0.0
        if changed:
            self._disturbed(f"another node set the set-point to {value:g}")


Place = OwnGains | RemoteController
"""Where gains act.

``require_law`` refuses gains for a law that does not run there; ``read`` returns those in force if
another node may have changed them, else None; ``put`` applies gains, all or none; ``sentence``
tells which are in force. All but the last raise RelayAutotuneError.
"""


def setpoint_message(values: Mapping[str, Any]) -> CommandMessage:
    """Return what writes a set-point into the message that its receiver takes.

    :param values: the parameters of controller_node.
    :raises ParameterError: if nothing is done with a parameter.
    """
    field, target = values["controller_command_field"], values["apply_to"]
    if field and target:
        return CommandMessage(*(values[each.name] for each in MESSAGE_PARAMETERS))
    said = [each.name for each in MESSAGE_PARAMETERS if values[each.name] != each.default]
    if field or said:
        raise ParameterError(
            f"{'controller_command_field' if field else said[0]} is given, which is for apply_to "
            f"together with controller_command_field: the set-point of another node in a message "
            f"of its own"
        )
    return CommandMessage()
