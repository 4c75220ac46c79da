# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Latency of relay_node in the midst of a tune, without a page and with some looking at it.

Usage, after `. ./env.sh`:

    python3 benchmarks/page_load.py [--seconds 60] [--rate 100] [--phases 6] [--browsers 5]
                                    [--quick]

The sender, relay_node and the clock are those of `latency.py`. Phases take turns, so that all meet
the same machine: nobody looks; `tune_loop --web` runs, and no page is open; readers have the page,
which take every frame and draw nothing, as browsers on other machines; as many windows of a
headless Chromium on this machine draw measurement and command as they come. Readers, and in one
of two kinds of phases the browsers, get only time that nobody else wants (the policy SCHED_IDLE).
The processor time is that of `tune_loop`, and of those who look. The table is Markdown; the exit
status is 1 if the target is missed with readers. With --quick a few seconds are run and the status
is 0.
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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
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
NOBODY, CLOSED, READERS = "nobody", "the page, not open", "{} readers"
GUESTS, BROWSERS = "{} browsers, in time that is left", "{} browsers"
# Begins a command that gets only time that nobody else wants.
GUEST = ("chrt", "--idle", "0")


@dataclass(frozen=True)
class Looked:
    """A page that is looked at.

    :param url: of the page.
    :param processes: that which serves it, and the first of those who look; 0: there is none.
    """

    url: str
    processes: tuple[int, int]


@contextlib.contextmanager
def looked_at(who: str, count: int) -> Iterator[Looked]:
    """Serve the page of the loop, and let somebody look.

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
        with LOOK[who](found[1], count) as first:
            yield Looked(found[1], (command.pid, first))
    finally:
        command.terminate()
        command.wait(20)


@contextlib.contextmanager
def unopened(_url: str, _count: int) -> Iterator[int]:
    """Open nothing."""
    yield 0


@contextlib.contextmanager
def read_by(url: str, count: int) -> Iterator[int]:
    """Let a process read all that open pages are told."""
    this = [*GUEST, sys.executable, __file__, "--role", "read", "--browsers", str(count), url]
    reader = subprocess.Popen(this, stdout=subprocess.PIPE, text=True)
    try:
        assert reader.stdout is not None
        reader.stdout.readline()
        yield reader.pid
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
def drawn_by(url: str, count: int, before: Sequence[str] = ()) -> Iterator[int]:
    """Let windows of a browser draw what comes."""
    profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
    with profile as folder, Chromium(Path(folder), before) as browser:
        for _ in range(count):
            browser.tab(url).wait("document.body.dataset.phase === 'idle'")
        yield browser.pid


LOOK: dict[str, Callable[[str, int], contextlib.AbstractContextManager[int]]] = {
    CLOSED: unopened,
    READERS: read_by,
    GUESTS: partial(drawn_by, before=GUEST),
    BROWSERS: drawn_by,
}


def used(first: int) -> float:
    """Return the processor time that a process and all that it has started have used [s]."""
    listed = subprocess.run(["ps", "-e", "-o", "pid=,ppid="], capture_output=True, text=True)
    pairs = [tuple(map(int, line.split())) for line in listed.stdout.splitlines()]
    found = [first] * (first > 0)
    for parent in found:
        found += [child for child, of in pairs if of == parent]
    ticks = 0
    for process in found:
        with contextlib.suppress(FileNotFoundError):
            fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


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
    bench.until(lambda: page.phase == phase and page.snapshot["state"], 20.0, what)
    page.close()


def phase(bench: Bench, count: int, page: Looked) -> tuple[np.ndarray, np.ndarray]:
    """Run one phase with a page on which the tune is started.

    :param bench: with the loop.
    :param count: of the measurements.
    :param page: the page.
    :return: latencies [ms], and the processor time of its processes as parts of one processor.
    """
    bench.send("tuned", 1)
    wish(bench, page.url, "start", "tuning")
    first, begun = len(bench.arrived["tuned"]), time.monotonic()
    before = np.array([used(each) for each in page.processes])
    sent = bench.send("tuned", count)
    arrived = np.array(bench.arrived["tuned"][first:][:count])
    spent = np.array([used(each) for each in page.processes]) - before
    spent /= time.monotonic() - begun
    wish(bench, page.url, "abort", "idle")
    return (arrived - sent[: arrived.size]) * 1e-6, spent


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each of the five [s]")
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
    parts: dict[str, list[np.ndarray]] = {who: [] for who in (NOBODY, *LOOK)}
    times_used: dict[str, list[np.ndarray]] = {who: [] for who in LOOK}
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
                        times.append(bench.phase("tuned", count)[0])
                        continue
                    with looked_at(who, options.browsers) as page:
                        found, spent = phase(bench, count, page)
                    times.append(found)
                    times_used[who].append(spent)
        finally:
            bench.close()
            rclpy.try_shutdown()
    latencies = {who: np.concatenate(times) for who, times in parts.items()}
    p99 = {who: float(np.percentile(times, 99.0)) for who, times in latencies.items()}
    ratios = {who: each / p99[NOBODY] for who, each in p99.items()}

    def processors(who: str) -> list[str]:
        parts_used = np.mean(times_used[who], axis=0) if who in LOOK else np.zeros(2)
        return [f"{100.0 * part:.0f} %" if part else "" for part in parts_used]

    rows = [
        (
            who.format(options.browsers),
            times.size,
            three(np.median(times)),
            three(p99[who]),
            f"{ratios[who]:.2f}",
            f"<= {TARGET:g}" if who == READERS else "",
            three(times.max()),
            *processors(who),
        )
        for who, times in latencies.items()
    ]
    titles = ("who looks", "samples", "median [ms]", "p99 [ms]", "p99 / nobody's", "target",
              "max [ms]", "tune_loop", "those who look")  # fmt: skip
    print(table(titles, rows))
    return 0 if ratios[READERS] <= TARGET or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
