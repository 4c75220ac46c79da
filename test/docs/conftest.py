# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The recordings of the pages are replayed by many tests, and analysed once."""

import pytest
from analysed import analysed_once, identified_once


@pytest.fixture(autouse=True)
def recordings_are_analysed_once(monkeypatch):
    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", analysed_once)
    monkeypatch.setattr("relay_autotune.analysis.identify", identified_once)
