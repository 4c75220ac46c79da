# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of identifier_node: method, rule, known process values, design options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from relay_autotune.analysis import Task
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import DEFAULT_METHOD, METHODS
from relay_autotune.quantities import Quantity, declared
from relay_autotune.tuning import DEFAULT_RULE, RULES
from relay_autotune.tuning.task import DesignOptions

# Measured by the experiment, so they are no parameters.
_MEASURED = ("noise_std", "amplitude")
# Renamed, because the plain name would mean something else beside a controller's parameters.
_PREFIXED = {"gain": "known_gain", "dead_time": "known_dead_time"}

KNOWN = tuple(
    replace(each, name=_PREFIXED.get(each.name, each.name), flag=each.name)
    for each in declared(Known)
)
DESIGN = tuple(each for each in declared(DesignOptions) if each.name not in _MEASURED)
PARAMETERS = (
    Quantity("method", DEFAULT_METHOD, choices=tuple(METHODS)).means(
        "Method whose model is published."
    ),
    Quantity("rule", DEFAULT_RULE, choices=tuple(RULES)).means("Rule whose gains are published."),
    *KNOWN,
    *DESIGN,
)


def known_from(values: Mapping[str, Any]) -> Known:
    """Return the known values of the process.

    :param values: of the parameters, by name.
    :raises ParameterError: if a value is out of its range, or the gain is zero.
    """
    return Known(**{each.flag: values[each.name] for each in KNOWN})


def options_from(values: Mapping[str, Any]) -> DesignOptions:
    """Return the design options of the controller.

    :param values: of the parameters, by name.
    :raises TuningError: if a value is out of its range.
    """
    return DesignOptions(**{each.name: values[each.name] for each in DESIGN})


def task_from(values: Mapping[str, Any]) -> Task:
    """Return how a record is to be identified and a controller to be designed.

    :param values: of the parameters, by name.
    :raises RelayAutotuneError: if a value is out of its range, or a name is unknown.
    """
    return Task(values["method"], values["rule"], known_from(values), options_from(values))
