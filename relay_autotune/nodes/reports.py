# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Messages of relay_node about a tune: cycles, record, state, diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from relay_autotune.errors import RecordError
from relay_autotune.exchange.messages import fill_cycle, fill_experiment, fill_settings, set_stamp
from relay_autotune.nodes.session import Session
from relay_autotune.nodes.silence import Counter
from relay_autotune_msgs.msg import RelayCycle, RelayExperiment


def cycle_message(session: Session, index: int) -> Any:
    """Build the message of a finished cycle.

    :param session: the tune.
    :param index: number of the cycle.
    """
    experiment = session.experiment
    first, stop = experiment.cycle_start[index], experiment.cycle_start[index + 1] + 1
    begin = 0 if index == 0 else first
    columns = experiment.samples(begin, stop)
    message = RelayCycle()
    fill_cycle(
        message,
        experiment.cycles[index],
        settings=experiment.settings,
        experiment_id=session.id,
        start_ns=session.start_ns,
        time=columns[0],
        measurement=columns[1],
        command=columns[2],
        lead_in=first - begin,
    )
    return message


def experiment_message(session: Session, *, arrays: bool = True) -> Any:
    """Build the message of the whole record.

    :param session: the tune.
    :param arrays: False: a summary, without the samples.
    """
    experiment = session.experiment
    message = RelayExperiment()
    try:
        fill_experiment(message, session.record(), arrays=arrays)
    except RecordError:
        # The tune ended before its first sample: an outcome, but no record.
        fill_settings(message.settings, experiment.settings)
        message.experiment_id = session.id
        message.outcome = int(experiment.outcome)
        message.reason = experiment.reason
        message.noise_std = math.nan
    if session.sample_count:
        set_stamp(message.header.stamp, session.start_ns)
    if session.early is not None:
        message.sought, message.sought_width = session.early.sought, session.early.wanted
    return message


def losses(count: int) -> str:
    """Say how many samples were lost on the way; "" for none."""
    return f"{count} {'sample' if count == 1 else 'samples'} lost on the way" if count else ""


def state_values(
    counter: Counter, session: Session | None, *, idle: str, lost: int
) -> dict[str, object]:
    """Return the facts of relay_node for /diagnostics.

    :param counter: of the measurements.
    :param session: the running tune; None: no tune runs.
    :param idle: state of the node without a tune.
    :param lost: samples that the middleware has lost during this tune.
    """
    values: dict[str, object] = {
        "state": idle,
        "experiment": "" if session is None else session.id,
        "rate [Hz]": float(counter.since_last_asked()),
        "age of the last sample [s]": counter.age,
    }
    if session is None:
        return values
    experiment = session.experiment
    return values | {
        "state": experiment.state.name.lower(),
        "cycles": experiment.cycle_count,
        "noise standard deviation": experiment.noise_std,
        "samples": session.sample_count,
        "lost samples": lost,
        "clock drift [s]": session.clocks.drift,
    }


def diagnostics(
    name: str, stamp_ns: int, problems: list[str], summary: str, values: Mapping[str, object]
) -> DiagnosticArray:
    """Build the array with one status.

    :param name: the node's fully qualified name without the leading slash.
    :param stamp_ns: the present time [ns since the epoch].
    :param problems: problems that an operator must act on; empty: the status is OK.
    :param summary: message if there is no problem.
    :param values: facts by name.
    """
    status = DiagnosticStatus(
        level=DiagnosticStatus.WARN if problems else DiagnosticStatus.OK,
        name=f"{name}: experiment",
        hardware_id="none",
        message="; ".join(problems) or summary,
        values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
    )
    message = DiagnosticArray(status=[status])
    set_stamp(message.header.stamp, stamp_ns)
    return message


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
