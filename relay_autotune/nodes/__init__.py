# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The ROS nodes: they turn messages and parameters into calls of the core, and results back."""

# First of all imports, so that a live fit and a replay of it give the same last digits.
import relay_autotune.threads  # noqa: F401
