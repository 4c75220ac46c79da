# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains of the controller in this node."""

from __future__ import annotations

from collections.abc import Callable

from relay_autotune.control.gains_history import GainSet
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.laws import OWN_LAW
from relay_autotune.nodes.controller_parameters import GAINS


class OwnGains:
    """The controller of this node as a place for gains.

    :param use: puts gains in force; None: the command is held.
    """

    name = "this node"
    outlives = False
    laws: tuple[str, ...] = ("", OWN_LAW)

    def __init__(self, use: Callable[[GainSet | None], None]) -> None:
        self._use = use

    async def read(self) -> GainSet | None:
        """Return None: no other node changes these gains."""
        return None

    async def put(self, gains: GainSet | None) -> None:
        """Put gains in force, or hold the command."""
        self._use(gains)

    def set_of(self, controller: Controller) -> GainSet:
        """Return the gains of a controller as a set."""
        return set_of(controller)

    def controller_of(self, gains: GainSet) -> Controller:
        """Return the controller with these gains."""
        return controller_of(gains)

    def said(self, gains: GainSet | None) -> str:
        """Say which gains are in force."""
        if gains is None:
            return "no gains are in force, the command is held"
        return f"{said(controller_of(gains))} in force"


def set_of(gains: Controller) -> GainSet:
    """Return gains as the history keeps them.

    :param gains: the controller.
    """
    return GainSet.of({entry.name: getattr(gains, entry.name) for entry in GAINS})


def controller_of(gains: GainSet) -> Controller:
    """Return gains that the history has kept.

    :param gains: as `set_of` made them.
    """
    return Controller(**gains.by_name())


def said(gains: Controller | None) -> str:
    """Return gains in words."""
    if gains is None:
        return "no gains"
    return f"kc {gains.kc:.6g}, ti {gains.ti:.6g} s, td {gains.td:.6g} s"
