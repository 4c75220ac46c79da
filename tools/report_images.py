# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Draw the pictures of the guide that show reports: the demo's, and each figure's of a bag.

    . ./env.sh && python3 tools/report_images.py [BROWSER]

With a browser that takes Chromium's options, such as `chromium`, it also takes pictures of the
report's first screen and of the page on which gains are shaped, and a moving one of a live tune.
"""

from __future__ import annotations

import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from relay_autotune.analysis import analyse
from relay_autotune.cli import demo
from relay_autotune.cli.own_nodes import free_domain
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
        live_tune(IMAGES / "live_tune.gif")
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
    # As relay_node does where nothing shows the ends of the actuator.
    experiment = RelayExperiment(parameters, demo.BASELINE, from_small=True)
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


# A loop as the tutorial has it, and how long each still picture is shown [ms].
_PLANT = (
    "plant_node --ros-args -r measurement:=/tank/level -r command:=/tank/valve "
    "-p structure:=fopdt -p gain:=1.65 -p 'time_constants:=[0.4]' -p dead_time:=0.2 "
    "-p 'operating_point:=[40.0, 2.0]' -p noise_std:=0.02 -p sample_period:=0.02"
)
_TUNE = "tune_loop --measurement /tank/level --command /tank/valve --within 30 50 --web"
_STILL, _MOVING = 3000, 700
_TUNED_WITHIN = 120.0


def live_tune(picture: Path, width: int = 1000, height: int = 720) -> dict[str, str]:
    """Tune and prove a simulated loop on its page, as somebody does, and take a moving picture.

    :param picture: the GIF.
    :param width: of the window [pixels].
    :param height: of the window [pixels].
    :return: what the page says at the end: its status, the gains, and the number of taps.
    """
    sys.path.insert(0, str(ROOT / "test/support"))
    from chromium import Chromium

    frames: list[tuple[Image.Image, int]] = []
    taps = 0
    with (
        _page_of_a_loop() as url,
        tempfile.TemporaryDirectory() as folder,
        Chromium(Path(folder)) as browser,
    ):
        tab = browser.tab()
        tab.size(width, height)
        tab.go(url)
        shot = Path(folder) / "shot.png"

        def look(shown: int) -> None:
            tab.picture(shot)
            frames.append((Image.open(io.BytesIO(shot.read_bytes())).convert("RGB"), shown))

        def tap(selector: str, typed: str = "") -> None:
            nonlocal taps
            tab.wait(f"document.querySelector({selector!r})?.disabled === false", _TUNED_WITHIN)
            tab.click(selector)
            taps += 1
            if typed:
                tab.call("Input.insertText", text=typed)

        def follow(phase: str) -> None:
            tab.wait(f"document.body.dataset.phase === {phase!r}", _TUNED_WITHIN)
            tab.eval("scrollTo(0, 0)")
            deadline = time.monotonic() + _TUNED_WITHIN
            while tab.eval("document.body.dataset.phase") != "idle":
                assert time.monotonic() < deadline, tab.text("#live-status")
                look(_MOVING)
                time.sleep(0.001 * _MOVING)

        tab.wait("document.body.dataset.measured > 2")
        look(_STILL // 2)
        tap("#start")
        tap("#form-at-0", "2")
        tap("#form-command_within-0", "0")
        tap("#form-command_within-1", "5")
        tab.wait("!document.querySelector('#plan-yes').disabled")
        look(_STILL)
        tap("#plan-yes")
        follow("tuning")
        look(_STILL)
        tap("#prove")
        tap("#plan-yes")
        follow("verifying")
        tab.wait("!document.querySelector('#proof').hidden")
        look(2 * _STILL)
        told = {"status": tab.text("#live-status"), "gains": tab.text("#gains")}
    # One palette for all, so that a frame holds only what has changed.
    every = Image.new("RGB", (width, height * len(frames)))
    for k, (image, _) in enumerate(frames):
        every.paste(image, (0, k * height))
    palette = every.quantize(160, Image.Quantize.MAXCOVERAGE)
    plain = Image.Dither.NONE
    first, *others = [image.quantize(palette=palette, dither=plain) for image, _ in frames]
    durations = [shown for _, shown in frames]
    first.save(
        picture, save_all=True, append_images=others, duration=durations, loop=0, optimize=True
    )
    return {**told, "taps": str(taps)}


@contextmanager
def _page_of_a_loop() -> Iterator[str]:
    """Start a simulated loop and the page that tunes it; yield its address."""
    with free_domain() as domain, tempfile.TemporaryDirectory() as home:
        around = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": home}
        around |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "HOME": home}
        plant = subprocess.Popen(shlex.split(_PLANT), env=around, stderr=subprocess.DEVNULL)
        tune = subprocess.Popen(
            shlex.split(_TUNE), env=around, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
        try:
            assert tune.stderr is not None
            lines = (re.search(r"page is at (\S+)", line) for line in tune.stderr)
            yield next(found[1] for found in lines if found)
        finally:
            for process in (tune, plant):
                process.terminate()
                process.wait()


if __name__ == "__main__":
    sys.exit(main())
