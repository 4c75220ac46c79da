# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How long the page takes in a headless Chromium: from the slider, and from a measurement.

Usage, after `. ./env.sh`:

    python3 benchmarks/page_latency.py [--moves 100] [--seconds 15] [--quick]

The slider is moved by the arrow keys from end to end and back, on the demo's process with 100
models around it. A move is over when gains and all curves are drawn anew: first with positions
that nobody has asked for before, then with all of them computed ahead. Measurements come 100 a
second; of each frame the oldest sample counts that it is the first to show. The table is Markdown;
the exit status is 1 if a target is missed. With --quick a few are made and the status is 0.
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
from markdown import table, three
from served import analysed, served, subject_of

from relay_autotune.web.live import Live

TARGET_MS, FIRST_PAINT_MS = 100.0, 1000.0
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


def moved(tab: Tab, moves: int) -> np.ndarray:
    """Return how long each move of the slider took [ms], from the calm end on.

    :param tab: with the page.
    :param moves: how many.
    """
    stride = 1
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
        "measured); requestAnimationFrame(() => window.seen.push([t, Date.now()])); })"
        ".observe(document.body, { attributes: true, attributeFilter: ['data-measured'] })"
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
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--moves", type=int, default=100, help="of the slider")
    parser.add_argument("--seconds", type=float, default=15.0, help="of measurements [s]")
    parser.add_argument("--quick", action="store_true", help="a few, only to see it run")
    options = parser.parse_args()
    if options.quick:
        options.moves, options.seconds = 4, 2.0
    rows: list[tuple[str, np.ndarray]] = []
    with tempfile.TemporaryDirectory() as folder, Chromium(Path(folder)) as browser:
        for ahead in (False, True):
            subject = subject_of(analysed())
            with served([subject], ahead=ahead) as url:
                tab = browser.tab()
                tab.size(1280, 900)
                tab.go(f"{url}#ms=1.2&controller=pid&rule=robust")
                tab.wait("document.body.dataset.settled === 'yes'")
                if ahead and not options.quick:
                    tab.until(
                        lambda s=subject: len(s.trade_off(s.first)) >= 123, "all positions", 600.0
                    )
                tab.eval(WATCH)
                moves = options.moves if ahead else min(options.moves, 40)
                what = "slider, computed ahead" if ahead else "slider, computed when asked"
                rows.append((what, moved(tab, moves)))
        live = Live("/relay_node")
        with served([], live=live) as url:
            tab = browser.tab(url)
            tab.wait("document.body.dataset.phase === 'idle'")
            paints = tab.eval(
                "performance.getEntriesByName('first-contentful-paint')[0].startTime"
            )
            rows.append(("measurement", measured(tab, live, options.seconds)))
    rows.append(("first paint", np.array([paints])))
    targets = ["", *[f"<= {TARGET_MS:g}"] * 2, f"<= {FIRST_PAINT_MS:g}"]
    found = [np.percentile(times, 95.0) for _, times in rows]
    cells = [
        (what, times.size, three(np.median(times)), three(p95), three(times.max()), target)
        for (what, times), p95, target in zip(rows, found, targets, strict=True)
    ]
    print(
        table(("from", "count", "median [ms]", "p95 [ms]", "max [ms]", "target, p95 [ms]"), cells)
    )
    met = max(found[1:3]) <= TARGET_MS and found[3] <= FIRST_PAINT_MS
    return 0 if met or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
