"""What identifier_node is told of the process beforehand: its parameters, and the facts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from relay_autotune.identification import Known
from relay_autotune.identification.known import LOSSES
from relay_autotune.nodes.parameters import NodeParameter
from relay_autotune.process.transfer_function import STRUCTURES

_MOST_LAGS = 20

KNOWN_PARAMETERS = (
    NodeParameter(
        "known_gain",
        math.nan,
        "y/u",
        "Static gain of the process, of an integrating one its gain in y/(u s); "
        "NaN: to be found, which atv, and chang with unequal lags, cannot.",
    ),
    NodeParameter(
        "known_dead_time", math.nan, "s", "Dead time of the process; NaN: to be found.", 0.0
    ),
    NodeParameter(
        "structure",
        "",
        "",
        "Structure of the model; empty: chosen by the method.",
        choices=("", *STRUCTURES[:-1]),
    ),
    NodeParameter(
        "order", 0, "", "Number of equal lags, for lag_n; 0: to be found.", 0, _MOST_LAGS
    ),
    NodeParameter(
        "loss",
        LOSSES[0],
        "",
        "How the waveform fit counts residuals; huber and tukey bear many outliers.",
        choices=LOSSES,
    ),
)


def known_from(values: Mapping[str, Any]) -> Known:
    """Return what is known of the process.

    :param values: of ``KNOWN_PARAMETERS``, by name.
    :raises ParameterError: if the gain is zero.
    """
    return Known(
        gain=float(values["known_gain"]),
        dead_time=float(values["known_dead_time"]),
        structure=str(values["structure"]),
        order=int(values["order"]),
        loss=str(values["loss"]),
    )
