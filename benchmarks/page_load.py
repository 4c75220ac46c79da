# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Latency of relay_node in the midst of a tune, without a page and with five browsers on it.

Usage, after `. ./env.sh`:

    python3 benchmarks/page_load.py [--seconds 60] [--rate 100] [--phases 6] [--browsers 5]
                                    [--quick]

The sender, relay_node and the clock are those of `latency.py`. Phases take turns: in one nobody
looks; in the other `tune_loop --web` runs, the tune is started on its page, and each of five
headless Chromium windows draws measurement and command as they come. The browsers run at the
lowest priority (nice 19), since those of a plant run on other machines; `tune_loop` runs as it
always does. The table is Markdown; the exit status is 1 if the target is missed. With --quick a
few seconds are run and the status is 0.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import numpy as np
import rclpy
from latency import Bench

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from chromium import Chromium
from markdown import table, three
from ros_domain import free_domain
from served import OpenPage

# Largest p99 with the browsers over that without.
TARGET = 1.1


@contextlib.contextmanager
def looked_at(browsers: int) -> Iterator[OpenPage]:
    """Serve the page of the loop and open it in browsers; yield it.

    :param browsers: how many.
    """
    command = subprocess.Popen(
        ["tune_loop", "--web", "--namespace", "tuned", "--record-only", "--wait", "30"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert command.stderr is not None
        said, found = "", None
        while found is None and (line := command.stderr.readline()):
            said += line
            found = re.search(r"the page is at (\S+)", line)
        if found is None:
            raise SystemExit(f"page_load: tune_loop has not served its page: {said}")
        # Nobody reads what it says from here on.
        Thread(target=command.stderr.read, daemon=True).start()
        page = OpenPage(found[1])
        with tempfile.TemporaryDirectory() as folder, Chromium(Path(folder)) as browser:
            for _ in range(browsers):
                browser.tab(found[1]).wait("document.body.dataset.phase === 'idle'")
            for process in _family(browser.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.setpriority(os.PRIO_PROCESS, process, 19)
            yield page
    finally:
        command.terminate()
        command.wait(20)


def _family(first: int) -> list[int]:
    """Return a process and all that it has started."""
    listed = subprocess.run(["ps", "-e", "-o", "pid=,ppid="], capture_output=True, text=True)
    pairs = [tuple(map(int, line.split())) for line in listed.stdout.splitlines()]
    found = [first]
    for parent in found:
        found += [child for child, of in pairs if of == parent]
    return found


def phase(bench: Bench, count: int, page: OpenPage | None) -> np.ndarray:
    """Run one phase; return its latencies [ms].

    :param bench: with the loop.
    :param count: of the measurements.
    :param page: on which the tune is started; None: by its service.
    """
    if page is None:
        return bench.phase("tuned", count)[0]
    bench.send("tuned", 1)
    bench.until(lambda: page.phase == "idle", 20.0, "the page")
    page.do("start")
    # The first feedback shows that the node has accepted.
    bench.until(lambda: page.phase == "tuning" and page.told["state"], 20.0, "the tune")
    first = len(bench.arrived["tuned"])
    sent = bench.send("tuned", count)
    arrived = np.array(bench.arrived["tuned"][first:][:count])
    page.do("abort")
    bench.until(lambda: page.phase == "idle", 20.0, "the end of the tune")
    return (arrived - sent[: arrived.size]) * 1e-6


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each of the two [s]")
    parser.add_argument("--rate", type=float, default=100.0, help="measurements a second")
    parser.add_argument("--phases", type=int, default=6, help="turns of each")
    parser.add_argument("--browsers", type=int, default=5, help="how many look")
    parser.add_argument("--quick", action="store_true", help="a few seconds, only to see it run")
    options = parser.parse_args()
    if options.quick:
        options.seconds, options.phases, options.browsers = 3.0, 1, 2
    count = int(options.seconds * options.rate / options.phases)
    parts: dict[str, list[np.ndarray]] = {"nobody looks": [], "browsers": []}
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        bench = Bench(options.rate, Path(folder), dict(os.environ))
        try:
            connected = time.monotonic() + 8.0
            bench.until(lambda: time.monotonic() > connected, 10.0, "discovery")
            for _ in range(options.phases):
                parts["nobody looks"].append(phase(bench, count, None))
                with looked_at(options.browsers) as page:
                    parts["browsers"].append(phase(bench, count, page))
        finally:
            bench.close()
            rclpy.try_shutdown()
    found = {name: np.concatenate(times) for name, times in parts.items()}
    p99 = {name: float(np.percentile(times, 99.0)) for name, times in found.items()}
    ratio = p99["browsers"] / p99["nobody looks"]
    told = {"nobody looks": "nobody", "browsers": f"{options.browsers} browsers"}
    rows = [
        (told[name], times.size, three(np.median(times)), three(p99[name]), three(times.max()))
        for name, times in found.items()
    ]
    rows.append(("ratio", "", "", f"{ratio:.2f} (target <= {TARGET:g})", ""))
    print(table(("who looks", "samples", "median [ms]", "p99 [ms]", "max [ms]"), rows))
    return 0 if ratio <= TARGET or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
