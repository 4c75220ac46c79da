# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The status that relay_node publishes on /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from relay_autotune.exchange.messages import set_stamp


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
