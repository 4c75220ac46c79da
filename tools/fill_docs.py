# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Write tables and texts from the code into the pages of docs/; a test compares the two.

    . ./env.sh && python3 -m tools.fill_docs

A page asks for it with a pair of comments, and what is between them is replaced:

    <!-- parameters of relay_node -->    <!-- end -->    a table of the node's parameters
    <!-- checks of judgement -->         <!-- end -->    the table of checks behind a verdict
    <!-- laws of equations -->           <!-- end -->    a table of the laws that gains are for
    <!-- reasons of 300 -->              <!-- end -->    a table of the reasons of 300 to 399

It also writes config/parameters.yaml, in which every parameter of every node has its default, and
relay_autotune_msgs/msg/Reason.msg, in which every reason has its constant.
"""

from __future__ import annotations

import math
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from relay_autotune.analysis import PARAMETERS as IDENTIFIER_PARAMETERS
from relay_autotune.identification.judgement.table import CHECKS
from relay_autotune.loop.laws import LAWS, ProgramLaw
from relay_autotune.nodes.plant import PARAMETERS as PLANT_PARAMETERS
from relay_autotune.nodes.tables import CONTROLLER_PARAMETERS, FIXED_PARAMETERS, TUNE_PARAMETERS
from relay_autotune.quantities import Quantity
from relay_autotune.reasons import Code
from relay_autotune.verdict import Check
from tools.attribute_docs import attribute_docs

ROOT = Path(__file__).resolve().parent.parent
PARAMETER_FILE = ROOT / "config/parameters.yaml"
REASON_FILE = ROOT / "relay_autotune_msgs/msg/Reason.msg"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))

TABLES: Mapping[str, Sequence[Quantity]] = {
    "relay_node": (*TUNE_PARAMETERS, *FIXED_PARAMETERS),
    "identifier_node": IDENTIFIER_PARAMETERS,
    "plant_node": PLANT_PARAMETERS,
    "controller_node": CONTROLLER_PARAMETERS,
}

# Where the names stand that a parameter may take, too many for a cell.
_NAMES = {
    "law": "laws.md#the-laws",
    "rule": "rules.md",
    "method": "methods.md",
    "structure": "plant.md#the-process",
}
_BLOCK = re.compile(
    r"<!-- (?P<kind>parameters|text|checks|laws|reasons) of (?P<what>\S+) -->\n.*?<!-- end -->",
    re.DOTALL,
)


def filled(page: str) -> str:
    """Return a page with its generated blocks filled from the code.

    :param page: the text of the page.
    :raises KeyError: if it asks for the parameters of a node that is not known here.
    """
    return _BLOCK.sub(_block, page)


def _block(asked: re.Match[str]) -> str:
    what = asked["what"]
    kinds: dict[str, Callable[[str], str]] = {
        "parameters": lambda name: table(TABLES[name]),
        "checks": lambda _: checks_table(CHECKS),
        "laws": laws_table,
        "reasons": lambda first: reasons_table(int(first)),
    }
    content = kinds[asked["kind"]](what)
    return f"<!-- {asked['kind']} of {what} -->\n\n{content}\n\n<!-- end -->"


def table(entries: Iterable[Quantity]) -> str:
    """Return parameters as a table, a row for each.

    :param entries: the parameters.
    """
    lines = ["| parameter | default, unit, range | what it is |", "|---|---|---|"]
    for entry in entries:
        value = f"{default_text(entry.default)} {entry.unit}".strip()
        told = ", ".join(filter(None, (value, _short(entry))))
        lines.append(f"| `{entry.name}` | {told} | {entry.description} |")
    return "\n".join(lines)


def _short(entry: Quantity) -> str:
    """Return the range of a parameter without its unit; empty: any number."""
    if entry.name in _NAMES:
        return f"[a name]({_NAMES[entry.name]})"
    text = entry.range_text.replace(f" [{entry.unit}]", "").replace(" where it is not given", "")
    text = text.replace(f" {entry.unit},", ",").removesuffix(f" {entry.unit}")
    return "" if text.startswith("any number") else text


def checks_table(checks: Iterable[Check]) -> str:
    """Return the table of checks, a row for each.

    :param checks: rows of the code's table.
    """
    lines = [
        "| check | what is measured | doubtful above | no gains above | what to do then |",
        "|---|---|---|---|---|",
    ]
    for check in checks:
        limits = (limit_text(check, limit) for limit in (check.doubtful, check.failed))
        cells = (f"{check.title} `{check.name}`", check.what, *limits, check.remedy)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def laws_table(what: str) -> str:
    """Return a table of the laws, a row for each.

    :param what: "programs", "equations" or "properties".
    """
    columns: dict[str, dict[str, Callable[[ProgramLaw], str]]] = {
        "programs": {
            "program, in the version whose source was read": lambda law: law.program,
            "command": lambda law: law.command,
        },
        "equations": {"in each sample": lambda law: f"`{law.equation}`"},
        "properties": {
            "form": lambda law: law.form,
            "integrates": lambda law: law.integral.words,
            "derivative of": lambda law: law.slope.value,
            "filter": lambda law: law.smoothing.words,
            "weight b": lambda law: " or ".join(f"{w:g}" for w in law.weights) or "0 to 1",
            "at a limit of the command": lambda law: law.limits,
            "its parameters": lambda law: ", ".join(f"`{s.name}`" for s in law.settings),
        },
    }
    chosen = columns[what]
    lines = [f"| law | {' | '.join(chosen)} |", "|---" * (1 + len(chosen)) + "|"]
    for law in LAWS.values():
        cells = (f"`{law.name}`", *(cell(law) for cell in chosen.values()))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def reasons_table(first: int) -> str:
    """Return a table of the reasons of a hundred, or of the half of it from 50 on; without notes.

    :param first: their first number.
    """
    stop = first + 50 if first % 100 or first == 200 else first + 100
    meanings = attribute_docs(Code)
    lines = ["| code | sentence | what is behind it, and what to do |", "|---|---|---|"]
    before = ""
    for code in sorted(Code):
        row, meaning = code.row, meanings.get(code.name, "")
        if first <= code < stop and meaning:
            remedy = row.remedy and f" {row.remedy[0].upper()}{row.remedy[1:]}."
            found, then = (re.sub(r":[^{}]*}", "}", t) for t in (row.found, meaning + remedy))
            # What a sentence may leave out, and what it has in common with the one before, is cut.
            whole = re.sub(r"\[[^]]*\]", "", found)
            head, _, last = whole.rpartition("; ")
            found = f"... {last}" if head and head == before else whole
            before = head
            # What follows a colon is told again beside it.
            found = re.sub(r": [^{}`]*$", "", found)
            cells = (f"{code} `{code.name}`", f"`{found}`", then)
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def reason_file() -> str:
    """Return Reason.msg, with a constant for each reason."""
    lines = [
        "# Why something ended, failed or was refused, for programs; the sentence for people",
        "# stands with it. tools/fill_docs.py writes this file from relay_autotune/reasons.py.",
        "#",
        "# A number keeps its meaning for ever. Up to 99: none, or without a code; from 100 on:",
        "# the experiment ended it, or a note to that; from 200 on: something outside of it did;",
        "# from 300 on: a tune cannot start; from 400 on: model and gains; from 500 on: a",
        "# verification; from 900 on: a defect.",
        "",
        "uint16 code      # one of the constants below; another one: a newer node has it",
        "string[] names   # of its values, shape (n,)",
        "string[] values  # numbers in full, names and words, shape (n,)",
        "",
        *(f"uint16 {code.name} = {code}" for code in Code),
    ]
    return "\n".join(lines) + "\n"


def limit_text(check: Check, limit: float) -> str:
    """Return a limit with its unit; a dash if there is none.

    :param check: whose limit it is.
    :param limit: the number; inf: there is none.
    """
    return f"{limit:g} {check.unit}".rstrip() if math.isfinite(limit) else "-"


def default_text(default: object) -> str:
    """Return a default as one would write it into a parameter file, or "not given".

    :param default: the default; NaN, an empty array or an empty text stand for "not given".
    """
    if default in ((), ""):
        return "not given"
    if isinstance(default, float) and math.isnan(default):
        return "NaN"
    if isinstance(default, float) and math.isinf(default):
        return f"`{'-' if default < 0 else ''}.inf`"
    return f"`{default}`"


def parameter_file() -> str:
    """Return a parameter file with every parameter of every node at its default."""
    lines = [
        "# Every parameter of every node at its default; tools/fill_docs.py writes this file.",
        "# Copy what you want to change. Doubles need a decimal point. `/**/` stands for any",
        "# namespace; y is the unit of the measurement and u that of the command.",
    ]
    for node, entries in TABLES.items():
        lines += ["", f"/**/{node}:", "  ros__parameters:"]
        for entry in entries:
            text = f"{entry.description} ({entry.range_text})"
            lines += [f"    # {line}" for line in textwrap.wrap(text, 93)]
            # a parameter that is not given has no value for the file
            mark = "# " if entry.default == () else ""
            lines.append(f"    {mark}{entry.name}: {yaml_value(entry.default)}")
    return "\n".join(lines) + "\n"


def yaml_value(value: object) -> str:
    """Return a value as a parameter file has it.

    :param value: a default.
    """
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(yaml_value, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else f"{'-' if value < 0 else ''}.inf"
    return str(value)


def main() -> int:
    """Fill all pages, and write the files that follow from the code."""
    written: list[tuple[Path, Callable[[], str]]] = [
        (PARAMETER_FILE, parameter_file),
        (REASON_FILE, reason_file),
        *((page, partial(lambda page: filled(page.read_text()), page)) for page in PAGES),
    ]
    for file, text in written:
        before, after = file.read_text() if file.exists() else "", text()
        if after != before:
            file.write_text(after)
            print(f"filled {file.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
