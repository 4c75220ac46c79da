# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""tune_loop on a loop that has nothing but its topics: it starts and ends its own nodes."""

from __future__ import annotations

import os
import pty
import re
import shutil
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from loop_rig import RELIABLE, Rig
from pages import block_noted, blocks, commands, matches
from ros_domain import mapped_segments
from std_msgs.msg import Float64

FAST = {
    "sample_period": 0.005,
    "structure": "fopdt",
    "gain": 1.65,
    "time_constants": [0.1],
    "dead_time": 0.05,
    "operating_point": [40.0, 2.0],
    "noise_std": 0.02,
}
# A controller closes this loop also on a busy machine.
SLOWER = FAST | {"sample_period": 0.02, "time_constants": [0.4], "dead_time": 0.2}
TOPICS = ("-r", "measurement:=/tank/level", "-r", "command:=/tank/valve")
PAGE = "docs/tutorial.md"
WORDS = (
    "--measurement", "/tank/level", "--command", "/tank/valve", "--within", "30", "50",
    "--at", "2", "--amplitude", "1", "--command-within", "0", "5", "--yes", "--wait", "30",
)  # fmt: skip


def begun(rig: Rig, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [shutil.which("tune_loop"), *WORDS, *words],
        env=rig.environment | {"HOME": str(rig.folder)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def nodes_of(parent: int) -> list[int]:
    """Return the processes that a process has started."""
    text = Path(f"/proc/{parent}/task/{parent}/children").read_text()
    return [int(number) for number in text.split()]


def is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()


def on_screen(written: str) -> str:
    """Return what a terminal shows in the end, of lines that are written in place, too."""
    lines = [""]
    for part in re.split(r"(\n|\r\x1b\[K|\x1b\[\d+A\x1b\[J)", written.replace("\r\n", "\n")):
        if part == "\n":
            lines.append("")
        elif part.startswith("\r"):
            lines[-1] = ""
        elif part.startswith("\x1b"):
            del lines[-1 - int(part[2 : part.index("A")]) :]
            lines.append("")
        else:
            lines[-1] += part
    return "\n".join(lines)


@pytest.mark.nightly
def test_the_session_of_the_tutorial_leads_to_proven_gains_and_leaves_nothing_running(
    rig: Rig,
) -> None:
    heard = rig.listen("/tank/valve", Float64, RELIABLE)
    (plant,) = commands(block_noted(PAGE, "tested: a plant for a session").text)
    rig.start("plant_node", *plant[plant.index("--ros-args") + 1 :])
    (call, *_) = (
        words
        for block in blocks("sh")
        for words in commands(block.text)
        if block.page == PAGE and "--within" in words
    )
    shown = block_noted(PAGE, "tested: a session").text
    prompt = re.compile(r"(.*(?:such as .*:|\[y/N\]|such as .*\]|\[none\]:)) (.*)")
    answers = [found[2] for line in shown.splitlines() if (found := prompt.fullmatch(line))]
    assert len(answers) == 5
    window, inside = pty.openpty()
    environment = {"HOME": str(rig.folder), "COLUMNS": "99", "NO_COLOR": "1"}
    process = subprocess.Popen(
        [shutil.which("tune_loop"), *call[call.index("tune_loop") + 1 :], "--wait", "30"],
        env=rig.environment | environment, cwd=rig.folder,
        stdin=inside, stdout=inside, stderr=inside,
    )  # fmt: skip
    os.close(inside)
    os.set_blocking(window, False)
    written, asked_at = bytearray(), [0]

    def is_over() -> bool:
        with suppress(OSError):
            written.extend(os.read(window, 1 << 16))
        last = on_screen(written.decode(errors="replace")).rpartition("\n")[2]
        if answers and len(written) > asked_at[0] and prompt.fullmatch(last):
            asked_at[0] = len(written)
            os.write(window, f"{answers.pop(0)}\n".encode())
        return process.poll() is not None

    rig.until(is_over, "its end", timeout=240.0)
    is_over()
    screen = on_screen(written.decode())
    assert process.returncode in (0, 3), screen
    assert matches(shown, screen, within=0.5), screen
    # Forty times the noise of 0.02, where half of the swing would be 0.15. On a busy machine what
    # the model leaves counts as noise, too.
    height = re.search(r"set-point step +\+(\d[\d.]*) y: overshoot", screen)
    assert height and 0.6 < float(height[1]) < 1.6, screen
    settings = yaml.safe_load((rig.folder / "gains.yaml").read_text())["/**"]["ros__parameters"]
    assert settings["kc"] == pytest.approx(0.64, rel=0.5)
    assert settings["safe_command"] == 2.0
    rig.until(lambda: heard[-1].data == 2.0, "the command that was said")
    ours = {"relay_node", "identifier_node", "controller_node", "tune_loop"}
    rig.until(lambda: not ours & set(rig.node.get_node_names()), "the end of its nodes")


def until_it_steps(rig: Rig, process: subprocess.Popen[str]) -> None:
    """Wait until a proof makes its step."""
    os.set_blocking(process.stderr.fileno(), False)
    said = bytearray()

    def is_stepping() -> bool:
        with suppress(BlockingIOError):
            said.extend(os.read(process.stderr.fileno(), 1 << 16))
        return b"step 1 of 1" in said

    rig.until(is_stepping, "the step", timeout=180.0)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("number", "node"),
    [
        (signal.SIGINT, ""),
        (signal.SIGTERM, ""),
        (signal.SIGHUP, ""),
        (signal.SIGKILL, ""),
        (signal.SIGKILL, "controller_node"),
        (signal.SIGKILL, "relay_node"),
    ],
)
def test_a_proof_that_is_ended_leaves_the_command_before_the_tune(
    rig: Rig, number: int, node: str
) -> None:
    heard = rig.listen("/tank/valve", Float64, RELIABLE)
    rig.start("plant_node", *TOPICS, **SLOWER | {"noise_std": 0.002})
    process = begun(rig, "--verify", "--step", "2")
    until_it_steps(rig, process)
    started = nodes_of(process.pid)
    assert len(started) == 3
    by_name = {
        name: pid
        for pid in started
        for name in ("relay_node", "controller_node")
        if name in Path(f"/proc/{pid}/cmdline").read_text()
    }
    hit = by_name.get(node, process.pid)
    if number == signal.SIGKILL:
        # What it leaves behind is removed with the rig.
        rig.processes[0].segments |= mapped_segments(hit)
    os.kill(hit, number)
    rig.until(lambda: process.poll() is not None, "its end")
    output = process.stdout.read()
    rig.until(lambda: not any(map(is_there, started)), "the end of its nodes")
    rig.until(lambda: heard[-1].data == 2.0, "the command before the tune")
    if node == "relay_node":
        assert "the safe command 2 u was sent in its place" in process.stderr.read()
        return
    if node or number != signal.SIGKILL:
        assert "the command stands at 2 u" in output


@pytest.mark.nightly
def test_another_node_that_commands_ends_a_proof(rig: Rig) -> None:
    rig.start("plant_node", *TOPICS, **SLOWER | {"noise_std": 0.002})
    process = begun(rig, "--verify", "--step", "2")
    until_it_steps(rig, process)
    other = rig.node.create_publisher(Float64, "/tank/valve", RELIABLE)
    rig.until(lambda: process.poll() is not None, "its end")
    rig.node.destroy_publisher(other)
    assert process.returncode != 0
    name = rig.node.get_fully_qualified_name()
    told = " ".join(process.stdout.read().split())
    assert f"/tank/valve is also published by {name}: two of them would fight" in told
    assert f"was sent, but {name} commands, too" in told


def test_if_the_command_is_killed_its_nodes_end_with_the_safe_command(rig: Rig) -> None:
    heard = rig.listen("/tank/valve", Float64, RELIABLE)
    rig.start("plant_node", *TOPICS, **FAST | {"time_constants": [50.0]})
    process = begun(rig, "--record-only")
    rig.until(lambda: any(m.data != 2.0 for m in heard), "a step", timeout=90.0)
    started = nodes_of(process.pid)
    assert len(started) == 1
    process.send_signal(signal.SIGKILL)
    process.communicate()
    rig.until(lambda: not any(map(is_there, started)), "the end of its nodes")
    rig.until(lambda: heard[-1].data == 2.0, "the safe command")


def test_a_node_that_starves_is_not_taken_for_gone_and_one_that_is_killed_is_missed_soon(
    rig: Rig,
) -> None:
    heard = rig.listen("/tank/valve", Float64, RELIABLE)
    rig.start("plant_node", *TOPICS, **FAST | {"time_constants": [50.0]})
    process = begun(rig, "--record-only")
    rig.until(lambda: any(m.data != 2.0 for m in heard), "a step", timeout=90.0)
    (relay,) = nodes_of(process.pid)
    os.kill(relay, signal.SIGSTOP)
    # Four times the time in which a node has to renew its liveliness.
    rig.run_for(4.0)
    assert process.poll() is None
    # What it leaves behind is removed with the rig.
    rig.processes[0].segments |= mapped_segments(relay)
    os.kill(relay, signal.SIGKILL)
    _, said = process.communicate(timeout=15.0)
    assert "during the tune relay_node was ended by signal 9 (Killed)" in said
    assert "the safe command 2 u was sent in its place" in said
    rig.until(lambda: heard[-1].data == 2.0, "the safe command")


def test_a_node_that_hangs_is_ended_and_the_safe_command_sent(rig: Rig) -> None:
    heard = rig.listen("/tank/valve", Float64, RELIABLE)
    rig.start("plant_node", *TOPICS, **FAST | {"time_constants": [50.0]})
    process = begun(rig, "--record-only")
    rig.until(lambda: any(m.data != 2.0 for m in heard), "a step", timeout=90.0)
    (relay,) = nodes_of(process.pid)
    rig.processes[0].segments |= mapped_segments(relay)
    os.kill(relay, signal.SIGSTOP)
    _, said = process.communicate(timeout=60.0)
    assert process.returncode == 1
    assert "hangs; the safe command 2 u was sent in its place" in said
    rig.until(lambda: heard[-1].data == 2.0, "the safe command")
    assert not is_there(relay)


def test_a_command_at_which_the_process_does_not_rest_ends_the_tune(rig: Rig) -> None:
    heard = rig.listen("/tank/valve", Float64, RELIABLE)
    slow = {"time_constants": [5.0], "sample_period": 0.02, "gain": 5.0}
    rig.start("plant_node", *TOPICS, **FAST | slow)
    # The plant rests at 40 with 2, and would go to 55, beyond the limit of 50, with 5.
    process = begun(rig, "--at", "5", "--command-within", "0", "9", "--record-only")
    rig.until(lambda: process.poll() is not None, "its end", timeout=90.0)
    output = process.stdout.read()
    assert process.returncode == 1
    told = " ".join(output.split())
    number = r"(\d+\.?\d*) y"
    found = re.search(f"failed: the measurement rested at {number} and is at {number}", told)
    assert float(found[1]) == pytest.approx(40.0, abs=0.05)
    assert float(found[2]) < 43.0
    assert "5 u is not the present command" in told
    assert "the command stands at 5 u, which is not the one at which the process rested" in told
    assert "run it again" not in told
    assert {message.data for message in heard} == {5.0}


@pytest.mark.parametrize(
    ("topic", "meant"),
    [
        ("/tank/levle", "; type --measurement /tank/level"),
        ("/tank/valve", ", but a subscription: the topics may be the wrong way round"),
    ],
)
def test_a_topic_that_is_not_there_is_told_with_what_may_be_meant(
    rig: Rig, topic: str, meant: str
) -> None:
    rig.start("plant_node", *TOPICS, **FAST)
    # The command is given as the measurement where that is given as the command.
    words = [{"/tank/level": topic, topic: "/tank/level"}.get(word, word) for word in WORDS]
    done = subprocess.run(
        [shutil.which("tune_loop"), *words, "--wait", "6"],
        env=rig.environment, capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    told = done.stderr.splitlines()[-1]
    assert told.startswith(f"tune_loop: {topic} has no publisher within 6 s{meant}")


def test_what_cannot_be_a_topic_is_refused_in_one_line(rig: Rig) -> None:
    words = [word.replace("/tank/level", "/tank/le vel") for word in WORDS]
    done = subprocess.run(
        [shutil.which("tune_loop"), *words],
        env=rig.environment, capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    told = done.stderr.splitlines()[-1]
    assert told.startswith(
        "tune_loop: no topic can be '/tank/le vel': topic name must not contain"
    )


@pytest.mark.nightly
def test_a_sensor_of_less_than_one_sample_a_second_is_tuned(rig: Rig) -> None:
    heard = rig.listen("/tank/valve", Float64, RELIABLE)
    slow = {"sample_period": 1.2, "time_constants": [4.0], "dead_time": 1.0}
    rig.start("plant_node", *TOPICS, **FAST | slow)
    process = begun(rig, "--record-only")
    # Each sample of the tune is answered: the sensor was silent for 1.2 s between two of them.
    rig.until(lambda: len(heard) > 3 or process.poll() is not None, "answers", timeout=120.0)
    process.send_signal(signal.SIGINT)
    output, said = process.communicate(timeout=30.0)
    assert "cancelled" in output, said
    assert re.search(r"0\.8[34]\d* per second", " ".join(said.split())), said
