# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Linear controllers as the loop analysis uses them: PI, PID, or with an internal model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from relay_autotune.arrays import ComplexArray
from relay_autotune.process.transfer_function import TransferFunction


class ControlLaw(Protocol):
    """A linear controller, as :class:`~relay_autotune.loop.gains.Controller` is."""

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return -command per measurement at complex frequencies [u/y]."""

    def from_setpoint(self, s: ComplexArray) -> ComplexArray:
        """Return command per set-point at complex frequencies [u/y]."""

    def characteristic(self, model: TransferFunction) -> tuple[TransferFunction, ...]:
        """Return the terms L_k of the loop's characteristic equation ``1 + sum L_k(s) = 0``."""


@dataclass(frozen=True)
class InternalModelLaw:
    r"""A controller that feeds its own command back through an internal model.

    ``u = forward (r - y) + inside u``, so that from error to command it is
    ``forward/(1 - inside)``: with internal model control ``forward`` is the controller Q and
    ``inside`` is Q times the model.

    :param forward: from error to command [u/y].
    :param inside: from command to command.
    """

    forward: TransferFunction
    inside: TransferFunction

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return -command per measurement at complex frequencies [u/y].

        :param s: rad/s, any shape.
        """
        return np.asarray(self.forward(s) / (1.0 - self.inside(s)))

    def from_setpoint(self, s: ComplexArray) -> ComplexArray:
        """Return command per set-point at complex frequencies [u/y].

        :param s: rad/s, any shape.
        """
        return self(s)

    def characteristic(self, model: TransferFunction) -> tuple[TransferFunction, ...]:
        """Return the terms L_k of the characteristic equation ``1 + sum L_k(s) = 0``.

        :param model: the process.
        """
        inside, forward = self.inside, self.forward
        negative = TransferFunction(
            -inside.gain, inside.zeros, inside.time_constants, inside.integrators, inside.dead_time
        )
        through = TransferFunction(
            forward.gain * model.gain,
            forward.zeros + model.zeros,
            forward.time_constants + model.time_constants,
            forward.integrators + model.integrators,
            forward.dead_time + model.dead_time,
        )
        return negative, through
