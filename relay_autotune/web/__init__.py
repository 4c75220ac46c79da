# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A page in the browser to watch a tune and to shape its gains: an optional part.

Nothing outside of this package imports it, except a command that was given `--web`. It needs the
Python package tornado.
"""
