# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A page that is served from a thread of the test."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

from tornado.websocket import websocket_connect

from relay_autotune.analysis import Analysis, analyse
from relay_autotune.bag.reader import read_experiments
from relay_autotune.report.case import case_of
from relay_autotune.web.address import Address
from relay_autotune.web.server import Page, serve
from relay_autotune.web.shape import Asked, Subject

REPOSITORY = Path(__file__).resolve().parents[2]
HOSTILE = "<img src=x onerror=\"document.title='taken'\"><script>document.title='taken'</script>"


@cache
def analysed(name: str = "unbiased_relay_with_noise") -> Analysis:
    """Return the analysis of a bag that comes with the package."""
    (record,) = read_experiments(REPOSITORY / "bags" / name).experiments
    return analyse(record)


def subject_of(analysis: Analysis, name: str = "a bag") -> Subject:
    """Return what a page shows of an analysis."""
    return Subject(case_of(analysis, name), analysis.shaping, Asked(), lambda a: f"replay {a.ms}")


def hostile(subject: Subject) -> Subject:
    """Return the subject with markup for its name and its reason."""
    case = replace(subject.case, source=HOSTILE, reason=HOSTILE)
    return Subject(case, subject.shaping, subject.first, lambda _: HOSTILE)


@contextmanager
def served(
    subjects: list[Subject], address: Address | None = None, *, ahead: bool = False
) -> Iterator[str]:
    """Serve a page, and yield what to open.

    :param subjects: what it shows.
    :param address: where it is served.
    :param ahead: whether what the slider may ask for is computed in between.
    """
    page = Page(
        subjects,
        ("yaml",),
        lambda gains, how, doubt: f"{how} {gains.kc:.6g} {doubt}\n",
        address or Address(),
    )
    if not ahead:
        page.foresee = lambda: None  # type: ignore[method-assign]
    loop, told, urls = asyncio.new_event_loop(), threading.Event(), []

    def tell(url: str) -> None:
        urls.append(url)
        told.set()

    async def until_cancelled() -> None:
        try:
            await serve(page, tell)
        except asyncio.CancelledError:
            return

    task = loop.create_task(until_cancelled())
    thread = threading.Thread(target=loop.run_until_complete, args=(task,))
    thread.start()
    try:
        assert told.wait(30.0)
        yield urls[0]
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()


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
                if "answer" in document:
                    heard.append(document)
                    break
        socket.close()
        return heard

    return asyncio.run(talk())
