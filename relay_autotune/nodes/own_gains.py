# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains of the controller in this node."""

from __future__ import annotations

import math
from collections.abc import Callable

from relay_autotune.control.gains_history import GainSet
from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.loop.laws import LawRate
from relay_autotune.nodes.controller_parameters import GAINS, OWN_LAWS, parameters_of_law

# Relative difference of two periods that are the same.
_SAME_RATE = 0.01


class OwnGains:
    """The controller of this node as a place for gains.

    :param use: puts gains in force; None: the command is held.
    :param rate: the law that it runs; None: its own.
    """

    name = "this node"
    outlives = False

    def __init__(self, use: Callable[[GainSet | None], None], rate: LawRate | None) -> None:
        self._use = use
        self._rate = rate

    def require_law(self, gains: Gains) -> None:
        """Refuse gains for another law than that of this node.

        :raises TuningError: with the parameters that make it run their law.
        """
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
