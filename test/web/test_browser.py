# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The page in a real browser: by mouse, by keyboard, narrow, dark, and with hostile names."""

import json
import re

import pytest
from chromium import Chromium
from served import HOSTILE, analysed, hostile, served, subject_of

from relay_autotune.web.address import Address
from relay_autotune.web.shape import DesignRequest

pytestmark = pytest.mark.browser
TAB, RIGHT, SPACE = ("Tab", 9), ("ArrowRight", 39), (" ", 32)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


def shown(tab) -> str:
    """Wait for the answer to what the controls say, and return the gains in the bar."""
    tab.wait("document.body.dataset.settled === 'yes'")
    return tab.text("#gains")


def curve(tab, plot: str) -> str:
    return tab.eval(f"document.querySelector('#{plot} .curve').getAttribute('d')")


def told(subject, asked: DesignRequest) -> str:
    return f"kc {subject.shaped(asked).gains.kc:.4f}"


@pytest.mark.nightly
def test_the_slider_by_keyboard_alone_and_a_page_that_is_loaded_again(browser, url, subject):
    tab = browser.tab(url)
    assert shown(tab).startswith(told(subject, DesignRequest()))
    before = [curve(tab, name) for name in ("plot-measurement", "plot-command", "plot-nyquist")]
    for _ in range(30):
        tab.press(*TAB)
        if tab.eval("document.activeElement.id") == "ms":
            break
    assert tab.eval("document.activeElement.id") == "ms"
    for _ in range(5):
        tab.press(*RIGHT)
    expected = told(subject, DesignRequest(ms=1.5))
    tab.until(lambda: shown(tab).startswith(expected), expected)
    assert tab.text("#ms-value") == "1.50"
    assert tab.text("#command") == "replay 1.5"
    after = [curve(tab, name) for name in ("plot-measurement", "plot-command", "plot-nyquist")]
    assert all(a != b for a, b in zip(before, after, strict=True))
    tab.call("Page.reload")
    tab.until(lambda: shown(tab).startswith(expected), f"{expected} after a reload")
    assert tab.said == []


@pytest.mark.long
def test_kinds_rules_and_weight_by_mouse(browser, url, subject):
    tab = browser.tab(url)
    shown(tab)
    value, unit = tab.text("#noise-value").split()
    known = subject.shaping.task.options
    assert (float(value), unit) == (pytest.approx(known.noise_share * known.amplitude, 0.06), "u")
    kept = tab.text("#keep")
    assert "Gains for controller_node" in kept and "Gains as yaml" in kept
    tab.click("input[value=pi]")
    expected = told(subject, DesignRequest(controller="pi"))
    tab.until(lambda: shown(tab).startswith(expected), expected)
    tab.click("#own-weight")
    tab.eval("weight = document.querySelector('#weight'), weight.value = 0.2,"
             "weight.dispatchEvent(new Event('input'))")  # fmt: skip
    tab.until(lambda: "b 0.2000" in shown(tab), "the weight")
    tab.eval("rule = document.querySelector('#rule'), rule.value = 'simc',"
             "rule.dispatchEvent(new Event('change'))")  # fmt: skip
    expected = told(subject, DesignRequest("simc", "pi"))
    tab.until(lambda: shown(tab).startswith(expected), expected)
    assert tab.eval("document.querySelectorAll('.mark.chosen').length") == 1
    tab.eval("law = document.querySelector('#law'), law.value = 'pid_controller',"
             "law.dispatchEvent(new Event('change'))")  # fmt: skip
    tab.until(lambda: shown(tab) and "for pid_controller every" in tab.text("#why"), "the law")
    assert "law=pid_controller" in tab.eval("location.hash")
    assert tab.said == []


@pytest.mark.long
def test_two_pages_do_not_disturb_each_other(browser, url, subject):
    first, second = browser.tab(url), browser.tab(f"{url}#ms=1.7&controller=pi&rule=robust")
    expected = told(subject, DesignRequest(controller="pi", ms=1.7))
    second.until(lambda: shown(second).startswith(expected), expected)
    assert shown(first).startswith(told(subject, DesignRequest()))


def test_an_address_with_impossible_wishes_shows_the_first_gains(browser, url, subject):
    tab = browser.tab(f"{url}#ms=-7&controller=%3Cb%3E&rule=os.system&setpoint_weight=x")
    assert shown(tab).startswith(told(subject, DesignRequest()))


@pytest.mark.long
def test_hostile_names_are_text(browser, subject):
    with served([hostile(subject), subject]) as url:
        tab = browser.tab(url)
        shown(tab)
        assert tab.text("#name") == HOSTILE
        assert tab.text("#command") == HOSTILE
        assert tab.eval("document.querySelectorAll('img, main script').length") == 0
        assert tab.eval("document.title") == f"{HOSTILE} - relay_autotune"
        assert tab.eval("document.querySelector('#tabs button').textContent") == HOSTILE
        assert tab.said == []


def test_a_script_that_got_into_the_page_would_not_run(browser, url):
    tab = browser.tab(url)
    shown(tab)
    tab.eval(f"document.body.insertAdjacentHTML('beforeend', {json.dumps(HOSTILE)})")
    tab.eval("new Promise((done) => setTimeout(done, 200))")
    assert tab.eval("document.title") != "taken"
    assert any("Content Security Policy" in text for text in tab.said)


def test_without_the_token_nothing_is_shown_and_with_it_it_leaves_the_address(browser, subject):
    with served([subject], Address("127.0.0.1", 0, "right")) as url:
        base = url.partition("?")[0]
        tab = browser.tab(f"{base}?token=wrong")
        assert tab.text("body").startswith("403")
        tab.go(url)
        assert shown(tab)
        assert "token" not in tab.eval("location.href")


@pytest.mark.parametrize("dark", [False, True])
def test_a_narrow_page_does_not_scroll_sideways_and_dark_is_dark(browser, url, dark):
    tab = browser.tab()
    tab.size(390, 844, dark=dark)
    tab.go(url)
    shown(tab)
    assert tab.eval("document.documentElement.scrollWidth") <= 390
    colour = tab.eval("getComputedStyle(document.body).backgroundColor")
    bright = sum(map(int, re.findall(r"\d+", colour)[:3])) / 3
    assert (bright < 60) if dark else (bright > 200)
    # what the slider does stands above the other controls
    tops = [tab.eval(f"document.querySelector('{each}').getBoundingClientRect().top")
            for each in ("#steps", "#controller")]  # fmt: skip
    assert tops == sorted(tops)
    # the verdict, the gains and the slider stay in view
    tab.eval("scrollTo(0, document.body.scrollHeight)")
    for part in ("#verdict", "#gains", "#ms"):
        top = tab.eval(f"document.querySelector('{part}').getBoundingClientRect().top")
        assert 0 <= top < 844, part


@pytest.mark.long
def test_on_a_phone_the_tabs_of_two_tunes_are_no_wider_than_it(browser, subject):
    folder = "/home/operator/.ros/relay_autotune/20261127T035954Z_712b7c35"
    with served([subject, subject_of(analysed(), folder)]) as url:
        tab = browser.tab()
        tab.size(390, 844)
        tab.go(url)
        shown(tab)
        assert (
            tab.eval("[...document.querySelectorAll('#tabs button')].at(-1).innerText") == folder
        )
        # A dialog on a wider page stands half outside of the screen.
        assert tab.eval("document.documentElement.scrollWidth") <= 390


def test_on_a_phone_controls_are_as_high_as_a_finger_and_gains_stay_whole(browser, url):
    tab = browser.tab()
    tab.size(390, 844)
    tab.go(url)
    shown(tab)
    tab.eval("document.querySelector('#form').innerHTML = '<span><input></span>'")
    tab.eval("document.querySelector('#plan').showModal()")
    heights = tab.eval(
        "[...document.querySelectorAll('button, select, input, summary')]"
        ".filter((each) => each.checkVisibility())"
        ".map((each) => [each.outerHTML, Math.max(each.offsetHeight,"
        "each.closest('fieldset label')?.offsetHeight ?? 0)])"
    )
    assert len(heights) > 20
    assert [each for each in heights if each[1] < 44] == []
    # A phone zooms into a field whose text is smaller.
    size = "getComputedStyle(document.querySelector('#form input')).fontSize"
    assert tab.eval(size) == "16px"
    # "b" and its number are on one line
    spans = "[...document.querySelectorAll('#gains span')]"
    assert tab.eval(f"{spans}.map((each) => each.getClientRects().length)") == [1, 1, 1, 1]


def test_everything_that_acts_or_shows_has_a_name_for_a_screen_reader(browser, url):
    tab = browser.tab(url)
    shown(tab)
    nodes = tab.call("Accessibility.getFullAXTree")["nodes"]
    roles = {"button", "slider", "radio", "checkbox", "combobox", "image", "group", "region"}
    found = {}
    for node in nodes:
        role = node.get("role", {}).get("value")
        if role in roles and not node["ignored"]:
            found.setdefault(role, []).append(node.get("name", {}).get("value", ""))
    assert {"button", "slider", "radio", "checkbox", "combobox", "image"} <= set(found)
    assert all(all(names) for role, names in found.items() if role != "group"), found
    assert len(found["image"]) == 6
    assert any("highest" in name for name in found["image"])


@pytest.mark.nightly
def test_a_command_that_ended_is_told(browser, subject):
    with served([subject]) as url:
        tab = browser.tab(url)
        before = shown(tab)
    tab.wait("!document.querySelector('#gone').hidden")
    assert "has ended" in tab.text("#gone")
    assert tab.text("#gains") == before
