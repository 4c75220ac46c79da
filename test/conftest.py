# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Make property tests repeatable, and deaf to how busy the machine is.

Tests that need a browser are left out where there is none, and a line at the end says so.
"""

import signal
from collections import Counter

import pytest
from hypothesis import settings

# Before numpy, as in nodes and commands: small matrices gain nothing by a second thread, which
# would only take the processor from the tests beside.
import relay_autotune.threads  # noqa: F401

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")

# nohup, a shell's background or a build server may have had them ignored; commands that the tests
# start would rightly go on doing that
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)

_LEFT_OUT = pytest.StashKey[int]()


def pytest_addoption(parser):
    parser.addoption(
        "--require-chromium", action="store_true", help="fail where there is no Chromium"
    )
    parser.addoption(
        "--first-cases", action="store_true", help="run the first case of each test alone"
    )


# Before pytest leaves out what is marked as nightly.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    number = Counter()
    for item in items:
        first_alone = config.option.first_cases or item.get_closest_marker("long")
        if first_alone and not item.get_closest_marker("nightly"):
            test = (item.path, item.parent.name, getattr(item, "originalname", item.name))
            number[test] += 1
            if number[test] > 1:
                item.add_marker(pytest.mark.nightly)
    of_browsers = [item for item in items if item.get_closest_marker("browser")]
    if not of_browsers:
        return
    # imported here: the environment with the oldest libraries has no server, nor these tests
    import chromium

    if chromium.found():
        return
    if config.getoption("--require-chromium"):
        raise pytest.UsageError("no Chromium found: apt install chromium")
    for item in of_browsers:
        item.add_marker(pytest.mark.skip(reason="no Chromium found"))
    config.stash[_LEFT_OUT] = len(of_browsers)


def pytest_terminal_summary(terminalreporter, config):
    if config.stash.get(_LEFT_OUT, 0):
        terminalreporter.write_line("no Chromium found: the browser tests did not run")
