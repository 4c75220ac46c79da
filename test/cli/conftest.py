# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The same recordings are replayed by many tests, and analysed once."""

import pytest
from analysed import analysed_once


@pytest.fixture(autouse=True)
def recordings_are_analysed_once(monkeypatch):
    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", analysed_once)
