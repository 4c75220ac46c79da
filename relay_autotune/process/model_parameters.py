# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of models: name, unit, scale and range of each, and checks of their values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.errors import ModelError


@dataclass(frozen=True)
class Parameter:
    """A parameter of a model.

    :param name: in results.
    :param unit: of its value; of a gain without integrators.
    :param logarithmic: True: it cannot change sign, so its logarithm is fitted and drawn, and the
        interval is that of the logarithm.
    :param least: smallest value.
    :param field: its name in flags, messages and the parameters of plant_node.
    :param turned: True: the field has the opposite sign.
    """

    name: str
    unit: str = "s"
    logarithmic: bool = True
    least: float = -math.inf
    field: str = "time_constants"
    turned: bool = False


GAIN = Parameter("gain", "y/u", field="gain")
INVERSE = Parameter("inverse_time_constant", field="zeros", turned=True)
TIME_CONSTANT = Parameter("time_constant")
TIME_CONSTANT_1 = Parameter("time_constant_1")
TIME_CONSTANT_2 = Parameter("time_constant_2")
TIME_CONSTANT_3 = Parameter("time_constant_3")
NATURAL_FREQUENCY = Parameter("natural_frequency", "rad/s", field="natural_frequency")
DAMPING = Parameter("damping", "", field="damping")
ZERO = Parameter("zero", logarithmic=False, field="zeros")
DEAD_TIME = Parameter("dead_time", logarithmic=False, least=0.0, field="dead_time")

# Every structure lists its parameters in this order.
PARAMETERS = (
    *(GAIN, INVERSE, TIME_CONSTANT, TIME_CONSTANT_1, TIME_CONSTANT_2, TIME_CONSTANT_3),
    *(NATURAL_FREQUENCY, DAMPING, ZERO, DEAD_TIME),
)


def positive(time_constant: float) -> float:
    """Return a time constant [s].

    :raises ModelError: unless it is positive.
    """
    if not time_constant > 0.0:
        raise ModelError(f"a time constant here must be > 0 s, found {time_constant:g} s")
    return float(time_constant)


def at_least_one(order: int) -> int:
    """Return the order of equal lags.

    :raises ModelError: if it is less than 1.
    """
    if order < 1:
        raise ModelError(f"the order of equal lags must be at least 1, found {order}")
    return order


def exactly(
    count: int, constants: Sequence[complex], name: str = "time_constants"
) -> tuple[complex, ...]:
    """Return the constants if their number is ``count`` [s].

    :raises ModelError: if there are more or fewer.
    """
    if len(constants) != count:
        raise ModelError(f"the structure needs {name} of length {count}, found {len(constants)}")
    return tuple(complex(c) for c in constants)


def oscillating_pair(natural_frequency: float, damping: float) -> tuple[complex, complex]:
    """Return the time constants of ``s^2/w0^2 + 2 zeta s/w0 + 1`` [s].

    :param natural_frequency: w0 [rad/s].
    :param damping: zeta.
    :raises ModelError: if w0 is not positive.
    """
    if not natural_frequency > 0.0:
        raise ModelError(f"a natural frequency must be > 0 rad/s, found {natural_frequency:g}")
    root = np.emath.sqrt(complex(damping * damping - 1.0))
    return (
        complex((damping + root) / natural_frequency),
        complex((damping - root) / natural_frequency),
    )
