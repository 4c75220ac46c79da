# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a record tells of the time before it, and which samples need that to be known."""

from __future__ import annotations

from relay_autotune.identification.waveform.problem import Problem
from relay_autotune.identification.waveform.separable import Trial
from relay_autotune.record.moves import answers_soon, begins_at_rest, changes_within
from relay_autotune.record.record import PiecewiseConstant

# Least number of moves of a command that tell whether one came before the record, and show a
# response beside a slow disturbance.
MANY = 6


def needs_no_past(problem: Problem, sign: int) -> bool:
    """Return whether a record shows that the process was at rest before.

    A free past explains any single step. Many moves tell of themselves whether one is needed: a
    command that moved just before the record acts in the rest, or after it where the dead time is
    longer. The latter is a coincidence where a motion follows the first move sooner than the rest
    lasted. A relay test began where its settings say, and is asked of its samples all the same.

    :param problem: all samples.
    :param sign: the direction in which the relay worked, 1 or -1; 0: not known.
    """
    parts = [
        (problem.time[part], problem.y[part], u)
        for part, u in zip(problem.experiments, problem.inputs, strict=True)
    ]
    return (
        not sign
        and (moves_seldom(problem) or all(answers_soon(*part) for part in parts))
        and all(
            # A command that is known to have held until the first sample is such a rest, too.
            (isinstance(u, PiecewiseConstant) and u.times[0] == time[0])
            or begins_at_rest(time, y, u)
            for time, y, u in parts
        )
    )


def moves_seldom(problem: Problem) -> bool:
    """Return whether no command moves often enough to tell what came before the record.

    :param problem: all samples.
    """
    parts = zip(problem.experiments, problem.inputs, strict=True)
    return all(changes_within(u, problem.time[part]).size < MANY for part, u in parts)


def drop_first_dead_time(problem: Problem, state: Trial) -> Problem:
    """Return the samples whose input is known; all of them where the process was at rest.

    The input before the record is not known, unless it is estimated, and acts for one dead time.

    :param problem: the problem.
    :param state: a fit, for its dead time.
    """
    if not problem.relaxation or problem.past:
        return problem
    some = problem.part(problem.time >= problem.starts + float(state.theta[-1]))
    least = min(part.stop - part.start for part in some.experiments)
    return some if least > 4 * state.parameters and _is_driven(some) else problem


def _is_driven(problem: Problem) -> bool:
    """Return whether the command changes within the samples of each experiment."""
    return all(
        part.stop > part.start and changes_within(u, problem.time[part]).size > 0
        for part, u in zip(problem.experiments, problem.inputs, strict=True)
    )
