# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Comparison of the models that the two halves of a record give."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.waveform.fit_covariance import Fit, Noise, estimate_of
from relay_autotune.identification.waveform.separable import Problem, Trial, left_beside, refine
from relay_autotune.process.transfer_function import TransferFunction

_TRIAL = 1e-6
_STEPS = 15
# Mean square of two standardised deviations that 99 % of equal halves do not exceed.
_BY_CHANCE = 4.6
# Largest standard deviation of its response's logarithm with which a half gives a model.
_TOLD = 0.5
_STEP = 1e-5
_FEWEST = 24


@dataclass(frozen=True)
class Halves:
    """Comparison of the two halves of a record.

    :param apart: mean square of the difference of their responses, relative to its covariance.
    :param models: of those halves that determine one.
    """

    apart: float
    models: tuple[TransferFunction, ...]

    @property
    def agree(self) -> bool:
        """True if they differ by no more than chance."""
        return self.apart <= _BY_CHANCE


def parted(problem: Problem, state: Trial) -> tuple[Problem, Problem] | None:
    """Split a record into halves of equal information on the model's parameters.

    :param problem: of one or several experiments.
    :param state: its fit.
    :return: None for several experiments, or for too few samples.
    """
    if len(problem.bounds) > 1:
        return None
    jacobian = np.concatenate((state.columns[: len(problem.structure.powers)], state.derivative))
    size = np.einsum("pn,pn->p", jacobian, jacobian)
    size[size == 0.0] = 1.0
    told = np.cumsum(np.sum(jacobian**2 / size[:, None], axis=0))
    middle = int(np.searchsorted(told, 0.5 * told[-1]))
    if min(middle, problem.time.size - middle) < max(_FEWEST, 4 * state.parameters):
        return None
    return problem.part(slice(None, middle)), problem.part(slice(middle, None))


def halves_of(fit: Fit, frequency: float) -> Halves | None:
    """Fit the chosen structure to either half of a record, and compare the responses.

    Both halves hold equal information on the model. With d the difference of the logarithms of
    their responses at one frequency, as real and imaginary part, and C its covariance, the mean
    square is ``d' C^-1 d/2``. It is 1 on average for one process under noise of this colour.

    :param fit: in colour, of one experiment.
    :param frequency: at which the responses are compared [rad/s].
    :return: None: it cannot be split, or a half gives no covariance.
    """
    parts = parted(fit.problem, fit.state)
    if parts is None:
        return None
    found: list[tuple[Estimate, complex, FloatArray]] = []
    evidence = 0.0
    for half in parts:
        own = refine(half, fit.state.theta, tolerance=_TRIAL, most=_STEPS)
        evidence += _evidence(half, own, fit.state)
        estimate = estimate_of(half, own, fit, Noise(False))
        if estimate is None or not estimate.known:
            return None
        found.append((estimate, *_response(estimate, frequency)))
    (first, at_first, of_first), (second, at_second, of_second) = found
    difference = np.log(at_first / at_second)
    apart = np.array([difference.real, difference.imag])
    covariance = of_first + of_second
    if not bool(np.all(np.isfinite(covariance))):
        return None
    square = 0.5 * float(apart @ np.linalg.pinv(covariance, hermitian=True) @ apart)
    # Where a half determines little, its fit may end far away, at a covariance that holds there
    # alone. No difference is more certain than that the halves differ at all.
    square = min(square, 0.5 * evidence)
    models = tuple(
        estimate.model
        for estimate, own in ((first, of_first), (second, of_second))
        if math.sqrt(float(np.trace(own))) <= _TOLD
    )
    return Halves(square, models)


def _evidence(half: Problem, own: Trial, whole: Trial) -> float:
    """Return twice the logarithm of the likelihood ratio of a half's fit and the whole's.

    :param half: the samples of the half.
    :param own: their fit.
    :param whole: the fit to all samples; the half has an offset, drift and past of its own.
    """
    left, _ = left_beside(half, whole)
    return half.time.size * math.log(max(float(left @ left) / max(own.cost, 1e-300), 1.0))


def _response(estimate: Estimate, frequency: float) -> tuple[complex, FloatArray]:
    """Return the response at a frequency, and the covariance of its logarithm, shape (2, 2)."""
    s, build = 1j * frequency, estimate.structure.build
    at = complex(estimate.model(s))
    slopes = np.zeros((2, estimate.values.size))
    for i, value in enumerate(estimate.values):
        moved = estimate.values.copy()
        step = _STEP * (abs(value) or 1.0 / frequency)
        moved[i] += step
        change = complex(np.log(build(moved)(s) / at)) / step
        slopes[:, i] = change.real, change.imag
    root = estimate.root
    spread = slopes @ estimate.covariance @ slopes.T
    if root is not None:
        spread = (slopes @ root) @ (slopes @ root).T
    return at, np.asarray(spread)
