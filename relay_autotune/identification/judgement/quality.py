# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How much of a record a model leaves unexplained, with one set of thresholds."""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.identification.result import Identification
from relay_autotune.record.record import Record

# The noise is known to 10 % from the 50 samples before a test, so that a residual of 1.3 times
# the noise is noise alone; 2 % of the measurement's spread is left by any simple structure.
_OF_NOISE = 1.3
_OF_SPREAD = 0.02
# Misfit beyond which a model is of another process.
_FAR_OFF = 2.0
# Probability as white noise below which a residual is clearly not white.
_NOT_WHITE = 1e-6


def misfit(found: Identification, record: Record, *, noise: float | None = None) -> float:
    """Return the residual over the largest one of a good fit, so that up to 1 is good.

    :param found: what was identified.
    :param record: the record.
    :param noise: standard deviation of the noise [y]; default: that measured before the test, 0
        where it was not measured.
    :return: NaN where the residual is not known.
    """
    known = record.noise_std if noise is None else noise
    spread = _OF_SPREAD * float(np.std(record.measurement))
    allowed = max(_OF_NOISE * known if math.isfinite(known) else 0.0, spread)
    residual = found.fit.residual_rms
    return residual / allowed if allowed > 0.0 else (math.inf if residual > 0.0 else 0.0)


def is_contradicted(found: Identification, record: Record) -> bool:
    """Return whether the residual of a model is clearly not noise.

    Where the noise was not measured, only the residual's correlation shows it.

    :param found: what was identified.
    :param record: the record.
    """
    if not misfit(found, record, noise=0.0) > 1.0:
        return False
    measured = math.isfinite(record.noise_std)
    return (measured and misfit(found, record) > 1.0) or found.fit.whiteness_p < _NOT_WHITE


def unexplained_share(found: Identification, record: Record) -> float:
    """Return the share of the measurement's variance that neither model nor noise explains.

    :param found: what was identified.
    :param record: the record.
    """
    variance = float(np.var(record.measurement))
    left = found.fit.residual_rms**2 - record.noise**2
    return max(left, 0.0) / variance if variance > 0.0 else math.nan


def is_far_off(found: Identification, record: Record) -> bool:
    """Return whether a model's residual is too large for its intervals to mean anything.

    :param found: what was identified.
    :param record: the record.
    """
    return misfit(found, record, noise=record.noise) > _FAR_OFF
