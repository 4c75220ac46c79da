# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What ends an experiment: faults of the sensor, the process, the actuator, the clock."""
