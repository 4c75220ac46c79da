"""What the constructors of transfer functions demand of their parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from relay_autotune.errors import ModelError


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
    """Return so many constants [s].

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
