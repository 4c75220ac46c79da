# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Latency of relay_node in the midst of a tune, without a page and with some looking at it.

Usage, after `. ./env.sh`:

    python3 benchmarks/page_load.py [--seconds 60] [--rate 100] [--phases 6] [--browsers 5]
                                    [--quick]

The sender, relay_node and the clock are those of `latency.py`. Phases take turns, so that all meet
the same machine: nobody looks; `tune_loop --web` runs, and no page is open; readers have the page,
which take every frame and draw nothing, as browsers on other machines; as many windows of a
headless Chromium on this machine draw measurement and command as they come. Readers and browsers
run at the lowest priority (nice 19), `tune_loop` as it always does. The table is Markdown; the
exit status is 1 if the target is missed with readers. With --quick a few seconds are run and the
status is 0.
"""

from __future__ import annotations

import argparse
import asyncio
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
from tornado.websocket import websocket_connect

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from chromium import Chromium
from markdown import table, three
from ros_domain import free_domain
from served import OpenPage

# Largest p99 with readers over that with nobody.
TARGET = 1.1
NOBODY, CLOSED, READERS, BROWSERS = "nobody", "the page, not open", "readers", "browsers"


@contextlib.contextmanager
def looked_at(who: str, count: int) -> Iterator[str]:
    """Serve the page of the loop, and yield its address.

    :param who: opens it.
    :param count: how many of them.
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
        with {READERS: read_by, BROWSERS: drawn_by}.get(who, unopened)(found[1], count):
            yield found[1]
    finally:
        command.terminate()
        command.wait(20)


@contextlib.contextmanager
def unopened(_url: str, _count: int) -> Iterator[None]:
    """Open nothing."""
    yield


@contextlib.contextmanager
def read_by(url: str, count: int) -> Iterator[None]:
    """Let a process read all that open pages are told."""
    this = [sys.executable, __file__, "--role", "read", "--browsers", str(count), url]
    reader = subprocess.Popen(["nice", "-n", "19", *this], stdout=subprocess.PIPE, text=True)
    try:
        assert reader.stdout is not None
        reader.stdout.readline()
        yield
    finally:
        reader.terminate()
        reader.wait(20)


async def read(url: str, count: int) -> None:
    """Read all that open pages are told, and throw it away."""
    address = url.replace("http:", "ws:", 1) + "socket"
    sockets = [await websocket_connect(address) for _ in range(count)]
    print("open", flush=True)

    async def through(socket: object) -> None:
        while await socket.read_message() is not None:  # type: ignore[attr-defined]
            pass

    await asyncio.gather(*map(through, sockets))


@contextlib.contextmanager
def drawn_by(url: str, count: int) -> Iterator[None]:
    """Let windows of a browser draw what comes."""
    with tempfile.TemporaryDirectory() as folder, Chromium(Path(folder)) as browser:
        for _ in range(count):
            browser.tab(url).wait("document.body.dataset.phase === 'idle'")
        for process in _family(browser.pid):
            with contextlib.suppress(ProcessLookupError):
                os.setpriority(os.PRIO_PROCESS, process, 19)
        yield


def _family(first: int) -> list[int]:
    """Return a process and all that it has started."""
    listed = subprocess.run(["ps", "-e", "-o", "pid=,ppid="], capture_output=True, text=True)
    pairs = [tuple(map(int, line.split())) for line in listed.stdout.splitlines()]
    found = [first]
    for parent in found:
        found += [child for child, of in pairs if of == parent]
    return found


def wish(bench: Bench, url: str, what: str, phase: str) -> None:
    """Do something by a page that is open only for that.

    :param bench: with the loop.
    :param url: of the page.
    :param what: the wish.
    :param phase: what the page then tells.
    """
    page = OpenPage(url)
    bench.until(lambda: page.phase, 20.0, "the page")
    page.do(what)
    # The first feedback shows that the node has accepted.
    bench.until(lambda: page.phase == phase and page.told["state"], 20.0, what)
    page.close()


def phase(bench: Bench, count: int, url: str | None) -> np.ndarray:
    """Run one phase; return its latencies [ms].

    :param bench: with the loop.
    :param count: of the measurements.
    :param url: of the page on which the tune is started; None: by its service.
    """
    if url is None:
        return bench.phase("tuned", count)[0]
    bench.send("tuned", 1)
    wish(bench, url, "start", "tuning")
    first = len(bench.arrived["tuned"])
    sent = bench.send("tuned", count)
    arrived = np.array(bench.arrived["tuned"][first:][:count])
    wish(bench, url, "abort", "idle")
    return (arrived - sent[: arrived.size]) * 1e-6


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each of the four [s]")
    parser.add_argument("--rate", type=float, default=100.0, help="measurements a second")
    parser.add_argument("--phases", type=int, default=6, help="turns of each")
    parser.add_argument("--browsers", type=int, default=5, help="how many look")
    parser.add_argument("--quick", action="store_true", help="a few seconds, only to see it run")
    parser.add_argument("--role", choices=("read",), help=argparse.SUPPRESS)
    parser.add_argument("url", nargs="?", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        asyncio.run(read(options.url, options.browsers))
        return 0
    if options.quick:
        options.seconds, options.phases, options.browsers = 3.0, 1, 2
    count = int(options.seconds * options.rate / options.phases)
    parts: dict[str, list[np.ndarray]] = {w: [] for w in (NOBODY, CLOSED, READERS, BROWSERS)}
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        bench = Bench(options.rate, Path(folder), dict(os.environ))
        try:
            connected = time.monotonic() + 8.0
            bench.until(lambda: time.monotonic() > connected, 10.0, "discovery")
            for _ in range(options.phases):
                for who, times in parts.items():
                    if who == NOBODY:
                        times.append(phase(bench, count, None))
                        continue
                    with looked_at(who, options.browsers) as url:
                        times.append(phase(bench, count, url))
        finally:
            bench.close()
            rclpy.try_shutdown()
    found = {who: np.concatenate(times) for who, times in parts.items()}
    p99 = {who: float(np.percentile(times, 99.0)) for who, times in found.items()}
    ratios = {who: each / p99[NOBODY] for who, each in p99.items()}
    many = {READERS: f"{options.browsers} readers", BROWSERS: f"{options.browsers} browsers"}
    rows = [
        (
            many.get(who, who),
            times.size,
            three(np.median(times)),
            three(p99[who]),
            f"{ratios[who]:.2f}",
            f"<= {TARGET:g}" if who == READERS else "",
            three(times.max()),
        )
        for who, times in found.items()
    ]
    titles = ("who looks", "samples", "median [ms]", "p99 [ms]", "p99 / nobody's", "target",
              "max [ms]")  # fmt: skip
    print(table(titles, rows))
    return 0 if ratios[READERS] <= TARGET or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
