# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The policies of config/security allow each node what it does, and nothing else."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.node import Node

from relay_autotune.cli.own_nodes import free_domain
from relay_autotune.nodes.controller import ControllerNode
from relay_autotune.nodes.identifier import IdentifierNode
from relay_autotune.nodes.plant import PlantNode
from relay_autotune.nodes.relay import RelayNode

FOLDER = Path(__file__).resolve().parents[2] / "config" / "security"
PLANT = ["structure:=fopdt", "gain:=2.0", "time_constants:=[1.0]", "dead_time:=0.5"]
# What each node may do depends on some of its parameters.
VARIANTS: dict[str, tuple[Callable[[], Node], list[list[str]]]] = {
    "relay_node": (
        RelayNode,
        [
            [],
            ["relay_on:=setpoint"],
            ["use_sim_time:=true"],
            ["command_others:=other_commands"],
        ],
    ),
    "identifier_node": (IdentifierNode, [[], ["use_sim_time:=true"]]),
    "controller_node": (
        ControllerNode,
        [[], ["use_sim_time:=true"], ["apply_to:=/pid_controller"]],
    ),
    "plant_node": (PlantNode, [PLANT, [*PLANT, "mode:=clock"], [*PLANT, "feedback:=true"]]),
}
# A rule of a policy: kind, what it allows, and the name as the policies write it.
Rules = set[tuple[str, str, str]]


def interfaces_of(node: Node, name: str) -> Rules:
    """Return what a node really publishes, hears, serves and calls."""
    own = (node.get_name(), node.get_namespace())
    ends = {
        ("topic", "publish"): node.get_publisher_names_and_types_by_node(*own),
        ("topic", "subscribe"): node.get_subscriber_names_and_types_by_node(*own),
        ("service", "reply"): node.get_service_names_and_types_by_node(*own),
        ("service", "request"): node.get_client_names_and_types_by_node(*own),
    }
    found: Rules = set()
    for (kind, right), entries in ends.items():
        for entry, _ in entries:
            before, action, _ = entry.partition("/_action/")
            rule = ("action", "execute") if action else (kind, right)
            found.add((*rule, before.replace(f"/{name}/", "~/")))
    return found


def rules_of(file: Path) -> Rules:
    """Return what a policy allows."""
    (profile,) = ElementTree.parse(file).getroot().iter("profile")
    assert profile.attrib == {"ns": "/", "node": file.name.removesuffix(".policy.xml")}
    found: Rules = set()
    for group in profile:
        ((right, allowed),) = group.attrib.items()
        assert allowed == "ALLOW"
        names = [str(entry.text) for entry in group]
        assert names == sorted(set(names)), f"{file.name}: {right} is not in order"
        found |= {(group.tag.removesuffix("s"), right, name) for name in names}
    return found


def test_each_node_has_a_policy() -> None:
    assert sorted(file.name for file in FOLDER.iterdir()) == sorted(
        f"{name}.policy.xml" for name in VARIANTS
    )


@pytest.mark.parametrize("name", VARIANTS)
def test_a_policy_allows_what_its_node_does(name: str, monkeypatch: Any, tmp_path: Any) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    # It leaves nothing in the default folder.
    monkeypatch.setenv("HOME", str(tmp_path))
    create, variants = VARIANTS[name]
    needed: Rules = set()
    with ExitStack() as domains:
        for parameters in variants:
            given = [word for value in parameters for word in ("-p", value)]
            # The node before, of the same name, may not have left its domain yet.
            domain = domains.enter_context(free_domain())
            rclpy.init(args=["--ros-args", *given], domain_id=domain)
            node = create()
            try:
                needed |= interfaces_of(node, name)
            finally:
                node.destroy_node()
                rclpy.try_shutdown()
    allowed = rules_of(FOLDER / f"{name}.policy.xml")
    assert needed - allowed == set(), "the node does what its policy does not allow"
    assert allowed - needed == set(), "the policy allows what the node does not do"
