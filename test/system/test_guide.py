# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The live commands of README and guide, exactly as written there."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
from loop_rig import Rig
from pages import ROOT, block_noted, blocks, commands, rows
from rcl_interfaces.srv import ListParameters
from rclpy.action import get_action_server_names_and_types_by_node

from relay_autotune.cli.simulated_loop import installed
from relay_autotune.nodes.plant import model_from
from relay_autotune.tuning import RULES
from relay_autotune.tuning.task import DesignOptions, DesignTask
from relay_autotune_msgs.msg import PidGains
from tools.fill_docs import TABLES

TUTORIAL = "docs/tutorial.md"
# Topics and services of every rclpy node.
COMMON_TOPICS = {"/rosout", "/parameter_events"}
COMMON_SERVICE_TYPES = ("rcl_interfaces/", "type_description_interfaces/")
COMMON_PARAMETERS = ("qos_overrides.", "use_sim_time", "start_type_description_service")


def start_as_shown(rig: Rig, page: str, note: str) -> dict[str, Any]:
    """Start what a block starts, and return the request of its service call."""
    *starts, call = commands(block_noted(page, note).text)
    for words in starts:
        assert words[:3] == ["ros2", "run", "relay_autotune"]
        own: dict[str, Any] = {}
        if words[3] == "relay_node":
            # A parallel test may delay the plant for a second.
            own = {"record_directory": str(rig.records), "measurement_timeout": 10.0}
        arguments = [word for word in words[4:] if word != "--ros-args"]
        rig.start(words[3], *arguments, **own)
    assert call[:3] == ["ros2", "service", "call"]
    assert call[3:5] == ["/relay_node/start_tune", "relay_autotune_msgs/srv/StartTune"]
    return yaml.safe_load(call[5])


def plant_shown(page: str, note: str) -> dict[str, Any]:
    """Return the parameters that a block gives to plant_node."""
    values = {entry.name: entry.default for entry in TABLES["plant_node"]}
    for word in commands(block_noted(page, note).text)[0]:
        name, assigned, value = word.partition(":=")
        if assigned:
            values[name] = yaml.safe_load(value)
    return values


@pytest.mark.nightly
def test_the_tutorial_is_followed_to_its_end_without_the_ros2_command(rig: Rig) -> None:
    """A test in real time: a busy machine disturbs the loop, so the verdict is not checked.

    With 20 samples a second, where the guide has 50: four nodes take a third of a processor then.
    """
    text = (ROOT / TUTORIAL).read_text().partition("## A loop without nodes")[0]
    typed = [b for b in blocks("sh") if b.page == TUTORIAL and b.text in text]
    first, *then = (words for b in typed for words in commands(b.text))
    assert first == ["simulated_loop"]
    parameters = yaml.safe_load(installed("tutorial.yaml").read_text())
    parameters["/**/plant_node"]["ros__parameters"]["sample_period"] = 0.05
    # A parallel test may delay a node for seconds.
    parameters["/**/relay_node"]["ros__parameters"] |= {
        "controller_timeout": 10.0,
        "measurement_timeout": 10.0,
    }
    slower = rig.folder / "slower.yaml"
    slower.write_text(yaml.safe_dump(parameters))
    first += ["--params", str(slower)]
    environment = rig.environment | {"HOME": str(rig.folder), "PATH": without_ros2()}
    rig.environment = environment
    window, inside = pty.openpty()
    process = subprocess.Popen(
        first, env=environment, stdin=inside, stdout=inside, stderr=inside, cwd=rig.folder
    )
    os.close(inside)
    os.set_blocking(window, False)
    written = bytearray()

    def said(end: str) -> bool:
        with suppress(OSError):
            written.extend(os.read(window, 1 << 16))
        assert process.poll() is None or end == "ended", written.decode()
        return end in written.decode(errors="replace")

    try:
        shown = block_noted(TUTORIAL, "tested: set-points").text
        asks, _, setpoint = shown.splitlines()[0].rpartition(" ")
        rig.until(lambda: said(asks), "the first question")
        os.write(window, f"{setpoint}\n".encode())
        rig.until(lambda: said(" 10 s  measurement 4"), "the answer to a set-point")
        os.write(window, b"40.0\n")
        for words in then:
            last = sorted((rig.folder / ".ros/relay_autotune").glob("2*"))
            given = [str(last[-1]) if word.startswith("~/") else word for word in words]
            if given[0] == "report":
                continue  # of which test_tune_loop.py tests one of such a tune
            if given[0] == "apply_gains":
                given += ["--yes", "--accept-doubtful"]
            done = subprocess.run(
                given, env=environment, cwd=rig.folder, capture_output=True, text=True, timeout=200
            )
            allowed = (0, 1) if given[0] == "apply_gains" else (0, 3)
            assert done.returncode in allowed, done.stdout + done.stderr
        # New or, where noise hides the step, those of before.
        assert "in force" in done.stdout
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30.0)
    assert said("ended")
    assert process.returncode == 0
    ours = {"relay_node", "identifier_node", "controller_node", "plant_node"}
    rig.until(lambda: not ours & set(rig.node.get_node_names()), "the end of its nodes")


def without_ros2() -> str:
    """Return the PATH without the folders that hold the `ros2` command."""
    folders = os.environ["PATH"].split(os.pathsep)
    return os.pathsep.join(f for f in folders if not Path(f, "ros2").exists())


def test_the_commands_for_a_tune_in_lockstep_give_the_same_gains_every_time(rig: Rig) -> None:
    page, note = "docs/plant.md", "tested: a tune in lockstep"
    gains = rig.listen("pi_gains", PidGains)
    rig.tune(**start_as_shown(rig, page, note))
    rig.until(lambda: gains, "gains", timeout=60.0)
    plant = plant_shown(page, note)
    options = DesignOptions(
        sample_period=plant["sample_period"], noise_std=plant["noise_std"], amplitude=1.0
    )
    wanted, _ = RULES["robust"](DesignTask(model=model_from(plant), options=options))
    assert gains[0].kc == pytest.approx(wanted.kc, rel=0.05)
    assert gains[0].ti == pytest.approx(wanted.ti, rel=0.05)


@pytest.mark.nightly
def test_the_job_of_a_build_server_gives_gains_and_ends_its_nodes(rig: Rig) -> None:
    """The block is run as it is written, with all nodes started at once."""
    text = block_noted("docs/quick_start.md", "tested: a job of a build server").text
    folder = rig.records.parent
    done = subprocess.run(
        ["bash", "-e", "-c", text],
        cwd=folder,
        env=rig.environment | {"HOME": str(folder)},
        capture_output=True,
        text=True,
        timeout=120.0,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads((folder / "tune.json").read_text())
    assert found["gains"]["kc"] == pytest.approx(0.645, rel=0.05)
    assert found["report"] == "tune.html"
    assert "Gains to type in" in (folder / "tune.html").read_text()
    assert (folder / ".ros/relay_autotune").is_dir()


def test_the_nodes_have_the_names_that_the_guide_says(rig: Rig) -> None:
    rig.plant(structure="fopdt", gain=1.65, time_constants=[20.0], dead_time=10.0)
    rig.relay(relay_on="setpoint")
    rig.identifier()
    rig.start("controller_node")
    said: dict[str, set[tuple[str, str, str]]] = {}
    for node, kind, name, type_name in rows("docs/messages.md", "node"):
        node, name, type_name = (cell.strip("`") for cell in (node, name, type_name))
        resolved = name.replace("~", f"/{node}") if name[0] in "~/" else f"/{name}"
        said.setdefault(node, set()).add((kind, resolved, type_name))
    assert set(said) == set(TABLES)
    for node, names in said.items():
        rig.until(lambda node=node, names=names: seen(rig, node) == names, f"names of {node}")
        answer = rig.call(ListParameters, f"/{node}/list_parameters", ListParameters.Request())
        own = {n for n in answer.result.names if not n.startswith(COMMON_PARAMETERS)}
        assert own == {entry.name for entry in TABLES[node]}


def seen(rig: Rig, node: str) -> set[tuple[str, str, str]]:
    """Return the topics and services of a node in the graph, without those of every node."""
    try:
        found = {
            "publishes": rig.node.get_publisher_names_and_types_by_node(node, "/"),
            "subscribes": rig.node.get_subscriber_names_and_types_by_node(node, "/"),
            "serves": [
                *rig.node.get_service_names_and_types_by_node(node, "/"),
                *get_action_server_names_and_types_by_node(rig.node, node, "/"),
            ],
        }
    except RuntimeError:  # the node has not been discovered yet
        return set()
    return {
        (kind, name, type_name)
        for kind, ends in found.items()
        for name, (type_name,) in ends
        if name not in COMMON_TOPICS
        and "/_action/" not in name
        and not type_name.startswith(COMMON_SERVICE_TYPES)
    }
