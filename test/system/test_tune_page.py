# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""tune_loop --web over real DDS: tunes are started, watched and ended on a page."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from chromium import Chromium
from loop_rig import RELIABLE, Process, Rig
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from served import OpenPage
from std_msgs.msg import Float64

NAMED = ("-r", "__ns:=/tank")
PLANT = {
    "structure": "fopdt",
    "gain": 2.0,
    "dead_time": 0.1,
    "operating_point": [5.0, 1.0],
    "noise_std": 0.005,
    "sample_period": 0.02,
}
# at rest at the command 1, which is not the one that is said
MOVING = PLANT | {"time_constants": [0.4]}
RELAY = {"amplitude": 0.5, "baseline": 1.0, "settle_time": 0.4, "measurement_timeout": 10.0}


def page_of(rig: Rig, *words: str, loops: str = "/tank") -> tuple[Process, str]:
    """Start the command, and return it with the address that it prints."""
    command = rig.start_command("tune_loop", "--namespace", loops, "--web", "--wait", "60", *words)
    found = rig.until(lambda: re.search(r"the page is at (\S+)", command.log), "the address")
    return command, found[1]


def accepted(rig: Rig, page: OpenPage) -> None:
    """Check until a tune could start; right after the start nodes have not found each other."""
    rig.until(lambda: page.snapshot, "what is known")
    rig.until(lambda: not page.plan(rig.until)["refusal"], "a check that accepts")


def test_a_tune_is_ended_on_any_page_in_each_state_and_a_closed_one_changes_nothing(
    rig: Rig,
) -> None:
    commands = rig.listen("tank/command", Float64, RELIABLE)
    rig.start("plant_node", *NAMED, time_constants=[50.0], **PLANT)
    rig.relay(*NAMED, **RELAY)
    command, url = page_of(rig, "--record-only")
    first, second = OpenPage(url), OpenPage(url)
    accepted(rig, first)
    first.do("start")
    rig.until(lambda: any(m.data != 1.0 for m in commands), "a step")
    first.close()
    seen = second.snapshot["elapsed"]
    rig.until(lambda: second.snapshot["elapsed"] > seen + 1.0, "a tune that goes on")
    late = OpenPage(url)
    # The test begins with a quarter of the amplitude.
    rig.until(
        lambda: late.snapshot and any(u != 1.0 for u in late.samples["command"]),
        "all that was before",
    )
    assert late.snapshot["status"]
    assert late.snapshot["node"] == "/tank/relay_node"
    late.do("abort")
    rig.until(lambda: second.phase == "idle", "the end")
    rig.until(lambda: commands[-1].data == 1.0, "the safe command")
    assert second.snapshot["result"][0].strip().startswith("tune")
    assert "cancelled" in second.snapshot["result"][0]
    assert second.subjects == []
    # in the midst of settling
    late.do("start")
    rig.until(lambda: late.phase == "tuning" and late.snapshot["state"] == "settling", "settling")
    second.do("abort")
    rig.until(lambda: late.phase == "idle", "the second end")
    rig.until(lambda: commands[-1].data == 1.0, "the safe command of the second")
    # Ctrl-C in the terminal ends the tune, then the command
    late.do("start")
    rig.until(lambda: commands[-1].data != 1.0, "a step")
    command.signal(signal.SIGINT)
    assert command.wait() == 1
    rig.until(lambda: commands[-1].data == 1.0, "the safe command again")
    assert late.ended.wait(30.0)
    assert "Traceback" not in command.log


def test_an_open_page_does_not_count_as_somebody_who_hears_the_command(rig: Rig) -> None:
    rig.relay(*NAMED, **RELAY)
    sensor = rig.node.create_publisher(Float64, "tank/measurement", RELIABLE)
    rig.node.create_timer(0.02, lambda: sensor.publish(Float64(data=5.0)))
    command, url = page_of(rig, "--record-only")
    page = OpenPage(url)
    rig.until(lambda: 5.0 in page.samples["measurement"], "a measurement on the page")

    def is_refused() -> bool:
        # Until relay_node has found the sensor, it refuses for that.
        page.do("start")
        rig.run_for(0.5)
        return "no command would arrive" in page.snapshot.get("status", "")

    rig.until(is_refused, "the refusal")
    assert page.phase == "idle"
    assert page.samples["command"] == []
    command.signal(signal.SIGINT)
    assert command.wait() == 1


def test_two_loops_of_a_page_are_tuned_at_once_and_ended_apart(rig: Rig) -> None:
    spaces = ("tank", "oven")
    commands = {each: rig.listen(f"{each}/command", Float64, RELIABLE) for each in spaces}
    for each in spaces:
        named = ("-r", f"__ns:=/{each}")
        rig.start("plant_node", *named, time_constants=[50.0], **PLANT)
        rig.relay(*named, **RELAY)
    command, url = page_of(rig, "--record-only", loops=",".join(spaces))
    pages = {each: OpenPage(url, number) for number, each in enumerate(spaces)}
    for each in spaces:
        accepted(rig, pages[each])
        pages[each].do("start")
        rig.until(lambda each=each: any(m.data != 1.0 for m in commands[each]), f"a step: {each}")
    pages["oven"].do("abort")
    rig.until(lambda: pages["oven"].phase == "idle", "the end of one")
    rig.until(lambda: commands["oven"][-1].data == 1.0, "the safe command of the oven")
    assert pages["oven"].snapshot["node"] == "/oven/relay_node"
    assert pages["tank"].phase == "tuning"
    # Ctrl-C ends the other one, then the command
    command.signal(signal.SIGINT)
    assert command.wait() == 1
    rig.until(lambda: commands["tank"][-1].data == 1.0, "the safe command")
    assert "Traceback" not in command.log


LOOP = {
    "mode": "clock", "speed": 2.0, "sample_period": 0.05, "structure": "fopdt",
    "gain": 2.0, "time_constants": [0.8], "dead_time": 0.4, "operating_point": [5.0, 1.0],
    "noise_std": 0.002, "seed": 5,
}  # fmt: skip


@pytest.mark.nightly
@pytest.mark.browser
def test_from_the_start_to_verified_gains_by_clicks(rig: Rig, tmp_path: Path) -> None:
    rig.start("plant_node", *NAMED, **LOOP)
    rig.relay(
        *NAMED, use_sim_time=True, amplitude=0.5, settle_time=1.0, measurement_timeout=10.0,
        controller_timeout=10.0,
    )  # fmt: skip
    rig.start(
        "controller_node", *NAMED, use_sim_time=True, kc=0.3, ti=0.8, initial_command=1.0,
        initial_setpoint=5.0,
    )  # fmt: skip
    rig.identifier(*NAMED, use_sim_time=True)
    command, url = page_of(rig)
    page = OpenPage(url)
    accepted(rig, page)
    gains = "/tank/controller_node"
    with Chromium(tmp_path / "profile") as browser:
        tab, other = browser.tab(url), browser.tab(url)

        def agree(button: str, *parts: str, step: str = "") -> None:
            tab.wait(f"!document.querySelector('{button}').disabled")
            tab.click(button)
            if step:
                tab.wait("document.querySelector('#form-step-0')?.value")
                tab.eval(f"field = document.querySelector('#form-step-0'), field.value = {step},"
                         "field.dispatchEvent(new Event('input', {bubbles: true}))")  # fmt: skip
            tab.wait("!document.querySelector('#plan-yes').disabled")
            # On a machine that is too busy for the loop's rate gains are doubtful.
            assert all(part in tab.text("#plan-lines") for part in parts)
            tab.click("#plan-yes")

        tab.wait("document.body.dataset.phase === 'idle'")
        tab.click("#start")
        tab.wait("!document.querySelector('#plan-yes').disabled")
        assert "relay between" in tab.text("#plan-lines")
        tab.click("#plan-yes")
        complete = "document.querySelector('#live-status').innerText === 'the tune is complete'"
        other.wait(complete, 120.0)
        tab.call("Page.reload")
        for each in (tab, other):
            each.wait(f"{complete} && document.querySelector('#gains').innerText.startsWith('kc')")
            each.wait("document.querySelector('#plot-live-measurement .curve')")
            assert each.text("#verdict").startswith(("gains ready to use", "doubtful gains"))
            assert each.eval("document.querySelectorAll('#live-cycles li').length") > 0
            # the model over the data, and how sure it is
            each.wait("document.querySelectorAll('#plot-so-far .curve').length === 2")
            each.wait(
                "document.querySelectorAll('#plot-ku .curve').length === 1"
                "|| document.querySelector('#plot-ku').hidden"
            )
            assert "dead time" in each.text("#live-estimates")
        kc = re.search(r"kc (\S+)", tab.text("#gains"))[1]
        assert kc in tab.eval("document.querySelector('#live-result').textContent")
        assert str(rig.records) in tab.text("#command")
        # calmer gains than those of the tune are shaped, applied and proven
        tab.eval("ms = document.querySelector('#ms'), ms.value = 1.3,"
                 "ms.dispatchEvent(new Event('input'))")  # fmt: skip
        tab.wait("document.body.dataset.settled === 'yes'")
        calm = re.search(r"kc (\S+)", tab.text("#gains"))[1]
        assert float(calm) < float(kc)
        tab.wait("document.querySelector('#beside').innerText.includes('0.3000')")
        # the tune has moved it away from its set-point
        rig.until(
            lambda: all(abs(y - 5.0) < 0.02 for y in page.samples["measurement"][-100:]), "rest"
        )
        agree("#prove", "kc 0.3000", f"kc {calm}", "by +0.5 y", step="0.5")
        other.wait("document.body.dataset.phase === 'verifying'")
        other.wait("document.body.dataset.phase === 'idle'", 90.0)
        assert "passed" in other.text("#live-status")
        assert f"{rig.values(gains, 'kc')[0]:.4f}" == calm
        for each in (tab, other):
            assert "passed" in each.text("#force-proof")
            assert each.eval("document.querySelectorAll('#plot-proof .curve').length") == 2
        # a verification that is ended on another page takes nothing back
        agree("#verify", f"has kc {calm}", "and back")
        other.wait("!document.querySelector('#abort').disabled")
        other.click("#abort")
        tab.wait(
            "document.querySelector('#live-status').innerText.includes('cancelled')"
            "|| document.querySelector('#live-status').innerText.includes('was ended')"
        )
        assert f"{rig.values(gains, 'kc')[0]:.4f}" == calm
        agree("#revert", "those before: kc 0.3, ti 0.8 s")
        tab.wait("document.querySelector('#live-status').innerText.includes('again')")
        assert rig.values(gains, "kc", "ti") == [0.3, 0.8]
        # a refusal is told with its reason
        rig.call(
            SetParameters, f"{gains}/set_parameters",
            SetParameters.Request(parameters=[Parameter("kc_max", value=0.35).to_parameter_msg()]),
        )  # fmt: skip
        agree("#apply", "they are not verified")
        tab.wait("document.querySelector('#live-status').innerText.includes('out of bounds')")
        assert rig.values(gains, "kc") == [0.3]
        assert tab.said == other.said == []
    command.signal(signal.SIGINT)
    assert command.wait() == 0


def test_after_a_failed_tune_the_page_says_how_the_plant_is_left_and_shows_what_it_does(
    rig: Rig,
) -> None:
    rig.start("plant_node", "-r", "measurement:=/level", "-r", "command:=/valve", **MOVING)
    words = ("--measurement", "/level", "--command", "/valve", "--at", "0.0")
    limits = ("--within", "-40", "40", "--command-within", "-2", "5")
    command = rig.start_command("tune_loop", *words, *limits, "--web", "--record-only")
    found = rig.until(lambda: re.search(r"the page is at (\S+)", command.log), "the address")
    page = OpenPage(found[1])
    accepted(rig, page)
    page.do("start")
    rig.until(lambda: page.phase == "tuning", "a tune")
    rig.until(lambda: page.phase == "idle", "its end")
    assert "the command stands at 0 u, which is not the one" in page.snapshot["status"]
    assert page.snapshot["window"] == []
    command.signal(signal.SIGINT)
    assert command.wait() == 1
