"""Text of others, with everything in it that would not be seen made visible.

A name in a file, or a reason from the network, may hold sequences that move a terminal's cursor,
change its title or its colours, turn the direction of writing, or begin a new line that looks
like one of ours. Such text is made visible where it enters: there it is told from our own lines,
and what is shown is what can be typed. Names of files, which must stay as they are to be opened,
are made visible where they are shown.
"""

from __future__ import annotations

# A cell of a table that begins with one of these is a formula to a spreadsheet.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def visible(text: str, keep: str = "") -> str:
    """Return a text with whatever cannot be printed as an escape sequence of Python.

    These are control characters, line breaks, marks of the direction of writing, characters
    without width, and bytes that were no text. What is visible already stays as it is.

    :param text: the text.
    :param keep: characters that stay all the same.
    """
    if text.isprintable():
        return text
    return "".join(
        char if char.isprintable() or char in keep else char.encode("unicode_escape").decode()
        for char in text
    )


def cell(text: str) -> str:
    """Return a text as a cell of a table that no spreadsheet takes for a formula.

    :param text: the text; one that begins as a formula does gets an apostrophe before it.
    """
    text = visible(text)
    return f"'{text}" if text.startswith(_FORMULA) else text
