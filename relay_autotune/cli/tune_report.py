# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The report of a tune: its record is analysed again with the identifier_node's parameters."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.arguments import flag_of, typed_as
from relay_autotune.cli.report import write_report

if TYPE_CHECKING:
    from relay_autotune.analysis import Analysis
    from relay_autotune.loop.gains import Controller
    from relay_autotune.record.record import Record

_NEAR = 1e-6


def flags_of(values: Mapping[str, Any]) -> str:
    """Return the flags with which `replay` and `report` give the identifier_node's result.

    :param values: of its parameters, by name.
    :return: the flags of those that are not the default.
    """
    from relay_autotune.nodes.identifier_parameters import PARAMETERS

    found = []
    for entry in PARAMETERS:
        value = values[entry.name]
        if value == entry.default or value != value:
            continue
        typed = typed_as(entry)
        if typed.unit != entry.unit:
            value = math.degrees(value)
        found += [flag_of(typed), f"{value:.12g}" if isinstance(value, float) else str(value)]
    return shlex.join(found)


def analysed_as_there(
    record: Record, values: Mapping[str, Any], tell: Callable[[str], None] = lambda _: None
) -> Analysis:
    """Identify and tune as the identifier_node does.

    :param record: the samples.
    :param values: of its parameters, by name.
    :param tell: called with what begins.
    """
    from relay_autotune.analysis import analyse
    from relay_autotune.nodes.identifier_parameters import known_from, options_from

    return analyse(
        record,
        method=values["method"],
        rule=values["rule"],
        known=known_from(values),
        options=options_from(values),
        tell=tell,
    )


def defaults() -> dict[str, Any]:
    """Return the default parameters of identifier_node, by name."""
    from relay_autotune.nodes.identifier_parameters import PARAMETERS

    return {entry.name: entry.default for entry in PARAMETERS}


def report_of_tune(
    record: Record,
    values: Mapping[str, Any],
    result: Any,
    source: str,
    output: str,
    present: Controller | None = None,
) -> str:
    """Write a report of a tune.

    :param record: its samples.
    :param values: of the identifier_node's parameters, by name.
    :param result: the `Tune.Result`.
    :param source: name of the tune in the report.
    :param output: file of the report.
    :param present: the gains in force; None: not known.
    :return: a warning for the user; empty: none.
    :raises BagError: if it cannot be written.
    """
    from relay_autotune.report.case import case_of

    found = analysed_as_there(record, values)
    case = replace(case_of(found, source), present=present)
    if result.bag:
        again = f"report {shlex.quote(result.bag)} {flags_of(values)}".rstrip()
        if present is not None:
            again += f" --present {present.kc:.6g} {present.ti:.6g} {present.td:.6g}"
        case = replace(case, command=f"{again} -o {shlex.quote(output)}")
    write_report([case], output)
    gains, published = found.best_gains, result.gains
    kc = gains.kc if gains is not None else math.nan
    if published.experiment_id and not math.isclose(kc, published.kc, rel_tol=_NEAR):
        return (
            f"the report has kc {kc:.6g} where the identifier_node gave {published.kc:.6g}: "
            "the node had other parameters, or is of another version"
        )
    return ""
