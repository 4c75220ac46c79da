# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""A closed loop: margins, responses to set-point and load, noise in the command.

The law runs once for each sample, and its command is held until the next one. With the law C and
the process G between hold and sampler, both at ``z = exp(s h)``, ``L = C G`` exactly, and the
measurement between the samples after a step of set-point or load, with the process itself, is

    F(z)/(1 + L(z)) G(s)/s    and    1/(1 + L(z)) G(s)/s,

since the hold's ``1 - z^-1`` is that of the step. A continuous controller is the limit for h -> 0.

The transforms are inverted by a fast Fourier transform along ``Re s = sigma`` (Dubner and Abate
1968). Where it has the samples' own instants, transforms in z give the samples exactly. Else a
truncated transform cannot follow a jump at t = 0, so the jump is removed before the inversion and
added after it. Integrals of an error are computed as ``int |e| = |int e| + 2 int (the part of the
other sign)``: the first is the transform at s = 0, so that a slow tail needs no computation.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.loop.gains import (
    Controller,
    Gains,
    InternalModelLaw,
    Margins,
    Performance,
    StepFigures,
)
from relay_autotune.loop.law import LawRate, SampledLaw
from relay_autotune.loop.laws import LAWS
from relay_autotune.loop.sampled import ClosedLoop
from relay_autotune.loop.stability import (
    closed_loop_unstable_poles,
    margins,
    peaks,
    sampled_unstable_poles,
)
from relay_autotune.process.frequencies import frequencies
from relay_autotune.process.model_set import ModelSet
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.text import digits, percent

_POINTS = 4096
_MOST_POINTS = 1 << 18
_DECAY = math.log(1e8)
_TURNS, _RESETS, _LONGEST = 6.0, 8.0, 64.0
# Least number of samples of a response, and the largest that are computed one by one.
_LEAST_SAMPLES, _MOST_SAMPLES = 256, 1 << 14
# Periods of the controller beyond which 1 - exp(-s h) has no digits left.
_MOST_PERIODS = 1e12
_ANGLES = 4096
# The horizon is long enough if the tail of a response is below this part of the whole.
_SETTLED = 1e-3
# A smaller final error counts as zero.
_NO_OFFSET = 1e-3
_BAND = 0.02

# A linear controller: continuous, sampled, or with a model inside.
ControlLaw = Controller | SampledLaw | InternalModelLaw


def abscissae(duration: float | FloatArray, points: int) -> ComplexArray:
    """Return the values of s for the transform of :func:`inverted` [rad/s].

    They lie on a line right of the imaginary axis (Dubner and Abate 1968).

    :param duration: s; or one of each function, shape (k, 1).
    :param points: number of instants of the function.
    :return: shape (points + 1,), or (k, points + 1).
    """
    return _DECAY / (2.0 * duration) + 1j * np.arange(points + 1) * (math.pi / duration)


def inverted(
    values: ComplexArray,
    duration: float | FloatArray,
    jump: float = 0.0,
    *,
    sampled: bool = False,
) -> FloatArray:
    """Return the function of a Laplace transform at equally spaced times from 0 on.

    :param values: the transform at :func:`abscissae`, shape (..., points + 1); it must not have
        poles right of the imaginary axis.
    :param duration: s; the last instant is one step before it; or one of each function, shape
        (k, 1).
    :param jump: value just after t = 0.
    :param sampled: True: of a sequence with one value for each instant, times their distance.
    :return: shape (..., points).
    """
    points = values.shape[-1] - 1
    step, decay = duration / points, 20.0 / duration
    time = np.arange(points) * step
    grown = np.exp(_DECAY / (2.0 * duration) * time) / step
    if sampled:
        return np.asarray(np.fft.irfft(values)[..., :points] * grown)
    if jump:
        values = values - jump / (abscissae(duration, points) + decay)
    # Lanczos' factors remove the ringing caused by the cut at the last frequency.
    values = values * np.sinc(np.arange(points + 1) / points)
    found = np.fft.irfft(values)[..., :points] * grown
    return np.asarray(found + jump * np.exp(-decay * time) if jump else found)


class Loop:
    """A control law and a process.

    :param law: with its gains and its period.
    :param model: the process, with the dead time of the loop, but none for the hold.
    :param process: the same as the loop meets it, where it is known already.
    """

    def __init__(
        self, law: ControlLaw, model: TransferFunction, process: ModelSet | None = None
    ) -> None:
        self.law, self.model = law, model
        self._process = process or ModelSet((model,), law.period)

    def process(self, s: ComplexArray) -> ComplexArray:
        """Return the process as the law meets it, y/u.

        :param s: rad/s, shape (n,).
        """
        return np.asarray(self._process(s)[:, 0])

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return L.

        :param s: rad/s, shape (n,).
        """
        return np.asarray(self.law(s) * self.process(s))

    @cached_property
    def grid(self) -> FloatArray:
        """Frequencies that show the loop [rad/s], shape (n,)."""
        return frequencies(self.model, times=self.law.times, period=self.law.period, loop=self)

    @cached_property
    def unstable_poles(self) -> float:
        """Number of unstable closed-loop poles; infinite: not certain, or one on the boundary.

        :raises TuningError: if the process has undamped poles other than at s = 0.
        """
        if self.law.period == 0.0:
            return closed_loop_unstable_poles(self.law.characteristic(self.model))
        integrators = self.model.integrators + (1 if self.law.i else 0)
        poles = int(self._process.unstable_poles[0])
        return sampled_unstable_poles(self, self.grid, self.law.period, poles, integrators)

    def ms(self) -> float:
        """Return the largest magnitude of the sensitivity function.

        :return: infinite where the loop is unstable, or where that could not be decided.
        """
        try:
            if self.unstable_poles != 0:
                return math.inf
        except RelayAutotuneError:
            return math.inf
        return peaks(self, self.grid)[0][0]

    def margins(self) -> tuple[Margins, float]:
        """Return the margins of the loop, which must be stable, and the frequency of its Ms.

        The delay margin is the phase margin over its frequency, also of a sampled loop.
        """
        integrates, ends = self.model.integrators > 0 or bool(self.law.i), []
        if not integrates:
            at_rest = self.law(np.zeros(1, dtype=np.complex128))[0].real
            ends.append(float(at_rest) * self.model.gain)
        if self.law.period > 0.0:
            ends.append(float(self(np.array([1j * math.pi / self.law.period]))[0].real))
        return margins(self, self.grid, ends, integrates=integrates)

    def noise_gain(self) -> float:
        """Return the standard deviation of the command per that of white noise [u/y].

        Of a continuous loop it is the largest magnitude from noise to command, an upper bound for
        every period.
        """
        if self.law.period == 0.0:
            s = 1j * self.grid
            return float(np.abs(self.law(s) / (1.0 + self(s))).max())
        s = 1j * (np.arange(_ANGLES) + 0.5) * (math.pi / _ANGLES / self.law.period)
        return float(np.sqrt(np.mean(np.abs(self.law(s) / (1.0 + self(s))) ** 2)))

    def step_responses(
        self, duration: float, points: int = _POINTS
    ) -> tuple[ClosedLoop, ClosedLoop]:
        """Return the responses to a unit step of the set-point, and to one of the load.

        The loop must be stable. The command after a load step is without the load itself; just
        after a step of the set-point it lacks what the derivative of the error adds to a few
        samples, unless the instants are the samples.

        :param duration: s.
        :param points: number of instants.
        """
        sampled = self._has_instants(duration, points)
        s = abscissae(duration, points)
        y_r, y_d, u_r, u_d = self._closed(s, sampled)
        step = self._unit_step(s, sampled)
        time = np.arange(points) * (duration / points)

        def inverse(values: ComplexArray, jump: float = 0.0) -> FloatArray:
            return inverted(values * step, duration, jump, sampled=sampled)

        if not sampled:
            u_r = u_r - self._kick(s)
        return (
            ClosedLoop(time, inverse(y_r), inverse(u_r, self._first_command())),
            ClosedLoop(time, inverse(y_d), inverse(u_d)),
        )

    def _has_instants(self, duration: float, points: int) -> bool:
        """Return whether equally spaced instants are those of the samples."""
        return math.isclose(duration, points * self.law.period, rel_tol=1e-9)

    def _unit_step(self, s: ComplexArray, sampled: bool) -> ComplexArray:
        h = self.law.period
        return h / -np.expm1(-s * h) if sampled else 1.0 / s

    def _closed(self, s: ComplexArray, sampled: bool) -> tuple[ComplexArray, ...]:
        """Return measurement and command from set-point and load: y/r, y/d, u/r, u/d.

        :param sampled: True: the measurement at the samples; False: between them as well.
        """
        held = self.process(s)
        process = held if sampled else self.model(s)
        law, forward = self.law(s), self.law.from_setpoint(s)
        rest = 1.0 + law * held
        return process * forward / rest, process / rest, forward / rest, -law * held / rest

    def _kick(self, s: ComplexArray) -> ComplexArray:
        """Return command per set-point by the derivative of the error alone."""
        return self.law.kick(s) if isinstance(self.law, SampledLaw) else 0.0 * s

    def _first_command(self) -> float:
        """Return the command just after a unit step of the set-point, without kick [u]."""
        constants = (*self.model.time_constants, *self.law.times, self.law.period)
        shortest = min([abs(c) for c in constants if c != 0.0], default=1.0)
        s = np.array([1e9 / shortest], dtype=np.complex128)
        first = self.law.from_setpoint(s) - self._kick(s)
        return float(first[0].real)

    def figures(self, frequency: float) -> StepFigures:
        """Return the features of the responses to unit steps; the loop must be stable.

        :param frequency: about which the loop is closed [rad/s].
        :raises TuningError: if the responses do not die away in any reasonable time.
        """
        duration, h = self._horizon(frequency), self.law.period
        if duration > _MOST_PERIODS * h > 0.0:
            raise TuningError(
                f"the responses of the closed loop last {duration / h:.1g} periods of its "
                "controller: with such small gains it does next to nothing"
            )
        longest = _LONGEST * duration
        # Twenty instants per period of this frequency, if the number of points allows it.
        finest = min(int(20.0 * duration * frequency / (2.0 * math.pi)), _MOST_POINTS // 8)
        points = max(_POINTS, 1 << finest.bit_length())
        while True:
            setpoint, load = self._responses(duration, points)
            final, offset, integrals = self._at_rest(frequency, setpoint)
            tails = (setpoint.measurement - final, load.measurement - offset)
            if all(_has_settled(tail) for tail in tails):
                break
            duration, points = 2.0 * duration, min(2 * points, _MOST_POINTS)
            if duration > longest:
                raise TuningError(
                    "the responses of the closed loop do not die away in any reasonable time"
                )
        error, step = final - setpoint.measurement, float(setpoint.time[1])
        command = self._with_kicks(setpoint)
        iae_setpoint, iae_load = (
            _iae(whole, e, step) if math.isfinite(whole) else math.inf
            for whole, e in zip(integrals, (error, load.measurement), strict=True)
        )
        return StepFigures(
            iae_load=iae_load,
            iae_setpoint=iae_setpoint,
            overshoot=max(float(np.max(-error / final)), 0.0),
            settling_time=_settling_time(setpoint.time, error, _BAND * abs(final)),
            effort_setpoint=abs(float(command[0])) + _variation(command),
            effort_load=_variation(load.command),
        )

    def _responses(self, duration: float, points: int) -> tuple[ClosedLoop, ClosedLoop]:
        """Return :meth:`step_responses` at the samples, for longer, where these are not many."""
        h = self.law.period
        if h > 0.0 and duration <= _MOST_SAMPLES * h:
            samples = max(_LEAST_SAMPLES, 1 << int(duration / h).bit_length())
            return self.step_responses(samples * h, samples)
        return self.step_responses(duration, points)

    def command_range(self, duration: float) -> tuple[float, float]:
        """Return the smallest and the largest command after a unit step of the set-point [u/y].

        :param duration: of the response [s].
        """
        setpoint, _ = self._responses(duration, _POINTS)
        command = self._with_kicks(setpoint)
        return float(command.min()), float(command.max())

    def _at_rest(
        self, frequency: float, setpoint: ClosedLoop
    ) -> tuple[float, float, tuple[float, float]]:
        """Return where both responses end, and the integrals of both errors [y s]."""
        step = float(setpoint.time[1])
        sampled = self._has_instants(step * setpoint.time.size, setpoint.time.size)
        # Small enough for the limit, and large enough that 1 - exp(-s h) has digits left.
        digits = math.sqrt(min(frequency * self.law.period, 1.0) or 1.0)
        s = np.array([1e-8 * frequency / digits], dtype=np.complex128)
        to_setpoint, to_load, *_ = self._closed(s, sampled)
        if self.law.i:
            whole = float(((1.0 - to_setpoint) * self._unit_step(s, sampled))[0].real)
            return 1.0, 0.0, (whole, 1.0 / self.law.i)
        final = float(to_setpoint[0].real)
        whole = 0.0 if abs(1.0 - final) < _NO_OFFSET else math.inf
        return final, float(to_load[0].real), (whole, math.inf)

    def _with_kicks(self, setpoint: ClosedLoop) -> FloatArray:
        """Return the command after a unit step of the set-point with all samples of its kick."""
        time, size, command = setpoint.time, setpoint.time.size, setpoint.command
        if self._has_instants(float(time[1]) * size, size):
            return command
        kicks = self.law.kicks if isinstance(self.law, SampledLaw) else np.zeros(1)
        kicked = np.arange(kicks.size) * self.law.period
        calm = np.concatenate(([self._first_command()], command[1:]))
        early, rest = np.interp(kicked, time, calm), time > kicked[-1]
        return np.concatenate((early + kicks, calm[rest]))

    def _horizon(self, frequency: float) -> float:
        """Return a first guess of how long the responses last [s]."""
        reset = max((abs(t) for t in self.model.time_constants), default=0.0)
        integral = abs(self.law.i)
        if integral > 0.0:
            reset = abs(complex(self.law(np.array([1j * frequency]))[0])) / integral
            if self.model.is_stable:
                # With a small gain, the integral alone brings the process to its set-point.
                reset += 1.0 / (integral * abs(self.model.gain))
        return _RESETS * reset + _TURNS * 2.0 * math.pi / frequency

    def performance(self) -> Performance:
        """Return what the loop does.

        :raises TuningError: if it is unstable, or its responses do not die away.
        """
        if self.unstable_poles != 0:
            law = self.law
            how = ""
            if isinstance(law, SampledLaw):
                how = f" where {law.law.name} runs it every {law.period:g} s" if law.period else ""
                law = law.gains
            shorter = ", or a shorter sample_period" if how else ""
            raise TuningError(
                f"{law} makes an unstable loop with the model{how}: use another rule{shorter}"
            )
        found, frequency = self.margins()
        figures = self.figures(frequency)
        return Performance(**vars(found), **vars(figures), noise_gain=self.noise_gain())


def _has_settled(tail: FloatArray) -> bool:
    """Return True if the late part of a deviation is negligible, shape (n,)."""
    late = tail[3 * tail.size // 4 : -tail.size // 16]
    return float(np.abs(late).max()) <= _SETTLED * float(np.abs(tail).max())


def _variation(values: FloatArray) -> float:
    return float(np.abs(np.diff(values)).sum())


def _settling_time(time: FloatArray, error: FloatArray, band: float) -> float:
    outside = np.flatnonzero(np.abs(error) > band)
    if not outside.size:
        return 0.0
    last = int(outside[-1])
    if last + 1 >= time.size:
        return float(time[-1])
    before, after = abs(error[last]), abs(error[last + 1])
    return float(time[last] + (before - band) / (before - after) * (time[1] - time[0]))


def _iae(whole: float, error: FloatArray, step: float) -> float:
    """Return the integral of |error| from the integral of the error and its part of other sign."""
    other = np.maximum(-math.copysign(1.0, whole) * error, 0.0)
    return abs(whole) + 2.0 * float(other.sum()) * step


def is_stable(controller: ControlLaw, model: TransferFunction) -> bool:
    """Return whether the closed loop is stable.

    :param controller: the gains, or any other linear controller.
    :param model: the process.
    """
    return Loop(controller, model).unstable_poles == 0


def analyse_loop(controller: ControlLaw, model: TransferFunction) -> Performance:
    """Return the performance of a controller on a model.

    :param controller: the gains, or any other linear controller.
    :param model: the process, with all dead time of the loop but that of the hold.
    :raises TuningError: if the closed loop is unstable, or its responses do not die away.
    """
    return Loop(controller, model).performance()


def as_run(present: Controller, new: Gains | None) -> SampledLaw | Controller:
    """Return gains of any origin as the law of new ones runs them.

    :param present: the gains; where that law cannot run them, they run continuously.
    :param new: those of the law; None: the present ones run continuously.
    """
    if new and new.law in LAWS:
        with suppress(TuningError):
            return LawRate(LAWS[new.law], new.law_period).of(present)
    return present


def performance_beside(
    present: Controller, new: Gains | None, model: TransferFunction, added_delay: float = math.nan
) -> Performance | None:
    """Return the performance of gains of any origin, run as new ones; None: the loop is unstable.

    :param present: the gains, as of :func:`as_run`; where they run continuously they have the dead
        time of the law's hold.
    :param new: those that they are compared with, as there.
    :param model: the process.
    :param added_delay: dead time of the loop besides it [s]; NaN: that of the law's hold alone.
    """
    hold = LAWS[new.law].lag(new.law_period) if new and new.law in LAWS else 0.0
    delay, law = hold if math.isnan(added_delay) else added_delay, as_run(present, new)
    if isinstance(law, SampledLaw):
        delay -= hold
    try:
        return analyse_loop(law, replace(model, dead_time=max(model.dead_time + delay, 0.0)))
    except TuningError:
        return None


# Factors of the error and of Ms that are worth a word, and how much more overshoot is.
_ERROR, _MS, _OVERSHOOT = 1.05, 1.02, 0.05


def lasting_error(gains: Controller, model: TransferFunction) -> float:
    """Return what a unit step of the load leaves of error, ``1/(1/K + kc)`` without integral.

    :param gains: the gains.
    :param model: the process; K is its gain, infinite if it integrates.
    :return: without its sign [y/u].
    """
    if gains.i:
        return 0.0
    return abs(1.0 / (gains.kc + (0.0 if model.integrators else 1.0 / model.gain)))


def difference(
    present: Controller, does: Performance | None, new: Gains, model: TransferFunction
) -> str:
    """Return in words what new gains change.

    :param present: the present gains.
    :param does: what they do on the model; None: they make the loop unstable.
    :param new: the new gains.
    :param model: the process.
    """
    if does is None:
        sentence = "the present gains make the loop unstable on the model"
        minutes = replace(present, ti=60.0 * present.ti, td=60.0 * present.td)
        for meant, slip in (
            (replace(present, kc=-present.kc), "is the sign of kc another one"),
            (minutes, "are ti and td in minutes, not in seconds"),
        ):
            if performance_beside(meant, new, model) is not None:
                return f"{sentence}; {meant} would not: {slip}?"
        return sentence
    before, after = lasting_error(present, model), lasting_error(new, model)
    lasts = max(before, after) > 0.0
    if lasts:
        # An error that stays has no integral.
        kinds = ("less exact", "as exact", "more exact")
        errors = f"a lasting error of {digits(after, 3)} instead of {digits(before, 3)} y/u"
    else:
        before, after = does.iae_load, new.iae_load
        kinds = ("slower", "as fast", "faster")
        errors = f"{after / before:.2f} times the error"
    calm = -1 if new.ms > _MS * does.ms else int(does.ms > _MS * new.ms)
    good = -1 if after > _ERROR * before else int(after * _ERROR < before)
    joined = "but" if calm * good < 0 else "and"
    more = "; where the present loop is calm enough, ask for faster ones with a larger ms"
    beyond = (
        f"; the overshoot after one of the set-point is {percent(new.overshoot)} instead of "
        f"{percent(does.overshoot)} %: a smaller mt lowers it"
    )
    return (
        f"the new gains are {('less calm', 'as calm', 'calmer')[calm + 1]} {joined} "
        f"{kinds[good + 1]}: Ms {new.ms:.3g} instead of {does.ms:.3g}, {errors} after a step of "
        f"the load{more * (good < 0 < calm and not lasts)}"
        f"{beyond * (new.overshoot > does.overshoot + _OVERSHOOT)}"
    )
