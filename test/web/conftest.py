# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""One page for the tests of a file."""

import pytest
from served import analysed, served, subject_of


@pytest.fixture(scope="module")
def subject():
    return subject_of(analysed())


@pytest.fixture(scope="module")
def url(subject):
    with served([subject]) as found:
        yield found
