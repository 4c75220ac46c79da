# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How far an identified model is to be trusted: its residual, its limit cycle, its rivals.

Every method's model is judged alike, on the record that it was identified from.

A model must also reproduce the relay test that it was identified from. Thyagarajan and Yu 2003 run
the relay experiment again on each model and look at the two curves beside each other (their Fig
9): models of different structure may share period and amplitude, but not the shape. Here the
difference is a number, for the models of any method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError, ModelError, RecordError
from relay_autotune.identification.limit_cycle.fold import Fold, as_switched, fold
from relay_autotune.identification.limit_cycle.fourier import SteadyState, steady_state
from relay_autotune.identification.result import FitReport, Identification, Validation
from relay_autotune.identification.waveform.problem import NEGLIGIBLE
from relay_autotune.identification.waveform.residuals import ljung_box, noise_to_signal
from relay_autotune.process.response import response
from relay_autotune.process.simulation import simulate_relay
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.cycles import is_switched
from relay_autotune.record.record import Cycle, PiecewiseConstant, Record, RelaySettings

# The noise is known to 10 % from the 50 samples before a test, so that a residual of 1.3 times
# the noise is noise alone; 2 % of the measurement's spread is left by any simple structure.
_OF_NOISE = 1.3
_OF_SPREAD = 0.02
# Ratio of a residual to the larger of both beyond which a model is of another process.
_FAR_OFF = 2.0


def unexplained_share(found: Identification, record: Record, residual: float) -> float:
    """Return the share of the measurement's variance that neither response nor noise explains.

    What drift, past and load explain is no evidence for the model, and does not count.

    :param found: what was identified.
    :param record: the record.
    :param residual: rms of what is not explained [y].
    """
    variance = float(np.var(record.measurement))
    if math.isfinite(found.to_explain):
        variance = min(variance, found.to_explain**2)
    left = residual**2 - record.noise**2
    return max(left, 0.0) / variance if variance > 0.0 else math.nan


def is_far_off(found: Identification, record: Record) -> bool:
    """Return whether a model's residual is too large for its intervals to mean anything.

    :param found: what was identified.
    :param record: the record.
    """
    allowed = max(_OF_NOISE * record.noise, _OF_SPREAD * float(np.std(record.measurement)))
    return found.fit.residual_rms > _FAR_OFF * allowed


_POINTS = 512
_FREQUENCIES = 4001
_CYCLES = (8, 32, 128)
_TOLERANCE = 1e-6
_KICK = 0.1


def validate(model: TransferFunction, record: Record) -> Validation:
    """Run the relay experiment of a record again on a model, and compare the limit cycles.

    The relay has the record's levels of the command, and switches at the levels at which the
    record's relay was seen to switch, which noise and sampling move a little away from the
    hysteresis that was set.

    :param model: any model.
    :param record: the relay test.
    :raises IdentificationError: if the record holds no whole cycle of a relay test.
    """
    seen = fold(record)
    return validate_fold(model, seen, steady_state(record, seen.settings))


def validate_fold(model: TransferFunction, seen: Fold, rest: SteadyState) -> Validation:
    """Compare a model's limit cycle with an averaged period; see :func:`validate`.

    :param model: any model.
    :param seen: the averaged period.
    :param rest: measurement under the baseline; where it was not measured, the set-point or, for
        a stable model, its gain and the means over the period replace it.
    """
    settings = as_switched(seen)
    high, low, middle = seen.period_high, seen.period_low, seen.settings.setpoint
    recorded = seen(_instants(high, low))
    edges = [] if math.isnan(seen.edge) else [seen.edge, high + seen.edge]
    peaks = np.append(recorded, seen(np.array(edges)))
    size = 0.5 * float(np.ptp(peaks))
    if not size > 0.0:
        raise IdentificationError(
            "the measurement is constant over the cycles: there is no limit cycle to compare with"
        )
    if model.process_sign * (-1 if settings.reverse_acting else 1) < 0:
        return Validation(reason="the model's gain is against the direction of the relay")
    try:
        point = rest.value
        if not rest.measured:
            # The limit cycle depends on the levels alone, and this baseline is a guess: so it
            # starts from the command that holds the model at the set-point.
            shift = (middle - _rest_by(model, seen, middle)) / model.gain
            settings = replace(
                settings, baseline=settings.baseline + shift, bias=settings.bias - shift
            )
            point = middle
        cycle, modelled = _limit_cycle(model, settings, point, _KICK * size)
    except ModelError as error:
        return Validation(reason=str(error))
    weight = np.repeat([high, low], _POINTS)
    away = _normalised(modelled, weight) - _normalised(recorded, weight)
    power = float(np.average(away**2, weights=weight))
    return Validation(
        period=(cycle.period - seen.period) / seen.period,
        period_high=(cycle.period_high - high) / seen.period,
        period_low=(cycle.period_low - low) / seen.period,
        peak_max=(cycle.peak_max - middle - float(np.max(peaks))) / size,
        peak_min=(cycle.peak_min - middle - float(np.min(peaks))) / size,
        shape=math.sqrt(max(power - (seen.curve_std / size) ** 2, 0.0)),
    )


def _rest_by(model: TransferFunction, seen: Fold, otherwise: float) -> float:
    """Return the mean over a period less the gain times the mean command, from the baseline."""
    if model.integrators or any(t.real <= 0.0 for t in model.time_constants):
        return otherwise
    high, low = seen.period_high, seen.period_low
    weight = np.repeat([high, low], _POINTS)
    mean = seen.settings.setpoint + float(np.average(seen(_instants(high, low)), weights=weight))
    swing = seen.settings.amplitude * (high - low) / seen.period
    return mean - model.gain * (seen.settings.bias + swing)


def _limit_cycle(
    model: TransferFunction, settings: RelaySettings, rest: float, kick: float
) -> tuple[Cycle, FloatArray]:
    """Return the limit cycle of a model, and its curve from the switch to high on."""
    # The relay may have switched below the rest, which no rise from there would reach.
    kick = max(settings.hysteresis, kick + max(rest - settings.setpoint, 0.0))
    for count in _CYCLES:
        run = simulate_relay(
            model, settings, cycles=count, operating_point=rest, kick=kick, kept=2
        )
        a, b = run.cycles[-2], run.cycles[-1]
        change = abs(a.period_high - b.period_high) + abs(a.period_low - b.period_low)
        if change <= _TOLERANCE * b.period:
            break
    return b, run.output(b.start + _instants(b.period_high, b.period_low))


def _instants(high: float, low: float) -> FloatArray:
    """Return as many times in the half with the command high as in the other [s]."""
    part = (np.arange(_POINTS) + 0.5) / _POINTS
    return np.concatenate((part * high, high + part * low))


def _normalised(y: FloatArray, weight: FloatArray) -> FloatArray:
    return np.asarray((y - np.average(y, weights=weight)) / (0.5 * np.ptp(y)))


def integrated_error(
    model: TransferFunction, process: TransferFunction, frequency: float, *, relative: bool = True
) -> float:
    """Return the error of a model over two decades about w_u (eqs 29 and 30).

    ``int |G_m - G|/|G| dw`` from 0.1 w_u to 10 w_u; printed values of the paper's Table 3 do not
    follow from it by any factor. Without the division the least error is that of the category
    that the paper reports in all its examples, with it in all but one.

    :param model: G_m.
    :param process: G.
    :param frequency: w_u [rad/s].
    :param relative: False: without the division by |G|.
    """
    w = frequency * np.logspace(-1.0, 1.0, _FREQUENCIES)
    process_response = process(1j * w)
    error = np.abs(model(1j * w) - process_response)
    if relative:
        error = error / np.abs(process_response)
    # In logarithmic steps, by Simpson's rule.
    integrand = error * w
    step = math.log(w[1] / w[0])
    weights = np.ones(_FREQUENCIES)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    return float(np.sum(weights * integrand) * step / 3.0)


def assess(models: Sequence[Identification], record: Record) -> tuple[Identification, ...]:
    """Add to identified models how well each one agrees with the record.

    Each gets the comparison of its limit cycle with the record's (Thyagarajan and Yu 2003,
    Fig 9), its error from the first model over two decades about w_u (eqs 29 and 30), and, where
    its method did not look at all samples, the quality of its fit to them.

    :param models: of one record, the selected one first.
    :param record: the record.
    """
    seen, rest = _averaged(record), operating_point(record)
    return tuple(
        replace(
            found,
            fit=_fit(found, record, rest),
            validation=_validated(found, seen, record),
            integrated_error=_error_from(models[0], found),
        )
        for found in models
    )


def _fit(found: Identification, record: Record, rest: float) -> FitReport:
    if found.fitted.size == 0:
        return fit_of_model(found.model, record, rest)
    used = np.isfinite(found.fitted)
    residual = (record.measurement - found.fitted)[used]
    power, mean = noise_to_signal(residual, found.fitted[used] - rest)
    return replace(found.fit, noise_to_signal_power=power, noise_to_signal=mean)


def fit_of_model(model: TransferFunction, record: Record, rest: float) -> FitReport:
    """Return how well a model reproduces all samples of a record.

    Estimated with it are the offset and, for a self-regulating process, the command before the
    record: a record may begin with its first step.

    :param model: any; an unstable one, which no open loop follows, gets no estimates.
    :param record: any record.
    :param rest: measurement about which it moves [y].
    """
    if model.grows:
        return FitReport(noise_std=record.noise_std)
    y = record.measurement
    answer = response(model, record.time, record.input())
    unknown = [np.ones_like(y)]
    if model.integrators == 0:
        before = PiecewiseConstant(record.time[:1], np.zeros(1), initial=1.0)
        unknown.append(response(model, record.time, before))
    columns = np.column_stack(unknown)
    residual = y - answer
    residual = residual - columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
    rms = math.sqrt(float(np.mean(residual**2)))
    spread = float(np.std(y))
    exact = rms <= NEGLIGIBLE * float(np.ptp(y))
    power, mean = noise_to_signal(residual, y - residual - rest)
    return FitReport(
        residual_rms=rms,
        noise_std=record.noise_std,
        fit=1.0 - rms / spread if spread > 0.0 else math.nan,
        whiteness_p=math.nan if exact else ljung_box(residual),
        noise_to_signal_power=power,
        noise_to_signal=mean,
    )


def operating_point(record: Record) -> float:
    """Return the measurement about which a record moves [y].

    It is the mean at rest, before the command first changes. Without such samples it is the
    set-point of a relay test, and the mean of any other record.

    :param record: any record.
    """
    if record.settings is not None:
        return steady_state(record, record.settings).value
    changes = record.input().times
    resting = record.time <= changes[0] if changes.size else np.ones(len(record), dtype=bool)
    return float(np.mean(record.measurement[resting] if resting.any() else record.measurement))


def _averaged(record: Record) -> Fold | None:
    if not is_switched(record):
        # The same relay on the model's command would make another oscillation.
        return None
    try:
        return fold(record)
    except (IdentificationError, RecordError):
        # Such as a step test: it has no limit cycle to compare with.
        return None


def _validated(found: Identification, seen: Fold | None, record: Record) -> Validation | None:
    if seen is None:
        return None
    try:
        rest = steady_state(record, seen.settings)
        return validate_fold(
            found.model, replace(seen, settings=_felt(seen.settings, found)), rest
        )
    except IdentificationError as error:
        return Validation(reason=str(error))


def _felt(settings: RelaySettings, found: Identification) -> RelaySettings:
    """Return the relay whose equal effects are those that a process feels of one."""
    low, high = found.felt(np.array([settings.low, settings.high])).tolist()
    bias = 0.5 * (high + low) - settings.baseline
    # Each of its moves crosses the play.
    return replace(settings, amplitude=0.5 * (high - low - found.play), bias=bias)


def _error_from(reference: Identification, found: Identification) -> float:
    if found is reference or not math.isfinite(reference.ultimate_frequency):
        return math.nan
    try:
        return integrated_error(found.model, reference.model, reference.ultimate_frequency)
    except ModelError:
        return math.nan
