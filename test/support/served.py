# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A page that is served from a thread of the test."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from analysed import analysed_once
from tornado.websocket import websocket_connect

from relay_autotune.recordings import read_experiments
from relay_autotune.report.case import case_of
from relay_autotune.result import Analysis
from relay_autotune.tuning.task import DesignOptions
from relay_autotune.web.address import Address
from relay_autotune.web.live import Live
from relay_autotune.web.server import Page, in_background
from relay_autotune.web.shape import DesignRequest, PageModel

REPOSITORY = Path(__file__).resolve().parents[2]
HOSTILE = "<img src=x onerror=\"document.title='taken'\"><script>document.title='taken'</script>"


@cache
def analysed(name: str = "unbiased_relay_with_noise") -> Analysis:
    """Return the analysis of a bag that comes with the package."""
    (record,) = read_experiments(REPOSITORY / "bags" / name).experiments
    return analysed_once(record)


def subject_of(analysis: Analysis, name: str = "a bag") -> PageModel:
    """Return what a page shows of an analysis."""
    shaping = analysis.shaping
    first = DesignRequest.of("robust", shaping.task.options if shaping else DesignOptions())
    return PageModel(case_of(analysis, name), shaping, first, lambda a: f"replay {a.ms}")


def hostile(subject: PageModel) -> PageModel:
    """Return the subject with markup for its name and its reason."""
    case = replace(subject.case, source=HOSTILE, reason=HOSTILE)
    return PageModel(case, subject.shaping, subject.first, lambda _: HOSTILE)


@contextmanager
def served(
    subjects: list[PageModel],
    address: Address | None = None,
    *,
    live: Live | None = None,
    lives: Sequence[Live] = (),
) -> Iterator[str]:
    """Serve a page, and yield what to open.

    :param subjects: what it shows.
    :param address: where it is served.
    :param live: the loop that is watched.
    :param lives: the loops, if there are several.
    """
    page = Page(
        subjects,
        address or Address(),
        [live] if live is not None else lives,
    )
    with in_background(page) as url:
        yield url


def conversation(url: str, *questions: object, headers: dict[str, str] | None = None) -> list:
    """Return what a page is told at first, and the answers to its questions.

    :param url: of the page.
    :param questions: each is sent as JSON, or as it is if it is text.
    :param headers: of the request.
    :return: documents; None at the end: the server closed the connection.
    """
    from tornado.httpclient import HTTPRequest

    async def talk() -> list:
        address = url.replace("http:", "ws:", 1).partition("?")[0] + "socket"
        socket = await websocket_connect(HTTPRequest(address, headers=headers or {}))
        heard = [json.loads(await socket.read_message())]
        for question in questions:
            text = question if isinstance(question, str) else json.dumps(question)
            await socket.write_message(text)
            while True:
                message = await asyncio.wait_for(socket.read_message(), 60.0)
                if message is None:
                    return [*heard, None]
                document = json.loads(message)
                if "answer" in document and "sketched" not in document["answer"]:
                    heard.append(document)
                    break
        socket.close()
        return heard

    return asyncio.run(talk())


class OpenPage:
    """A page that is open in a browser, as the server sees it, in a thread of its own.

    :param url: of the page.
    :param loop: number of the loop that it watches.
    """

    def __init__(self, url: str, loop: int = 0) -> None:
        self._number = loop
        self._address = url.replace("http:", "ws:", 1) + "socket"
        self.snapshot: dict[str, Any] = {}
        """What it received last of the loop."""
        self.shown: dict[str, Any] = {}
        """The figures that change seldom, by name."""
        self.samples: dict[str, list[float]] = {"measurement": [], "command": []}
        self.subjects: list[dict[str, Any]] = []
        self.ended = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._opened = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()
        assert self._opened.wait(30.0)

    def _run(self) -> None:
        self._loop.run_until_complete(self._listen())

    async def _listen(self) -> None:
        self._socket = await websocket_connect(self._address)
        self._opened.set()
        while (text := await self._socket.read_message()) is not None:
            message = json.loads(text)
            if message.get("loop", self._number) != self._number:
                continue
            self.snapshot = message.get("live", self.snapshot)
            self.shown |= message.get("shown", {})
            self.subjects = message.get("subjects", self.subjects)
            for name, (_, values) in message.get("samples", {}).items():
                self.samples[name] += values
        self.ended.set()

    @property
    def phase(self) -> str:
        """What the page says is going on."""
        return str(self.snapshot.get("phase", ""))

    def do(self, wish: str, **more: Any) -> None:
        """Wish something."""

        def send() -> None:
            self._socket.write_message(json.dumps({"do": wish, "loop": self._number, **more}))

        self._loop.call_soon_threadsafe(send)

    def plan(self, until: Callable[..., Any], wish: str = "start", **more: Any) -> dict[str, Any]:
        """Ask what a wish would do, and return the answer.

        :param until: waits for a condition.
        """
        number = self.snapshot["plan"]["number"] + 1
        self.do(wish, dry=number, **more)
        # A second wish on its way would be a second check, during which no tune can be started.
        until(lambda: self.snapshot["plan"]["number"] == number and self.phase == "idle", "a plan")
        return self.snapshot["plan"]

    def close(self) -> None:
        """Close the browser."""
        self._loop.call_soon_threadsafe(self._socket.close)
        assert self.ended.wait(30.0)
