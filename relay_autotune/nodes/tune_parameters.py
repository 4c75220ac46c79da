# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of relay_node."""

from __future__ import annotations

import math

from relay_autotune.experiment.early_end import SOUGHT, ULTIMATE_GAIN
from relay_autotune.experiment.parameters import PARAMETERS as EXPERIMENT_PARAMETERS
from relay_autotune.nodes.live_types import FLOAT64
from relay_autotune.quantities import Quantity

__all__ = [
    "EXPERIMENT_PARAMETERS",
    "FIXED_PARAMETERS",
    "MESSAGE_PARAMETERS",
    "NODE_PARAMETERS",
    "TUNE_PARAMETERS",
]

NODE_PARAMETERS = (
    Quantity(
        "baseline",
        math.nan,
        "u",
        "Command of the operating point; NaN: the mean of controller_command where that comes, "
        "else the command held now, else initial_command.",
    ),
    Quantity(
        "baseline_is_present",
        False,
        "",
        "True: the process rests at the baseline already; a tune fails as soon as the measurement "
        "leaves, while settling, the rest that it showed before.",
    ),
    Quantity(
        "safe_command",
        math.nan,
        "u",
        "Command after a tune that was aborted or failed; NaN: the baseline. If it is given, also "
        "when the node ends while it passes commands on.",
    ),
    Quantity(
        "process_type",
        "self_regulating",
        "",
        "Behaviour at a constant command: the process settles, drifts, or runs away. After a tune "
        "the last two go back to controller_command, or to proportional control.",
        choices=("self_regulating", "integrating", "unstable"),
    ),
    Quantity(
        "hold_gain",
        0.0,
        "u/y",
        "Gain of that proportional control, with the sign of the process; 0: half of K_u, from "
        "the first whole cycle on.",
    ),
    Quantity(
        "start_without_hold",
        False,
        "",
        "True: a tune of a process that is not self-regulating may start with neither "
        "controller_command nor hold_gain.",
    ),
    Quantity(
        "stop_when",
        "converged",
        "",
        "converged: a tune ends when min_cycles cycles agree; confident: when the 95 % interval "
        "of confident_of from identifier_node is narrow enough.",
        choices=("converged", "confident"),
    ),
    Quantity(
        "confident_of",
        ULTIMATE_GAIN,
        "",
        "For stop_when confident: ultimate_gain is K_u; ms is the predicted Ms of the gains.",
        choices=SOUGHT,
    ),
    Quantity(
        "confidence",
        0.0135,
        "",
        "Half width of that interval as a fraction of the value, for stop_when confident.",
        1e-4,
        1.0,
    ),
    Quantity(
        "controller_timeout",
        1.0,
        "s",
        "Longest silence of controller_command while it counts as connected; after a longer "
        "silence the safe command is sent.",
        1e-3,
    ),
    Quantity(
        "return_time",
        0.0,
        "s",
        "Time in which the command returns to the controller's after a tune; 0: the last period "
        "of the oscillation, else 5 s.",
        0.0,
    ),
    Quantity(
        "feedback_tolerance",
        0.0,
        "u",
        "How far command_feedback may be from the command, where that topic is published; 0: "
        "half of the amplitude, and no check before the first cycle where the tune finds it.",
        0.0,
    ),
    Quantity(
        "feedback_timeout",
        1.0,
        "s",
        "Longest time beyond that tolerance; after it the actuator counts as stuck.",
        1e-3,
    ),
    Quantity(
        "measurement_timeout",
        1.0,
        "s",
        "Longest silence of the measurement; after it a tune is aborted.",
        1e-3,
    ),
    Quantity(
        "model_timeout",
        10.0,
        "s",
        "Longest wait of the recording for model and gains after a tune, counted from the last "
        "sign of life of identifier_node.",
        0.0,
    ),
    Quantity(
        "record_directory",
        "~/.ros/relay_autotune",
        "",
        "Folder in which each experiment gets a folder of its own.",
    ),
)
MESSAGE_PARAMETERS = (
    Quantity("command_type", FLOAT64, "", "Message type of the command."),
    Quantity(
        "command_field",
        "data",
        "",
        "Path of the command in it, such as linear.x or data[1]; data of an array is its only "
        "element, as a forward_command_controller of ros2_control for one joint wants it.",
    ),
    Quantity(
        "command_message",
        "",
        "",
        "What stands in the other elements of each command, as ros2 topic pub takes it, such as "
        "'{data: [0.0, 1.5]}'; empty: zeros.",
    ),
)
FIXED_PARAMETERS = (
    Quantity(
        "initial_command",
        math.nan,
        "u",
        "Answer to each measurement before the first tune; NaN: silent until then.",
    ),
    Quantity(
        "path",
        "passthrough",
        "",
        "passthrough: without a tune, controller_command is passed on to command; takeover: the "
        "controller publishes command itself and is silent during a tune.",
        choices=("passthrough", "takeover"),
    ),
    Quantity(
        "relay_on",
        "command",
        "",
        "command: the relay commands the actuator; setpoint: it publishes setpoint, and the "
        "present loop stays closed, its controller connected by controller_command.",
        choices=("command", "setpoint"),
    ),
    Quantity(
        "measurement_type",
        FLOAT64,
        "",
        "Message type of the measurement; its header's stamp, if it has one, is the time.",
    ),
    Quantity(
        "measurement_field",
        "data",
        "",
        "Path of the measurement in it, such as velocity[left_wheel].",
    ),
    Quantity(
        "repeat_period",
        0.0,
        "s",
        "For a sensor that publishes only on change: after this time of silence the last value "
        "counts as a new sample, and measurement_timeout does not apply; 0: silence is a fault.",
        0.0,
    ),
    Quantity(
        "controller_command_field",
        "",
        "",
        "For relay_on setpoint, where the controller commands the actuator itself: path of its "
        "command in the messages of the measurement; command_type and all below are then those of "
        "setpoint. Empty: it comes on controller_command and is passed on.",
    ),
    *MESSAGE_PARAMETERS,
    Quantity(
        "command_others",
        "command_message",
        "",
        "Where they come from: that parameter, or the newest message on other_commands, so that "
        "other joints hold what they were told last.",
        choices=("command_message", "other_commands"),
    ),
    Quantity(
        "command_period",
        0.0,
        "s",
        "For an actuator that stops when no command comes, as a base does by cmd_vel: the last "
        "command goes out again when none has for this time; 0: one command for each measurement.",
        0.0,
    ),
)
TUNE_PARAMETERS: tuple[Quantity, ...] = (*EXPERIMENT_PARAMETERS, *NODE_PARAMETERS)
