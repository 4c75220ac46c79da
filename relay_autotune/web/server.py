# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The server of the page: a few files, a socket for what is asked, and files to keep."""

from __future__ import annotations

import asyncio
import json
import logging
import mimetypes
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from http import HTTPStatus
from importlib.resources import files
from socket import socket
from threading import Event, Lock, Thread
from typing import Any
from urllib.parse import parse_qs

from tornado.httpserver import HTTPServer
from tornado.ioloop import PeriodicCallback
from tornado.iostream import StreamClosedError
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from relay_autotune.errors import RelayAutotuneError, SelectionError, TuningError, defect
from relay_autotune.exchange.export import EXPORTS, exported, exports_of, file_name
from relay_autotune.loop.laws import LAWS
from relay_autotune.report.page import page as report_page
from relay_autotune.report.page import style_sheet
from relay_autotune.text import in_units, visible
from relay_autotune.web import wire
from relay_autotune.web.address import Address
from relay_autotune.web.live import Live, PageCommand
from relay_autotune.web.shape import DesignRequest, PageModel, asked_of
from relay_autotune.web.worker import Worker, yield_to_nodes

_STATIC = ("page.html", "page.css", "page.js", "plot.js", "plan.js", "live.js")
# No script, style or connection but those of this server, and no page around ours.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_LARGEST_QUESTION = 1 << 16
# How long open pages may take to hear of the end [s].
_ENDS_WITHIN = 5.0
# Interval of the news that pages get without asking [s].
_EVERY = 0.5
# Interval of samples [s]; the eye sees no more, and relay_node needs the processor.
_LIVE_EVERY = 0.04
# Priority of the thread; one that ends a tune has to be heard on a busy machine, too.
_NICE = 5
# Time after which a report or a model makes way for another one [s]: each takes seconds.
_SLOW = 10.0
# What did not end so often while nothing was asked is not begun again unasked.
_MOST_BEGUN = 3
# Answers that are kept; the oldest is dropped first.
_MOST_KEPT = 2000


class Page:
    """All that a page shows, with the answers that are known.

    :param subjects: the models, at least one.
    :param address: where it is served.
    :param lives: the loops that are watched; empty: it shows models alone.
    """

    def __init__(
        self,
        subjects: Sequence[PageModel],
        address: Address,
        lives: Sequence[Live] = (),
    ) -> None:
        self.subjects: list[PageModel] = []
        self.revision = 0
        """Number of changes of what is shown of the models."""
        self.address = address
        self.lives = tuple(lives)
        self.units: Mapping[str, str] = {}
        """What y and u stand for."""
        self._known: dict[tuple[int, DesignRequest], str] = {}
        self._last: dict[int, DesignRequest] = {}
        self._begun: Counter[tuple[int, DesignRequest]] = Counter()
        self._adding = Lock()
        self.open: set[_Socket] = set()
        """Connections of the pages that are open."""
        self.worker = Worker(self._next_ahead)
        """Computes what is asked; what the page shows first, at once."""
        self.sketches = Worker()
        self.slow = Worker(turn=_SLOW, longest=6.0 * _SLOW)
        """Computes what takes seconds: reports, and models."""
        for subject in subjects:
            self.add(subject)

    def add(self, subject: PageModel) -> int:
        """Show another model; what the page shows of it first is computed at once.

        :param subject: the model.
        :return: its number on the page.
        """
        with self._adding:
            self.subjects.append(subject)
            number = len(self.subjects) - 1
        self.changed()
        if subject.shaping is not None:
            self.worker.ask(partial(self.answer, number, subject.first))
        return number

    def changed(self) -> None:
        """Tell all pages what is shown of the models."""
        self.revision += 1

    def _next_ahead(self) -> Callable[[], object] | None:
        """Return what to compute ahead: what the slider can ask for next, once somebody asked."""
        # relay_node needs the processor while a tune runs.
        if any(live.snapshot.phase != "idle" for live in self.lives):
            return None
        for number, last in list(self._last.items()):
            for asked in self.subjects[number].positions(last):
                key = number, asked
                if key not in self._known and self._begun[key] < _MOST_BEGUN:
                    self._begun[key] += 1
                    return partial(self.answer, number, asked)
        return None

    def question(self, number: object, given: object) -> tuple[int, DesignRequest]:
        """Return the model and what is asked for, from what a page has sent.

        :param number: of the model.
        :param given: what is asked for, as JSON was read.
        :raises TuningError: if there is no such model, or a value is out of its range.
        """
        if not (isinstance(number, int) and 0 <= number < len(self.subjects)):
            raise TuningError("there is no such experiment")
        return number, asked_of(given)

    def known(self, number: int, asked: DesignRequest) -> str | None:
        """Return the answer to what a page asks, as JSON; None: it has to be computed.

        :param number: of the model.
        :param asked: what is asked for.
        """
        if self.subjects[number].shaping is not None:
            self._last[number] = asked
        return self._known.get((number, asked))

    def sketch(self, number: int, asked: DesignRequest) -> str | None:
        """Return gains that come near to what is asked for; None: too little is known.

        :param number: of the model.
        :param asked: what is asked for.
        """
        subject = self.subjects[number]
        try:
            shaped = subject.sketched(asked)
        except Exception:  # noqa: BLE001  the exact answer says what is wrong
            return None
        if shaped is None:
            return None
        return wire.to_text({"sketched": wire.of_shaped(subject, shaped)})

    def answer(self, number: int, asked: DesignRequest) -> str:
        """Return the answer to what a page asks, as JSON.

        :param number: of the model.
        :param asked: what is asked for.
        """
        known = self._known.get((number, asked))
        if known is not None:
            return known
        subject = self.subjects[number]
        try:
            shaped = subject.shaped(asked)
            exports = {"exports": list(exports_of(shaped.gains.law))}
            answer = wire.to_text({"shaped": wire.of_shaped(subject, shaped) | exports})
        except RelayAutotuneError as error:
            answer = _refused(error)
        except Exception as error:  # noqa: BLE001  a defect must not leave the page waiting
            answer = wire.to_text({"refused": defect(error)})
        return self.keep(number, asked, answer)

    def keep(self, number: int, asked: DesignRequest, answer: str) -> str:
        """Keep the answer to what a page asks, and return it.

        :param number: of the model.
        :param asked: what was asked for.
        :param answer: as JSON.
        """
        if len(self._known) >= _MOST_KEPT:
            self._known.pop(next(iter(self._known)))
        self._known[number, asked] = answer
        return answer

    def tend(self) -> None:
        """Stop what computes for too long; to be called now and then."""
        for worker in (self.worker, self.sketches, self.slow):
            worker.tend()

    def close(self) -> None:
        """Compute nothing more."""
        for worker in (self.worker, self.sketches, self.slow):
            worker.close()

    def everything(self) -> str:
        """Return what a page shows whatever is asked, as JSON."""
        subjects = [wire.of_subject(subject) for subject in self.subjects]
        return wire.to_text({"subjects": subjects, "laws": ["", *LAWS], "units": dict(self.units)})

    def tell_news(self) -> None:
        """Tell all open pages what is new of the loops that are watched."""
        for number, live in enumerate(self.lives):
            news = live.news()
            if news is not None:
                text = wire.to_text({"loop": number} | news)
                for connection in list(self.open):
                    connection.tell(text)


class _Guarded(RequestHandler):
    """Answer those who may ask, and allow nothing foreign in what is answered."""

    def initialize(self, page: Page) -> None:
        """Take the page."""
        self.page = page

    def set_default_headers(self) -> None:
        """Forbid all that the page does not need."""
        self.set_header("Content-Security-Policy", _POLICY)
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("Cache-Control", "no-store")
        self.clear_header("Server")

    def prepare(self) -> None:
        """Refuse a request under a foreign name, or without the token."""
        address = self.page.address
        if not address.admits_host(self.request.headers.get("Host", "")):
            raise HTTPError(HTTPStatus.FORBIDDEN, reason="This page is not served by that name")
        if not address.token:
            return
        given = self.get_query_argument("token", "")
        if not address.admits_token(given or self.get_cookie(self._cookie) or ""):
            raise HTTPError(
                HTTPStatus.FORBIDDEN, reason="Open the address that the command has printed"
            )
        if given:
            self.set_cookie(self._cookie, given, httponly=True, samesite="Strict")

    @property
    def _cookie(self) -> str:
        # Browsers share cookies between the ports of a machine.
        port = self.request.host.rpartition(":")[2]
        return f"relay_autotune_{port if port.isdecimal() else 80}"

    def write_error(self, status_code: int, **_: Any) -> None:
        """Answer with one line of text."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code}: {self._reason}\n")

    def subject_and_asked(self) -> tuple[PageModel, DesignRequest]:
        """Return the model and what is asked for, from the request's query."""
        try:
            given = parse_qs(self.request.query, max_num_fields=10)
            fields = _read(given.get("asked", ["{}"])[0])
            number, asked = self.page.question(int(given.get("of", ["0"])[0]), fields)
        except (ValueError, RecursionError) as error:
            raise HTTPError(HTTPStatus.BAD_REQUEST, reason="Not understood") from error
        return self.page.subjects[number], asked

    async def send(self, worker: Worker, written: Callable[[], str], kind: str, name: str) -> None:
        """Answer with a file to keep.

        :param worker: computes it.
        :param written: returns what stands in it.
        :param kind: of text.
        :param name: of the file.
        """
        try:
            text = await asyncio.wrap_future(worker.ask(written))
        except RelayAutotuneError as error:
            raise HTTPError(HTTPStatus.CONFLICT, reason=_one_line(error)) from error
        self.set_header("Content-Type", f"text/{kind}; charset=utf-8")
        self.set_header("Content-Disposition", f'attachment; filename="{name}"')
        self.finish(text)


class _Static(_Guarded):
    """The page itself, its script and its look."""

    def get(self, name: str) -> None:
        """Answer with a file."""
        name = name or "page.html"
        if name == "favicon.ico":
            self.set_status(HTTPStatus.NO_CONTENT)
            return
        if name not in _STATIC:
            raise HTTPError(HTTPStatus.NOT_FOUND)
        if name == "page.html" and self.get_query_argument("token", ""):
            # The token does not stay in the address bar, nor in a bookmark that is passed on.
            self.redirect("/")
            return
        text = (files("relay_autotune.web") / "static" / name).read_text(encoding="utf-8")
        if name == "page.css":
            text = f"{style_sheet()}\n{text}"
        kind = mimetypes.guess_type(name)[0] or "text/plain"
        self.set_header("Content-Type", f"{kind}; charset=utf-8")
        self.finish(text)


class _Report(_Guarded):
    """The report with the gains that are asked for, as one file."""

    async def get(self) -> None:
        """Answer with the report."""
        subject, asked = self.subject_and_asked()

        def written() -> str:
            if subject.shaping is None:
                return report_page([subject.case])
            return report_page([subject.case_with(subject.shaped(asked))])

        # Figures take seconds to draw, for which the slider must not wait.
        await self.send(self.page.slow, written, "html", "tune.html")


class _Export(_Guarded):
    """The gains in a file that another program loads."""

    async def get(self, name: str) -> None:
        """Answer with the file."""
        if name not in EXPORTS:
            raise HTTPError(HTTPStatus.NOT_FOUND)
        subject, asked = self.subject_and_asked()
        accepts = self.get_query_argument("accept_doubtful", "") == "yes"

        def written() -> str:
            shaped = subject.shaped(asked)
            if name not in exports_of(shaped.gains.law):
                raise HTTPError(HTTPStatus.NOT_FOUND)
            doubt = shaped.judgement.reason
            if doubt and not accepts:
                raise TuningError("these gains are doubtful, and were not accepted")
            return exported(shaped.gains, name, subject.target, doubt=doubt)

        await self.send(self.page.worker, written, "plain", file_name(name))


class _Socket(_Guarded, WebSocketHandler):
    """What one open page asks, and what it is sent."""

    def open(self, *_: str, **__: str) -> None:
        """Tell the page everything, and from then on what is new."""
        self.set_nodelay(True)
        self._sent: dict[int, tuple[DesignRequest, int]] = {}
        self._asked: dict[int, DesignRequest] = {}
        self._waits: asyncio.Task[None] | None = None
        self._shown = 0
        # Everything includes what is new until now.
        self.page.tell_news()
        for number, live in enumerate(self.page.lives):
            self.tell(wire.to_text({"loop": number} | live.everything()))
        self.page.open.add(self)
        self._tell_subjects()
        self._news = PeriodicCallback(self._tell_news, 1000.0 * _EVERY)
        self._news.start()

    def tell(self, text: str) -> None:
        """Send a message; a page that has just gone misses it.

        :param text: JSON.
        """
        with suppress(WebSocketClosedError):
            self.write_message(in_units(text, self.page.units))

    def _tell_subjects(self) -> None:
        self._shown = self.page.revision
        self.tell(self.page.everything())

    def on_close(self) -> None:
        """Stop telling."""
        self.page.open.discard(self)
        self._news.stop()
        if self._waits is not None:
            self._waits.cancel()

    async def on_message(self, message: str | bytes) -> None:
        """Answer what the page asks."""
        begun = time.perf_counter()
        try:
            question = _read(message)
            if self.page.lives and "do" in question:
                loop = question.get("loop", 0)
                if not (isinstance(loop, int) and 0 <= loop < len(self.page.lives)):
                    raise TuningError("there is no such loop")
                if refused := self.page.lives[loop].wish(self._wish(question)):
                    self.tell(wire.to_text({"loop": loop, "refused": refused}))
                return
            count = question["n"]
            number, asked = self.page.question(question["of"], question["asked"])
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
            self.close(1008, "not understood")
            return
        head = {"of": number, "n": count if isinstance(count, int) else 0}
        self._asked[number] = asked
        if self._waits is not None:
            # The page shows the newest answer alone.
            self._waits.cancel()
        known = self.page.known(number, asked)
        if known is not None:
            self._tell_answer(head, known, begun)
            return
        self._waits = asyncio.create_task(self._sketch_and_answer(head, asked, begun))

    async def _sketch_and_answer(
        self, head: dict[str, int], asked: DesignRequest, begun: float
    ) -> None:
        """Tell gains that come near, then the exact ones."""
        # One after the other, since both threads would only hold each other up.
        number = head["of"]
        with suppress(RelayAutotuneError):
            work = partial(self.page.sketch, number, asked)
            sketch = await asyncio.wrap_future(self.page.sketches.ask(work))
            if sketch is not None:
                self._tell_answer(head, sketch, begun)
        try:
            exact = partial(self.page.answer, number, asked)
            answer = await asyncio.wrap_future(self.page.worker.ask(exact))
        except RelayAutotuneError as error:
            answer = self.page.keep(number, asked, _refused(error))
        self._tell_answer(head, answer, begun)

    def _tell_answer(self, head: dict[str, int], answer: str, begun: float) -> None:
        took = round(1000.0 * (time.perf_counter() - begun), 3)
        self.tell(f'{wire.to_text(head | {"took": took})[:-1]},"answer":{answer}}}')

    def _wish(self, question: dict[str, Any]) -> PageCommand:
        of, asked = question.get("of", 0), question.get("asked")
        if not isinstance(of, int):
            raise TuningError("there is no such wish")
        return PageCommand(
            question["do"],
            of,
            None if asked is None else asked_of(asked),
            question.get("step", 0.0),
            question.get("accept_doubtful") is True,
            dict(question.get("settings", {})),
            question.get("dry", 0),
        )

    def _tell_news(self) -> None:
        if self._shown != self.page.revision:
            self._tell_subjects()
        for number, subject in enumerate(self.page.subjects):
            asked = self._asked.get(number, subject.first).apart_from_ms
            known = wire.of_trade_off(subject, asked)
            if (asked, len(known)) != self._sent.get(number):
                self._sent[number] = asked, len(known)
                self.tell(wire.to_text({"of": number, "trade_off": known}))


def _read(text: str | bytes) -> Any:
    """Return what JSON says; NaN and the like are no numbers of it."""
    return json.loads(text, parse_constant=_no_number)


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _refused(error: Exception) -> str:
    return wire.to_text({"refused": visible(str(error))})


def _one_line(error: Exception) -> str:
    # A reason stands in the head of the answer, which is in Latin letters.
    return visible(str(error)).encode("ascii", "replace").decode()[:300]


def application(page: Page) -> Application:
    """Return what answers requests.

    :param page: what is shown.
    """
    given = {"page": page}
    return Application(
        [
            (r"/socket", _Socket, given),
            (r"/report.html", _Report, given),
            (r"/gains/([a-z0-9_]+)", _Export, given),
            (r"/([a-z.]*)", _Static, given),
        ],
        websocket_max_message_size=_LARGEST_QUESTION,
        websocket_ping_interval=20,
        log_function=lambda _: None,
    )


class _OneLine(logging.Formatter):
    """What the libraries of the server log, in which a request may be quoted, as one line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        said = visible(record.getMessage().partition("\n")[0])
        error = record.exc_info[1] if record.exc_info else None
        return said if error is None else f"{said}: {defect(error)}"


def _is_news(record: logging.LogRecord) -> bool:
    """Return whether something else is logged than that a page has gone."""
    gone = (WebSocketClosedError, StreamClosedError, ConnectionError)
    return not (record.exc_info and isinstance(record.exc_info[1], gone))


def _log_in_lines() -> None:
    """Let the libraries of the server log single lines, in which text of others is visible."""
    lines = logging.StreamHandler()
    lines.setFormatter(_OneLine())
    lines.setLevel(logging.WARNING)
    lines.addFilter(_is_news)
    for name in ("tornado", "asyncio"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [lines], False


async def _serve(page: Page, sockets: Sequence[socket]) -> None:
    """Serve a page until the task is cancelled.

    :param page: what is shown.
    :param sockets: that listen for browsers.
    """
    yield_to_nodes(_NICE)
    _log_in_lines()
    server = HTTPServer(application(page), max_body_size=_LARGEST_QUESTION)
    server.add_sockets(sockets)
    regular = [
        PeriodicCallback(work, 1000.0 * _LIVE_EVERY) for work in (page.tell_news, page.tend)
    ]
    for each in regular:
        each.start()
    with suppress(asyncio.CancelledError):
        await asyncio.Event().wait()
    page.tell_news()
    for each in regular:
        each.stop()
    page.close()
    server.stop()
    for connection in list(page.open):
        connection.close(1001, "the command has ended")
    await server.close_all_connections()


@contextmanager
def in_background(page: Page) -> Iterator[str]:
    """Serve a page from a thread, and yield what to open.

    :param page: what is shown.
    :raises SelectionError: if the address cannot be used.
    """
    address = page.address
    try:
        sockets = bind_sockets(address.port, address.host)
    except OSError as error:
        raise SelectionError(
            f"the page cannot be served on {address.host}:{address.port}: {error.strerror}; "
            "name another with --web-address"
        ) from error
    loop = asyncio.new_event_loop()
    task = loop.create_task(_serve(page, sockets))
    # It ends with the process also where this block is left by a second Ctrl-C.
    thread = Thread(target=loop.run_until_complete, args=(task,), name="server", daemon=True)
    thread.start()
    try:
        yield address.url(sockets[0].getsockname()[1])
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(_ENDS_WITHIN)


def run(page: Page, tell: Callable[[str], None]) -> None:
    """Serve a page until Ctrl-C.

    :param page: what is shown.
    :param tell: called with the address to open.
    :raises SelectionError: if the address cannot be used.
    """
    with in_background(page) as url, suppress(KeyboardInterrupt):
        tell(url)
        Event().wait()
