# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""tune_loop over real DDS, started like by a user or by a script."""

from __future__ import annotations

import json
import math
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from loop_rig import RELIABLE, Rig
from rcl_interfaces.srv import GetParameters
from std_msgs.msg import Float64

from relay_autotune.record.record import Outcome
from relay_autotune.recordings import read_experiments
from relay_autotune_msgs.msg import RelayExperiment

LOOP = {
    "sample_period": 0.1,
    "structure": "fopdt",
    "gain": 2.0,
    "time_constants": [2.0],
    "dead_time": 1.0,
    "operating_point": [5.0, 1.0],
    "noise_std": 0.005,
}
NAMED = ("-r", "__ns:=/tank")


def command(rig: Rig, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [shutil.which("tune_loop"), *arguments],
        env=rig.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(rig: Rig, *arguments: str) -> tuple[int, str, str]:
    process = command(rig, *arguments)
    output, said = process.communicate(timeout=90.0)
    assert "Traceback" not in said
    return process.returncode, output, said


def error(said: str) -> str:
    """Return the one line of an error, after those that say what is done or looked for."""
    *looked, last = said.splitlines()
    assert all(line.startswith(("joining ", "looking for ")) for line in looked), said
    return last


def ready(rig: Rig) -> None:
    """Wait until a tune could start, by repeated requests."""
    asked = {"node": "tank/relay_node", "dry_run": True}
    rig.until(lambda: rig.ask_for_tune(**asked).accepted, "a loop that is ready")


def test_a_tune_is_shown_and_its_result_printed(rig: Rig) -> None:
    # While it waits for this test's commands a lockstep without limit would take a processor.
    quick = {"mode": "lockstep", "lockstep_speed": 15.0, "seed": 3}
    rig.start("plant_node", *NAMED, **quick, **LOOP)
    records = str(rig.records)
    rig.start(
        "relay_node", *NAMED, amplitude=0.5, baseline=1.0, sample_period=0.1,
        record_directory=records,
    )  # fmt: skip
    ready(rig)
    status, output, said = run(rig, "--namespace", "tank", "--dry-run", "--amplitude", "0.25")
    assert status == 0
    assert output.startswith("ok    levels        relay between 0.825 and 1.325 u")
    assert output.endswith("tune_loop --namespace tank --amplitude 0.25\n")
    status, output, said = run(rig, "--namespace", "tank", "--dry-run", "--at", "1.2")
    assert status == 0 and "between 0.85 and 1.85 u" in output
    names = GetParameters.Request(names=["baseline", "safe_command"])
    kept = rig.call(GetParameters, "tank/relay_node/get_parameters", names).values
    assert kept[0].double_value == 1.0 and math.isnan(kept[1].double_value)
    said = "tune_loop: no relay_node"  # on a busy machine it is not found so soon
    while error(said).startswith("tune_loop: no relay_node"):
        status, output, said = run(rig, "--namespace", "tank", "--wait", "0.5")
    assert status == 1
    assert error(said).startswith("tune_loop: no identifier_node publishes /tank/pi_gains")
    rig.identifier(*NAMED, rule="imc")
    page = rig.records.parent / "page.html"
    status, output, said = run(rig, "--report", str(page), "--ros-args", "-r", "__ns:=/tank")
    assert status == 0, said
    assert "\x1b" not in output + said
    for part in ("tune of /tank/relay_node", "cycle 2, period", "left", "completed, period"):
        assert part in said
    (bag,) = Path(records).iterdir()
    for part in ("completed: ", "(fopdt, waveform)", "kc ", str(bag), f"xdg-open {page}"):
        assert part in output
    assert output.endswith(f"replay {bag} --rule imc --structure fopdt\n")
    kc = re.search(r"kc (\S+)", output)[1]
    assert kc in page.read_text()


class Watched:
    """A tune by tune_loop of a slow process, whose relay has made its first step.

    :param rig: the rig.
    :param output: a terminal for tune_loop; None: two pipes.
    """

    def __init__(self, rig: Rig, output: int | None = None) -> None:
        self.rig = rig
        self.commands = rig.listen("tank/command", Float64, RELIABLE)
        self.experiments = rig.listen("tank/relay_experiment", RelayExperiment)
        slow = LOOP | {"time_constants": [50.0], "sample_period": 0.02}
        rig.start("plant_node", *NAMED, **slow)
        self.relay = rig.start(
            "relay_node", *NAMED, amplitude=0.5, baseline=1.0, settle_time=0.4,
            record_directory=str(rig.records), measurement_timeout=10.0,
        )  # fmt: skip
        ready(rig)
        words = ("--namespace", "/tank", "--record-only")
        if output is None:
            self.process = command(rig, *words, "--json")
        else:
            self.shown = rig.start_command("tune_loop", *words, output=output)
        rig.until(self.is_moving, "a step")

    def is_moving(self) -> bool:
        return any(m.data != 1.0 for m in self.commands)

    def until_safe(self) -> None:
        self.rig.until(lambda: self.commands[-1].data == 1.0, "the safe command")

    def end(self) -> tuple[str, str]:
        """Return the output of tune_loop after its end."""
        output, said = self.process.communicate(timeout=15.0)
        assert self.process.returncode == 1
        assert "Traceback" not in said
        assert "never awaited" not in said + self.relay.log
        return output, said


def test_ctrl_c_cancels_and_says_that_the_safe_command_is_out(rig: Rig) -> None:
    tune = Watched(rig)
    tune.process.send_signal(signal.SIGINT)
    output, said = tune.end()
    assert "cancelling: the safe command goes out" in said
    found = json.loads(output)
    assert (found["node"], found["outcome"]) == ("/tank/relay_node", "cancelled")
    assert found["gains"] is None
    assert Path(found["bag"]).is_dir()
    tune.until_safe()


def test_a_terminal_that_is_closed_cancels(rig: Rig) -> None:
    window, inside = pty.openpty()
    tune = Watched(rig, inside)
    os.close(inside)
    os.close(window)
    ended = rig.until(lambda: tune.experiments, "the record")[-1]
    tune.until_safe()
    assert "cancelled" in ended.reason
    assert tune.shown.wait() == 1


@pytest.mark.nightly
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_model_that_takes_for_ever_is_not_waited_for(rig: Rig, number: int) -> None:
    quick = {"mode": "lockstep", "lockstep_speed": 15.0, "seed": 3}
    rig.start("plant_node", *NAMED, **quick, **LOOP)
    relay = rig.start(
        "relay_node", *NAMED, amplitude=0.5, baseline=1.0, sample_period=0.1,
        record_directory=str(rig.records), model_timeout=600.0,
    )  # fmt: skip
    code = """
import sys, threading
from relay_autotune.nodes import identifier
identifier.analyse = lambda *_, **__: threading.Event().wait()
sys.argv += ["--ros-args", "-r", "__ns:=/tank"]
sys.exit(identifier.main())
"""
    rig.start_python("identifier", code)
    ready(rig)
    shown = rig.start_command("tune_loop", "--namespace", "tank", "--json", "--report", "a.html")
    rig.until(lambda: "computing the model" in shown.log, "the computation")
    shown.signal(number)
    assert shown.wait() == 1
    assert "no report: the tune was cancelled" in shown.log
    assert '"outcome": "cancelled"' in shown.log
    # The recording is whole, and the node is ready for the next tune.
    rig.until(lambda: "without transfer_function and pi_gains: cancelled" in relay.log, "its end")
    (record,) = read_experiments(next(rig.records.iterdir())).experiments
    assert record.outcome == Outcome.COMPLETED


def test_the_end_of_relay_node_is_told_with_its_reason(rig: Rig) -> None:
    tune = Watched(rig)
    tune.relay.signal(signal.SIGTERM)
    output, said = tune.end()
    found = json.loads(output)
    assert found["outcome"] == "aborted"
    assert "was stopped by SIGTERM" in found["reason"]
    assert "see to the plant" not in said
    tune.until_safe()


def test_a_relay_node_that_is_killed_is_missed_soon(rig: Rig) -> None:
    """Its entries stay in the graph for 20 s, but tune_loop must notice earlier."""
    tune = Watched(rig)
    tune.relay.signal(signal.SIGKILL)
    output, said = tune.end()
    assert output == ""
    assert "during the tune /tank/relay_node has gone" in said
    assert "see to the plant" in said
    assert tune.commands[-1].data != 1.0


def test_without_a_relay_node_it_says_so_in_one_line(rig: Rig) -> None:
    status, output, said = run(rig, "--namespace", "tank", "--wait", "0.2")
    assert (status, output) == (1, "")
    assert error(said).startswith("tune_loop: no relay_node /tank/relay_node within 0.2 s")
    assert "nodes that offer a tune: none." in said
    status, output, said = run(rig, "--report", "page.doc")
    assert (status, output) == (2, "")
    assert said.count("\n") == 1
    status, output, said = run(rig, "--namespace", "no name")
    assert (status, output) == (2, "")
    assert said.count("\n") == 1


def test_ctrl_c_ends_the_search_for_nodes_at_once(rig: Rig) -> None:
    process = command(rig, "--namespace", "nowhere", "--wait", "600")
    # The node appears in the graph when it begins to look for the others.
    rig.until(lambda: "tune_loop" in rig.node.get_node_names(), "tune_loop")
    process.send_signal(signal.SIGINT)
    output, said = process.communicate(timeout=30.0)
    assert process.returncode == 130
    assert output == ""
    assert all(line.startswith("looking for /nowhere/relay_node, ") for line in said.splitlines())


def test_help_needs_no_graph() -> None:
    start = "from relay_autotune.start import tune_loop; raise SystemExit(tune_loop())"
    done = subprocess.run(
        [sys.executable, "-c", start, "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "--record-only" in done.stdout
