# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Processes: transfer functions and structures, their exact responses and simulation."""
