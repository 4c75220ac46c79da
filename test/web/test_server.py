# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Who is served, with what, and what a page is told."""

import asyncio
import re
import socket
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import Request, urlopen

import pytest
from served import HOSTILE, conversation, hostile, served
from tornado.httpclient import HTTPClientError

from relay_autotune.errors import SelectionError
from relay_autotune.verdict import Judgement
from relay_autotune.web.address import Address, address_of
from relay_autotune.web.live import Live
from relay_autotune.web.server import Page, in_background
from relay_autotune.web.shape import DesignRequest, PageModel


def get(url: str, **headers: str):
    try:
        with urlopen(Request(url, headers=headers), timeout=60.0) as answer:
            return answer.status, dict(answer.headers), answer.read().decode()
    except HTTPError as error:
        return error.code, dict(error.headers), error.read().decode()


@pytest.mark.long
@pytest.mark.parametrize(
    "path",
    ["", "page.css", "page.js", "plot.js", "report.html?of=7", "gains/yaml", "nothing"],
)
def test_every_answer_forbids_what_is_foreign(url, path):
    _, headers, _ = get(url + path)
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self';" in policy
    assert "unsafe" not in policy
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "Server" not in headers


def test_the_page_has_no_script_or_style_of_its_own_and_names_no_other_server(url):
    _, _, text = get(url)
    assert "<style" not in text
    assert " style=" not in text
    assert " on" not in text.replace(" on the", "").replace(" one", "")
    assert text.count("<script") == text.count('<script type="module" src="page.js">') == 1
    for path in ("", "page.js", "plot.js", "page.css"):
        assert "//" not in get(url + path)[2].replace("http://www.w3.org/2000/svg", "").replace(
            '${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket', ""
        ).replace("\n//", "").replace("// ", "")
    script = get(url + "page.js")[2] + get(url + "plot.js")[2]
    for markup in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("):
        assert markup not in script


def test_what_is_not_there_is_not_found(url):
    assert get(url + "server.py")[0] == 404
    assert get(url + "gains/exe")[0] == 404
    assert get(url + "report.html?asked=%7B")[0] == 400
    assert get(url + "report.html?of=7")[0] == 400


def test_a_foreign_name_is_not_served(url):
    assert get(url, Host="tank.example:80")[0] == 403
    assert get(url, Host="localhost:8080")[0] == 200


def test_a_page_of_a_stranger_cannot_open_the_socket(url):
    with pytest.raises(HTTPClientError, match="403"):
        conversation(url, headers={"Origin": "http://tank.example"})


@pytest.mark.long
def test_the_socket_tells_everything_and_answers(url, subject):
    first, answer, refused = conversation(
        url,
        {"of": 0, "n": 7, "asked": {"ms": 1.6, "controller": "pi"}},
        {"of": 0, "n": 8, "asked": {"rule": "unstable"}},
    )
    assert first["subjects"][0]["name"] == "a bag"
    assert answer["n"] == 7
    shaped = subject.shaped(DesignRequest(controller="pi", ms=1.6))
    assert answer["answer"]["shaped"]["isa"][0][1] == f"{shaped.gains.kc:.4f}"
    assert "unstable" in refused["answer"]["refused"]


@pytest.mark.parametrize(
    "question", ["no json", "[]", "{}", '{"of": 3, "n": 1, "asked": {}}', '{"of": "0", "n": 1}',
                 {"of": 0, "n": 1, "asked": {"rule": "os.system"}}, "[" * 5000],
)  # fmt: skip
def test_a_question_that_cannot_be_ends_the_connection(url, question):
    assert conversation(url, question)[-1] is None


LONG = "9" * 400
WISHES = (
    '{"do": "start", "loop": 1e400}', '{"do": ["start"]}', '"do"', '["do"]', '{"do": "explode"}',
    '{"do": "apply", "of": -1}', f'{{"do": "verify", "step": {LONG}}}',
    '{"do": "verify", "step": NaN}', '{"do": "verify", "step": 1e300}',
    '{"do": "verify", "step": true}', '{"do": "apply", "asked": {"sample_period": 1e-300}}',
)  # fmt: skip


IMPOSSIBLE = ("1e300", "1e400", LONG, "-1", "NaN", "true", '"0.1"', "[]", "{}", "-1e-9")


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sample_period", "1e-300"),
        *product(("sample_period", "noise_share", "ms", "setpoint_weight"), IMPOSSIBLE),
    ],
)
def test_each_number_has_the_range_of_its_declaration(url, name, value, capfd):
    asked = f'{{"{name}": {value}}}'
    assert conversation(url, f'{{"of": 0, "n": 1, "asked": {asked}}}')[-1] is None
    assert get(f"{url}report.html?asked={quote(asked)}")[0] == 400
    assert capfd.readouterr().err == ""


@pytest.mark.long
@pytest.mark.parametrize("wish", WISHES)
def test_a_wish_that_cannot_be_ends_the_connection(subject, wish, capfd):
    live = Live("/relay_node")
    with served([subject], live=live) as url:
        assert conversation(url, wish, {"of": 0, "n": 1, "asked": {}})[-1] is None
    assert live.next_wish() is None
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "query", ["&".join(f"f{k}=1" for k in range(50)), f"of={LONG}", "of=%ff", "asked=%00", "of=-1"]
)
def test_a_query_that_cannot_be_is_no_defect(url, query, capfd):
    assert get(f"{url}report.html?{query}")[0] == 400
    assert get(f"{url}gains/yaml?{query}")[0] == 400
    assert capfd.readouterr().err == ""


@pytest.mark.long
def test_sockets_that_vanish_are_no_defect(url, capfd):
    host, port = url.removeprefix("http://").strip("/").split(":")
    for _ in range(20):
        with socket.create_connection((host, int(port))) as end:
            end.sendall(
                b"GET /socket HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
                b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n\x81\xff"
            )
            end.recv(10)
            # What was not read makes the end a reset.
            end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    assert get(url)[0] == 200
    assert capfd.readouterr().err == ""


@pytest.mark.nightly
def test_no_page_waits_for_the_question_of_another_one(subject):
    class Slow(PageModel):
        begun, over = threading.Event(), False

        def shaped(self, asked):
            while asked.ms == 2.0 and not self.over:
                self.begun.set()
                # leaves the processor to the question of the other page
                time.sleep(0.01)
            return super().shaped(asked)

    pi = {"controller": "pi"}
    slow = Slow(subject.case, subject.shaping, subject.first, subject.command)
    with served([slow]) as url, ThreadPoolExecutor() as pool:
        first = pool.submit(conversation, url, {"of": 0, "n": 1, "asked": {**pi, "ms": 2.0}})
        assert slow.begun.wait(60.0)
        answer = conversation(url, {"of": 0, "n": 2, "asked": {**pi, "ms": 1.5}})[1]
        assert answer["answer"]["shaped"]["ms"] <= 1.5
        assert not first.done()
        Slow.over = True
        assert "shaped" in first.result()[1]["answer"]


@pytest.mark.long
def test_five_pages_at_once_have_answers_of_their_own(url):
    async def all_of_them():
        asked = [
            {"of": 0, "n": k, "asked": {"ms": 1.3 + 0.1 * k, "controller": "pi"}} for k in range(5)
        ]
        return await asyncio.gather(*(asyncio.to_thread(conversation, url, a) for a in asked))

    found = [heard[1]["answer"]["shaped"]["ms"] for heard in asyncio.run(all_of_them())]
    assert found == sorted(found)
    assert len(set(found)) == 5


@pytest.mark.nightly
def test_gains_are_kept_in_a_file(url):
    status, headers, text = get(url + "gains/yaml?asked=%7B%22ms%22%3A1.6%7D")
    assert status == 200
    assert re.search(r"^kc: 0.8", text, re.MULTILINE)
    assert headers["Content-Disposition"] == 'attachment; filename="gains.yaml"'
    asked = quote('{"law": "simple_pid", "sample_period": 0.2}')
    status, headers, text = get(url + f"gains/simple_pid?asked={asked}")
    assert status == 200, text
    assert headers["Content-Disposition"] == 'attachment; filename="simple_pid.py"'
    assert "from simple_pid import PID" in text
    asked = quote('{"law": "iec_61131_3_pid", "sample_period": 0.2}')
    status, _, text = get(url + f"gains/iec_61131_3_pid?asked={asked}")
    assert status == 200, text


def test_the_report_has_the_gains_that_were_shaped(url, subject, monkeypatch):
    # its figures take seconds, and have tests of their own
    monkeypatch.setattr("relay_autotune.report.page.PLATES", ())
    status, _, text = get(url + "report.html?asked=%7B%22rule%22%3A%22simc%22%7D")
    assert status == 200
    assert "rule <code>simc</code>" in text
    assert "replay 1.4" in text


@pytest.mark.long
def test_doubtful_gains_are_written_only_when_they_are_accepted(subject, monkeypatch):
    finding = replace(subject.shaping.findings[0], result=1, sentence="the data drift", remedy="x")
    doubtful = PageModel(subject.case, subject.shaping, subject.first, subject.command)
    monkeypatch.setattr(
        type(subject.shaping), "judgement", lambda self, gains: Judgement((finding,))
    )
    with served([doubtful]) as url:
        asked = "gains/yaml?asked=" + quote('{"controller": "pi"}')
        status, _, text = get(url + asked)
        assert status == 409
        assert "doubtful" in text
        status, _, text = get(url + asked + "&accept_doubtful=yes")
        assert status == 200
        assert "the data drift" in text


def test_hostile_names_travel_as_text(subject):
    with served([hostile(subject)]) as url:
        (first,) = conversation(url)
        assert first["subjects"][0]["name"] == HOSTILE
        assert HOSTILE not in get(url)[2]


def test_another_address_needs_its_token(subject):
    address = Address("127.0.0.1", 0, "right")
    with served([subject], address) as url:
        assert url.endswith("/?token=right")
        base = url.partition("?")[0]
        for wrong in ("", "?token=wrong", "?token="):
            assert get(base + wrong)[0] == 403
        for path in ("page.js", "report.html", "gains/yaml"):
            assert get(base + path)[0] == 403
        with pytest.raises(HTTPClientError, match="403"):
            conversation(base)
        port = base.rsplit(":")[-1].strip("/")
        cookie = f"relay_autotune_{port}=right"
        assert get(base, Cookie=cookie)[0] == 200
        assert conversation(base, headers={"Cookie": cookie})[0]["subjects"]
        assert get(base, Cookie=cookie + "x")[0] == 403


def test_the_token_does_not_stay_in_the_address(subject):
    with served([subject], Address("127.0.0.1", 0, "right")) as url:
        import http.client

        port = int(url.partition("?")[0].rsplit(":")[-1].strip("/"))
        connection = http.client.HTTPConnection("127.0.0.1", port)
        connection.request("GET", "/?token=right")
        answer = connection.getresponse()
        assert answer.status == 302
        assert answer.headers["Location"] == "/"
        assert "HttpOnly" in answer.headers["Set-Cookie"]
        assert "SameSite=Strict" in answer.headers["Set-Cookie"]


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [("127.0.0.1", "127.0.0.1", 0), ("localhost:8080", "localhost", 8080), ("[::1]:9", "::1", 9)],
)
def test_a_loopback_address_needs_no_token(text, host, port):
    assert address_of(text) == Address(host, port)


def test_every_other_address_gets_a_token_of_its_own():
    first, second = address_of("0.0.0.0:8080"), address_of("0.0.0.0:8080")
    assert len(first.token) >= 20
    assert first.token != second.token
    assert first.token not in repr(first)
    assert f"?token={first.token}" in first.url(8080)


def test_the_address_of_all_interfaces_is_told_as_another_machine_reaches_it(subject):
    address = address_of("0.0.0.0")
    with served([subject], address) as url:
        base = url.partition("?")[0]
        port = base.rsplit(":")[-1].strip("/")
        assert get(base, Cookie=f"relay_autotune_{port}={address.token}")[0] == 200
        assert get(base)[0] == 403
        assert socket.inet_aton(base.split("/")[2].partition(":")[0]) != bytes(4)


@pytest.mark.parametrize("text", ["", ":80", "a b", "host:port", "1.2.3.4:99999", "x/y", "a@b"])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(SelectionError, match="not an address"):
        address_of(text)


def test_an_address_that_is_taken_is_refused_in_one_line(url, subject):
    port = int(url.rsplit(":")[-1].strip("/"))
    page = Page([subject], Address("127.0.0.1", port))
    with pytest.raises(SelectionError, match="--web-address"), in_background(page):
        pass
