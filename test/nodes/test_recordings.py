# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How the recordings of a node end."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Float64

from relay_autotune import nodes
from relay_autotune.cli.own_nodes import free_domain
from relay_autotune.nodes import recording as recording_module
from relay_autotune.nodes.recording import RESULTS, Recording
from relay_autotune.nodes.results import SignsOfLife, said_by
from relay_autotune_msgs.msg import PidGains, TransferFunction

PATIENCE = 500


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with free_domain() as domain:
        rclpy.init(domain_id=domain)
        node = Node("recorder", use_global_arguments=False)
        yield node
        node.destroy_node()
        rclpy.try_shutdown()


def test_one_that_lacks_results_is_told_after_one_that_lacks_nothing(
    node: Node,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    results = dict(zip(RESULTS, (TransferFunction, PidGains), strict=True))
    topics = {"measurement": Float64, "command": Float64, **results}
    ends = {name: node.create_publisher(kind, name, 10) for name, kind in topics.items()}
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    for experiment, complete in (("whole", True), ("lacking", False)):
        recording = Recording(node, ends, str(tmp_path), experiment)
        assert recording.problem() == "" and recording.path == tmp_path / experiment
        recording.sample((1, 1, 1.0, 1, 0.5))
        if complete:
            for name, kind in results.items():
                recording.message(name, 2, kind(final=True))
        closed: list[str] = []
        recording.close_with_results(0.05, closed.append)
        # What the identifier is at goes on, as it says it.
        signs: list[Any] = []
        life = SignsOfLife(node)
        monkeypatch.setattr(life, "_publisher", SimpleNamespace(publish=signs.append))
        life.work_on(experiment)
        life.at("comparing structures")
        life._tell()
        assert [said_by(sign) for sign in signs] == [
            (experiment, True, ""), (experiment, True, "comparing structures"),
        ]  # fmt: skip
        recording.note_progress(*said_by(signs[-1])[1:])
        waits_for = recording.awaited()
        assert waits_for.endswith("s: comparing structures") is not complete
        # The identifier has sent all, of which the model was refused.
        recording.note_progress(False, "the model was refused")
        recording.note_progress(False, "")
        for _ in range(PATIENCE):
            if closed:
                break
            executor.spin_once(timeout_sec=0.02)
        assert ("no transfer_function and no pi_gains" in closed[0]) is not complete
        assert ("the model was refused" in closed[0]) is not complete
        recording.join(10.0)
        assert recording.problem() == ""
    Recording(node, ends, str(tmp_path), "alone").close_with_results(0.0, closed.append)
    for _ in range(PATIENCE):
        if len(closed) > 1:
            break
        executor.spin_once(timeout_sec=0.02)
    assert closed[1].endswith("no pi_gains: a recording alone was asked for")
    executor.shutdown()
    told = capfd.readouterr().err
    assert "[INFO]" in told and "whole is closed with model and gains" in told
    assert "[WARN]" in told and "lacking is closed without" in told


def test_its_path_can_be_typed_in_another_folder(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    topics = ("measurement", "command")
    ends = {name: node.create_publisher(Float64, name, 10) for name in topics}
    recording = Recording(node, ends, "records", "one")
    assert recording.path == tmp_path / "records" / "one"
    recording.close("")
    recording.join(10.0)


def test_it_waits_as_long_as_the_identifier_gets_on(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(
        recording_module, "time", SimpleNamespace(monotonic=lambda: now[0], time_ns=int)
    )
    topics = ("measurement", "command", *RESULTS)
    ends = {name: node.create_publisher(Float64, name, 10) for name in topics}
    recording = Recording(node, ends, str(tmp_path), "slow")
    closed: list[str] = []
    recording.close_with_results(10.0, closed.append)
    for stage in (*(f"stage {k}" for k in range(20)), *["the last one"] * 5):
        now[0] += 100.0
        recording.note_progress(True, stage)
    assert now[0] == 2500.0
    waits_for = recording.awaited()
    assert waits_for.startswith("waiting for identifier_node")
    recording.close("")
    (reason,) = closed
    assert "has not got on from the last one for" in reason
    recording.join(10.0)


def test_each_line_that_logs_has_one_severity() -> None:
    # A logger raises where a line of code logs with another severity than before.
    for path in sorted(Path(nodes.__file__).parent.glob("*.py")):
        chosen = re.findall(r"(?:get_logger\(\)|\blog)\.\w+\b(?!\()", path.read_text())
        assert not chosen, path.name
