# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Models and controllers as systems of python-control."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from relay_autotune.errors import MissingPackageError, ModelError
from relay_autotune.process.transfer_function import TransferFunction

if TYPE_CHECKING:
    from relay_autotune.loop.gains import Controller

PADE_ORDER = 5


def to_control(system: TransferFunction | Controller, *, pade_order: int = PADE_ORDER) -> Any:
    """Return a model, or a controller from error to command, as `control.TransferFunction`.

    >>> from relay_autotune import Controller, TransferFunction, to_control
    >>> loop = to_control(TransferFunction.fopdt(1.65, 20.0, 10.0))
    >>> loop = loop * to_control(Controller(kc=0.6, ti=20.0))
    >>> loop.ninputs, loop.noutputs
    (1, 1)

    A rational function cannot hold a dead time D: it becomes a Pade approximation, all-pass, whose
    phase is that of the dead time up to about ``w = n/D`` rad/s for the order n (within 0.03 rad
    for n = 2, 0.003 rad for n = 5). A controller's set-point weight has no place in it.

    :param system: a process, or a controller such as the gains of a rule.
    :param pade_order: n >= 1, the number of poles that the dead time adds.
    :raises ModelError: if the order is less than 1.
    :raises MissingPackageError: if python-control is not installed.
    """
    if pade_order < 1:
        raise ModelError(f"pade_order must be at least 1, found {pade_order}")
    try:
        control = importlib.import_module("control")
    except ImportError as error:
        raise MissingPackageError(
            f"python-control is needed for to_control and cannot be loaded ({error}); "
            "install it with `pip install control`"
        ) from error
    model = system if isinstance(system, TransferFunction) else system.transfer_function()
    rational = control.TransferFunction(list(model.numerator), list(model.denominator))
    if model.dead_time == 0.0:
        return rational
    return rational * control.TransferFunction(*control.pade(model.dead_time, pade_order))
