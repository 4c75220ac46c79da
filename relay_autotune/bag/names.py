# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Names in the recordings of relay_node."""

from __future__ import annotations

EXPERIMENT = "relay_autotune_msgs/msg/RelayExperiment"
CYCLE = "relay_autotune_msgs/msg/RelayCycle"
FLOAT64 = "std_msgs/msg/Float64"

# The metadata record of the file that names the loop's topics.
EXPERIMENT_METADATA = "relay_autotune"
