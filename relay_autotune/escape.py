# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Escape invisible characters in foreign text.

A name in a file, or a reason from the network, may hold sequences that move a terminal's cursor,
change its title or colours, reverse the direction of writing, or begin a new line that looks like
one of ours. Such text is escaped where it enters, so that it can be told from our own lines and
can be typed as shown. File names must stay unchanged for opening, so they are escaped only where
they are shown.
"""

from __future__ import annotations

# A spreadsheet takes a cell that begins with one of these for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def visible(text: str, keep: str = "") -> str:
    """Return a text with each unprintable character as an escape sequence of Python.

    These are control characters, line breaks, marks of the direction of writing, characters
    without width, and bytes that were no text. Visible characters stay unchanged.

    :param text: the text.
    :param keep: unprintable characters that stay unchanged.
    """
    if text.isprintable():
        return text
    return "".join(
        char if char.isprintable() or char in keep else char.encode("unicode_escape").decode()
        for char in text
    )


def cell(text: str) -> str:
    """Return a text as a table cell that no spreadsheet takes for a formula.

    :param text: the text; if it begins like a formula, an apostrophe is put before it.
    """
    text = visible(text)
    return f"'{text}" if text.startswith(_FORMULA) else text
