# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Text of others is shown with everything in it visible."""

from __future__ import annotations

import sys

import pytest

from relay_autotune.text import cell, visible


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/tank/level", "/tank/level"),
        ("Größe 7 °C", "Größe 7 °C"),
        ("\x1b[2J", r"\x1b[2J"),
        ("a\nreplay: done", r"a\nreplay: done"),
        ("\x9b31m", r"\x9b31m"),
        ("\u202egnp.exe", r"\u202egnp.exe"),
        ("\udcff", r"\udcff"),
    ],
)
def test_what_cannot_be_seen_is_made_visible(text, expected):
    assert visible(text) == expected
    assert visible(visible(text)) == expected


@pytest.mark.long
def test_every_character_comes_out_printable():
    # Planes 4 to 13 hold no character.
    planes = *range(0x40000), *range(0xE0000, sys.maxunicode + 1)
    text = visible("".join(map(chr, planes)))
    assert text.isprintable()
    assert text.encode("utf-8")


def test_some_characters_can_be_kept():
    assert visible("a\n\x07", keep="\n") == "a\n\\x07"


@pytest.mark.parametrize("first", ["=", "+", "-", "@"])
def test_no_cell_is_a_formula(first):
    assert cell(f"{first}cmd|' /C calc'!A0") == f"'{first}cmd|' /C calc'!A0"
    assert cell("level") == "level"
