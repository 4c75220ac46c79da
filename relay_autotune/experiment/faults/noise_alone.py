"""Recognise a relay that switches on the noise of its sensor alone."""

from __future__ import annotations

from relay_autotune.record.record import FloatArray

# An oscillation shows in the samples' standard deviation, which must be so many times that of the
# noise; a relay without a process switches on noise alone, too, and its cycles agree at last.
_ABOVE_NOISE = 1.5

TELL = 50
"""So many samples tell it before there are cycles enough."""


def why_noise_alone(measurement: FloatArray, noise_std: float, after: str) -> str:
    """Return why samples are no oscillation; empty: they may be one.

    :param measurement: the samples [y], shape (n,).
    :param noise_std: standard deviation of the noise at rest [y].
    :param after: how many cycles there are, in words.
    """
    spread = float(measurement.std())
    if spread >= _ABOVE_NOISE * noise_std:
        return ""
    return (
        f"no oscillation after {after}, only noise: the measurement's standard deviation is "
        f"{spread:.3g}, that of its noise at rest {noise_std:.3g}; give a larger amplitude, or "
        "check that the actuator follows its command"
    )
