# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Numbers as text, and text of others, escaped.

A name in a file, or a reason from the network, may hold sequences that move a terminal's cursor,
change its title or colours, reverse the direction of writing, or begin a new line that looks like
one of ours. Such text is escaped where it enters, so that it differs from our own lines and can
be typed as shown. File names must stay unchanged for opening, so they are escaped only where
they are printed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime

from relay_autotune.errors import visible as visible

# Half a unit of the fourth digit of 9999, the finest of four digits.
_FINEST = 5e-5

# Below it numbers have no exponent, and a share below this is shown as none.
_PLAIN, _UNSEEN = 1e6, 5e-4

# Interval of the sentences on what is waited for [s]: below a second on a busy machine, too.
PROGRESS_EVERY = 0.8
# The same in a log, which nobody watches line by line [s].
LOGGED_EVERY = 10.0


def digits(value: float, count: int = 4) -> str:
    """Return a number with ``count`` significant digits; a dash if it is not finite.

    :param value: the number.
    :param count: significant digits.
    """
    if not math.isfinite(value):
        return "-"
    text = f"{value:#.{count}g}".rstrip(".") if value else "0"
    # 203 with two digits is 200, which is easier to read than 2.0e+02.
    return f"{float(text):.0f}" if "e+" in text and abs(value) < _PLAIN else text


def percent(share: float) -> str:
    """Return a share in percent, with two digits; 0 where it is less than it takes to see it.

    :param share: the share.
    """
    return digits(100.0 * share, 2) if not abs(share) < _UNSEEN else "0"


def counted(count: int, thing: str) -> str:
    """Return a number of things, such as "1 sample" and "2 samples".

    :param count: how many.
    :param thing: one of them.
    """
    return f"{count} {thing}{'' if count == 1 else 's'}"


def span_text(seconds: float, samples: int, lost: int) -> str:
    """Return how long was recorded, such as "30.00 s, 300 samples, 2 lost".

    :param seconds: the duration [s].
    :param samples: how many; 0: not known.
    :param lost: how many more were sent.
    """
    text = f"{digits(seconds)} s"
    if samples:
        text += f", {counted(samples, 'sample')}" + f", {lost} lost" * bool(lost)
    return text


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


def apart(words: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return what stands outside of ``--ros-args`` ... ``--`` on a command line, and what within.

    :param words: of the command line.
    """
    own, ros = list[str](), list[str]()
    within = False
    for word in words:
        if within and word == "--":
            within = False
            continue
        within = within or word == "--ros-args"
        (ros if within else own).append(word)
    return own, ros


# Of a node or a topic; a full name has a slash first.
NAME_OF_ROS = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*\Z", re.ASCII)

# A spreadsheet takes a cell that begins with one of these for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def cell(text: str) -> str:
    """Return a text as a table cell that no spreadsheet takes for a formula.

    :param text: the text; if it begins like a formula, an apostrophe is put before it.
    """
    text = visible(text)
    return f"'{text}" if text.startswith(_FORMULA) else text


# Where y and u stand for units: in a quotient, behind a number, or in brackets.
_QUOTIENT = re.compile(r"(?<![\w/])(u/\(y s\)|y/\(u s\)|u s/y|y s/u|u/y|y/u|y/s)(?![\w/])")
_SINGLE = re.compile(r"(?<=\d )([yu])(?![\w/(])|(?<=\[)([yu])(?=[\],])")


def in_units(text: str, units: Mapping[str, str]) -> str:
    """Return a text with the units of a loop in place of y and u.

    >>> in_units("kc 0.6 u/y, a step by +2 y", {"y": "°C", "u": "%"})
    'kc 0.6 %/°C, a step by +2 °C'

    :param text: for people.
    :param units: of the measurement, by "y", and of the command, by "u", as far as known.
    """
    if not units:
        return text
    below = {name: f"({unit})" if "/" in unit else unit for name, unit in units.items()}

    def spelled(part: str, names: Mapping[str, str]) -> str:
        return re.sub(r"[yu]", lambda letter: names.get(letter[0], letter[0]), part)

    def quotient(found: re.Match[str]) -> str:
        above, _, under = found[0].partition("/")
        return f"{spelled(above, units)}/{spelled(under, below)}"

    text = _QUOTIENT.sub(quotient, text)
    return _SINGLE.sub(lambda found: units.get(found[0], found[0]), text)


# A unit has no blank, and a letter or one of these signs.
_UNIT_ALONE = re.compile(r"(?=.*[^\W\d_]|[%°])[\w%°/^*·.-]{1,12}\Z")


def is_unit(text: str) -> bool:
    """Return whether a text may stand for y or u.

    >>> is_unit("m³/h"), is_unit("%"), is_unit("left hand side"), is_unit("1")
    (True, True, False, False)
    """
    return _UNIT_ALONE.match(text) is not None


_UNIT_BEHIND = re.compile(r"(?<=[\d\s])([%°][a-zA-Z]*|[^\W\d_][\w/^*]*)\s*[)\]]?$")


def unit_of(text: str) -> str:
    """Return the unit that stands behind the last number of an answer; empty: none does.

    >>> unit_of("20 to 35 °C"), unit_of("0-100%"), unit_of("1.5")
    ('°C', '%', '')

    :param text: as people type it.
    """
    found = _UNIT_BEHIND.search(text.strip())
    return found[1] if found else ""
