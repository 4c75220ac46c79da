# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Numbers as text, and text of others, escaped.

A name in a file, or a reason from the network, may hold sequences that move a terminal's cursor,
change its title or colours, reverse the direction of writing, or begin a new line that looks like
one of ours. Such text is escaped where it enters, so that it can be told from our own lines and
can be typed as shown. File names must stay unchanged for opening, so they are escaped only where
they are shown.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

from relay_autotune.errors import visible as visible

# Half a unit of the fourth digit of 9999, the finest of four digits.
_FINEST = 5e-5

# Interval at which users are told what is waited for [s]: below a second on a busy machine, too.
TOLD_EVERY = 0.8
# The same in a log, which nobody watches line by line [s].
LOGGED_EVERY = 10.0


def digits(value: float, count: int = 4) -> str:
    """Return a number with ``count`` significant digits; a dash if it is not finite.

    :param value: the number.
    :param count: significant digits.
    """
    if not math.isfinite(value):
        return "-"
    return f"{value:#.{count}g}".rstrip(".") if value else "0"


def duration(seconds: float) -> str:
    """Return a duration as text, such as "12 min 5 s"; a dash if it is not finite.

    :param seconds: the duration [s], not negative.
    """
    if not math.isfinite(seconds):
        return "-"
    if seconds < 90.0:
        return f"{seconds:.{1 if seconds < 10.0 else 0}f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 90:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min"


def plus_minus(value: float, half: float) -> str:
    """Return the half width of an interval, such as ``± 0.12``; empty if it is not known.

    A half width below the shown digits of the value would be rounding, not accuracy.

    :param value: in the middle.
    :param half: half the width.
    """
    if not math.isfinite(half):
        return ""
    if half < _FINEST * abs(value):
        return f"± less than {100.0 * _FINEST:g} %"
    return f"± {digits(half, 2)}"


def date_text(start: float) -> str:
    """Return a date and time in UTC.

    :param start: s since the epoch.
    """
    try:
        return f"{datetime.fromtimestamp(start, tz=UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):
        return f"{start:g} s after 1970"


# A spreadsheet takes a cell that begins with one of these for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def cell(text: str) -> str:
    """Return a text as a table cell that no spreadsheet takes for a formula.

    :param text: the text; if it begins like a formula, an apostrophe is put before it.
    """
    text = visible(text)
    return f"'{text}" if text.startswith(_FORMULA) else text
