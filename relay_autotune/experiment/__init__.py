# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parts of a relay experiment: settling, the first kick, oscillation, levels, its end."""
