# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Experiments as relay_node publishes them, of an exactly simulated process."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from relay_runs import simulate_relay

from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome, Record, RelaySettings


def record_of(
    process: TransferFunction,
    experiment_id: str,
    *,
    outcome: Outcome = Outcome.COMPLETED,
    bias: float = 0.0,
    extra_delay: float = 0.0,
    cycles: int = 6,
) -> Record:
    """Return the record of a relay experiment without noise."""
    relay = RelaySettings(
        5.0, 1.0, 0.5, bias, 0.05, extra_delay, reverse_acting=process.process_sign < 0
    )
    run = simulate_relay(process, relay, cycles=cycles, time=300 * cycles)
    return replace(run.record(), experiment_id=experiment_id, outcome=outcome)


def experiment_of(process: TransferFunction, experiment_id: str, **options: Any) -> Any:
    """Return the message of such an experiment."""
    # here, since tests of the core use the record above without ROS
    from relay_autotune.exchange.messages import fill_experiment
    from relay_autotune_msgs.msg import RelayExperiment

    message = RelayExperiment()
    fill_experiment(message, record_of(process, experiment_id, **options))
    return message
