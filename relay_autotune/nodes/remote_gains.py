# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains of a controller in another node, set through its parameters: all of them or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from relay_autotune.control.gains_history import GainSet
from relay_autotune.errors import ParameterError, RelayAutotuneError, TuningError
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.loop.laws import LAWS
from relay_autotune.nodes.lifetime import STEADY

# Names of the gains that may be sent, of the ISA and of the parallel form.
NAMES = ("kc", "ti", "td", "tf", "b", "p", "i", "d")

# Longest wait for an answer [s].
TIMEOUT = 2.0


class RemoteError(RelayAutotuneError):
    """Another node did not take the gains."""


def mapping_of(texts: Sequence[str]) -> dict[str, str]:
    """Return the parameter name for each gain.

    :param texts: pairs such as ``p:gains.heater.p``.
    :raises ParameterError: if a text is not such a pair.
    """
    found = {}
    for text in texts:
        name, _, target = text.partition(":")
        if name not in NAMES or not target:
            raise ParameterError(
                f"apply_parameters has {text!r}, expected GAIN:PARAMETER with a gain of "
                f"{', '.join(NAMES)}"
            )
        found[name] = target
    return found


def controller_of(gains: Mapping[str, float], feedforward: float = 0.0) -> Controller:
    """Return the controller with gains given by name, in the ISA or the parallel form.

    :param gains: some of `NAMES`; defaults: no derivative, no filter, set-point weight 1.
    :param feedforward: gain from the set-point to the command, beside these gains [u/y]; with
        ``kc (b r - y)`` it is a set-point weight ``b + feedforward/kc``.
    :raises RelayAutotuneError: if they are not enough for a controller.
    """
    proportional = gains.get("kc", gains.get("p"))
    if proportional is None or not {"ti", "i"} & set(gains):
        raise RemoteError(
            f"only the gains {', '.join(gains)} are known, expected kc or p, and ti or i: name "
            "their parameters in apply_parameters"
        )
    integral, derivative = gains.get("i", 0.0), gains.get("d", 0.0)
    return Controller(
        proportional,
        gains.get("ti", proportional / integral if integral else 0.0),
        gains.get("td", derivative / proportional if proportional else 0.0),
        gains.get("tf", 0.0),
        gains.get("b", 1.0) + (feedforward / proportional if proportional else 0.0),
    )


class RemoteGains:
    """The parameters of another node as a place for gains: all of them or none.

    Each service call is given up after `TIMEOUT`, because the other node may hang.

    :param node: the calling node.
    :param target: name of the controlling node.
    :param mapping: its parameter name for each gain.
    :param feedforward: its gain from the set-point to the command beside these [u/y].
    """

    outlives = True

    def __init__(
        self, node: Node, target: str, mapping: Mapping[str, str], feedforward: float = 0.0
    ) -> None:
        self.name = target
        self._node = node
        self._mapping = dict(mapping)
        self._feedforward = feedforward
        base = target.rstrip("/")
        # Answers must be handled while the callback that waits for them is still running.
        self._group = ReentrantCallbackGroup()
        self._get, self._set = (
            node.create_client(kind, f"{base}/{name}", callback_group=self._group)
            for kind, name in (
                (GetParameters, "get_parameters"),
                (SetParametersAtomically, "set_parameters_atomically"),
            )
        )

    def require_law(self, gains: Gains) -> None:
        """Refuse gains for a program whose parameters are not the gains themselves.

        :raises TuningError: with what to do.
        """
        if gains.law and not LAWS[gains.law].sets_gains:
            raise TuningError(
                f"they are for the law {gains.law}, which {self.name} does not run: write them "
                f"to a file with apply_gains --file, or tune without that law"
            )

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
        values = gains.by_name()
        named = {name: values[target] for name, target in self._mapping.items()}
        return controller_of(named, self._feedforward)

    def said(self, gains: GainSet | None) -> str:
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
        values = {}
        for name, value in zip(names, answer.values, strict=False):
            if value.type == ParameterType.PARAMETER_DOUBLE:
                values[name] = float(value.double_value)
        missing = [name for name in names if name not in values]
        if missing:
            raise RemoteError(f"{self.name} has no number {', '.join(missing)}")
        return GainSet.of(values)

    async def put(self, gains: GainSet | None) -> None:
        """Set the parameters and read them back.

        :param gains: None: leave them as they are, since another node's command cannot be held.
        :raises RelayAutotuneError: if the values read back differ, or cannot be read.
        """
        if gains is None:
            return
        request = SetParametersAtomically.Request(
            parameters=[
                Parameter(
                    name=name,
                    value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value),
                )
                for name, value in gains.values
            ]
        )
        answer = await self._ask(self._set, request)
        if not answer.result.successful:
            raise RemoteError(f"{self.name} refused the gains: {answer.result.reason}")
        found = await self.read()
        if not found.is_near(gains):
            raise RemoteError(f"{self.name} did not take the gains: it has {found}, not {gains}")

    async def _ask(self, client: Any, request: Any) -> Any:
        if not client.service_is_ready():
            raise RemoteError(f"the node {self.name} is not there, or has no parameter services")
        answer = client.call_async(request)

        def give_up() -> None:
            if not answer.done():
                answer.set_exception(
                    RemoteError(f"{self.name} did not answer within {TIMEOUT:g} s")
                )

        timer = self._node.create_timer(
            TIMEOUT,
            give_up,
            callback_group=self._group,
            clock=STEADY,
        )
        try:
            return await answer
        finally:
            self._node.destroy_timer(timer)
