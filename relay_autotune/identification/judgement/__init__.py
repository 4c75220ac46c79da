# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How far a model is to be trusted: the table of checks and its verdict, and what they ask."""
