# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Closed loops: gains, the law as it runs, margins, stability, noise, responses."""
