# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of controller_node, and what they give."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from relay_autotune.control.controller import (
    LARGEST_GAIN,
    LARGEST_VALUE,
    LONGEST_TIME,
    GainBounds,
)
from relay_autotune.errors import ParameterError
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.laws import LAWS, OWN_LAW, LawRate
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes.live_types import FLOAT64
from relay_autotune.nodes.tune_parameters import MESSAGE_PARAMETERS
from relay_autotune.quantities import Quantity

# Names of the law that the node runs by itself.
OWN_LAWS = ("", OWN_LAW)
# Answer of ~/apply where no gains have come since the last were applied or discarded.
NONE_WAIT = "no gains wait to be applied"
GAINS = (
    Quantity(
        "kc",
        0.0,
        "u/y",
        "Proportional gain, with the sign of the process; 0: no gains yet, the command is held.",
        -LARGEST_GAIN,
        LARGEST_GAIN,
    ),
    Quantity("ti", 0.0, "s", "Integral time; 0: no integral action.", 0.0, LONGEST_TIME),
    Quantity("td", 0.0, "s", "Derivative time.", 0.0, LONGEST_TIME),
    Quantity("tf", 0.0, "s", "Time constant of the filter on the measurement.", 0.0, LONGEST_TIME),
    Quantity("b", 1.0, "", "Weight of the set-point in the proportional part.", 0.0, 1.0),
)
OTHERS = (
    Quantity("command_min", -math.inf, "u", "Lowest command."),
    Quantity("command_max", math.inf, "u", "Highest command."),
    Quantity(
        "safe_command",
        math.nan,
        "u",
        "Command when the node ends; NaN: the last command, or during a verification the command "
        "before its step.",
    ),
    Quantity(
        "measurement_min",
        -math.inf,
        "y",
        "A measurement below this is a fault of the sensor: it is ignored, and the command is "
        "held.",
    ),
    Quantity("measurement_max", math.inf, "y", "Likewise above this."),
    Quantity(
        "kc_max",
        LARGEST_GAIN,
        "u/y",
        "Gains with a kc of a larger magnitude are refused.",
        0.0,
        LARGEST_GAIN,
    ),
    Quantity(
        "ti_min",
        0.0,
        "s",
        "Gains with a shorter ti, other than 0, are refused.",
        0.0,
        LONGEST_TIME,
    ),
    Quantity(
        "auto_apply",
        False,
        "",
        "True: new gains are applied at once; false: only when ~/apply is called.",
    ),
    Quantity(
        "accept_doubtful",
        False,
        "",
        "True: ~/apply and ~/verify also accept gains and models whose verdict is not trusted; "
        "auto_apply never does.",
    ),
    Quantity(
        "verify_step",
        0.0,
        "y",
        "Height of the set-point step of ~/verify, if the request does not give it.",
        -LARGEST_VALUE,
        LARGEST_VALUE,
    ),
    Quantity(
        "verify_step_max",
        0.0,
        "y",
        "Largest set-point step that a request of ~/verify may ask for; 0: none beyond "
        "verify_step.",
        0.0,
    ),
    Quantity(
        "verify_load_max",
        0.0,
        "u",
        "Largest load step that ~/verify may add to the command; 0: none is allowed.",
        0.0,
    ),
)
FIXED = (
    Quantity(
        "initial_setpoint",
        math.nan,
        "y",
        "Set-point until one comes; NaN: the first measurement.",
    ),
    Quantity("initial_command", 0.0, "u", "Command from which it starts."),
    Quantity(
        "law",
        "",
        "",
        "Law of another program that this node runs in place of its own, so that gains for it "
        "can be applied and proven; empty: its own.",
        choices=("", *LAWS),
    ),
    Quantity(
        "law_period",
        0.0,
        "s",
        "Time between two runs of that law; 0: not given.",
        0.0,
    ),
    Quantity("manual", False, "", "True: it starts in manual, holding initial_command."),
    Quantity(
        "sample_period",
        0.0,
        "s",
        "Period of the samples where they carry no time; 0: stamps.",
        0.0,
    ),
    Quantity(
        "measurement_type", FLOAT64, "", "Message type of the measurement, as in relay_node."
    ),
    Quantity("measurement_field", "data", "", "Path of the measurement in it."),
    Quantity(
        "repeat_period",
        0.0,
        "s",
        "For a sensor that publishes only on change: after this time of silence the last value "
        "counts as a new sample; 0: no repetition.",
        0.0,
    ),
    Quantity(
        "apply_to",
        "",
        "",
        "Node that gets the gains through its parameters, such as /pid_controller; empty: this "
        "node controls.",
    ),
    Quantity(
        "apply_parameters",
        "p:p,i:i,d:d",
        "",
        "That node's parameter for each gain, separated by commas, such as "
        "p:gains.heater.p,i:gains.heater.i,d:gains.heater.d.",
    ),
    Quantity(
        "apply_feedforward",
        0.0,
        "u/y",
        "With apply_to: gain from the set-point to the command that the node adds to that of its "
        "gains; a step of the set-point is predicted with it.",
    ),
    Quantity(
        "controller_command_field",
        "",
        "",
        "With apply_to, where that node commands the actuator itself: path of its command in the "
        "messages of the measurement; command_type and all below are then those of setpoint. "
        "Empty: it comes on command, and setpoint is a Float64.",
    ),
    *MESSAGE_PARAMETERS,
    Quantity(
        "record_directory",
        "~/.ros/relay_autotune",
        "",
        "Folder of the journal in which proven and failed gains are kept.",
    ),
)
PARAMETERS = (*GAINS, *OTHERS, *FIXED)


def gains_from(values: Mapping[str, Any]) -> Controller | None:
    """Return the gains that the parameters give, None if there are none.

    :param values: the parameters by name.
    :raises RelayAutotuneError: if they are not valid.
    """
    if values["kc"] == 0.0:
        return None
    return Controller(**{entry.name: values[entry.name] for entry in GAINS})


def limits_from(values: Mapping[str, Any]) -> Limits:
    """Return the range of the command.

    :param values: the parameters by name.
    :raises RelayAutotuneError: if the range is empty.
    """
    return Limits(values["command_min"], values["command_max"])


def range_from(values: Mapping[str, Any]) -> Limits:
    """Return the range of the measurement.

    :param values: the parameters by name.
    :raises ParameterError: if the range is empty.
    """
    low, high = values["measurement_min"], values["measurement_max"]
    if not low < high:
        raise ParameterError(
            f"measurement_min {low:g} and measurement_max {high:g} leave no range"
        )
    return Limits(low, high)


def bounds_from(values: Mapping[str, Any], rate: LawRate | None) -> GainBounds:
    """Return the bounds for new gains.

    :param values: the parameters by name.
    :param rate: of `rate_from`.
    """
    return GainBounds(values["kc_max"], values["ti_min"], rate)


def rate_from(values: Mapping[str, Any]) -> LawRate | None:
    """Return the law that the node runs, None if it is its own.

    :param values: the parameters by name, at least those of `parameters_of_law`.
    :raises ParameterError: if its period is not given, or another node has the gains.
    """
    law = values.get("law", "")
    if law in OWN_LAWS:
        return None
    period = values["law_period"]
    if values.get("apply_to"):
        raise ParameterError(
            f"law is {law}, which this node would run itself, and apply_to is "
            f"{values['apply_to']}, which runs its own: give only one of them"
        )
    if period == 0.0:
        raise ParameterError(
            f"law is {law} and law_period is 0 s: give the time between two runs of its program"
        )
    return LawRate(LAWS[law], period)


def parameters_of_law(law: str, period: float) -> dict[str, Any]:
    """Return the parameters with which the node runs a law; none for its own.

    :param law: its name.
    :param period: of its runs [s].
    """
    return {} if law in OWN_LAWS else {"law": law, "law_period": period}
