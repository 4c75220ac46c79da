# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The waveform fit: structures, responses with derivatives, least squares, covariance, choice."""
