# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What pages are told of a running loop, and what they can wish."""

import asyncio
import json
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from analysed import analysed_once
from chromium import Chromium
from served import HOSTILE, analysed, served, subject_of
from tornado.websocket import websocket_connect

from relay_autotune.record.record import Outcome
from relay_autotune.report.case import ultimate_of
from relay_autotune.web import live as live_module
from relay_autotune.web import wire
from relay_autotune.web.live import Live, PageCommand, PagePlan
from relay_autotune.web.wire import of_running


def talk(url, work):
    """Open a socket, run a coroutine with it, and return what it returns."""

    async def talked():
        socket = await websocket_connect(url.replace("http:", "ws:") + "socket")
        try:
            return await work(socket)
        finally:
            socket.close()

    return asyncio.run(asyncio.wait_for(talked(), 60.0))


async def heard(socket, holds):
    """Return the first message for which something holds."""
    while True:
        message = json.loads(await socket.read_message())
        if holds(message):
            return message


def test_a_page_that_is_opened_late_is_told_all_and_then_what_is_new():
    live = Live("/tank/relay_node")
    live.tell(phase="tuning", status="at the high level")
    for k in range(5):
        live.sample("measurement", float(k))
    live.sample("command", 2.0)
    live.sample("command", math.nan)

    # What is told again is not new.
    statuses = iter(("at the low level", "at the high level"))

    async def listen(socket):
        first = await heard(socket, lambda m: m.get("all"))
        live.sample("measurement", 7.0)
        live.tell(status=next(statuses))
        seen = [await heard(socket, lambda m: "samples" in m or "live" in m)]
        while len(seen) < 2 and not {"samples", "live"} <= set(seen[0]):
            seen.append(await heard(socket, lambda m: "samples" in m or "live" in m))
        return first, {key: value for message in seen for key, value in message.items()}

    with served([], live=live) as url:
        first, news = talk(url, listen)
        again, _ = talk(url, listen)
    assert first["live"]["node"] == "/tank/relay_node"
    assert first["live"]["status"] == "at the high level"
    assert first["live"]["remaining"] is None
    assert first["samples"]["measurement"][1] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert first["samples"]["command"][1] == [2.0]
    assert news["samples"]["measurement"][1] == [7.0]
    assert news["live"]["status"] == "at the low level"
    assert again["samples"]["measurement"][1] == [0.0, 1.0, 2.0, 3.0, 4.0, 7.0]


def test_five_pages_are_told_the_same():
    live = Live("/relay_node")

    async def all_of_them(url):
        sockets = [
            await websocket_connect(url.replace("http:", "ws:") + "socket") for _ in range(5)
        ]
        for socket in sockets:
            await heard(socket, lambda m: m.get("all"))
        live.sample("measurement", 3.5)
        found = [await heard(s, lambda m: "samples" in m) for s in sockets]
        for socket in sockets:
            socket.close()
        return found

    with served([], live=live) as url:
        found = asyncio.run(asyncio.wait_for(all_of_them(url), 60.0))
    assert [m["samples"]["measurement"][1] for m in found] == [[3.5]] * 5


def test_only_what_is_possible_can_be_wished():
    live = Live("/relay_node")
    live.wish(PageCommand("start"))
    assert live.next_wish() == PageCommand("start")
    live.tell(phase="tuning")
    assert live.wish(PageCommand("apply")).startswith("not done: another wish came first")
    assert not live.abort.is_set()
    assert live.wish(PageCommand("abort")) == ""
    assert live.abort.is_set()
    live.rest("cancelled", good=False)
    # as soon as it is told that it is over
    assert live.wish(PageCommand("apply")) == ""
    assert live.next_wish() == PageCommand("apply")
    assert not live.abort.is_set()


def test_of_what_is_agreed_to_at_the_same_time_one_is_done_and_the_other_page_hears_why_not():
    """It was dropped without a word, by what the first one began or ended with."""
    live = Live("/relay_node")

    async def both(socket):
        await heard(socket, lambda m: "subjects" in m)
        for what in ("start", "apply"):
            await socket.write_message(json.dumps({"do": what}))
        return await heard(socket, lambda m: "refused" in m)

    with served([], live=live) as url:
        # the first waits for its turn, or was taken and has told nothing yet
        told = talk(url, both)
        assert told == {"loop": 0, "refused": live.wish(PageCommand("revert"))}
        assert live.next_wish() == PageCommand("start")
        assert live.wish(PageCommand("revert")) == told["refused"]
    # a question takes nobody's turn, and is answered after what is done
    assert live.wish(PageCommand("apply", dry=3)) == ""
    live.rest("refused", good=False)
    assert live.next_wish() == PageCommand("apply", dry=3)
    assert live.wish(PageCommand("revert")) == ""
    assert live.next_wish() == PageCommand("revert")


def test_the_model_of_a_running_tune_lies_on_the_data_with_its_intervals():
    analysis = analysed()
    model = analysis.model
    (gain, _) = ultimate_of(model)
    told = of_running(model, analysis.record, [(2, gain), (3, gain)])
    _, (times, drawn) = told["data"]
    record = analysis.record
    expected = np.interp(times, record.time, analysis.model.fitted)
    assert np.max(np.abs(np.array(drawn) - expected)) < 0.02 * np.ptp(record.measurement)
    assert told["gains"]["cycle"] == [2, 3]
    assert told["gains"]["low"][0] < told["gains"]["value"][0] < told["gains"]["high"][0]
    assert [row[0] for row in told["estimates"]][:1] == ["gain"]
    assert of_running(model, None, [])["data"] is None
    assert json.dumps(told, allow_nan=False)


def test_figures_are_told_when_they_change_and_to_a_page_that_is_opened_late():
    live = Live("/relay_node")
    live.news()
    live.show("proof", [1])
    assert live.news() == {"shown": {"proof": [1]}}
    assert live.news() is None
    assert live.everything()["shown"] == {"proof": [1]}


def test_a_whole_number_is_a_step():
    assert isinstance(PageCommand("verify", step=3).step, float)


@pytest.mark.parametrize(
    "wish",
    [
        *({"do": what} for what in ("reboot", 7, None, ["start"], {"start": 1})),
        {"do": "apply", "of": "0", "asked": {}},
        {"do": "apply", "of": 0, "asked": {"rule": "os.system"}},
        {"do": "verify", "step": "1"},
        {"do": "verify", "step": math.inf},
        {"do": "start", "settings": {"at": "2"}},
        {"do": "start", "settings": {"within": [1, None]}},
        {"do": "start", "settings": 7},
        {"do": "prove", "dry": "1"},
        {"do": "prove", "dry": -1},
    ],
)
def test_an_impossible_wish_ends_the_connection(wish):
    live = Live("/relay_node")

    async def ask(socket):
        await heard(socket, lambda m: "subjects" in m)
        await socket.write_message(json.dumps(wish))
        while await socket.read_message() is not None:
            continue

    with served([], live=live) as url:
        talk(url, ask)
    assert live.next_wish() is None


def test_a_page_without_a_loop_takes_no_wishes():
    async def ask(socket):
        await heard(socket, lambda m: "subjects" in m)
        await socket.write_message(json.dumps({"do": "start"}))
        while (message := await socket.read_message()) is not None:
            assert "live" not in message

    with served([]) as url:
        talk(url, ask)


def test_what_is_kept_is_bounded(monkeypatch):
    monkeypatch.setattr(live_module, "_KEPT", 100)
    live = Live("/relay_node")
    for k in range(1000):
        live.sample("measurement", float(k))
    kept = live.everything()["samples"]["measurement"][1]
    assert (len(kept), kept[0], kept[-1]) == (100, 900.0, 999.0)
    assert len(live.news()["samples"]["measurement"][0]) <= 1000
    assert live.news() is None


def test_nobody_who_looks_does_not_make_what_is_new_grow(monkeypatch):
    live = Live("/relay_node")
    with served([], live=live):
        for k in range(200):
            live.sample("measurement", float(k))
        deadline = time.monotonic() + 30.0
        while live._signals["measurement"].new:
            assert time.monotonic() < deadline
            time.sleep(0.01)


@pytest.mark.long
@pytest.mark.browser
def test_the_page_of_a_loop_with_hostile_texts(tmp_path):
    live = Live(HOSTILE)
    live.tell(status=HOSTILE, cycles=(HOSTILE,), result=(HOSTILE,))
    with served([], live=live) as url, Chromium(tmp_path) as browser:
        tab = browser.tab(url)
        tab.wait("document.body.dataset.phase === 'idle'")
        assert tab.text("#name") == HOSTILE
        assert tab.text("#live-status") == HOSTILE
        tab.click("#start")
        asked = tab.until(live.next_wish, "the wish")
        live.tell(plan=PagePlan(asked.dry, HOSTILE, HOSTILE, ((HOSTILE, HOSTILE, HOSTILE),)))
        tab.wait("document.querySelector('#plan-lines li')")
        assert tab.text("#plan-said") == HOSTILE
        assert tab.eval("document.querySelectorAll('img, main script, dialog script').length") == 0
        assert tab.eval("document.title") == f"{HOSTILE} - relay_autotune"
        assert tab.said == []


@pytest.mark.long
@pytest.mark.browser
def test_an_open_page_draws_so_many_points_at_most_and_none_while_it_is_hidden(tmp_path):
    live = Live("/relay_node")

    def hidden(told):
        tab.eval(
            f"Object.defineProperty(document, 'hidden', {{value: {told}, configurable: true}})"
        )
        tab.eval("document.dispatchEvent(new Event('visibilitychange')); 0")

    def newest():
        return live.everything()["samples"]["measurement"][0][-1]

    with Chromium(tmp_path) as browser, served([], live=live) as url:
        tab = browser.tab(url)
        tab.wait("document.body.dataset.phase === 'idle'")
        for k in range(5001):
            live.sample("measurement", float(k))
        tab.wait(f"Number(document.body.dataset.measured) >= {newest() - 1e-3}")
        drawn = "document.querySelector('#plot-live-measurement path.measured').getAttribute('d')"
        points = [point.split() for point in tab.eval(drawn).removeprefix("M").split("L")]
        x, y = np.array(points, float).T
        assert 1000 <= x.size <= 2000
        # All from the left end of the figure on, in their order.
        assert x[0] == x.min() == 62.0
        assert np.all(np.diff(y) <= 0.0)
        assert np.ptp(y) > 150.0
        hidden("true")
        before = tab.eval("document.body.dataset.measured")
        live.sample("measurement", 6000.0)
        live.tell(status="told after it")
        tab.wait("document.querySelector('#live-status').innerText === 'told after it'")
        assert tab.eval("document.body.dataset.measured") == before
        hidden("false")
        tab.wait(f"Number(document.body.dataset.measured) >= {newest() - 1e-3}")


@pytest.mark.long
@pytest.mark.browser
def test_long_numbers_of_a_figure_do_not_run_into_the_title_of_its_axis(tmp_path):
    live = Live("/relay_node")
    with Chromium(tmp_path) as browser, served([], live=live) as url:
        tab = browser.tab(url)
        tab.wait("document.body.dataset.phase === 'idle'")
        for k in range(100):
            live.sample("measurement", 39.66 + 0.00007 * k)
        tab.wait("document.querySelectorAll('#plot-live-measurement .tick').length > 4")
        box = "each.getBoundingClientRect()"
        ticks = tab.eval(
            "[...document.querySelectorAll('#plot-live-measurement .tick[text-anchor=end]')]"
            f".map((each) => [each.textContent, {box}.left])"
        )
        title = "[...document.querySelectorAll('#plot-live-measurement .axis')].at(-1)"
        assert max(len(text) for text, _ in ticks) >= 6
        assert tab.eval(f"(each => {box}.right)({title})") < min(at for _, at in ticks)
        # the axis of time has its name while there is no command, whose figure has it below
        assert "time [s]" in tab.text("#plot-live-measurement")
        live.sample("command", 2.0)
        tab.wait("document.querySelector('#plot-live-command').checkVisibility()")
        assert "time [s]" not in tab.text("#plot-live-measurement")


@pytest.mark.long
@pytest.mark.browser
def test_abort_is_in_reach_while_a_tune_runs_and_its_model_can_be_shaped_then(tmp_path):
    live = Live("/relay_node")
    live.tell(phase="tuning", state="relay", setpoint=40.0, hysteresis=0.1)
    live.sample("measurement", 40.0)
    with served([], live=live) as url, Chromium(tmp_path) as browser:
        tab = browser.tab()
        tab.size(390, 700)
        tab.go(url)
        tab.wait("!document.querySelector('#abort').disabled")
        tab.eval("scrollTo(0, document.body.scrollHeight)")
        assert 0 <= tab.eval("document.querySelector('#abort').getBoundingClientRect().top") < 700
        assert tab.eval("document.documentElement.scrollWidth") <= 390
        # a button that cannot be used takes no room from the figures
        assert not tab.eval("document.querySelector('#start').checkVisibility()")
        live.sample("measurement", 41.0)
        tab.wait("document.querySelectorAll('#plot-live-measurement path.line').length === 3")
        tab.click("#abort")
        tab.until(live.abort.is_set, "the wish")
        live.tell(phase="idle")
        tab.wait("document.querySelector('#abort').disabled")
        assert tab.eval("document.querySelector('#start').checkVisibility()")
        assert tab.said == []


@pytest.mark.nightly
@pytest.mark.browser
def test_on_a_phone_a_wish_shows_what_comes_of_it_and_a_model_stands_once(tmp_path):
    live = Live("/relay_node")
    live.tell(proves=True, process="1 / (1 + s)")
    curve = [[0.0, 1.0], [0.0, 1.0]]
    step = {"name": "set-point step", "measurement": curve, "predicted": curve}
    live.show("proof", [step])
    live.tell(proof=(("verdict", "passed"),))
    with served([subject_of(analysed())], live=live) as url, Chromium(tmp_path) as browser:
        tab = browser.tab()
        tab.size(390, 844)
        tab.go(url)
        tab.wait("!document.querySelector('#prove').disabled")
        tab.wait("document.querySelectorAll('#plot-proof .curve').length === 2")
        said = tab.eval("document.querySelector('#plot-proof svg').getAttribute('aria-label')")
        assert said == "Verification: measured and predicted: set-point step"
        # the model is that of the experiment below
        assert tab.text("#process")
        assert not tab.eval("document.querySelector('#live-process').checkVisibility()")
        # nothing moves under the pointer any more
        tab.wait("document.body.dataset.settled === 'yes'")
        tab.eval("import('/plot.js').then(({units}) => { units.y = 'K'; }), 0")
        # what it would do is asked first; a step that cannot be made is changed where it stands
        tab.click("#prove")
        asked = tab.until(live.next_wish, "the wish")
        assert asked.step == 0.0
        form = {"name": "step", "question": "step of the set-point", "unit": "y", "ends": 1,
                "values": [9.0], "now": "", "needed": True}  # fmt: skip
        live.tell(status="before", plan=PagePlan(asked.dry, "9 y, expected -3 to 4 y", "step", (),
                                                 (form,)))  # fmt: skip
        tab.wait("document.querySelector('#form-step-0')?.ariaInvalid === 'true'")
        assert tab.text("#plan-said") == "9 y, expected -3 to 4 y"
        assert tab.text("#form label") == "step of the set-point [K]"
        assert tab.eval("document.activeElement.id") == "form-step-0"
        assert tab.eval("document.querySelector('#plan-yes').disabled")
        tab.eval("document.activeElement.value = ''; 0")
        tab.call("Input.insertText", text="2")
        asked = tab.until(live.next_wish, "the wish")
        assert asked.dry and asked.step == 2.0
        expected = "The valve is expected from 46 to 58 u, for 2 min."
        live.tell(plan=PagePlan(asked.dry, lines=(("", "expected", expected),), form=(form,)))
        tab.wait("!document.querySelector('#plan-yes').disabled")
        assert expected in tab.text("#plan-lines")
        assert tab.eval("document.querySelector('#form-step-0').value") == "2"
        assert not tab.eval("document.querySelector('[aria-invalid]')")
        # after Cancel nothing stands there of what was refused
        assert tab.text("#live-status") == "before"
        tab.eval("scrollTo(0, document.body.scrollHeight)")
        tab.click("#plan-yes")
        wish = tab.until(live.next_wish, "the wish")
        assert (wish.dry, wish.step) == (0, 2.0)
        assert tab.eval("scrollY") == 0
        # of two pages that agree at the same time the later one is told, until it asks again
        live.rest("passed", good=True)
        tab.wait("!document.querySelector('#start').disabled")
        tab.click("#start")
        asked = tab.until(live.next_wish, "the wish")
        live.tell(plan=PagePlan(asked.dry))
        tab.wait("!document.querySelector('#plan-yes').disabled")
        assert live.wish(wish) == ""
        tab.click("#plan-yes")
        tab.wait("document.querySelector('#gone').checkVisibility()")
        assert tab.text("#gone").startswith("not done: another wish came first")
        tab.click("#start")
        tab.wait("document.querySelector('#gone').hidden")
        # the figure of a proof does not stand beside the gains of the next tune
        live.tell(phase="tuning", proof=())
        tab.wait("document.querySelector('#proof').hidden")
        assert tab.eval("document.querySelector('#live-process').checkVisibility()")
        assert tab.said == []


@pytest.mark.nightly
@pytest.mark.browser
def test_a_tune_without_gains_leaves_the_earlier_ones_grey_with_their_time(tmp_path):
    live = Live("/relay_node")
    live.tell(tuned=0, began="09:12")
    subject = subject_of(analysed())
    subject.when = "09:12"
    with served([subject], live=live) as url, Chromium(tmp_path) as browser:
        tab = browser.tab()
        tab.size(390, 844)
        tab.go(url)
        tab.wait("document.querySelector('#gains').innerText.startsWith('kc')")
        colour = "getComputedStyle(document.querySelector('#gains')).color"
        valid = tab.eval(colour)
        assert tab.text("#gains-of") == "of the tune at 09:12"
        # the gains are in reach on a phone: to prove and to keep them stands above the figures
        tops = [
            tab.eval(f"document.querySelector('{each}').getBoundingClientRect().top")
            for each in ("#live-now", "#keep-box", "#steps", "#controller")
        ]
        assert tops == sorted(tops) and tops[1] < 844
        live.tell(tuned=-1, began="09:31")
        said = "of the tune at 09:12; the last tune, at 09:31, gave none"
        tab.wait(f"document.querySelector('#gains-of').innerText === {said!r}")
        assert tab.eval(colour) != valid
        assert tab.said == []


@pytest.mark.nightly
@pytest.mark.browser
def test_a_tune_that_was_aborted_does_not_show_the_gains_of_the_one_before(tmp_path):
    aborted = replace(analysed().record, outcome=Outcome.ABORTED, reason="a button")
    subjects = [subject_of(analysed()), subject_of(analysed_once(aborted))]
    with served(subjects) as url, Chromium(tmp_path) as browser:
        tab = browser.tab(url)
        tab.wait("document.querySelector('#gains').innerText.startsWith('kc')")
        tab.click("#tabs button:nth-child(2)")
        tab.wait("document.querySelector('#reason').checkVisibility()")
        assert tab.text("#gains") == "no gains"


@pytest.mark.nightly
@pytest.mark.browser
def test_what_must_be_read_first_stands_first_and_a_finger_that_scrolls_moves_no_slider(
    tmp_path, monkeypatch
):
    note = "The process answers differently up and down."
    monkeypatch.setattr(wire, "remarks_of", lambda case: (note,))
    subject = subject_of(analysed())
    live = Live("/relay_node")
    with served([subject], live=live) as url, Chromium(tmp_path) as browser:
        tab = browser.tab()
        tab.size(390, 844)
        tab.go(url)
        tab.wait("document.querySelector('#notes').checkVisibility()")
        assert note in tab.text("#notes")
        top = "document.querySelector('{}').getBoundingClientRect().top"
        assert tab.eval(top.format("#notes")) < tab.eval(top.format("#live-now"))
        tab.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=1)
        tab.eval("document.querySelector('#noise-share').scrollIntoView({block: 'center'})")
        before = tab.eval("document.querySelector('#noise-share').value")
        y = tab.eval(top.format("#noise-share")) + 15
        for k, kind in enumerate(["touchStart", *["touchMove"] * 8, "touchEnd"]):
            points = [] if kind == "touchEnd" else [{"x": 250, "y": y - 25 * k}]
            tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        tab.wait(f"document.querySelector('#noise-share').value === {before!r}", 10.0)


def test_a_model_that_is_added_is_told_to_open_pages():
    from relay_autotune.web.address import Address
    from relay_autotune.web.server import Page, in_background

    page = Page((), Address(), [Live("/relay_node")])

    async def listen(socket):
        assert (await heard(socket, lambda m: "subjects" in m))["subjects"] == []
        page.add(subject_of(analysed(), "the bag"))
        found = await heard(socket, lambda m: m.get("subjects"))
        return found["subjects"][0]["name"]

    with in_background(page) as url:
        assert talk(url, listen) == "the bag"


def test_what_is_wished_goes_to_the_loop_that_is_meant():
    lives = [Live("/tank/relay_node"), Live("/oven/relay_node")]
    lives[1].tell(phase="tuning")

    async def wish(socket):
        told = [await heard(socket, lambda m: m.get("all")) for _ in lives]
        await socket.write_message(json.dumps({"do": "abort", "loop": 1}))
        await socket.write_message(json.dumps({"do": "start", "loop": 0}))
        await socket.write_message(json.dumps({"do": "start", "loop": 2}))
        while await socket.read_message() is not None:
            continue
        return [(m["loop"], m["live"]["node"]) for m in told]

    with served([], lives=lives) as url:
        assert talk(url, wish) == [(0, "/tank/relay_node"), (1, "/oven/relay_node")]
    assert (lives[0].abort.is_set(), lives[1].abort.is_set()) == (False, True)
    assert (lives[0].next_wish(), lives[1].next_wish()) == (PageCommand("start"), None)


@pytest.mark.nightly
@pytest.mark.browser
def test_each_loop_has_a_tab_and_every_one_that_runs_can_be_ended(tmp_path):
    lives = [Live("/tank/relay_node"), Live("/oven/relay_node")]
    lives[0].tell(controller="/tank/controller_node", present="kc 1 u/y")
    subject = subject_of(analysed())
    subject.loop = 1
    with served([subject], lives=lives) as url, Chromium(tmp_path) as browser:
        tab = browser.tab(url)
        tab.wait("document.querySelectorAll('#loops button').length === 2")
        # The models come behind the loops.
        tab.wait("document.querySelector('#name').innerText !== 'connecting'")
        assert tab.text("#name") == "/tank/relay_node"
        assert not tab.text("#gains")
        # gains of another loop are not offered, and a plan makes way for a tune
        assert tab.eval("document.querySelector('#apply').disabled")
        tab.click("#verify")
        tab.wait("document.querySelector('#plan').open")
        lives[1].tell(phase="tuning", state="relay", status="at the high level")
        tab.wait("!document.querySelector('#plan').open")
        tab.click("#loops .stop")
        tab.until(lives[1].abort.is_set, "the end of the other loop")
        assert not lives[0].abort.is_set()
        tab.click("#loops button:nth-child(2)")
        tab.wait("document.querySelector('#live-status').innerText === 'at the high level'")
        tab.wait("document.querySelector('#gains').innerText.startsWith('kc')")
        assert not tab.eval("document.querySelector('#abort').disabled")
        tab.click("#loops button:nth-child(1)")
        tab.wait("document.querySelector('#name').innerText === '/tank/relay_node'")
        assert not tab.text("#gains")
        assert tab.said == []
