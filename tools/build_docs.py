# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Build the user guide as a web site in docs/_build/html; `make docs` calls this.

The pages are plain Markdown that a forge shows as they are. So that they need no directives of
Sphinx, they are copied to docs/_build/source first, and there the links between them are adapted
and the table of contents is made from the sections of docs/index.md. Any warning is an error.
"""

from __future__ import annotations

import os
import posixpath
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
BUILD = DOCS / "_build"
SPHINX = ROOT / ".venv-docs/bin/python"

# pages from outside of docs/ that are part of the site, and their names there
OUTSIDE: Mapping[str, str] = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.rst": "changelog.rst",
    "bags/README.md": "bags.md",
}

_LINK = re.compile(r"(?<=\[)([^\[\]]*)\]\((?!https?:|mailto:|#)([^)#\s]+)(#[^)\s]*)?\)")
_FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


def pages() -> dict[str, str]:
    """Return the name on the site of every page, by its path from the repository's root."""
    guide = {f"docs/{page.name}": page.name for page in sorted(DOCS.glob("*.md"))}
    return guide | dict(OUTSIDE)


def contents(index: str) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the sections of the site, each with its pages and the texts of their links.

    A page belongs where it is linked first.

    :param index: the text of docs/index.md; a section is what is under a heading of level two.
    """
    names = pages()
    seen = {"index.md"}
    sections = []
    for part in re.split(r"^## ", index, flags=re.MULTILINE)[1:]:
        own = []
        for words, target, _ in _LINK.findall(_FENCE.sub("", part)):
            name = names.get(posixpath.normpath(f"docs/{target}"), "index.md")
            if name not in seen:
                own.append((name, words))
                seen.add(name)
        if own:
            sections.append((part.partition("\n")[0].strip(), own))
    return sections


def contents_block(index: str) -> str:
    """Return the tables of contents that Sphinx needs, for the end of docs/index.md.

    :param index: its text.
    """
    lines = []
    for title, own in contents(index):
        lines += ["", "```{toctree}", ":hidden:", f":caption: {title}", ""]
        lines += [f"{words} <{name}>" for name, words in own]
        lines += ["```"]
    return "\n".join([*lines, ""])


def with_site_links(text: str, path: str) -> str:
    """Return a page with its links as they are on the site, where all pages are in one folder.

    :param text: the page.
    :param path: its path from the repository's root.
    """
    names = pages()
    folder = posixpath.dirname(path)

    def adapted(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        # every other file is a download, from docs/ (such as pictures) or elsewhere
        name = names.get(target) or posixpath.relpath(target, "docs")
        if name.startswith("../"):
            name = f"files/{target}"
        return f"{link[1]}]({name}{link[3] or ''})"

    return _LINK.sub(adapted, text)


def stage(source: Path) -> None:
    """Copy the pages and what they link to, as Sphinx is to see them.

    :param source: folder for the copies, which is made anew.
    """
    shutil.rmtree(source, ignore_errors=True)
    shutil.copytree(DOCS, source, ignore=shutil.ignore_patterns(BUILD.name))
    for path, name in pages().items():
        text = written = (ROOT / path).read_text()
        if path.endswith(".md"):
            text = with_site_links(written, path)
        if path == "docs/index.md":
            text += contents_block(written)
        (source / name).write_text(text)
        for file in re.findall(r"\]\(files/([^)#]+)\)", text):
            copy = source / "files" / file
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, copy)
            if copy.suffix == ".md":  # results of a benchmark, a page of the site, too
                copy.write_text(copy.read_text().replace("](../../docs/", "](../../../"))


def main() -> int:
    """Build the site; Sphinx prints its errors."""
    stage(BUILD / "source")
    options = ["--fail-on-warning", "--keep-going", "--quiet", "--builder", "html"]
    folders = [str(BUILD / name) for name in ("source", "html", "doctrees")]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(SPHINX), "-m", "sphinx", *options, "--doctree-dir", folders.pop(), *folders]
    done = subprocess.run(command, env=environment)
    if done.returncode:
        return done.returncode
    print(f"the guide is in {(BUILD / 'html/index.html').relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
