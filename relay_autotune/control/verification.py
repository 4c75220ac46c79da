# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Verify gains with a step: compare it with the model's prediction of the same step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from relay_autotune.arrays import FloatArray
from relay_autotune.control.controller import PredictedLoop, Step
from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop, is_stable
from relay_autotune.loop.sampled import UNLIMITED, Limits
from relay_autotune.reasons import Code, Reason
from relay_autotune.scalar import minimum_near, root

# A response has settled when it stays within this part of its largest deviation.
SETTLED = 0.05
# After a tune the loop begins up to twice the step away from rest, and what is left of that after
# the settling time of a step changed the gain that the next step shows by a tenth: settling times.
SETTLES = 1.5
# A step lasts for a multiple of the predicted settling time, and for a least number of samples.
WATCHED = 1.6
LEAST_SAMPLES = 30

# Tolerances against the prediction: difference of overshoot, ratio of settling times, ratio of
# IAE, gain, peak of sensitivity.
OVERSHOOT_MARGIN = 0.15
SETTLING_RATIO = 2.0
IAE_RATIO = 1.6
GAIN_RANGE = (0.6, 1.7)
MS_RATIO = 1.3
# Allowance for noise in each comparison, in standard deviations.
NOISE_ALLOWANCE = 3.0
# Standard deviations by which the largest of some six samples about a peak is above it.
_AT_PEAK = 1.27
# A deviation this many times the largest predicted one ends the step at once.
RUNAWAY = 3.0

# A comparison that takes more than this part of its tolerance passes narrowly.
_NARROW = 0.75

# A sensor whose samples are this many periods of a law apart leaves runs of it out.
_SLOWER_SENSOR = 1.2

_GAIN_SEARCH = (0.3, 3.0)
# The least step: change of the gain for a derivative; nodes of the mean over the noise; noise as a
# part of the step, and how often its range, and that of the gain, is halved.
_SLIGHTLY = 1.01
_NODES = 20
_NOISE_SEARCH = (1e-6, 1e2)
_MS_HALVINGS = 8
_PREDICTED_SAMPLES = 4000
_DOUBLINGS = 8


@dataclass(frozen=True)
class Response:
    """Features of a response to a step.

    :param overshoot: of a set-point step, beyond it, as a fraction; of a load step, the largest
        deviation to the other side, as a fraction of the largest.
    :param settling_time: time until the error stays within :func:`settled_band` [s].
    :param iae: integral of the absolute error [y s].
    :param largest: largest deviation from the start [y].
    """

    overshoot: float
    settling_time: float
    iae: float
    largest: float


@dataclass(frozen=True)
class Comparison:
    """Comparison of a measured step with the predicted one.

    :param passed: True if every comparison is within its tolerance.
    :param why: the problems, or what passes narrowly, and the compared numbers.
    :param measured: the measured response.
    :param expected: the predicted one.
    :param predicted: predicted deviation at each sample [y], shape (n,).
    :param fit: 1 - rms(difference)/rms(predicted about its mean).
    :param gain_ratio: factor on the model's gain that fits the measured step best.
    :param ms: Ms with that gain; NaN: the loop would be unstable.
    :param ms_predicted: Ms with the identified model.
    """

    passed: bool
    why: Reason
    measured: Response
    expected: Response
    predicted: FloatArray
    fit: float
    gain_ratio: float
    ms: float
    ms_predicted: float

    @property
    def reason(self) -> str:
        """The same as a sentence."""
        return str(self.why)


@dataclass(frozen=True)
class Plan:
    """Duration of a step, and the deviation that stops it.

    :param duration: how long to observe it [s].
    :param runaway: deviation from rest that ends the step at once [y].
    :param peak: largest deviation of the measurement that the model predicts [y].
    :param command: predicted range of the command with the step and back without it, relative to
        rest [u].
    :param visible: least height of a step [y, of a load u] with noise of standard deviation 1.
    """

    duration: float
    runaway: float
    peak: float
    command: tuple[float, float]
    visible: float

    def require_visible(self, step: Step, noise_std: float) -> None:
        """Refuse a step that cannot be judged.

        :param step: the step.
        :param noise_std: standard deviation of the measurement noise [y].
        :raises TuningError: with the least step.
        """
        height, unit = (step.setpoint, "y") if step.setpoint else (step.load, "u")
        least = rounded(self.visible * noise_std)
        if abs(height) < least:
            raise TuningError(f"the step is {height:g} {unit}: {least_text(least, unit)}")


def least_text(least: float, unit: str) -> str:
    """Say which steps the noise hides.

    :param least: the least step that it does not hide.
    :param unit: of the step.
    """
    return f"with the noise of the measurement, less than {least:g} {unit} cannot be judged"


def noise_of(noise_std: float, residual_rms: float) -> float:
    """Return the noise in which a step is seen: the larger of two, NaN if none is known [y].

    :param noise_std: of the measurement at rest [y].
    :param residual_rms: what the model leaves of the measurement [y].
    """
    return float(np.fmax(noise_std, residual_rms))


def rounded(value: float, whole: Callable[[float], int] = math.ceil) -> float:
    """Return a number in two digits that is at least a value, 0 for a negative one.

    :param value: the value.
    :param whole: `math.floor`: that is at most the value.
    """
    if not 0.0 < value < math.inf:
        return max(value, 0.0)
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    # What is in two digits but for the last bits stays.
    return float(f"{whole(round(value / unit, 7)) * unit:.2g}")


def plan(loop: PredictedLoop, step: Step, period: float, noise_std: float = 0.0) -> Plan:
    """Return how long a step must be observed, and when to stop it.

    :param loop: controller and process.
    :param step: the step.
    :param period: sample period of the loop [s].
    :param noise_std: standard deviation of the measurement noise [y].
    :raises TuningError: if the loop is unstable on the model, does not settle, or has fewer
        samples than the law that they run.
    """
    # Another program does not wait for the samples.
    control = loop.control
    rate = None if control.elsewhere else control.rate
    if rate is not None and period > _SLOWER_SENSOR * rate.period:
        raise TuningError(
            f"the samples come every {period:.3g} s, and {rate.law.name} runs every "
            f"{rate.period:.3g} s: these gains can only be proven in their own program; design "
            f"them for the sensor, with a sampling period of {period:.3g} s"
        )
    if not is_stable(control.law, loop.model):
        raise TuningError("these gains make an unstable loop with the model: nothing to verify")
    horizon = max(8.0 * (control.gains.ti + loop.model.dead_time), LEAST_SAMPLES * period)
    for _ in range(_DOUBLINGS):
        # Predict a slow loop with fewer samples, to save time.
        interval = max(period, horizon / _PREDICTED_SAMPLES)
        if rate is not None:
            interval = max(period, min(interval, rate.period))
        time = np.arange(int(horizon / interval) + 2, dtype=np.float64) * interval
        run = loop.run(time, step)
        response = describe(time, run.measurement, step)
        if response.settling_time < 0.6 * horizon:
            duration = max(WATCHED * response.settling_time, LEAST_SAMPLES * period)
            runaway = RUNAWAY * response.largest + 10.0 * noise_std
            low, high, last = run.command.min(), run.command.max(), run.command[-1]
            command = float(min(low, last - high, 0.0)), float(max(high, last - low, 0.0))
            watched = time[time <= duration]
            visible = _visible(loop, step, watched, period, run.measurement)
            return Plan(duration, runaway, response.largest, command, visible)
        horizon *= 2.0
    raise TuningError("the predicted response does not settle in any reasonable time")


def _visible(
    loop: PredictedLoop, step: Step, time: FloatArray, period: float, predicted: FloatArray
) -> float:
    """Return the least height of a step with noise of standard deviation 1 [y, of a load u].

    A loop that does what is predicted then fails by the noise as rarely as a normal value leaves
    `NOISE_ALLOWANCE` standard deviations. The chances of :func:`_comparisons` are added, for white
    noise: that a sample is beyond the largest overshoot; that one is outside of the band when it
    should have settled; that the sum of absolute errors, or the fitted gain, is beyond its limit,
    to which also belongs the gain that makes Ms too large.

    :param loop: controller and process.
    :param step: the step.
    :param time: instants of the prediction until the end of the step [s], shape (n,).
    :param period: sample period of the loop [s].
    :param predicted: deviation of the measurement [y], at these instants at least.
    """
    deviation = predicted[: time.size]
    expected = describe(time, deviation, step)
    scale = step.setpoint or expected.largest
    other = loop.with_gain(_SLIGHTLY).run(time, step).measurement
    slope = float(np.sum(((other - deviation) / math.log(_SLIGHTLY) / scale) ** 2))
    interval = float(np.median(np.diff(time)))
    # Samples for each instant of the prediction.
    each = max(interval / period, 1.0)
    error = (step.setpoint - deviation) / scale
    beyond = _beyond(deviation, step, expected.largest)
    limit = SETTLING_RATIO * expected.settling_time + 2.0 * period
    late = (time + interval > limit) | (time >= time[-1] - interval)
    edges = [_edge(loop, math.log(end)) for end in GAIN_RANGE]
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    weights = weights / weights.sum()
    floor = math.sqrt(2.0 / math.pi)

    def chance(ratio: float) -> float:
        """Return the chance for a noise of some part of the step."""
        above = (expected.overshoot + OVERSHOOT_MARGIN - beyond) / ratio + NOISE_ALLOWANCE
        band = SETTLED / ratio + NOISE_ALLOWANCE
        settled = error[late] / ratio
        outside = ndtr(-band + settled) + ndtr(-band - settled)
        seen = np.maximum(np.abs(error[:, None] + ratio * nodes) - floor * ratio, 0.0)
        mean = seen @ weights
        spread = math.sqrt(float(np.sum(seen**2 @ weights - mean**2)) / each)
        room = IAE_RATIO * expected.iae / abs(scale) / interval - float(mean.sum())
        # A gain is seen with this standard deviation of its logarithm.
        unsure = ratio / math.sqrt(max(slope * each, 1e-300))
        rare = [room / spread, *(edge / unsure for edge in edges)]
        return float(each * (ndtr(-above).sum() + outside.sum()) + ndtr(-np.array(rare)).sum())

    allowed = 2.0 * float(ndtr(-NOISE_ALLOWANCE))
    ends = (math.log(end) for end in _NOISE_SEARCH)
    most = math.exp(root(lambda ratio: chance(math.exp(ratio)) - allowed, *ends))
    # A step of this height has a response of the size of `scale`.
    height = abs(step.setpoint or step.load)
    return height / (abs(scale) * most)


def _edge(loop: PredictedLoop, end: float) -> float:
    """Return how far the logarithm of the process gain may go to an end until Ms is too large.

    :param loop: controller and process.
    :param end: where the gain is itself too far from the model's.
    """
    most = MS_RATIO * _ms(loop)

    def is_within(part: float) -> bool:
        return _ms(loop.with_gain(math.exp(part * end))) <= most

    low, high = 0.0, 1.0
    if is_within(high):
        return abs(end)
    for _ in range(_MS_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_within(middle) else (low, middle)
    return low * abs(end)


def settled_band(size: float, noise_std: float) -> float:
    """Return the error within which a response has settled [y].

    :param size: the step of the set-point, or the largest deviation after one of the load [y].
    :param noise_std: standard deviation of the noise [y].
    """
    return SETTLED * size + NOISE_ALLOWANCE * noise_std


def describe(
    time: FloatArray, deviation: FloatArray, step: Step, noise_std: float = 0.0
) -> Response:
    """Return the features of a response.

    :param time: instants of the samples, the first at the step [s], shape (n,).
    :param deviation: measurement minus its value before the step [y], shape (n,).
    :param step: the step.
    :param noise_std: standard deviation of the noise, which does not count as error [y].
    """
    error = step.setpoint - deviation
    largest = float(np.max(np.abs(deviation)))
    size, overshoot = abs(step.setpoint) or largest, 0.0
    if size > 0.0:
        beyond = float(_beyond(deviation, step, largest).max())
        overshoot = max(0.0, beyond - _AT_PEAK * noise_std / size)
    outside = np.flatnonzero(np.abs(error) > settled_band(size, noise_std))
    settled = 0 if outside.size == 0 else min(int(outside[-1]) + 1, time.size - 1)
    # Noise alone has a mean absolute value of sqrt(2/pi) standard deviations.
    absolute = np.maximum(np.abs(error) - math.sqrt(2.0 / math.pi) * noise_std, 0.0)
    return Response(
        overshoot=overshoot,
        settling_time=float(time[settled] - time[0]),
        iae=float(np.sum(0.5 * (absolute[1:] + absolute[:-1]) * np.diff(time))),
        largest=largest,
    )


def _beyond(deviation: FloatArray, step: Step, largest: float) -> FloatArray:
    """Return how far a response is beyond its step, as a part of that.

    After a step of the load: to the other side than most, as a part of its largest deviation.
    """
    if step.setpoint:
        return deviation / step.setpoint - 1.0
    return deviation / (largest if deviation.max() < -deviation.min() else -largest)


def compare(
    loop: PredictedLoop,
    step: Step,
    time: FloatArray,
    deviation: FloatArray,
    *,
    limits: Limits = UNLIMITED,
    noise_std: float = 0.0,
) -> Comparison:
    """Compare a measured step with the prediction.

    :param loop: controller and process.
    :param step: the step.
    :param time: instants of the samples, the first at the step [s], shape (n,).
    :param deviation: measurement minus its value before the step [y], shape (n,).
    :param limits: range of the command, relative to its value before the step [u].
    :param noise_std: standard deviation of the measurement noise [y].
    """

    def predict(factor: float) -> FloatArray:
        return loop.with_gain(factor).run(time, step, limits=limits).measurement

    def misfit(log_factor: float) -> float:
        difference = deviation - np.nan_to_num(predict(math.exp(log_factor)), nan=1e9)
        return float(np.mean(np.minimum(difference**2, 1e12)))

    predicted = predict(1.0)
    best, _ = minimum_near(misfit, np.log(_GAIN_SEARCH), 0, 1e-3)
    ratio = math.exp(best)
    spread = float(np.std(predicted))
    rms = math.sqrt(float(np.mean((deviation - predicted) ** 2)))
    measured = describe(time, deviation, step, noise_std)
    expected = describe(time, predicted, step)
    size = abs(step.setpoint) or measured.largest
    band = settled_band(size, noise_std) / size
    in_band = describe(time, predicted, step, noise_std).settling_time
    # White noise leaves the gain this uncertain.
    slope = (predict(_SLIGHTLY * ratio) - predict(ratio)) / math.log(_SLIGHTLY)
    seen = float(np.linalg.norm(slope))
    unsure = NOISE_ALLOWANCE * ratio * noise_std / seen if seen > 0.0 else 0.0
    ms, ms_predicted = _ms(loop.with_gain(ratio)), _ms(loop)
    spared = (NOISE_ALLOWANCE - _AT_PEAK) * noise_std / (abs(step.setpoint) or expected.largest)
    compared = _comparisons(measured, expected, spared, ratio, ms, ms_predicted, time)
    # Written so that NaN does not pass.
    problems = [c.problem for c in compared if not c.taken <= 1.0]
    narrow = [c.numbers for c in compared if c.taken > _NARROW]
    numbers = (
        f"overshoot {measured.overshoot:.0%} (predicted {expected.overshoot:.0%}), "
        f"settling to {100.0 * band:.0f} % {measured.settling_time:.3g} s ({in_band:.3g} s), "
        f"IAE {measured.iae:.3g} ({expected.iae:.3g}), Ms {ms:.2f} ({ms_predicted:.2f}), "
        f"gain {ratio:.2f} times the model's"
    )
    why = Code.AS_PREDICTED(numbers=numbers)
    if problems:
        why = Code.NOT_AS_PREDICTED(problems="; ".join(problems), numbers=numbers)
    elif narrow:
        why = Code.NARROWLY(narrow=", ".join(narrow), numbers=numbers)
    return Comparison(
        passed=not problems,
        # For those who print the numbers without the sentence.
        why=why.plus(gain_uncertainty=unsure, settled_band=band),
        measured=measured,
        # The time given is into the band of the measured one; the limit is without noise.
        expected=replace(expected, settling_time=in_band),
        predicted=predicted,
        fit=1.0 - rms / spread if spread > 0.0 else math.nan,
        gain_ratio=ratio,
        ms=ms,
        ms_predicted=ms_predicted,
    )


def _ms(loop: PredictedLoop) -> float:
    ms = Loop(loop.control.law, loop.model).ms()
    return ms if math.isfinite(ms) else math.nan


@dataclass(frozen=True)
class _Compared:
    """A comparison with the prediction.

    :param taken: part of its tolerance that was needed; above 1 it fails.
    :param problem: what is wrong then.
    :param numbers: what was measured, and what passes.
    """

    taken: float
    problem: str
    numbers: str


def _comparisons(
    measured: Response,
    expected: Response,
    spared: float,
    ratio: float,
    ms: float,
    ms_predicted: float,
    time: FloatArray,
) -> tuple[_Compared, ...]:
    overshoot = expected.overshoot + OVERSHOOT_MARGIN + spared
    settling = SETTLING_RATIO * expected.settling_time + 2.0 * float(np.median(np.diff(time)))
    settled = measured.settling_time < float(time[-1] - time[0])
    iae, least, most = IAE_RATIO * expected.iae, *GAIN_RANGE
    return (
        _Compared(
            _taken(measured.overshoot, expected.overshoot, overshoot),
            "the overshoot is larger than predicted",
            f"the overshoot is {measured.overshoot:.0%}, at most {overshoot:.0%} passes",
        ),
        _Compared(
            _taken(measured.settling_time, expected.settling_time, settling)
            if settled
            else math.inf,
            "it settles later than predicted, or not at all",
            f"it settles after {measured.settling_time:.3g} s, at most {settling:.3g} s passes",
        ),
        _Compared(
            _taken(measured.iae, expected.iae, iae),
            "the error lasts longer than predicted",
            f"the IAE is {measured.iae:.3g}, at most {iae:.3g} passes",
        ),
        _Compared(
            math.log(ratio) / math.log(least if ratio < 1.0 else most),
            "the process has another gain than the model",
            f"the gain is {ratio:.2f} times the model's, {least:g} to {most:g} passes",
        ),
        _Compared(
            _taken(ms, ms_predicted, MS_RATIO * ms_predicted),
            "the loop is less robust than predicted",
            f"Ms is {ms:.2f}, at most {MS_RATIO * ms_predicted:.2f} passes",
        ),
    )


def _taken(measured: float, expected: float, limit: float) -> float:
    """Return which part of the way from the prediction to its limit was taken."""
    return (measured - expected) / (limit - expected) if limit > expected else math.inf
