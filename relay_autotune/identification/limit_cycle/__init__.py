# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a recorded limit cycle shows: its average and scatter, shape, harmonics, steady state."""
