"""The times of the lockstep protocol between plant_node and relay_node.

The plant repeats its first measurement until a command comes. That command starts the run, and
each command leads to one further sample. A repeat may cross the first command on its way and
would then be counted as sample 1, so the plant keeps quiet for a moment after the first command,
and the relay drops what comes within half of that moment and says the same as sample 0.
"""

# The plant repeats a measurement that nobody has answered after this silence [s].
REPEAT_AFTER = 0.2

# From the first command to sample 1 [s].
QUIET_AFTER_GO = 0.01

# What the relay dropped as a repeat was none if nothing follows within this time [s].
NO_REPEAT_AFTER = 0.1
