# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A relay experiment on the set-point: the present loop stays closed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ParameterError
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.nodes.live_types import reader_of
from relay_autotune.nodes.readiness import NotReadyError
from relay_autotune.nodes.session import Session
from relay_autotune.record.record import Record, RelaySettings


def reported_by(values: Mapping[str, Any]) -> Callable[[Any], float] | None:
    """Return what reads the controller's command from the measurement's messages.

    :param values: the fixed parameters of relay_node.
    :return: None: these messages do not have it.
    :raises ParameterError: if they cannot have it, or nothing is done with it.
    """
    field = values["controller_command_field"]
    if not field:
        return None
    if values["relay_on"] != "setpoint" or values["path"] != "passthrough":
        raise ParameterError(
            f"controller_command_field is {field!r}, which is for relay_on setpoint with path "
            f"passthrough: found {values['relay_on']} and {values['path']}"
        )
    return reader_of(values["measurement_type"], field, "controller_command_field").value


def on_setpoint(parameters: ExperimentParameters) -> tuple[ExperimentParameters, float]:
    """Return the parameters of a relay on the set-point, and its baseline.

    The levels are set-points. So the limits of the measurement apply to them, and a higher level
    raises the measurement, because the loop is closed.

    :param parameters: the user's parameters; ``amplitude`` is in units of the measurement.
    :raises NotReadyError: if the set-point is not given.
    """
    if math.isnan(parameters.setpoint):
        raise NotReadyError(
            "relay_on is setpoint, but setpoint is not given: set it to that of the present loop"
        )
    changed = replace(
        parameters,
        command_min=parameters.measurement_min,
        command_max=parameters.measurement_max,
        process_gain_sign=1,
    )
    return changed, parameters.setpoint


class SetpointSession(Session):
    """A session whose record holds the controller's commands, not the set-points.

    The controller answers a sample after the relay has seen it. So the command of a sample is
    known only at the next sample.

    :param actual: returns the last command to the actuator [u].
    """

    def __init__(self, *args: Any, actual: Callable[[], float], **options: Any) -> None:
        super().__init__(*args, **options)
        self._actual = actual
        self._told: list[float] = []
        self._record_later: Callable[[tuple[int, int, float, int, float]], None] | None = None
        self._last_sample: tuple[int, int, float, int, float] | None = None

    def record_with(self, sample: Callable[[tuple[int, int, float, int, float]], None]) -> None:
        """Hand each sample and the controller's answer to ``sample``, one sample later."""
        self._record_later = sample
        super().record_with(self._keep)

    def _keep(self, sample: tuple[int, int, float, int, float]) -> None:
        self._hand_on()
        self._last_sample = sample

    def _hand_on(self) -> None:
        last = self._last_sample
        if last is None or self._record_later is None:
            return
        told = self._actual()
        self._told.append(told)
        self._record_later((*last[:4], told))
        self._last_sample = None

    def record(self) -> Record:
        """Return the record, with the controller's commands.

        While the experiment runs, the answer to the last sample may be missing; the previous
        command stands in for it.

        :raises RecordError: if there was no sample.
        """
        if self.experiment.finished:
            self._hand_on()
        record = super().record()
        told = np.array(self._told[: len(record)])
        if told.size < len(record):
            told = np.append(told, np.full(len(record) - told.size, self._actual()))
        settings = record.settings
        if settings is not None:
            settings = _settings_of(settings, told, record)
        return replace(record, command=told, settings=settings)


def _settings_of(settings: RelaySettings, told: FloatArray, record: Record) -> RelaySettings:
    moved = np.flatnonzero(record.command != record.command[0])
    rest = float(told[: moved[0]].mean()) if moved.size and moved[0] > 0 else float(told[0])
    low, high = float(told.min()), float(told.max())
    return replace(
        settings,
        baseline=rest,
        amplitude=0.5 * (high - low) or math.ulp(rest),
        bias=0.5 * (high + low) - rest,
        reverse_acting=False,
    )
