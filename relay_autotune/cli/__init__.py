# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Commands that work without a ROS graph."""

import relay_autotune.threads  # noqa: F401
