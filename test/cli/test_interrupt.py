# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Ctrl-C while an executable starts, or is at work."""

from __future__ import annotations

import os
import pty
import random
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BAG = ROOT / "bags/biased_relay"
PLANT = ["--ros-args", "-p", "numerator:=[1.0]", "-p", "denominator:=[20.0, 1.0]"]

# As the installed script does it; that one has begun when it says so.
BEGIN = """
import sys
from relay_autotune.start import {0}
print("begins", flush=True)
sys.exit({0}())
"""


def interrupted(name: str, words: list[str], delay: float) -> tuple[int, str]:
    """Return exit status and standard error of an executable that is interrupted after a delay."""
    given = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}
    process = subprocess.Popen(
        [sys.executable, "-c", BEGIN.format(name), *words],
        cwd=ROOT, env=given, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        # Tests in the background of a script ignore it, and what they start would go on so.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "begins\n"
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    return process.returncode, said


@pytest.mark.long
@pytest.mark.parametrize("moments", [2, pytest.param(8, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    ("name", "words", "ends"),
    [
        ("replay", [str(BAG)], {-signal.SIGINT, 130, 0}),
        ("identify", ["--method", "wang_biased"], {-signal.SIGINT, 130, 1, 2}),
        ("plant_node", PLANT, {-signal.SIGINT, 0}),
    ],
)
def test_no_traceback_at_any_moment(name, words, ends, moments):
    rng = random.Random(name)
    for _ in range(moments):
        status, said = interrupted(name, words, rng.uniform(0.01, 0.7))
        assert status in ends, said
        assert "Traceback" not in said
        assert "KeyboardInterrupt" not in said


ASK = """
from relay_autotune.cli.terminal import _input
for _ in range(300):
    try:
        _input("ask ")
    except KeyboardInterrupt:
        print("came")
print(_input("ask "))
"""


def test_ctrl_c_as_a_prompt_appears_is_heeded():
    window, inside = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", ASK], cwd=ROOT, stdin=inside, stdout=inside, stderr=inside,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    os.close(inside)
    heard = b""
    try:
        for count in range(1, 302):
            while heard.count(b"ask ") < count or heard.count(b"came") < count - 1:
                assert select.select([window], [], [], 30.0)[0], "it waits for a line"
                heard += os.read(window, 4096)
            if count <= 300:
                process.send_signal(signal.SIGINT)
        os.write(window, b"a line\n")
        assert process.wait(30.0) == 0
    finally:
        process.kill()
        process.wait()
        os.close(window)


@pytest.mark.long
def test_ctrl_c_while_the_processes_of_a_fleet_load_is_no_traceback(tmp_path):
    # What the fork server loads first interrupts it there.
    (tmp_path / "loaded_first.py").write_text(
        "import os, signal; os.kill(os.getpid(), signal.SIGINT)"
    )
    code = (
        "import sys; from relay_autotune.cli import fleet, replay\n"
        "fleet._PRELOADED.insert(0, 'loaded_first')\n"
        "sys.exit(replay.main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "--jobs", "2", "no_bag", "nor_this"],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True,
        check=False, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    # The command itself was not meant.
    assert done.returncode == 1
    assert "KeyboardInterrupt" not in done.stderr
    assert done.stderr.count("does not exist") == 2


@pytest.mark.long
def test_one_that_is_not_to_be_interrupted():
    """Whoever starts a command with SIGINT ignored, as nohup and `&` in a script do, means it."""
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "import sys; sys.argv[1:] = ['--help']\n"
        "from relay_autotune.start import csv_to_bag\n"
        "try:\n"
        "    csv_to_bag()\n"
        "finally:\n"
        "    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


CLOSED = """
import signal, sys, time
from relay_autotune.cli.terminal import end_with_terminal
signal.signal(signal.SIGHUP, signal.{0})
end_with_terminal()
print("begins", flush=True)
time.sleep({1})
"""


@pytest.mark.parametrize(("handler", "seconds", "status"), [
    ("SIG_DFL", 60.0, -signal.SIGHUP),
    # As nohup leaves it.
    ("SIG_IGN", 1.0, 0),
])  # fmt: skip
def test_a_closed_terminal_ends_a_command_which_the_system_sends_no_signal(
    handler: str, seconds: float, status: int
) -> None:
    master, slave = pty.openpty()
    # In a session without a terminal nobody sends it SIGHUP.
    process = subprocess.Popen(
        [sys.executable, "-c", CLOSED.format(handler, seconds)],
        cwd=ROOT, text=True, stdin=slave, stdout=subprocess.PIPE, stderr=slave,
        start_new_session=True,
    )  # fmt: skip
    os.close(slave)
    assert process.stdout is not None
    assert process.stdout.readline() == "begins\n"
    os.close(master)
    assert process.wait(30.0) == status


def test_what_the_middleware_prints_does_not_stand_in_a_result() -> None:
    code = (
        "import os; from relay_autotune.cli.arguments import guarded_in_graph\n"
        "print('before')\n"
        "raise SystemExit(guarded_in_graph('any', lambda _: print(os.write(1, b'noise')) or 3))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (3, "before\n5\n", "noise")


def test_a_result_stands_before_the_error_that_followed_it() -> None:
    code = (
        "import sys; from relay_autotune.cli.arguments import guarded_in_graph\n"
        "guarded_in_graph('any', lambda _: print('result') or sys.stderr.write('error'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert done.stdout == b"result\nerror"
