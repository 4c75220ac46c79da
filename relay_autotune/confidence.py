# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The width of a 95 % interval."""

from __future__ import annotations

NORMAL_95 = 1.96
"""Half of the width of the 95 % interval of a normal estimate, in standard deviations."""
