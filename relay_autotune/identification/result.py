"""What an identification gives: model, uncertainty, quality of fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from relay_autotune.confidence import NORMAL_95
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.combinations import DETERMINED, Combination
from relay_autotune.identification.uncertainty import Uncertain
from relay_autotune.identification.uncertainty import is_logarithmic as is_logarithmic
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point

if TYPE_CHECKING:
    from relay_autotune.identification.judgement.validation import Validation
    from relay_autotune.identification.shown.fourier import FrequencyPoint

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class FitReport:
    """How well a model reproduces the record.

    :param residual_rms: root mean square of measurement minus model [y].
    :param noise_std: noise measured before the test [y]; NaN: not estimated.
    :param fit: 1 - rms(residual)/rms(measurement about its mean).
    :param whiteness_p: probability of a residual this correlated if it were white (Ljung and
        Box); NaN: not estimated.
    :param prediction: root mean square error over the last cycle, predicted from those
        before [y]; NaN: not estimated.
    :param noise_to_signal: mean|residual|/mean|model about the operating point|, N2 of Wang et
        al. 1997; NaN: not estimated.
    :param noise_to_signal_power: the same of mean squares, their N1; NaN: not estimated.
    """

    residual_rms: float = math.nan
    noise_std: float = math.nan
    fit: float = math.nan
    whiteness_p: float = math.nan
    prediction: float = math.nan
    noise_to_signal: float = math.nan
    noise_to_signal_power: float = math.nan


def _model_alone(_: FloatArray) -> TransferFunction:
    raise IdentificationError("this rival is known by its model alone, without parameters")


@dataclass(frozen=True)
class Rival:
    """Another structure that the data do not rule out.

    :param model: its best fit.
    :param support: its weight among all structures tried, 0 to 1.
    :param build: the transfer function for any values of the parameters.
    :param parameters: names of the structure's parameters; empty: only the model is known.
    :param values: their values, shape (p,).
    :param root: B of their covariance B B', shape (p, k).
    """

    model: TransferFunction
    support: float
    build: Callable[[FloatArray], TransferFunction] = _model_alone
    parameters: tuple[str, ...] = ()
    values: FloatArray = field(default_factory=lambda: np.empty(0))
    root: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the values, shape (p, p)."""
        return self.root @ self.root.T


@dataclass(frozen=True)
class Identification:
    """A model identified by one method, with what is known of its accuracy.

    :param method: name in the registry.
    :param model: the transfer function.
    :param build: the transfer function for any values of the parameters.
    :param parameters: names of the structure's parameters.
    :param values: their values, shape (p,).
    :param covariance: of the values, shape (p, p); NaN: not estimated.
    :param ci95_low: lower ends of the 95 % intervals, shape (p,); NaN: not estimated.
    :param ci95_high: upper ends, shape (p,); NaN: not estimated.
    :param ultimate_gain: K_u [u/y], with the sign of the process; NaN: the model has none.
    :param ultimate_gain_std: its standard deviation [u/y]; NaN: not estimated.
    :param ultimate_frequency: w_u [rad/s]; NaN: the model has none.
    :param ultimate_frequency_std: its standard deviation [rad/s]; NaN: not estimated.
    :param fit: quality of the fit.
    :param warnings: sentences that the user must read.
    :param undetermined: parameters whose 95 % interval is wider than 20 % of the value.
    :param fitted: the model's measurement at the record's samples, with all that was estimated
        beside the model [y], shape (n,); NaN: not part of the fit; empty: not computed.
    :param rivals: other structures with some support, the best first.
    :param validation: how the limit cycle of the model differs from the record's; None: not
        compared.
    :param points: measured points of the frequency response, by rising frequency; empty: the
        method has none.
    :param integrated_error: ``int |G_m - G|/|G| dw`` over two decades about w_u, with G the
        model that counts (Thyagarajan and Yu 2003, eqs 29 and 30) [rad/s]; NaN: of that model
        itself, or not computed.
    :param support: weight of this structure among all that were tried, 0 to 1; 1: no other was.
    :param combinations: where a parameter is not determined, what the data determine all the
        same.
    :param advice: then, what test would determine it, each a sentence.
    """

    method: str
    model: TransferFunction
    build: Callable[[FloatArray], TransferFunction]
    parameters: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    ci95_low: FloatArray
    ci95_high: FloatArray
    ultimate_gain: float = math.nan
    ultimate_gain_std: float = math.nan
    ultimate_frequency: float = math.nan
    ultimate_frequency_std: float = math.nan
    fit: FitReport = field(default_factory=FitReport)
    warnings: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    fitted: FloatArray = field(default_factory=lambda: np.empty(0))
    rivals: tuple[Rival, ...] = ()
    validation: Validation | None = None
    points: tuple[FrequencyPoint, ...] = ()
    integrated_error: float = math.nan
    support: float = 1.0
    combinations: tuple[Combination, ...] = ()
    advice: tuple[str, ...] = ()

    @property
    def structure(self) -> str:
        """Name of the model's structure."""
        return self.model.structure

    @property
    def std(self) -> FloatArray:
        """Standard deviations of the values, shape (p,); NaN: not estimated."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def with_uncertainty(
    method: str,
    build: Callable[[FloatArray], TransferFunction],
    parameters: tuple[str, ...],
    values: FloatArray,
    covariance: FloatArray | None = None,
    quantile: float = NORMAL_95,
    fit: FitReport | None = None,
    warnings: tuple[str, ...] = (),
    fitted: FloatArray | None = None,
) -> Identification:
    """Complete an identification: intervals of the parameters and of the ultimate point.

    Gains and time constants get intervals of their logarithm, since they cannot change sign; a
    dead time gets a linear one, cut at zero. K_u and w_u follow from the covariance to first
    order: at a fixed frequency a parameter p changes log G by d, and the point moves by

        dw = -d(arg G)/dp / (d(arg G)/dw),   d(log K_u) = -d(log|G|)/dp - d(log|G|)/dw dw.

    :param method: name in the registry.
    :param build: the model as a function of the values.
    :param parameters: names, p of them.
    :param values: shape (p,).
    :param covariance: shape (p, p); None: not estimated.
    :param quantile: half width of a 95 % interval in standard deviations.
    :param fit: quality of the fit.
    :param warnings: sentences for the user.
    :param fitted: the model's measurement at the samples; None: not computed.
    :raises IdentificationError: if a value is not finite.
    """
    if not bool(np.all(np.isfinite(values))):
        found = ", ".join(f"{n} = {v:g}" for n, v in zip(parameters, values, strict=True))
        raise IdentificationError(f"{method} gave no finite model: {found}")
    p = len(parameters)
    model = build(values)
    cov = np.full((p, p), math.nan) if covariance is None else covariance
    std = np.sqrt(np.diag(cov))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ratio = np.exp(np.minimum(quantile * std / np.abs(values), 700.0))
        low, high = values / ratio, values * ratio
    low, high = np.minimum(low, high), np.maximum(low, high)
    for i, name in enumerate(parameters):
        if not is_logarithmic(name):
            low[i], high[i] = values[i] - quantile * std[i], values[i] + quantile * std[i]
        if name == "dead_time" and np.isfinite(low[i]):
            low[i] = max(low[i], 0.0)
    wide = std * quantile > DETERMINED * np.abs(values)
    undetermined = tuple(n for n, w in zip(parameters, wide, strict=True) if w)
    point = ultimate_point(model)
    if point is None:
        warnings = (*warnings, "the model has no ultimate point: no gain makes it oscillate")
    identified = Identification(
        method,
        model,
        build,
        parameters,
        values,
        cov,
        low,
        high,
        ultimate_gain=math.nan if point is None else point.gain,
        ultimate_frequency=math.nan if point is None else point.frequency,
        fit=fit or FitReport(),
        warnings=warnings,
        undetermined=undetermined,
        fitted=np.empty(0) if fitted is None else fitted,
    )
    if point is None or covariance is None:
        return identified
    gain_std, frequency_std = ultimate_std(identified, point.gain, point.frequency)
    return replace(identified, ultimate_gain_std=gain_std, ultimate_frequency_std=frequency_std)


def ultimate_std(found: Uncertain, gain: float, frequency: float) -> tuple[float, float]:
    """Return the standard deviations of K_u and w_u to first order; see with_uncertainty.

    :param found: a model with the covariance of its values.
    :param gain: its K_u [u/y].
    :param frequency: its w_u [rad/s].
    """

    def log_response(x: FloatArray, w: float) -> complex:
        # At the ultimate point -K_u G is 1, so that its logarithm has no branch nearby.
        return complex(np.log(-gain * found.build(x)(1j * w)))

    step = 1e-6
    values = found.values
    by_frequency = (
        log_response(values, frequency * (1.0 + step))
        - log_response(values, frequency * (1.0 - step))
    ) / (2.0 * step * frequency)
    gradient_gain, gradient_frequency = [], []
    for i, (name, value) in enumerate(zip(found.parameters, values, strict=True)):
        # A dead time or a zero of next to nothing still acts by its part of the period.
        least = 0.0 if is_logarithmic(name) else 1.0 / frequency
        size = max(abs(value), least) or 1.0 / frequency
        up, down = values.copy(), values.copy()
        up[i], down[i] = value + step * size, value - step * size
        if name == "dead_time":
            down[i] = max(down[i], 0.0)
        change = (log_response(up, frequency) - log_response(down, frequency)) / (up[i] - down[i])
        dw = -change.imag / by_frequency.imag
        gradient_frequency.append(dw)
        gradient_gain.append(-gain * (change.real + by_frequency.real * dw))

    def deviation(gradient: list[float]) -> float:
        g = np.array(gradient)
        return math.sqrt(max(float(g @ found.covariance @ g), 0.0))

    return deviation(gradient_gain), deviation(gradient_frequency)
