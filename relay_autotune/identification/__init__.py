# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Identification: from a record to a model, its uncertainty, and a judgement of both."""
