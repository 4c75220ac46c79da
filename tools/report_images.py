# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Draw the pictures of the guide that show reports: the demo's, and each figure's of a bag.

    . ./env.sh && python3 tools/report_images.py [BROWSER]

With a browser that takes Chromium's options, such as `chromium`, it also takes pictures of the
report's first screen and of the page on which gains are shaped.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from relay_autotune.analysis import analyse
from relay_autotune.cli import demo
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
from relay_autotune.recordings import read_experiments
from relay_autotune.report import write_page, write_picture
from relay_autotune.report.case import Case, case_of
from relay_autotune.report.figures import PLATES
from relay_autotune.report.style import save
from relay_autotune.result import Analysis

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs/images"
BAG = ROOT / "bags/unbiased_relay_with_noise"


def main() -> int:
    """Draw all pictures."""
    found = tune_as_the_demo()
    case = case_of(found, "demo_output/bag", truth=demo.TRUTH)
    write_picture(case, IMAGES / "demo.png", title=demo.picture_title(found))
    (record,) = read_experiments(BAG).experiments
    shown = case_of(analyse(record), BAG.name)
    for plate in PLATES:
        save(plate.figure(shown), str(IMAGES / f"report_{plate.key}.png"))
    if sys.argv[1:]:
        first_screen(sys.argv[1], case)
        page_in_browser(found)
    for picture in (*IMAGES.glob("report_*.png"), IMAGES / "demo.png", IMAGES / "web_page.png"):
        # A palette is enough for lines and makes the file three times smaller; this one keeps rare
        # colours, such as those of the markers on a curve.
        with Image.open(picture) as image:
            few = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
            few.save(picture, optimize=True)
    return 0


def tune_as_the_demo() -> Analysis:
    """Return the demo's result; in lockstep its samples can be computed without processes."""
    process = VirtualProcess(
        demo.TRUTH,
        rest_measurement=demo.REST,
        rest_command=demo.BASELINE,
        disturbances=Disturbances(noise_std=demo.NOISE_STD),
        seed=demo.SEED,
    )
    parameters = ExperimentParameters(amplitude=demo.AMPLITUDE, sample_period=demo.PERIOD)
    experiment = RelayExperiment(parameters, demo.BASELINE)
    k = 0
    while not experiment.finished:
        process.command(experiment.step(k * demo.PERIOD, process.measure(k * demo.PERIOD)))
        k += 1
    return analyse(experiment.record())


def first_screen(browser: str, case: Case) -> None:
    """Take a picture of the first screen of a report.

    :param browser: that takes Chromium's options.
    :param case: in the report.
    """
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "report.html"
        write_page([case], page, title=demo.PAGE_TITLE)
        options = [
            *("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
            *(f"--user-data-dir={folder}/profile", "--window-size=1280,1180"),
            f"--screenshot={IMAGES / 'report_page.png'}",
        ]
        subprocess.run([browser, *options, page.as_uri()], check=True, timeout=120)


def page_in_browser(found: Analysis) -> None:
    """Take a picture of the page on which gains are shaped.

    :param found: the analysis that it shows.
    """
    sys.path.insert(0, str(ROOT / "test/support"))
    from chromium import Chromium  # type: ignore[import-not-found]

    from relay_autotune.web.address import Address
    from relay_autotune.web.server import Page, in_background
    from relay_autotune.web.shape import DesignRequest, PageModel

    case = case_of(found, "demo_output/bag")
    assert found.shaping is not None
    first = DesignRequest.of("robust", found.shaping.task.options)
    subject = PageModel(case, found.shaping, first, lambda _: "replay demo_output/bag")
    page = Page([subject], Address())
    with (
        tempfile.TemporaryDirectory() as folder,
        in_background(page) as url,
        Chromium(Path(folder)) as browser,
    ):
        tab = browser.tab()
        tab.size(1280, 1080)
        tab.go(url)
        tab.until(
            lambda: len(subject.trade_off(first)) >= len(list(subject.positions(first))),
            "all",
            600,
        )
        tab.wait("document.querySelectorAll('#plot-trade .curve').length === 2")
        tab.picture(IMAGES / "web_page.png")


if __name__ == "__main__":
    sys.exit(main())
