"""The parameters of relay_node."""

from __future__ import annotations

import math

from relay_autotune.nodes.parameters import Entry, NodeParameter
from relay_autotune.relay_parameters import PARAMETERS as EXPERIMENT_PARAMETERS

__all__ = ["EXPERIMENT_PARAMETERS", "FIXED_PARAMETERS", "NODE_PARAMETERS", "TUNE_PARAMETERS"]

NODE_PARAMETERS = (
    NodeParameter(
        "baseline",
        math.nan,
        "u",
        "Command of the operating point; NaN: the command held now, else initial_command.",
    ),
    NodeParameter(
        "measurement_timeout",
        1.0,
        "s",
        "A tune is aborted when no measurement comes for so long.",
        1e-3,
    ),
    NodeParameter(
        "model_timeout",
        10.0,
        "s",
        "After a tune, the recording waits so long for model and gains.",
        0.0,
    ),
    NodeParameter(
        "record_directory",
        "~/.ros/relay_autotune",
        "",
        "Folder in which each experiment gets a folder of its own.",
    ),
)
FIXED_PARAMETERS = (
    NodeParameter(
        "initial_command",
        math.nan,
        "u",
        "Answer to each measurement before the first tune; NaN: silent until then.",
    ),
)
TUNE_PARAMETERS: tuple[Entry, ...] = (*EXPERIMENT_PARAMETERS, *NODE_PARAMETERS)
