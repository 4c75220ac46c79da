# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Relay-feedback autotuning: experiments, identification and controller design.

The names in ``__all__`` are the interface for programs and notebooks. Each is loaded at its first
use, so that nodes and commands load only the parts that they need::

    from relay_autotune import analyse, draw, read_records

    found = analyse(read_records("log.csv")[0])
    print(found.model.model, found.best_gains.kc, found.best_gains.ti)
    draw(found, "tune.png", title="Tank 7")

``METHODS``, ``STRUCTURES`` and ``RULES`` hold what can be chosen, by name:

    >>> import relay_autotune
    >>> "waveform" in relay_autotune.METHODS, "fopdt" in relay_autotune.STRUCTURES
    (True, True)
    >>> sorted(relay_autotune.RULES)[:3]
    ['amigo', 'imc', 'imc_chang']
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from relay_autotune.analysis import analyse, analyse_jointly
    from relay_autotune.control.controller import simulate_closed_loop
    from relay_autotune.errors import RelayAutotuneError
    from relay_autotune.exchange.models import to_control
    from relay_autotune.experiment.experiment import RelayExperiment
    from relay_autotune.experiment.parameters import ExperimentParameters
    from relay_autotune.identification.known import Known
    from relay_autotune.identification.methods import METHODS, identify
    from relay_autotune.identification.result import Identification
    from relay_autotune.loop.gains import Controller, Gains
    from relay_autotune.process.structures import STRUCTURES
    from relay_autotune.process.transfer_function import TransferFunction
    from relay_autotune.process.ultimate import ultimate_point
    from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
    from relay_autotune.record.record import Outcome, PiecewiseConstant, Record, RelaySettings
    from relay_autotune.recordings import read_records
    from relay_autotune.report import draw, write_report
    from relay_autotune.result import Analysis
    from relay_autotune.tuning import RULES, tune
    from relay_autotune.tuning.task import DesignOptions

_HOMES = {
    "analysis": ("analyse", "analyse_jointly"),
    "result": ("Analysis",),
    "control.controller": ("simulate_closed_loop",),
    "recordings": ("read_records",),
    "errors": ("RelayAutotuneError",),
    "identification.known": ("Known",),
    "identification.methods": ("METHODS", "identify"),
    "identification.result": ("Identification",),
    "process.structures": ("STRUCTURES",),
    "process.transfer_function": ("TransferFunction",),
    "exchange.models": ("to_control",),
    "record.record": ("Outcome", "PiecewiseConstant", "Record", "RelaySettings"),
    "experiment.experiment": ("RelayExperiment",),
    "experiment.parameters": ("ExperimentParameters",),
    "report": ("draw", "write_report"),
    "tuning": ("RULES", "Controller", "DesignOptions", "Gains", "tune"),
    "process.ultimate": ("ultimate_point",),
    "process.virtual_process": ("Disturbances", "VirtualProcess"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [  # noqa: RUF022  in the order in which one meets them
    "read_records",
    "analyse",
    "analyse_jointly",
    "Analysis",
    "draw",
    "write_report",
    "Record",
    "RelaySettings",
    "Outcome",
    "PiecewiseConstant",
    "identify",
    "Identification",
    "Known",
    "METHODS",
    "TransferFunction",
    "STRUCTURES",
    "ultimate_point",
    "tune",
    "DesignOptions",
    "Gains",
    "Controller",
    "RULES",
    "simulate_closed_loop",
    "RelayExperiment",
    "ExperimentParameters",
    "VirtualProcess",
    "Disturbances",
    "to_control",
    "RelayAutotuneError",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
