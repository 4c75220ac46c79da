"""Write into the pages of docs/ what the code says itself; a test compares the two.

    . ./env.sh && python3 tools/fill_docs.py

A page asks for it with a pair of comments, and what is between them is replaced:

    <!-- parameters of relay_node -->    <!-- end -->    a table of the node's parameters
    <!-- text of FILE -->                <!-- end -->    a file, in a fenced block
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from relay_autotune.nodes.controller_parameters import PARAMETERS as CONTROLLER_PARAMETERS
from relay_autotune.nodes.identifier import PARAMETERS as IDENTIFIER_PARAMETERS
from relay_autotune.nodes.parameters import Entry
from relay_autotune.nodes.plant import PARAMETERS as PLANT_PARAMETERS
from relay_autotune.nodes.tune_parameters import FIXED_PARAMETERS, TUNE_PARAMETERS

ROOT = Path(__file__).resolve().parent.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))

TABLES: Mapping[str, Sequence[Entry]] = {
    "relay_node": (*TUNE_PARAMETERS, *FIXED_PARAMETERS),
    "identifier_node": IDENTIFIER_PARAMETERS,
    "plant_node": PLANT_PARAMETERS,
    "controller_node": CONTROLLER_PARAMETERS,
}

_BLOCK = re.compile(
    r"<!-- (?P<kind>parameters|text) of (?P<what>\S+) -->\n.*?<!-- end -->", re.DOTALL
)


def filled(page: str) -> str:
    """Return a page with what the code says in the places that ask for it.

    :param page: the text of the page.
    :raises KeyError: if it asks for the parameters of a node that is not known here.
    :raises OSError: if it asks for a file that cannot be read.
    """
    return _BLOCK.sub(_block, page)


def _block(asked: re.Match[str]) -> str:
    what = asked["what"]
    content = table(TABLES[what]) if asked["kind"] == "parameters" else text_of(what)
    return f"<!-- {asked['kind']} of {what} -->\n\n{content}\n\n<!-- end -->"


def table(entries: Iterable[Entry]) -> str:
    """Return parameters as a table, a row for each.

    :param entries: the parameters.
    """
    lines = ["| parameter | default | unit | range | what it is |", "|---|---|---|---|---|"]
    for entry in entries:
        cells = (
            f"`{entry.name}`",
            default_text(entry.default),
            entry.unit,
            entry.range_text,
            entry.description,
        )
        lines.append(f"| {' | '.join(cells)} |".replace("|  |", "| |"))
    return "\n".join(lines)


def default_text(default: object) -> str:
    """Return a default as one would write it into a parameter file, or "not given".

    :param default: the default; NaN, an empty array or an empty text stand for "not given".
    """
    if default in ((), ""):
        return "not given"
    if isinstance(default, float) and math.isnan(default):
        return "NaN (not given)"
    if isinstance(default, float) and math.isinf(default):
        return f"`{'-' if default < 0 else ''}.inf` (no limit)"
    return f"`{default}`"


def text_of(name: str) -> str:
    """Return a file of the repository in a fenced block.

    :param name: its path from the repository's root.
    """
    return f"```text\n{(ROOT / name).read_text().rstrip()}\n```"


def main() -> int:
    """Fill all pages."""
    for page in PAGES:
        before = page.read_text()
        after = filled(before)
        if after != before:
            page.write_text(after)
            print(f"filled {page.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
