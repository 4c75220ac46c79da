"""Gains for a controller in another node, set through its parameters: all of them or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from relay_autotune.control.gains import Controller
from relay_autotune.errors import ParameterError, RelayAutotuneError

# What may be sent, by the names of the gains in both forms.
NAMES = ("kc", "ti", "td", "tf", "b", "p", "i", "d")

# How far a value that is read back may be from what was set, relatively.
_EQUAL = 1e-9


class RemoteError(RelayAutotuneError):
    """Another node that did not take the gains."""


def mapping_of(texts: Sequence[str]) -> dict[str, str]:
    """Return which gain goes into which parameter.

    :param texts: such as ``p:gains.heater.p``.
    :raises ParameterError: if a text is no such pair.
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


def controller_of(gains: Mapping[str, float]) -> Controller:
    """Return the controller that gains by name make, in the ISA or the parallel form.

    :param gains: some of `NAMES`; without a derivative, filter or set-point weight, there is
        none, none, and 1.
    :raises RelayAutotuneError: if they make none.
    """
    proportional = gains.get("kc", gains.get("p"))
    if proportional is None or not {"ti", "i"} & set(gains):
        raise RemoteError(
            f"of the gains only {', '.join(gains)} are known, expected kc or p, and ti or i: name "
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


class RemoteGains:
    """Set the gains of a node and read them back.

    :param node: the node that asks.
    :param target: name of the node that controls.
    :param mapping: which gain goes into which of its parameters.
    """

    def __init__(self, node: Node, target: str, mapping: Mapping[str, str]) -> None:
        self.target = target
        self._mapping = dict(mapping)
        base = target.rstrip("/")
        # The answers must come while the callback that waits for them has not returned.
        group = ReentrantCallbackGroup()
        self._get, self._set = (
            node.create_client(kind, f"{base}/{name}", callback_group=group)
            for kind, name in (
                (GetParameters, "get_parameters"),
                (SetParametersAtomically, "set_parameters_atomically"),
            )
        )

    async def read(self) -> dict[str, float]:
        """Return the present values of the parameters by name.

        :raises RemoteError: if the node is not there, or lacks one of them.
        """
        if not self._get.service_is_ready() or not self._set.service_is_ready():
            raise RemoteError(f"the node {self.target} is not there, or has no parameter services")
        names = list(self._mapping.values())
        answer = await self._get.call_async(GetParameters.Request(names=names))
        values = {}
        for name, value in zip(names, answer.values, strict=False):
            if value.type == ParameterType.PARAMETER_DOUBLE:
                values[name] = float(value.double_value)
        missing = [name for name in names if name not in values]
        if missing:
            raise RemoteError(f"{self.target} has no number {', '.join(missing)}")
        return values

    async def controller(self) -> Controller:
        """Return the gains in force.

        :raises RelayAutotuneError: if they cannot be read, or make no controller.
        """
        values = await self.read()
        return controller_of({name: values[target] for name, target in self._mapping.items()})

    async def write(self, gains: Controller) -> dict[str, float]:
        """Set the parameters, read them back, and undo all if one is not as it was set.

        :param gains: the gains.
        :return: the values before, by parameter name.
        :raises RemoteError: if the gains are not in force; then the ones before are.
        """
        before = await self.read()
        wanted = {target: float(getattr(gains, name)) for name, target in self._mapping.items()}
        await self._put(wanted)
        found = await self.read()
        wrong = [
            f"{name} is {found[name]:g} instead of {value:g}"
            for name, value in wanted.items()
            if abs(found[name] - value) > _EQUAL * abs(value)
        ]
        if wrong:
            await self._put(before)
            raise RemoteError(f"{self.target} did not take the gains: {'; '.join(wrong)}")
        return before

    async def restore(self, values: Mapping[str, float]) -> None:
        """Set values that were there before.

        :param values: by parameter name.
        :raises RemoteError: if the node refuses them.
        """
        await self._put(values)

    async def _put(self, values: Mapping[str, float]) -> None:
        request = SetParametersAtomically.Request(
            parameters=[
                Parameter(
                    name=name,
                    value=ParameterValue(
                        type=ParameterType.PARAMETER_DOUBLE, double_value=float(value)
                    ),
                )
                for name, value in values.items()
            ]
        )
        answer = await self._set.call_async(request)
        if not answer.result.successful:
            raise RemoteError(f"{self.target} refused the gains: {answer.result.reason}")
