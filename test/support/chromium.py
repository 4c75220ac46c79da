# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A headless Chromium that tests drive by its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.request import urlopen

from tornado.websocket import websocket_connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--hide-scrollbars", "--remote-debugging-port=0", "about:blank"),
)
_STARTS_WITHIN, _ANSWERS_WITHIN = 60.0, 30.0


def found() -> str | None:
    """Return the Chromium of this machine; None: there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Chromium:
    """A browser with a new, empty profile.

    :param profile: an empty folder for it.
    :param before: words of a command that starts it, such as nice.
    """

    def __init__(self, profile: Path, before: Sequence[str] = ()) -> None:
        program = found()
        assert program is not None, "no Chromium found"
        self._process = subprocess.Popen(
            [*before, program, f"--user-data-dir={profile}", *_FLAGS],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        file, deadline = profile / "DevToolsActivePort", time.monotonic() + _STARTS_WITHIN
        while not (file.exists() and file.read_text().count("\n")):
            assert time.monotonic() < deadline, "Chromium has not started"
            time.sleep(0.02)
        self._port = int(file.read_text().split()[0])
        self._loop = asyncio.new_event_loop()
        self._tabs: list[Tab] = []

    @property
    def pid(self) -> int:
        """The process that has started all others."""
        return self._process.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for tab in self._tabs:
            tab.close()
        self._loop.close()
        self._process.terminate()
        self._process.wait(_ANSWERS_WITHIN)

    def tab(self, url: str = "") -> Tab:
        """Open a window of its own, since one behind another draws nothing.

        :param url: what it shows.
        """
        with urlopen(f"http://127.0.0.1:{self._port}/json/version") as answer:
            browser = json.load(answer)["webSocketDebuggerUrl"]
        made = Tab(self._loop, browser)
        self._tabs.append(made)
        target = made.call("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        made.connect(re.sub(r"/devtools/.*", f"/devtools/page/{target}", browser))
        if url:
            made.go(url)
        return made


class Tab:
    """One tab.

    :param loop: on which its connection runs.
    :param url: of the connection.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, url: str) -> None:
        self._loop = loop
        self._numbers = itertools.count(1)
        self.said: list[str] = []
        """Errors and warnings on the console, such as of the content security policy."""
        self._connection = self._run(lambda: websocket_connect(url, max_message_size=1 << 28))

    def connect(self, url: str) -> None:
        """Talk to another target from now on."""
        self.close()
        self._connection = self._run(lambda: websocket_connect(url, max_message_size=1 << 28))
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def close(self) -> None:
        """End the connection."""

        async def closed() -> None:
            self._connection.close()

        self._run(closed)

    def _run(self, begin: Callable[[], Any]) -> Any:
        async def awaited() -> Any:
            return await asyncio.wait_for(begin(), _ANSWERS_WITHIN)

        return self._loop.run_until_complete(awaited())

    def call(self, method: str, **parameters: Any) -> Any:
        """Return the answer to a command of the protocol."""
        number = next(self._numbers)
        text = json.dumps({"id": number, "method": method, "params": parameters})
        self._run(lambda: self._connection.write_message(text))
        while True:
            message = json.loads(self._run(self._connection.read_message))
            self._note(message)
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]

    def _note(self, message: dict[str, Any]) -> None:
        method, told = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.said.append(str(told["exceptionDetails"].get("exception", told)))
        elif method == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.said.append(told["entry"]["text"])

    def go(self, url: str) -> None:
        """Open an address."""
        self.call("Page.navigate", url=url)
        self.wait("document.readyState === 'complete'")

    def eval(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; a promise is awaited."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def text(self, selector: str) -> str:
        """Return the text of an element as it is shown."""
        return str(self.eval(f"document.querySelector({json.dumps(selector)})?.innerText ?? ''"))

    def wait(self, expression: str, seconds: float = 60.0) -> None:
        """Wait until an expression is true.

        :param expression: JavaScript.
        :param seconds: longest wait.
        """
        self.until(
            lambda: self.eval(f"!!(document.readyState === 'complete' && ({expression}))"),
            expression,
            seconds,
        )

    def until(self, holds: Callable[[], Any], what: str, seconds: float = 60.0) -> Any:
        """Return a value once it is true."""
        deadline = time.monotonic() + seconds
        while not (value := holds()):
            shown = "document.body && document.body.innerText.slice(0, 600)"
            assert time.monotonic() < deadline, (
                f"{what} within {seconds} s; shown: {self.eval(shown)}"
            )
            time.sleep(0.05)
        return value

    def click(self, selector: str) -> None:
        """Click on the middle of an element, as a hand with a mouse does."""
        name = json.dumps(selector)
        self.eval(f"document.querySelector({name}).scrollIntoView({{block: 'center'}})")
        box = self.eval(
            f"(() => {{const b = document.querySelector({name}).getBoundingClientRect();"
            "return [b.x + b.width / 2, b.y + b.height / 2];})()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call(
                "Input.dispatchMouseEvent",
                type=kind, x=box[0], y=box[1], button="left", clickCount=1,
            )  # fmt: skip

    def press(self, key: str, code: int, text: str = "") -> None:
        """Press a key.

        :param key: its name, such as ArrowRight.
        :param code: its virtual key code.
        :param text: what it types.
        """
        more = {"text": text} if text else {}
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind, key=key, code=key, windowsVirtualKeyCode=code, **more,
            )  # fmt: skip

    def size(self, width: int, height: int, *, dark: bool = False) -> None:
        """Set the size of the window, and the colours that its user prefers."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip
        scheme = "dark" if dark else "light"
        self.call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": scheme}],
        )

    def picture(self, path: Path) -> None:
        """Write what the window shows as a PNG."""
        self.call("Page.bringToFront")
        answer = self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(answer["data"]))
