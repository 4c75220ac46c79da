# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The page on the report names what the command and the figures have."""

from __future__ import annotations

import re

from pages import ROOT

from relay_autotune.report.figures import PLATES

PAGE = (ROOT / "docs/report.md").read_text()


def test_every_figure_has_a_section_with_its_picture() -> None:
    sections = dict(re.findall(r"^## (.*)\n\n!\[[^]]+\]\(images/(.*)\)$", PAGE, re.MULTILINE))
    figures = {plate.title: f"report_{plate.key}.png" for plate in PLATES}
    assert sections == {"The first screen": "report_page.png", **figures}
    for name in sections.values():
        picture = ROOT / "docs/images" / name
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size < 200_000
