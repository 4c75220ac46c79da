# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The times of the lockstep protocol between plant_node and relay_node.

The plant repeats its first measurement until a command comes. The first command starts the run,
and each command leads to one further sample. A repeat may cross the first command on its way and
would then be counted as sample 1. So the plant pauses after the first command, and the relay drops
a measurement equal to sample 0 within the first half of that pause.
"""

# Interval at which the plant repeats a measurement without an answer [s].
REPEAT_AFTER = 0.2

# Pause from the first command to sample 1 [s].
QUIET_AFTER_GO = 0.01

# If no sample follows within this time, the relay answers the measurement that it dropped [s].
NO_REPEAT_AFTER = 0.1
