# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The result of an identification: model, uncertainty, what is determined, quality of fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.limit_cycle.fourier import FrequencyPoint
from relay_autotune.process.transfer_function import TransferFunction, process_text
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.quantities import NORMAL_95, result_field, result_fields
from relay_autotune.record.record import Input, PiecewiseConstant
from relay_autotune.text import percent

# Largest half interval of a determined value, relative to the value.
DETERMINED = 0.2


@dataclass(frozen=True)
class Combination:
    """A combination of parameters with its uncertainty; NaN: not estimated."""

    name: str = result_field(message="combinations")
    """In terms of the parameters."""
    unit: str = result_field(message="combination_units")
    """Unit of the value."""
    value: float = result_field(nan=True)
    """Its value."""
    std: float = result_field("", math.nan, lower=0.0)
    """Its standard deviation."""
    ci95_low: float = result_field("", math.nan, document="ci95")
    """Lower end of its 95 % interval."""
    ci95_high: float = result_field("", math.nan, document="ci95")
    """Upper end."""

    @property
    def determined(self) -> bool:
        """True if half its interval is at most 20 % of the value."""
        return is_determined(self.value, self.ci95_low, self.ci95_high)


def is_determined(value: float, low: float, high: float) -> bool:
    """Return whether half an interval is at most 20 % of the value; False if it is not known."""
    return bool(0.5 * (high - low) <= DETERMINED * abs(value))


def point_of(model: TransferFunction) -> tuple[float, float]:
    """Return K_u and w_u; NaN where there is none."""
    point = ultimate_point(model)
    return (math.nan, math.nan) if point is None else (point.gain, point.frequency)


@dataclass(frozen=True)
class Validation:
    """How a model's limit cycle differs from the record's, relative to the latter.

    Differences of times are relative to the period, those of y to half of the record's peak to
    peak; NaN: the model has no limit cycle. The shape compares the two curves, each from its own
    mean over its own half of peak to peak, with the half periods laid upon each other, and with
    the noise of the record's curve subtracted.
    """

    period: float = result_field("", math.nan)
    """Difference of the whole period."""
    period_high: float = result_field("", math.nan)
    """Difference of the time with the command high."""
    period_low: float = result_field("", math.nan)
    """Difference of the time with the command low."""
    peak_max: float = result_field("", math.nan)
    """Difference of the highest measurement."""
    peak_min: float = result_field("", math.nan)
    """Difference of the lowest measurement."""
    shape: float = result_field("", math.nan, lower=0.0)
    """Root mean square difference of the two curves."""
    reason: str = result_field("", "")
    """Why there is no limit cycle; empty if there is one."""

    @property
    def worst(self) -> float:
        """Return the largest of them; infinite where the model has no limit cycle."""
        if self.reason:
            return math.inf
        return max(
            abs(getattr(self, f.name)) for f in result_fields(Validation) if f.kind is float
        )


@dataclass(frozen=True)
class FitReport:
    """How well a model reproduces the record; NaN: not estimated.

    ``noise_to_signal`` is N2 of Wang et al. 1997, and ``noise_to_signal_power`` their N1.
    """

    residual_rms: float = result_field("y", math.nan, lower=0.0, column=2)
    """Root mean square of measurement minus model."""
    noise_std: float = result_field("y", math.nan, lower=0.0)
    """Noise measured before the test."""
    fit: float = result_field("", math.nan, upper=1.0, column=1)
    """1 - rms(residual)/rms(measurement about its mean)."""
    whiteness_p: float = result_field("", math.nan, lower=0.0, upper=1.0)
    """Probability of a residual this correlated if it were white (Ljung and Box)."""
    prediction: float = result_field("y", math.nan, lower=0.0)
    """Root mean square error over the last cycle, predicted from those before."""
    noise_to_signal: float = result_field("", math.nan, lower=0.0)
    """mean|residual|/mean|model about the operating point|."""
    noise_to_signal_power: float = result_field("", math.nan, lower=0.0)
    """The same of mean squares."""


@dataclass(frozen=True)
class Part:
    """The models that a part of a record allows.

    :param begin: its first time [s].
    :param end: its last time [s].
    :param models: drawn from their posterior, each as likely as the others.
    :param contradicts: True: the part excludes the model of the whole record.
    :param record: number of the record that it is, from 1, where several were fitted together.
    """

    begin: float
    end: float
    models: tuple[TransferFunction, ...]
    contradicts: bool = True
    record: int = 0

    @property
    def span(self) -> str:
        """Which part it is, as text."""
        if self.record:
            return f"record {self.record}"
        return f"{self.begin:.4g} s to {self.end:.4g} s"

    def share_against(self, model: TransferFunction) -> float:
        """Return the share of its models that are of the other direction than one of the whole.

        The sign of a static gain counts where the part shows it: at the frequency of which it
        shows one radian, the responses are then more than 90 degrees apart.

        :param model: of the whole record.
        """
        at = np.array([1j / (self.end - self.begin)])
        return float(
            np.mean(
                [
                    m.process_sign != model.process_sign and (m(at) / model(at))[0].real < 0.0
                    for m in self.models
                ]
            )
        )


@dataclass(frozen=True, eq=False)
class Rival:
    """Another structure that the data do not rule out.

    The estimate has a covariance where the support is worth it.
    """

    estimate: Estimate = result_field()
    """The structure's best fit; documents have its model alone."""
    support: float = result_field(lower=0.0, upper=1.0)
    """Its weight among all structures tried."""

    @property
    def model(self) -> TransferFunction:
        """The transfer function."""
        return self.estimate.model


@dataclass(frozen=True, repr=False, eq=False)
class Identification:
    """A model identified by one method, with what is known of its accuracy.

    >>> from relay_autotune import Known, identify, read_records
    >>> found = identify(read_records("bags/heater.csv")[0], known=Known(structure="fopdt"))
    >>> found
    <Identification: 0.6204 e^(-15.89 s) / (1 + 110.2 s)   (fopdt, waveform)>
    >>> found.parameters, found.undetermined
    (('gain', 'time_constant', 'dead_time'), ())

    The integrated error is ``int |G_m - G|/|G| dw`` over two decades about w_u, with G the
    selected model (Thyagarajan and Yu 2003, eqs 29 and 30).
    """

    method: str = result_field(word=True, column=1)
    """Name in the registry."""
    estimate: Estimate = result_field()
    """The parameters of the model and their covariance."""
    ci95_low: FloatArray = result_field(nan=True, document="ci95")
    """Lower ends of the 95 % intervals, shape (p,)."""
    ci95_high: FloatArray = result_field(nan=True, document="ci95")
    """Upper ends, shape (p,)."""
    fit: FitReport = result_field("", FitReport())
    """Quality of the fit."""
    validation: Validation | None = result_field("", None, prefix="validation_")
    """How the limit cycle of the model differs from the record's; None: not compared."""
    integrated_error: float = result_field("rad/s", math.nan, lower=0.0)
    """Difference from the selected model; NaN: it is that model, or not computed."""
    points: tuple[FrequencyPoint, ...] = result_field("", (), prefix="point_")
    """Measured points of the frequency response, by rising frequency."""
    ultimate_gain: float = result_field("u/y", math.nan, column=1)
    """K_u with the sign of the process; NaN: the model has none."""
    ultimate_gain_std: float = result_field("u/y", math.nan, lower=0.0, column=1)
    """Its standard deviation; NaN: not estimated."""
    ultimate_frequency: float = result_field("rad/s", math.nan, lower=0.0, column=1)
    """w_u; NaN: the model has none."""
    ultimate_frequency_std: float = result_field("rad/s", math.nan, lower=0.0, column=1)
    """Its standard deviation; NaN: not estimated."""
    warnings: tuple[str, ...] = result_field("", ())
    """Sentences that the user must read."""
    undetermined: tuple[str, ...] = result_field("", ())
    """Parameters whose 95 % interval is wider than 20 % of the value."""
    combinations: tuple[Combination, ...] = result_field("", (), prefix="combination_")
    """Where a parameter is not determined, what the data determine all the same."""
    advice: tuple[str, ...] = result_field("", ())
    """Then, what test would determine it, each a sentence."""
    support: float = result_field("", 1.0, lower=0.0, upper=1.0)
    """Weight of this structure among all that were tried; 1: no other was."""
    rivals: tuple[Rival, ...] = result_field("", (), message=None)
    """Other structures with some support, the best first."""
    draws: tuple[TransferFunction, ...] = result_field("", (), message=None, optional=True)
    """Models that the record allows, of either direction, each as likely as the others; left
    out: the method knows the covariance alone."""
    # The model's measurement at the record's samples, with all that was estimated with the
    # model [y], shape (n,); NaN: not part of the fit; empty: not computed. It is as long as the
    # record, and so in no document or message.
    fitted: FloatArray = field(default_factory=lambda: np.empty(0))
    # How strongly commands above and below one act, relative to the model, and that one [u]; NaN:
    # all act alike.
    effects: tuple[float, float] = (1.0, 1.0)
    middle: float = math.nan
    # Lowest and highest command that the actuator was found to follow [u].
    ends: tuple[float, float] = (-math.inf, math.inf)
    # Fastest change of the command that was found to be followed [u/s].
    rate: float = math.inf
    # True: the process was not at rest at the relay's baseline when the test began.
    began_away: bool = False
    # True: a move of the command just before the record was estimated with the model.
    moved_before: bool = False
    # True: a step of the load was estimated with the model.
    loaded: bool = False
    # Play between command and process that was estimated with the model [u]; 0: none.
    play: float = 0.0
    # Dry friction that was estimated with the model, as a command [u]; 0: none.
    friction: float = 0.0
    # Standard deviation of the measurement without drift, past and load, which the model has to
    # explain [y]; NaN: the whole measurement.
    to_explain: float = math.nan
    # Models that each part of the record allows by itself.
    parts: tuple[Part, ...] = ()
    # How well models of the other direction explain the record, 0 to 1; 0 where it is known.
    opposed: float = 0.0
    # Returns the FOPDT that was fitted besides the model; None: there is none, or it is the model.
    plain: Callable[[], Identification | None] | None = None

    def __repr__(self) -> str:
        """Return the model on one line; the fields have the rest."""
        return f"<Identification: {process_text(self.model)}   ({self.structure}, {self.method})>"

    @property
    def model(self) -> TransferFunction:
        """The transfer function."""
        return self.estimate.model

    def felt(self, command: FloatArray) -> FloatArray:
        """Return commands as the model feels them, whose effects above and below one may differ.

        :param command: u, shape (n,).
        """
        command = np.clip(command, *self.ends)
        if math.isnan(self.middle):
            return command
        away = command - self.middle
        return np.asarray(self.middle + np.where(away > 0.0, *self.effects) * away)

    def felt_input(self, u: PiecewiseConstant) -> Input:
        """Return a held command as the model feels it.

        :param u: the command.
        """
        levels = self.felt(u.levels)
        held = replace(u, values=levels[1:], initial=float(levels[0]))
        return held.slewed(self.rate) if math.isfinite(self.rate) else held

    @property
    def why_chosen(self) -> str:
        """Why it was taken before rivals of more support, a sentence; empty: there are none."""
        if not any(rival.support > self.support for rival in self.rivals):
            return ""
        return (
            f"the structure of the best score is taken, which in coloured noise has "
            f"{percent(self.support)} % of the support; the models on 95 % of which gains hold "
            "are of all of them, by their support"
        )

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
        warnings = (
            *warnings,
            "the model has no ultimate point: no proportional controller makes it oscillate",
        )
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
