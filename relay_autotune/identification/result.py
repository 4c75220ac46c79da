"""What an identification gives: model, uncertainty, quality of fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from relay_autotune.confidence import NORMAL_95
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.combinations import DETERMINED, Combination
from relay_autotune.identification.estimate import Estimate
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


@dataclass(frozen=True)
class Rival:
    """Another structure that the data do not rule out.

    :param estimate: its best fit, with a covariance where its support is worth it.
    :param support: its weight among all structures tried, 0 to 1.
    """

    estimate: Estimate
    support: float

    @property
    def model(self) -> TransferFunction:
        """The transfer function."""
        return self.estimate.model


@dataclass(frozen=True)
class Identification:
    """A model identified by one method, with what is known of its accuracy.

    :param method: name in the registry.
    :param estimate: the parameters of the model and their covariance.
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
    :param parts: models on which gains have to hold, too: of the halves of the record where they
        differ by more than chance, and plain ones that simulate it nearly as well.
    """

    method: str
    estimate: Estimate
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
    parts: tuple[TransferFunction, ...] = ()

    @property
    def model(self) -> TransferFunction:
        """The transfer function."""
        return self.estimate.model

    @property
    def structure(self) -> str:
        """Name of the model's structure."""
        return self.model.structure

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the structure's parameters."""
        return self.estimate.structure.names

    @property
    def values(self) -> FloatArray:
        """Their values, shape (p,)."""
        return self.estimate.values

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the values, shape (p, p); NaN: not estimated."""
        return self.estimate.covariance

    @property
    def std(self) -> FloatArray:
        """Standard deviations of the values, shape (p,); NaN: not estimated."""
        return self.estimate.std


def identified(
    method: str,
    estimate: Estimate,
    quantile: float = NORMAL_95,
    fit: FitReport | None = None,
    warnings: tuple[str, ...] = (),
    fitted: FloatArray | None = None,
) -> Identification:
    """Complete an estimate by what follows from it: intervals, K_u and w_u.

    :param method: name in the registry.
    :param estimate: the model with the covariance of its parameters.
    :param quantile: half width of a 95 % interval in standard deviations.
    :param fit: quality of the fit.
    :param warnings: sentences for the user.
    :param fitted: the model's measurement at the samples; None: not computed.
    :raises IdentificationError: if a value is not finite.
    """
    names, values = estimate.structure.names, estimate.values
    if not bool(np.all(np.isfinite(values))):
        found = ", ".join(f"{n} = {v:g}" for n, v in zip(names, values, strict=True))
        raise IdentificationError(f"{method} gave no finite model: {found}")
    low, high = estimate.intervals(quantile)
    wide = estimate.std * quantile > DETERMINED * np.abs(values)
    point = ultimate_point(estimate.model)
    stds = (math.nan, math.nan)
    if point is None:
        warnings = (*warnings, "the model has no ultimate point: no gain makes it oscillate")
    elif estimate.known:
        stds = estimate.ultimate_std(point.gain, point.frequency)
    return Identification(
        method,
        estimate,
        low,
        high,
        ultimate_gain=math.nan if point is None else point.gain,
        ultimate_gain_std=stds[0],
        ultimate_frequency=math.nan if point is None else point.frequency,
        ultimate_frequency_std=stds[1],
        fit=fit or FitReport(),
        warnings=warnings,
        undetermined=tuple(n for n, w in zip(names, wide, strict=True) if w),
        fitted=np.empty(0) if fitted is None else fitted,
    )
