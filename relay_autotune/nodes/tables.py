# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of relay_node and of controller_node, and what the latter give."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from relay_autotune.bag.definitions import FLOAT64
from relay_autotune.control.controller import LARGEST_GAIN, LARGEST_VALUE, LONGEST_TIME, GainBounds
from relay_autotune.errors import ParameterError
from relay_autotune.experiment.early_end import SOUGHT, ULTIMATE_GAIN
from relay_autotune.experiment.parameters import PARAMETERS as EXPERIMENT_PARAMETERS
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate
from relay_autotune.loop.laws import LAWS, OWN_LAW
from relay_autotune.loop.sampled import Limits
from relay_autotune.quantities import Quantity

NODE_PARAMETERS = (
    Quantity("baseline", math.nan, "u").means(
        "Command of the operating point; NaN: the mean of controller_command where that comes, "
        "else the command held now, else initial_command."
    ),
    Quantity("baseline_is_present", False).means(
        "True: the process rests at the baseline already; a tune fails as soon as the measurement "
        "leaves, while settling, the rest that it showed before."
    ),
    Quantity("safe_command", math.nan, "u").means(
        "Command after a tune that was aborted or failed; NaN: the baseline. If it is given, also "
        "when the node ends while it passes commands on."
    ),
    Quantity(
        "process_type", "self_regulating", choices=("self_regulating", "integrating", "unstable")
    ).means(
        "Behaviour at a constant command: the process settles, drifts, or runs away. After a tune "
        "the last two go back to controller_command, or to proportional control."
    ),
    Quantity("hold_gain", 0.0, "u/y").means(
        "Gain of that proportional control, with the sign of the process; 0: half of K_u, from "
        "the first whole cycle on."
    ),
    Quantity("start_without_hold", False).means(
        "True: a tune of a process that is not self-regulating may start with neither "
        "controller_command nor hold_gain."
    ),
    Quantity("stop_when", "converged", choices=("converged", "confident")).means(
        "converged: a tune ends when min_cycles cycles agree; confident: when the 95 % interval "
        "of confident_of from identifier_node is narrow enough."
    ),
    Quantity("confident_of", ULTIMATE_GAIN, choices=SOUGHT).means(
        "For stop_when confident: ultimate_gain is K_u; ms is the predicted Ms of the gains."
    ),
    Quantity("confidence", 0.0135, "", 1e-4, 1.0).means(
        "Half width of that interval as a fraction of the value, for stop_when confident."
    ),
    Quantity("controller_timeout", 1.0, "s", 1e-3).means(
        "Longest silence of controller_command while it counts as connected, or five intervals of "
        "the measurement where that is longer; after a longer silence the safe command is sent."
    ),
    Quantity("return_time", 0.0, "s", 0.0).means(
        "Time in which the command returns to the controller's after a tune; 0: the last period "
        "of the oscillation, else 5 s."
    ),
    Quantity("feedback_tolerance", 0.0, "u", 0.0).means(
        "How far command_feedback may be from the command, where that topic is published; 0: "
        "half of the amplitude, and no check before the first cycle where the tune finds it."
    ),
    Quantity("feedback_timeout", 1.0, "s", 1e-3).means(
        "Longest time beyond that tolerance; after it the actuator counts as stuck."
    ),
    Quantity("measurement_timeout", 1.0, "s", 0.0).means(
        "Longest silence of the measurement; after it a tune is aborted. 0: five intervals of the "
        "measurement, and at least 1 s."
    ),
    Quantity("model_timeout", 10.0, "s", 0.0).means(
        "Longest wait of the recording for model and gains after a tune, counted from the last "
        "sign of life of identifier_node; 0: a recording alone is wanted."
    ),
    Quantity("record_directory", "~/.ros/relay_autotune").means(
        "Folder in which each experiment gets a folder of its own."
    ),
)
MESSAGE_PARAMETERS = (
    Quantity("command_type", FLOAT64).means("Message type of the command."),
    Quantity("command_field", "data").means(
        "Path of the command in it, such as linear.x or data[1]; data of an array is its only "
        "element, as a forward_command_controller of ros2_control for one joint wants it."
    ),
    Quantity("command_message", "").means(
        "What stands in the other elements of each command, as ros2 topic pub takes it, such as "
        "'{data: [0.0, 1.5]}'; empty: zeros."
    ),
)
MEASUREMENT_PARAMETERS = (
    Quantity("measurement_type", FLOAT64).means(
        "Message type of the measurement; its header's stamp, if it has one, is the time."
    ),
    Quantity("measurement_field", "data").means(
        "Path of the measurement in it, such as velocity[left_wheel]."
    ),
)
FIXED_PARAMETERS = (
    Quantity("initial_command", math.nan, "u").means(
        "Answer to each measurement before the first tune; NaN: silent until then."
    ),
    Quantity("path", "passthrough", choices=("passthrough", "takeover")).means(
        "passthrough: without a tune, controller_command is passed on to command; takeover: the "
        "controller publishes command itself and is silent during a tune."
    ),
    Quantity("relay_on", "command", choices=("command", "setpoint")).means(
        "command: the relay commands the actuator; setpoint: it publishes setpoint, and the "
        "present loop stays closed, its controller connected by controller_command."
    ),
    *MEASUREMENT_PARAMETERS,
    Quantity("repeat_period", 0.0, "s", 0.0).means(
        "For a sensor that publishes only on change: after this time of silence the last value "
        "counts as a new sample, and measurement_timeout does not apply; 0: silence is a fault."
    ),
    Quantity("controller_command_field", "").means(
        "For relay_on setpoint, where the controller commands the actuator itself: path of its "
        "command in the messages of the measurement; command_type and all below are then those of "
        "setpoint. Empty: it comes on controller_command and is passed on."
    ),
    *MESSAGE_PARAMETERS,
    Quantity(
        "command_others", "command_message", choices=("command_message", "other_commands")
    ).means(
        "Where they come from: that parameter, or the newest message on other_commands, so that "
        "other joints hold what they were told last."
    ),
    Quantity("command_period", 0.0, "s", 0.0).means(
        "For an actuator that stops when no command comes, as a base does by cmd_vel: the last "
        "command goes out again when none has for this time; 0: one command for each measurement."
    ),
)
TUNE_PARAMETERS: tuple[Quantity, ...] = (*EXPERIMENT_PARAMETERS, *NODE_PARAMETERS)


# Names of the law that the node runs by itself.
OWN_LAWS = ("", OWN_LAW)
GAINS = (
    Quantity("kc", 0.0, "u/y", -LARGEST_GAIN, LARGEST_GAIN).means(
        "Proportional gain, with the sign of the process; 0: no gains yet, the command is held."
    ),
    Quantity("ti", 0.0, "s", 0.0, LONGEST_TIME).means("Integral time; 0: no integral action."),
    Quantity("td", 0.0, "s", 0.0, LONGEST_TIME).means("Derivative time."),
    Quantity("tf", 0.0, "s", 0.0, LONGEST_TIME).means(
        "Time constant of the filter on the measurement."
    ),
    Quantity("b", 1.0, "", 0.0, 1.0).means("Weight of the set-point in the proportional part."),
)
OTHERS = (
    Quantity("command_min", -math.inf, "u").means("Lowest command."),
    Quantity("command_max", math.inf, "u").means("Highest command."),
    Quantity("safe_command", math.nan, "u").means(
        "Command when the node ends; NaN: the last command, or during a verification the command "
        "before its step."
    ),
    Quantity("measurement_min", -math.inf, "y").means(
        "A measurement below this is a fault of the sensor, which the process cannot reach: it is "
        "ignored, and the command is held."
    ),
    Quantity("measurement_max", math.inf, "y").means("Likewise above this."),
    Quantity("kc_max", LARGEST_GAIN, "u/y", 0.0, LARGEST_GAIN).means(
        "Gains with a kc of a larger magnitude are refused."
    ),
    Quantity("ti_min", 0.0, "s", 0.0, LONGEST_TIME).means(
        "Gains with a shorter ti, other than 0, are refused."
    ),
    Quantity("auto_apply", False).means(
        "True: new gains are applied at once; false: only when ~/apply is called."
    ),
    Quantity("accept_doubtful", False).means(
        "True: ~/apply and ~/verify also accept gains and models whose verdict is not trusted; "
        "auto_apply never does."
    ),
    Quantity("verify_step", 0.0, "y", -LARGEST_VALUE, LARGEST_VALUE).means(
        "Height of the set-point step of ~/verify, if the request does not give it."
    ),
    Quantity("verify_step_max", 0.0, "y", 0.0).means(
        "Largest set-point step that a request of ~/verify may ask for; 0: none beyond "
        "verify_step."
    ),
    Quantity("verify_load_max", 0.0, "u", 0.0).means(
        "Largest load step that ~/verify may add to the command; 0: none is allowed."
    ),
)
FIXED = (
    Quantity("initial_setpoint", math.nan, "y").means(
        "Set-point until one comes; NaN: the first measurement."
    ),
    Quantity("initial_command", 0.0, "u").means("Command from which it starts."),
    Quantity("law", "", choices=("", *LAWS)).means(
        "Law of another program that this node runs in place of its own, so that gains for it "
        "can be applied and proven; empty: its own."
    ),
    Quantity("law_period", 0.0, "s", 0.0).means(
        "Time between two runs of that law; 0: not given."
    ),
    Quantity("manual", False).means("True: it starts in manual, holding initial_command."),
    Quantity("sample_period", 0.0, "s", 0.0).means(
        "Period of the samples where they carry no time; 0: stamps."
    ),
    *MEASUREMENT_PARAMETERS,
    Quantity("repeat_period", 0.0, "s", 0.0).means(
        "For a sensor that publishes only on change: after this time of silence the last value "
        "counts as a new sample; 0: no repetition."
    ),
    Quantity("apply_to", "").means(
        "Node that gets the gains through its parameters, such as /pid_controller; empty: this "
        "node controls."
    ),
    Quantity("apply_parameters", "p:p,i:i,d:d").means(
        "That node's parameter for each gain, separated by commas, such as "
        "p:gains.heater.p,i:gains.heater.i,d:gains.heater.d; tracking is the time constant of a "
        "back-calculation."
    ),
    Quantity("apply_feedforward", 0.0, "u/y").means(
        "With apply_to: gain from the set-point to the command that the node adds to that of its "
        "gains; a step of the set-point is predicted with it."
    ),
    Quantity("controller_command_field", "").means(
        "With apply_to, where that node commands the actuator itself: path of its command in the "
        "messages of the measurement; command_type and all below are then those of setpoint. "
        "Empty: it comes on command, and setpoint is a Float64."
    ),
    *MESSAGE_PARAMETERS,
    Quantity("record_directory", "~/.ros/relay_autotune").means(
        "Folder of the journal in which proven and failed gains are kept."
    ),
)
CONTROLLER_PARAMETERS = (*GAINS, *OTHERS, *FIXED)


@dataclass(frozen=True)
class Settings:
    """What the parameters of controller_node that may change give.

    :param gains: the controller; None: there are no gains, the command is held.
    :param bounds: bounds for new gains.
    :param limits: range of the command.
    :param within: range of the measurement.
    """

    gains: Controller | None
    bounds: GainBounds
    limits: Limits
    within: Limits


def settings_from(values: Mapping[str, Any], rate: LawRate | None) -> Settings:
    """Return what the parameters give.

    :param values: the parameters by name.
    :param rate: of `rate_from`.
    :raises RelayAutotuneError: if a range is empty, or the gains are not valid or out of bounds.
    """
    limits = Limits(values["command_min"], values["command_max"])
    low, high = values["measurement_min"], values["measurement_max"]
    if not low < high:
        raise ParameterError(
            f"measurement_min {low:g} and measurement_max {high:g} leave no range"
        )
    bounds = GainBounds(values["kc_max"], values["ti_min"], rate)
    gains = None
    if values["kc"] != 0.0:
        gains = Controller(**{entry.name: values[entry.name] for entry in GAINS})
        bounds.require(gains)
    return Settings(gains, bounds, limits, Limits(low, high))


def rate_from(values: Mapping[str, Any]) -> LawRate | None:
    """Return the law that the node runs, None if it is its own.

    :param values: the parameters by name: law, law_period and apply_to.
    :raises ParameterError: if its period is not given, or another node has the gains.
    """
    law, period = values["law"], values["law_period"]
    is_own = law in OWN_LAWS
    if values["apply_to"] and not is_own:
        raise ParameterError(
            f"law is {law}, which this node would run itself, and apply_to is "
            f"{values['apply_to']}, which runs its own: give only one of them"
        )
    if period == 0.0 and not is_own:
        raise ParameterError(
            f"law is {law} and law_period is 0 s: give the time between two runs of its program"
        )
    return rate_of(law, period)


def rate_of(law: str, period: float) -> LawRate | None:
    """Return a law and how often it runs, None for that of controller_node.

    :param law: its name.
    :param period: of its runs [s].
    """
    return None if law in OWN_LAWS else LawRate(LAWS[law], period)


def sensor_parameters(kind: str, field: str) -> dict[str, Any]:
    """Return the parameters with which a node hears a measurement; none where they are usual.

    :param kind: its message type.
    :param field: path of the number in it.
    """
    given = zip(MEASUREMENT_PARAMETERS, (kind, field), strict=True)
    return {each.name: value for each, value in given if value != each.default}


def parameters_of_law(law: str, period: float) -> dict[str, Any]:
    """Return the parameters with which the node runs a law; none for its own.

    :param law: its name.
    :param period: of its runs [s].
    """
    return {} if law in OWN_LAWS else {"law": law, "law_period": period}
