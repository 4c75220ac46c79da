# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The live commands of README and guide, exactly as written there."""

from __future__ import annotations

import json
import subprocess
from typing import Any

import pytest
import yaml
from loop_rig import Rig
from pages import block_noted, commands, rows
from rcl_interfaces.srv import ListParameters
from rclpy.action import get_action_server_names_and_types_by_node

from relay_autotune.nodes.plant import model_from
from relay_autotune.tuning import RULES, DesignOptions, DesignTask
from relay_autotune_msgs.msg import PidGains, RelayExperiment, TransferFunction
from tools.fill_docs import TABLES

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


def test_the_live_commands_of_the_readme_tune_a_loop(rig: Rig) -> None:
    """A test in real time: a busy machine disturbs the loop, so not every number is checked."""
    experiments = rig.listen("relay_experiment", RelayExperiment)
    models = rig.listen("transfer_function", TransferFunction)
    answer = rig.tune(**start_as_shown(rig, "README.md", "tested: three processes, then the call"))
    rig.until(lambda: experiments, "end of the experiment", timeout=90.0)
    assert experiments[0].experiment_id == answer.experiment_id
    assert experiments[0].outcome == RelayExperiment.COMPLETED, experiments[0].reason
    rig.until(lambda: models and models[-1].final, "model", timeout=60.0)
    assert rig.bag(answer).is_dir()


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
