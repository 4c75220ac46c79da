# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The guide as a web site: every page is in its contents, and every link leads to a page of it."""

from __future__ import annotations

import re
from pathlib import Path

from pages import ROOT

from tools.build_docs import contents, contents_block, pages, stage, with_site_links

INDEX = (ROOT / "docs/index.md").read_text()


def test_the_index_leads_to_every_page_once() -> None:
    listed = [name for _, own in contents(INDEX) for name, _ in own]
    assert sorted(listed) == sorted(set(pages().values()) - {"index.md"})
    text = contents_block(INDEX)
    assert all(text.count(f"<{name}>") == 1 for name in listed)


def test_links_become_those_of_the_site() -> None:
    text = "[a](../README.md#b), [c](live.md), [d](../LICENSE), ![e](images/demo.png), [f](#g)"
    assert with_site_links(text, "docs/index.md") == (
        "[a](readme.md#b), [c](live.md), [d](files/LICENSE), ![e](images/demo.png), [f](#g)"
    )
    assert with_site_links("[a](docs/live.md) [b](https://x.y)", "README.md") == (
        "[a](live.md) [b](https://x.y)"
    )


def test_what_is_staged_has_all_that_its_pages_link_to(tmp_path: Path) -> None:
    stage(tmp_path / "source")
    for page in (tmp_path / "source").glob("*.md"):
        for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
