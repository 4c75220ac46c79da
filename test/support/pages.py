# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The pages of the user guide, and the commands and examples in them."""

from __future__ import annotations

import math
import re
import shlex
import textwrap
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GUIDE = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
PAGES = (*GUIDE, ROOT / "CONTRIBUTING.md", ROOT / "bags/README.md")

_FENCE = re.compile(
    r"(?:^<!-- (?P<note>[^\n]*?) -->\n\n)?"
    # Within a list a block is indented.
    r"^(?P<indent> *)```(?P<language>\w+)\n(?P<text>.*?)^(?P=indent)```$",
    re.DOTALL | re.MULTILINE,
)
# What is said of work that takes ten seconds, or will: where the machine is slow.
PROGRESS = re.compile(r"^(computing the model|reading .*), \d.*\n", re.MULTILINE)

_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_TOKEN = re.compile(rf"\.\.\.|{_NUMBER.pattern}|[^\W\d]+|.", re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block with the hidden comment right above it.

    :param page: path of its page from the repository's root.
    :param language: the word after the fence.
    :param note: the comment; empty: no comment.
    :param text: the content of the block.
    """

    page: str
    language: str
    note: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}: {self.text.splitlines()[0]}"


def blocks(*languages: str, pages: tuple[Path, ...] = PAGES) -> list[Block]:
    """Return the fenced blocks in some languages."""
    return [
        Block(
            str(page.relative_to(ROOT)),
            found["language"],
            found["note"] or "",
            textwrap.dedent(found["text"]),
        )
        for page in pages
        for found in _FENCE.finditer(page.read_text())
        if found["language"] in languages
    ]


def block_noted(page: str, note: str) -> Block:
    """Return the one block of a page that has a note."""
    kinds = ("python", "sh", "text", "yaml")
    (found,) = (b for b in blocks(*kinds) if (b.page, b.note) == (page, note))
    return found


def commands(text: str) -> list[list[str]]:
    """Return the words of each line of a shell block."""
    lines = text.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def sessions(text: str) -> list[tuple[list[str], str]]:
    """Return the words of each command of a console block, and the output shown for it."""
    parts = re.split(r"^\$ (.*)\n", text, flags=re.MULTILINE)
    assert parts[0] == "", f"a console block begins with a command, found {parts[0]!r}"
    return [(shlex.split(c), shown) for c, shown in zip(parts[1::2], parts[2::2], strict=True)]


def every_command(*pages: Path) -> list[list[str]]:
    """Return the words of each command on some pages: in blocks and in the text."""
    found = [w for b in blocks("sh", pages=pages) for w in commands(b.text)]
    found += [w for b in blocks("console", pages=pages) for w, _ in sessions(b.text)]
    for page in pages:
        # What has a single apostrophe is a sentence of a program, not a command.
        lines = [s for s in spans(page) if re.match(r"[.\w]+ [^ ]", s) and s.count("'") % 2 == 0]
        found += map(shlex.split, lines)
    return parts_of(found)


def parts_of(lines: list[list[str]]) -> list[list[str]]:
    """Split lines like the shell, without variables that are set for one command."""
    parts: list[list[str]] = []
    for words in lines:
        parts.append([])
        for word in words:
            if word in ("&&", "|", "&", ">"):
                parts.append([])
            elif parts[-1] or not re.match(r"[A-Z_]+=", word):
                parts[-1].append(word)
    return [words for words in parts if words]


def matches(shown: str, output: str, within: float = 0.0) -> bool:
    """Return whether an output is the shown one.

    :param shown: the text of a page, in which `...` stands for anything.
    :param output: what was printed.
    :param within: how far a number may be from the shown one, as a share of it; above 0 the width
        of a number may break the lines elsewhere, too.
    """
    if within:
        shown, output = (" ".join(text.split()) for text in (shown, output))
    printed = _TOKEN.findall(output.rstrip())

    def is_alike(token: str, other: str) -> bool:
        if within and _NUMBER.fullmatch(token) and _NUMBER.fullmatch(other):
            return math.isclose(float(token), float(other), rel_tol=within)
        return token == other

    # How much of the output may have passed, after each token.
    passed = {0}
    for token in _TOKEN.findall(shown.rstrip()):
        if token == "..." and passed:
            passed = set(range(min(passed), len(printed) + 1))
        else:
            passed = {k + 1 for k in passed if k < len(printed) and is_alike(token, printed[k])}
    return len(printed) in passed


def spans(page: Path) -> list[str]:
    """Return the texts in backticks of a page, outside of its blocks."""
    return re.findall(r"`([^`\n]+)`", _FENCE.sub("", page.read_text()))


def rows(page: str, first_column: str) -> list[list[str]]:
    """Return the rows of the tables of a page whose header begins with a cell."""
    found: list[list[str]] = []
    inside = False
    for line in (ROOT / page).read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not line.startswith("|"):
            inside = False
        elif cells[0] == first_column:
            inside = True
        elif inside and not set(line) <= set("|-"):
            found.append(cells)
    return found
