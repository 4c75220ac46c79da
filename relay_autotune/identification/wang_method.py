"""The methods `wang_biased` and `wang_unbiased`: FOPDT models from one relay test.

Wang, Hang and Zou 1997. Peaks and fundamental are those of the averaged period, whose peaks noise
does not raise; the levels at which the relay was seen to switch take the place of its hysteresis.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from relay_autotune.cycles import find_cycles
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.cycle.cycle_scatter import NOT_SETTLED, RelayTest, relay_test
from relay_autotune.identification.cycle.fold import Fold, as_switched, fold
from relay_autotune.identification.cycle.steady_state import (
    UNKNOWN_REST,
    StaticGain,
    static_gain,
    steady_state,
)
from relay_autotune.identification.cycle.symmetric_cycle import require_unbiased
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.result import Identification, with_uncertainty
from relay_autotune.identification.wang1997 import (
    PARAMETERS,
    FopdtCycle,
    fopdt_from_biased,
    fopdt_from_unbiased,
    fopdt_with_gain,
)
from relay_autotune.models import TransferFunction
from relay_autotune.record import Record

FloatArray = NDArray[np.float64]


_LEAST_CYCLES = 3
_MOST_PARTS = 20


@dataclass(frozen=True)
class _Facts:
    """What is the same for all cycles.

    :param sign: +1, or -1 for a reverse-acting relay.
    :param gain: K [y/u], with its sign; NaN: to be found.
    :param rest: measurement at rest [y].
    """

    sign: int
    gain: float
    rest: float


def identify_biased(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a FOPDT model from a biased relay test (eqs 6 to 11).

    Deviations are taken from the measured steady state; where the set-point lies elsewhere, the
    bias about it is ``mu0 - (setpoint - rest)/K``. What is not certain of the steady state is not
    certain of the gain either.

    :param record: a relay test with a bias.
    :param known: a known gain takes the place of eq 6.
    :raises IdentificationError: if the relay was unbiased, or the numbers are no limit cycle of a
        FOPDT process.
    """
    test = relay_test("wang_biased", record)
    rest = steady_state(record, test.whole.settings)
    gain = (
        static_gain(test, rest)
        if math.isnan(known.gain)
        else StaticGain(known.gain, 0.0, math.inf)
    )
    sign = -1 if test.whole.settings.reverse_acting else 1
    if not sign * gain.value > 0.0:
        raise IdentificationError(
            f"a gain of {gain.value:g} is against the direction of the relay: the state before "
            "the test was not steady, the load changed, or the known gain has the wrong sign"
        )
    facts = _Facts(sign, gain.value, rest.value)
    uncertain = [replace(facts, gain=gain.value + gain.scatter)]
    if rest.measured:
        # A steady state that is a little higher makes the gain lower.
        lower = gain.value - rest.std / gain.excursion
        uncertain.append(replace(facts, gain=lower, rest=rest.value + rest.std))
    remark = "" if rest.measured else UNKNOWN_REST
    return _identified("wang_biased", test, record, _from_biased, facts, tuple(uncertain), remark)


def identify_unbiased(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a FOPDT model from an unbiased relay test (eqs 21 to 25).

    :param record: a relay test without bias.
    :param known: a known gain takes the place of eqs 23 to 25.
    :raises IdentificationError: if the relay was biased, or no FOPDT process has the limit cycle.
    """
    test = relay_test("wang_unbiased", record)
    require_unbiased("wang_unbiased", test.whole.settings)
    sign = -1 if test.whole.settings.reverse_acting else 1
    if sign * known.gain < 0.0:
        raise IdentificationError(
            f"a gain of {known.gain:g} is against the direction of the relay: the known gain has "
            "the wrong sign"
        )
    facts = _Facts(sign, known.gain, math.nan)
    return _identified("wang_unbiased", test, record, _from_unbiased, facts, (), "")


def _from_biased(seen: Fold, facts: _Facts) -> FloatArray:
    # With the command turned round a reverse-acting process has a positive gain.
    settings, gain = as_switched(seen), facts.sign * facts.gain
    high, low = (seen.period_high, seen.period_low)[:: facts.sign]
    about = settings.setpoint
    down, up = (p - about + seen.settings.setpoint for p in seen.peaks())
    bias = facts.sign * settings.bias - (about - facts.rest) / gain
    cycle = FopdtCycle(high, low, up, down)
    k, t, dead = fopdt_from_biased(cycle, gain, settings.amplitude, bias, settings.hysteresis)
    return np.array((facts.sign * k, t, dead))


def _from_unbiased(seen: Fold, facts: _Facts) -> FloatArray:
    settings = as_switched(seen)
    down, up = seen.peaks()
    amplitude, period = 0.5 * (up - down), seen.period
    if math.isnan(facts.gain):
        k, t, dead = fopdt_from_unbiased(
            period, amplitude, abs(seen.fundamental()), settings.amplitude, settings.hysteresis
        )
    else:
        k, t, dead = fopdt_with_gain(
            facts.sign * facts.gain, period, amplitude, settings.amplitude, settings.hysteresis
        )
    return np.array((facts.sign * k, t, dead))


_Measure = Callable[[Fold, _Facts], FloatArray]


def _identified(
    method: str,
    test: RelayTest,
    record: Record,
    measure: _Measure,
    facts: _Facts,
    uncertain: tuple[_Facts, ...],
    remark: str,
) -> Identification:
    """Measure on the averaged period; what leaving out each cycle changes is the uncertainty.

    :param uncertain: the facts, each with one of them off by its standard deviation.
    :param remark: for the user; may be empty.
    """
    settings = test.whole.settings
    record = replace(record, settings=settings, cycle_start=_bounds(record))
    cycles = test.whole.cycle.cycles
    whole = fold(record, cycles)

    def values(seen: Fold, known: _Facts) -> FloatArray:
        found = measure(seen, known)
        # What the relay added to the dead time is no part of the process.
        found[2] = max(found[2] - settings.extra_delay, 0.0)
        return found

    best = values(whole, facts)
    covariance = None
    if len(cycles) >= _LEAST_CYCLES:
        covariance = _jackknife(whole, record, cycles, lambda part: values(part, facts))
    if covariance is not None:
        for other in uncertain:
            covariance = covariance + _by(lambda known: values(whole, known), other, best)
    remarks = [remark, "" if test.whole.cycle.converged else NOT_SETTLED]
    return with_uncertainty(
        method,
        lambda v: TransferFunction.fopdt(float(v[0]), float(v[1]), float(v[2])),
        PARAMETERS,
        best,
        covariance,
        float(stdtrit(max(len(cycles) - 1, 1), 0.975)),
        warnings=tuple(r for r in remarks if r),
    )


def _bounds(record: Record) -> tuple[int, ...]:
    return record.cycle_start or find_cycles(record)


def _jackknife(
    whole: Fold,
    record: Record,
    cycles: tuple[int, ...],
    measure: Callable[[Fold], FloatArray],
) -> FloatArray | None:
    """Return the covariance by leaving out one cycle after the other; None: too few solve."""
    parts = []
    for left_out in cycles[:: -(-len(cycles) // _MOST_PARTS)]:
        try:
            parts.append(measure(fold(record, tuple(c for c in cycles if c != left_out), whole)))
        except IdentificationError:
            # Without that cycle the numbers are no limit cycle; the others tell the scatter.
            continue
    if len(parts) < _LEAST_CYCLES:
        return None
    away = np.array(parts) - np.mean(parts, axis=0)
    return np.asarray(away.T @ away * (len(cycles) - 1) / len(parts))


def _by(
    measure: Callable[[_Facts], FloatArray], uncertain: _Facts, best: FloatArray
) -> FloatArray:
    """Return the covariance that one uncertain fact makes."""
    if not math.isfinite(uncertain.gain + uncertain.rest):
        return np.full((best.size, best.size), math.nan)
    try:
        change = measure(uncertain) - best
    except IdentificationError:
        # So far off no FOPDT process has the limit cycle: nothing bounds the error.
        return np.full((best.size, best.size), math.nan)
    return np.outer(change, change)
