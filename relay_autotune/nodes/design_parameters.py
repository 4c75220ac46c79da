"""What identifier_node asks of a controller: its parameters, and the options they make."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from relay_autotune.nodes.parameters import NodeParameter
from relay_autotune.tuning.task import CONTROLLERS, MS_RANGE, DesignOptions

_DEFAULT = DesignOptions()

DESIGN_PARAMETERS = (
    NodeParameter(
        "controller",
        _DEFAULT.controller,
        "",
        "What is designed; auto: PI, unless the rule finds PID worth it.",
        choices=CONTROLLERS,
    ),
    NodeParameter("ms", _DEFAULT.ms, "", "Largest Ms, for robust and unstable.", *MS_RANGE),
    NodeParameter(
        "mt",
        math.nan,
        "",
        "Largest Mt, above 1, for robust; NaN: 1.4, of an integrating process 1.26.",
        1.0001,
    ),
    NodeParameter(
        "sample_period",
        _DEFAULT.sample_period,
        "s",
        "Period of the controller to be, half of which counts as dead time; 0: the recording's.",
        0.0,
    ),
    NodeParameter(
        "loop_delay",
        _DEFAULT.loop_delay,
        "s",
        "Dead time that the loop of the controller to be adds to the process.",
        0.0,
    ),
    NodeParameter(
        "noise_share",
        _DEFAULT.noise_share,
        "",
        "Standard deviation of the noise in the command over the relay's amplitude that "
        "derivative action may cause.",
        1e-6,
    ),
    NodeParameter("filter_ratio", _DEFAULT.filter_ratio, "", "Largest td/tf.", 1.0),
    NodeParameter(
        "closed_loop_time",
        math.nan,
        "s",
        "Lambda of imc, simc and unstable; NaN: the rule's own.",
        1e-9,
    ),
    NodeParameter(
        "phase_peak",
        _DEFAULT.phase_peak,
        "rad",
        "Phase of the loop at its peak, for luyben2003.",
        math.nextafter(-math.pi, 0.0),
        math.nextafter(-0.5 * math.pi, -math.inf),
    ),
    NodeParameter(
        "resonance", _DEFAULT.resonance, "dB", "Closed-loop resonance, for luyben2003.", 1e-3
    ),
)


def options_from(values: Mapping[str, Any]) -> DesignOptions:
    """Return what the parameters ask of a controller.

    :param values: by name; those of other parameters are left alone.
    :raises TuningError: if a value is out of its range.
    """
    given = {entry.name: values[entry.name] for entry in DESIGN_PARAMETERS}
    for name in ("mt", "closed_loop_time"):
        if math.isnan(given[name]):
            given[name] = None
    return DesignOptions(**given)
