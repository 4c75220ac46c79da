# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A served page, and whether there is a browser to look at it."""

from __future__ import annotations

import chromium
import pytest


def pytest_addoption(parser):
    parser.addoption(
        "--require-chromium", action="store_true", help="fail where there is no Chromium"
    )


def pytest_collection_modifyitems(config, items):
    of_browsers = [item for item in items if item.get_closest_marker("browser")]
    if not of_browsers or chromium.found():
        return
    if config.getoption("--require-chromium", default=False):
        raise pytest.UsageError("no Chromium found: apt install chromium")
    for item in of_browsers:
        item.add_marker(pytest.mark.skip(reason="no Chromium found"))
    config.stash[_LEFT_OUT] = len(of_browsers)


_LEFT_OUT = pytest.StashKey[int]()


def pytest_terminal_summary(terminalreporter, config):
    if config.stash.get(_LEFT_OUT, 0):
        terminalreporter.write_line("no Chromium found: the browser tests did not run")
