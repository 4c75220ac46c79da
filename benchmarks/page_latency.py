# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How long the page takes in a headless Chromium, and what memory a long live page needs.

Usage, after `. ./env.sh`:

    python3 benchmarks/page_latency.py [--moves 100] [--seconds 15] [--minutes 60] [--quick]

The slider is moved by the arrow keys from end to end and back, on the demo's process with 100
models around it. A move is over when gains and all curves are drawn anew. First only every eighth
position is known, as some seconds after the page was opened: gains between these are drawn, then
the exact ones. Then all positions are computed ahead. Measurements come 100 a second; of each
frame the oldest sample counts that it is the first to show.

For the memory, the measurements and the states of an hour at 100 a second are told as fast as the
page takes them, with the page open; resident memory of the server and heap of the page are read
after a sixth of it and at the end. The tables are Markdown; the exit status is 1 if a target is
missed. With --quick a little is made and the status is 0.
"""

from __future__ import annotations

import argparse
import gc
import resource
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from chromium import Chromium, Tab
from markdown import table, three
from served import analysed, served, subject_of

from relay_autotune.web.live import Live

TARGET_MS, FIRST_PAINT_MS, GROWTH = 100.0, 1000.0, 1.1
# Measurements a second of the loop whose memory is looked at.
RATE = 100
RIGHT, LEFT = ("ArrowRight", 39), ("ArrowLeft", 37)
# The page notes each move of the slider, the first frame with new gains and curves, and the first
# with the exact ones.
WATCH = """
window.times = {drawn: [], exact: []};
window.begun = {};
document.querySelector('#ms').addEventListener(
  'input', () => { window.begun = { drawn: performance.now(), exact: performance.now() }; },
  { capture: true });
const over = (what) => {
  const begun = window.begun[what];
  if (!begun) return;
  window.begun[what] = 0;
  requestAnimationFrame(() => requestAnimationFrame(() => {
    window.times[what].push(performance.now() - begun);
  }));
};
new MutationObserver((changes) => {
  if (changes.some((each) => each.attributeName === 'data-shown')) over('drawn');
  if (document.body.dataset.settled === 'yes') over('exact');
}).observe(document.body, { attributes: true, attributeFilter: ['data-settled', 'data-shown'] });
document.querySelector('#ms').focus();
"""


def moved(tab: Tab, moves: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how long each move of the slider took [ms], from the calm end on.

    :param tab: with the page.
    :param moves: how many.
    :return: to the first gains and curves, and to the exact ones.
    """
    stride = 1
    for _ in range(moves):
        value = float(tab.eval("document.querySelector('#ms').value"))
        stride = -1 if value > 1.99 else 1 if value < 1.21 else stride
        count = tab.eval("window.times.exact.length")
        tab.press(*(RIGHT if stride > 0 else LEFT))
        tab.wait(f"window.times.exact.length > {count}")
    drawn, exact = (
        np.array(tab.eval(f"window.times.{what}.slice(-{moves})")) for what in ("drawn", "exact")
    )
    return drawn, exact


def memory(tab: Tab, live: Live, minutes: float) -> tuple[float, float]:
    """Return the resident memory of this server and the heap of the page [MiB].

    :param tab: with the page.
    :param live: the loop, of which so much more is told first.
    :param minutes: of measurements and states, as of a loop at 100 Hz.
    """
    for second in range(round(60.0 * minutes)):
        live.tell(status=f"at the high level for {second} s", elapsed=float(second))
        for k in range(RATE):
            live.sample("measurement", float(np.sin(k / 10.0)))
            if k % 20 == 0:
                live.sample("command", float(k % 40))
        last = live.everything()["samples"]["measurement"][0][-1] if second % 60 == 0 else None
        if last is not None:
            # The page keeps up: nothing piles up between it and the server.
            tab.wait(f"Number(document.body.dataset.measured) >= {last - 0.5}")
        else:
            time.sleep(0.005)
    gc.collect()
    # What is being compiled or drawn just now counts as used: the least of some collections.
    sizes = []
    for _ in range(5):
        tab.call("HeapProfiler.collectGarbage")
        used = tab.call("Runtime.getHeapUsage")
        sizes.append(used["usedSize"] + used["backingStorageSize"])
        time.sleep(0.5)
    heap = min(sizes)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20, heap / 2**20


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
    parser.add_argument("--minutes", type=float, default=60.0, help="of a live page [min]")
    parser.add_argument("--quick", action="store_true", help="a few, only to see it run")
    options = parser.parse_args()
    if options.quick:
        options.moves, options.seconds, options.minutes = 4, 2.0, 0.5
    rows: list[tuple[str, np.ndarray]] = []
    profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
    with profile as folder, Chromium(Path(folder)) as browser:
        for ahead in (False, True):
            subject = subject_of(analysed())
            first = replace(subject.first, controller="pid", ms=1.2)
            positions = list(subject.positions(first))
            for asked in [] if ahead else positions[:6]:
                subject.shaped(asked)
            with served([subject]) as url:
                tab = browser.tab()
                tab.size(1280, 900)
                tab.go(f"{url}#ms=1.2&controller=pid&rule=robust")
                tab.wait("document.body.dataset.settled === 'yes'")
                if ahead and not options.quick:
                    every = len(positions)
                    tab.until(
                        lambda s=subject, f=first, n=every: len(s.trade_off(f)) >= n,
                        "all positions", 600.0,
                    )  # fmt: skip
                tab.eval(WATCH)
                moves = options.moves if ahead else min(options.moves, 40)
                drawn, exact = moved(tab, moves)
                if ahead:
                    rows.append(("slider, computed ahead", exact))
                else:
                    rows.append(("slider, between known gains", drawn))
                    rows.append(("slider, the exact gains then", exact))
        live = Live("/relay_node")
        with served([], live=live) as url:
            tab = browser.tab(url)
            tab.wait("document.body.dataset.phase === 'idle'")
            paints = tab.eval(
                "performance.getEntriesByName('first-contentful-paint')[0].startTime"
            )
            rows.append(("measurement", measured(tab, live, options.seconds)))
        live = Live("/relay_node")
        with served([], live=live) as url:
            tab = browser.tab(url)
            tab.wait("document.body.dataset.phase === 'idle'")
            early = memory(tab, live, options.minutes / 6.0)
            late = memory(tab, live, options.minutes * 5.0 / 6.0)
    rows.append(("first paint", np.array([paints])))
    limit = f"<= {TARGET_MS:g}"
    targets = [limit, "", limit, limit, f"<= {FIRST_PAINT_MS:g}"]
    found = [np.percentile(times, 95.0) for _, times in rows]
    cells = [
        (what, times.size, three(np.median(times)), three(p95), three(times.max()), target)
        for (what, times), p95, target in zip(rows, found, targets, strict=True)
    ]
    print(
        table(("from", "count", "median [ms]", "p95 [ms]", "max [ms]", "target, p95 [ms]"), cells)
    )
    growth = [b / a for a, b in zip(early, late, strict=True)]
    kept = [
        (what, three(a), three(b), f"{ratio:.3f}", f"<= {GROWTH:g}")
        for what, a, b, ratio in zip(("server", "page"), early, late, growth, strict=True)
    ]
    sixth = f"after {options.minutes / 6.0:g} min [MiB]"
    print()
    print(
        table(("memory", sixth, f"after {options.minutes:g} min [MiB]", "ratio", "target"), kept)
    )
    met = max(found[0], *found[2:4]) <= TARGET_MS and found[4] <= FIRST_PAINT_MS
    met = met and max(growth) <= GROWTH
    return 0 if met or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
