# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Settings of Sphinx for the user guide; `make docs` builds it."""

import re
from pathlib import Path

# in the copy that is built, the repository is two folders further up than in docs/
_manifest = next(
    folder / "package.xml"
    for folder in Path(__file__).resolve().parents
    if (folder / "package.xml").is_file()
)

project = "relay_autotune"
author = "relay_autotune maintainers"
copyright = author  # noqa: A001, as Sphinx calls it
version = release = re.search(r"<version>(.*)</version>", _manifest.read_text())[1]

extensions = ["myst_parser", "sphinx_copybutton"]
# Results of benchmarks are pages that other pages link to.
suppress_warnings = ["toc.not_included"]
myst_heading_anchors = 4
copybutton_exclude = ".linenos, .gp, .go"

html_theme = "furo"
html_title = f"relay_autotune {release}"
html_static_path = ["_static"]
html_css_files = ["guide.css"]
html_logo = "_static/logo.svg"
html_favicon = "_static/logo.svg"
html_copy_source = False
html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {
        "color-brand-primary": "#005a8c",
        "color-brand-content": "#005a8c",
        "font-stack": "Inter, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif",
    },
    "dark_css_variables": {
        "color-brand-primary": "#6cb8e6",
        "color-brand-content": "#6cb8e6",
    },
}
