# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How long the page takes, in a headless Chromium: from the slider, and from a measurement.

Usage, after `. ./env.sh`:

    python3 benchmarks/page_latency.py [--moves 100]

The slider is moved by the arrow keys from end to end and back over the gains of the simulated
demo's process, with 100 models around; a move is over when the gains and all curves have been
drawn anew. First while nothing was computed ahead, on positions that were not asked for before;
then after all positions were computed ahead. The measurements are 100 a second, and each is on
the screen when the frame has begun in which it is drawn. The table is Markdown; the exit status is
1 if a target is missed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from chromium import Chromium, Tab
from served import analysed, served, subject_of

from relay_autotune.web.live import Live

TARGET_MS = 100.0
RIGHT, LEFT = ("ArrowRight", 39), ("ArrowLeft", 37)
# The page notes each move of the slider, and the first frame after its answer was drawn.
WATCH = """
window.times = [];
document.querySelector('#ms').addEventListener(
  'input', () => { window.begun = performance.now(); }, { capture: true });
new MutationObserver(() => {
  if (document.body.dataset.settled === 'yes' && window.begun) {
    const begun = window.begun;
    window.begun = 0;
    requestAnimationFrame(() => requestAnimationFrame(() => {
      window.times.push(performance.now() - begun);
    }));
  }
}).observe(document.body, { attributes: true, attributeFilter: ['data-settled'] });
document.querySelector('#ms').focus();
"""


def moved(tab: Tab, moves: int, stride: int) -> np.ndarray:
    """Return how long each of some moves of the slider took [ms].

    :param tab: with the page.
    :param moves: of them.
    :param stride: 1 to the fast end first, -1 to the calm one.
    """
    for _ in range(moves):
        value = float(tab.eval("document.querySelector('#ms').value"))
        stride = -1 if value > 1.99 else 1 if value < 1.21 else stride
        count = tab.eval("window.times.length")
        tab.press(*(RIGHT if stride > 0 else LEFT))
        tab.wait(f"window.times.length > {count}")
    return np.array(tab.eval(f"window.times.slice(-{moves})"))


def measured(tab: Tab, live: Live, seconds: float) -> np.ndarray:
    """Return how long measurements took to the frame that shows them [ms]."""
    begun = live._begun
    tab.eval(
        "window.seen = []; new MutationObserver(() => { const t = Number(document.body.dataset."
        "measured); const now = Date.now(); requestAnimationFrame(() => window.seen.push([t, "
        "Date.now()])); }).observe(document.body, { attributes: true, attributeFilter: "
        "['data-measured'] })"
    )
    stop = threading.Event()

    def feed() -> None:
        while not stop.wait(0.01):
            live.sample("measurement", float(np.sin(time.monotonic())))

    thread = threading.Thread(target=feed)
    thread.start()
    tab.call("Page.bringToFront")
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        tab.eval("new Promise((done) => setTimeout(done, 200))")
    stop.set()
    thread.join()
    offset = time.time() - (time.monotonic() - begun)
    seen = np.array(tab.eval("window.seen"))
    shown, taken = seen[:, 1] / 1000.0 - offset, seen[:, 0]
    # A frame shows all samples since the one before it; the oldest of them has waited longest.
    oldest = np.concatenate((taken[:1], taken[:-1] + 0.01))
    return 1000.0 * (shown - oldest)[1:]


def main() -> int:
    """Run it and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moves", type=int, default=100)
    options = parser.parse_args()
    rows: list[tuple[str, np.ndarray]] = []
    with tempfile.TemporaryDirectory() as folder, Chromium(Path(folder)) as browser:
        for ahead, what in ((False, "slider, not computed before"), (True, "slider, ahead")):
            subject = subject_of(analysed())
            with served([subject], ahead=ahead) as url:
                tab = browser.tab()
                tab.size(1280, 900)
                tab.go(f"{url}#ms=1.2&controller=pid&rule=robust")
                tab.wait("document.body.dataset.settled === 'yes'")
                if ahead:
                    tab.until(lambda s=subject: len(s.trade_off()) >= 123, "all positions", 600.0)
                tab.eval(WATCH)
                rows.append((what, moved(tab, 40 if not ahead else options.moves, 1)))
        live = Live("/relay_node")
        with served([], live=live) as url:
            tab = browser.tab(url)
            tab.wait("document.body.dataset.phase === 'idle'")
            begun = tab.eval("performance.getEntriesByName('first-contentful-paint')[0].startTime")
            rows.append(("measurement at 100 Hz to the screen", measured(tab, live, 15.0)))
    print("| from | count | median ms | p95 ms | largest ms |")
    print("|---|---|---|---|---|")
    for what, times in rows:
        p95 = np.percentile(times, 95)
        print(
            f"| {what} | {times.size} | {np.median(times):.0f} | {p95:.0f} | {times.max():.0f} |"
        )
    print(f"| first paint | 1 | {begun:.0f} | | |")
    missed = [what for what, times in rows[1:] if np.percentile(times, 95) > TARGET_MS]
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
