# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Recognise a relay that switches only on the noise of its sensor."""

from __future__ import annotations

from relay_autotune.record.record import FloatArray

# Least ratio of the samples' standard deviation to the noise's for an oscillation. A relay without
# a process switches on noise, too, and some of its cycles agree in the end.
_ABOVE_NOISE = 1.5

TELL = 50
"""Number of samples for this decision before there are enough cycles."""


def why_noise_alone(measurement: FloatArray, noise_std: float, after: str) -> str:
    """Return why samples are no oscillation, "" if they may be one.

    :param measurement: the samples [y], shape (n,).
    :param noise_std: standard deviation of the noise at rest [y].
    :param after: number of cycles, in words.
    """
    spread = float(measurement.std())
    if spread >= _ABOVE_NOISE * noise_std:
        return ""
    return (
        f"no oscillation after {after}, only noise: the measurement's standard deviation is "
        f"{spread:.3g}, that of its noise at rest {noise_std:.3g}; give a larger amplitude, or "
        "check that the actuator follows its command"
    )
