# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A tune by somebody with a phone: from the address to proven gains, over real DDS."""

from __future__ import annotations

import pytest
from PIL import Image

from tools.report_images import live_tune

pytestmark = pytest.mark.browser


@pytest.mark.nightly
def test_seven_taps_on_a_phone_lead_to_proven_gains_and_make_the_picture_of_the_readme(tmp_path):
    told = live_tune(tmp_path / "tune.gif", 390, 800)
    assert told["status"].startswith("proof passed")
    # Start, three numbers, Start the tune, Prove and yes.
    assert told["taps"] == "7"
    kc, ti = (float(told["gains"].split()[k]) for k in (1, 4))
    # as the terminal gives for the same loop, see docs/tutorial.md
    assert kc == pytest.approx(0.5954, rel=0.1)
    assert ti == pytest.approx(0.3165, rel=0.15)
    with Image.open(tmp_path / "tune.gif") as picture:
        assert picture.n_frames > 10
        assert picture.size == (390, 800)
