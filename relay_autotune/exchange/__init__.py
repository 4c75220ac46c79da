# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Results in other forms: messages, documents, text, notebooks, python-control."""
