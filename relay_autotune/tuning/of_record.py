# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a design takes from the record: noise, amplitude, clock, and what its rows do not show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.judgement.difference import Difference
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.posterior import DRAWS
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.quantities import LONGEST, SHORTEST
from relay_autotune.record.cycles import cycles_of, limit_cycle
from relay_autotune.record.record import Record
from relay_autotune.text import digits
from relay_autotune.tuning.ensemble import ensemble
from relay_autotune.tuning.rules.formulas import describing_point_of_cycle
from relay_autotune.tuning.task import DesignOptions, DesignTask

# Ratio of two values of K_u below which a user is told of both.
_MUCH_LESS = 0.9


def task_of_record(
    chosen: Identification,
    record: Record,
    options: DesignOptions,
    simple: TransferFunction | None,
    rng: np.random.Generator | None = None,
    beside: Difference | None = None,
) -> DesignTask:
    """Return what the rules are given for the selected model of a record.

    :param chosen: that model.
    :param record: the record.
    :param options: as they were given.
    :param simple: the FOPDT that most rules need; None: there is none.
    :param rng: draws the models within the uncertainty; None: of a fixed seed.
    :param beside: what the record shows beside the model; None: it was not asked.
    """
    rng = rng or np.random.default_rng(0)
    options = _with_noise(options, chosen, record)
    models = ensemble(chosen, rng=rng)
    if beside is not None and not models:
        models = (chosen.model,) * DRAWS
    unseen = record.unseen
    if unseen:
        options = replace(options, loop_delay=options.loop_delay + 0.5 * unseen)
        models = _spread_in_time(models, unseen, rng)
    describing, settings = None, record.settings
    if settings is not None and cycles_of(record):
        average, sign = limit_cycle(record), chosen.model.process_sign
        describing = describing_point_of_cycle(average, settings.amplitude, sign)
    return DesignTask(
        model=chosen.model,
        options=options,
        simple=simple,
        models=models,
        errors=None if beside is None else beside.draws(len(models), rng),
        describing=describing,
        recorded_period=_clock_of(record),
    )


def _with_noise(options: DesignOptions, chosen: Identification, record: Record) -> DesignOptions:
    """Take noise, amplitude and sampling period from the record if they are not given."""
    # The controller will see single samples, not means of many.
    before = record.unthinned
    if math.isnan(options.noise_std):
        # What moves slowly is none, though a coarse sensor may show nothing else.
        measured = record.noise if before is None else before.noise
        options = replace(options, noise_std=measured or chosen.fit.residual_rms)
    if math.isnan(options.amplitude):
        # Without relay settings: half of the command's range.
        settings, half = record.settings, 0.5 * float(np.ptp(record.command))
        options = replace(options, amplitude=half if settings is None else abs(settings.amplitude))
    if options.sample_period == 0.0:
        options = replace(options, sample_period=_clock_of(record))
    return options


def _clock_of(record: Record) -> float:
    """Return the time between samples without the jitter of the stamps [s]; 0: there is none."""
    # No program is set to further digits.
    return float(f"{sampling_period(record):.3g}")


def _spread_in_time(
    models: Sequence[TransferFunction], unseen: float, rng: np.random.Generator
) -> tuple[TransferFunction, ...]:
    """Return models whose dead times are spread evenly over a time about their own.

    :param models: n of them.
    :param unseen: that time [s].
    :param rng: decides which of them is how late.
    """
    late = rng.permutation(unseen * ((np.arange(len(models)) + 0.5) / len(models) - 0.5))
    return tuple(
        replace(m, dead_time=max(m.dead_time + float(by), 0.0))
        for m, by in zip(models, late, strict=True)
    )


def warned_of_rows(chosen: Identification, record: Record) -> Identification:
    """Add to a model's warnings what its record does not show of the command, where it matters.

    :param chosen: the model.
    :param record: the record.
    """
    unseen = record.unseen
    if not unseen:
        return chosen
    later = replace(chosen.model, dead_time=chosen.model.dead_time + unseen)
    point = ultimate_point(later)
    if point is None or abs(point.gain) > _MUCH_LESS * abs(chosen.ultimate_gain):
        return chosen
    warning = (
        f"a change of the command may have come up to {digits(unseen, 3)} s before its row, and "
        f"K_u be as low as {digits(point.gain, 3)}: the gains allow for that; log faster, or "
        "add a row just before and one just after each change"
    )
    return replace(chosen, warnings=(*chosen.warnings, warning))


def sampling_period(record: Record) -> float:
    """Return the time between the samples as they were taken [s].

    :param record: the record.
    :raises IdentificationError: if no clock can have given it.
    """
    before = record.unthinned
    period = 0.0 if len(record) < 2 else record.interval if before is None else before.interval
    if record.unseen and record.is_of_changes:
        # Rows between were left out, but for those about changes of the command.
        gaps = np.diff(record.time)[np.diff(record.command) == 0.0]
        period = float(np.min(gaps, where=gaps > 0.0, initial=period))
    if period and not SHORTEST <= period <= LONGEST:
        raise IdentificationError(
            f"the samples are {period:.3g} s apart, expected {SHORTEST:g} to {LONGEST:g} s: check "
            f"the unit of the time"
        )
    return period
