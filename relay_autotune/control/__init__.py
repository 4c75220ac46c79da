# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Controllers that run on a loop, and the proof of their gains."""
