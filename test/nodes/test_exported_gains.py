# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Exported gains through ROS's own two readers of parameter files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rclpy
from rcl_interfaces.msg import ParameterType
from rclpy.node import Node
from rclpy.parameter import parameter_dict_from_yaml_file
from ros_domain import free_domain

from relay_autotune.cli.tune import main
from relay_autotune.nodes.tables import CONTROLLER_PARAMETERS

MODEL = (
    "--gain",
    "1.65e5",
    "--time-constants",
    "20",
    "--dead-time",
    "10",
    "--sample-period",
    "0.5",
)
DOUBLES = ("p", "i", "d", "u_clamp_max", "u_clamp_min", "tracking_time_constant")


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    """Gains of which i is about 1e-7, the kind of number that goes wrong."""
    path = tmp_path / "gains.yaml"
    asked = ("--rule", "imc", "--export", "pid_controller", "--dof", "heater")
    clamps = ("--command-min", "-5", "--command-max", "1e-5", "--output", str(path))
    assert main([*MODEL, *asked, *clamps]) == 0
    return path


def test_as_ros2_param_load_reads_it(exported: Path) -> None:
    found = parameter_dict_from_yaml_file(str(exported))
    for name in DOUBLES:
        value = found[f"gains.heater.{name}"].value
        assert value.type == ParameterType.PARAMETER_DOUBLE, name
    assert found["gains.heater.u_clamp_max"].value.double_value == pytest.approx(1e-5)
    assert found["gains.heater.antiwindup_strategy"].value.string_value == "back_calculation"
    assert set(found) == {f"gains.heater.{n}" for n in (*DOUBLES, "antiwindup_strategy")}


@contextmanager
def started_with(file: Path, name: str) -> Iterator[Node]:
    """Return a node that has the parameters of a file."""
    with free_domain() as domain:
        context = rclpy.Context()
        arguments = ["--ros-args", "--params-file", str(file)]
        rclpy.init(args=arguments, context=context, domain_id=domain)
        try:
            node = Node(
                name, context=context, automatically_declare_parameters_from_overrides=True
            )
            yield node
            node.destroy_node()
        finally:
            rclpy.try_shutdown(context=context)


def test_as_a_node_reads_it_at_its_start(exported: Path) -> None:
    with started_with(exported, "pid_controller") as node:
        for name in DOUBLES:
            value = node.get_parameter(f"gains.heater.{name}").value
            assert isinstance(value, float), name
        assert node.get_parameter("gains.heater.i").value == pytest.approx(
            node.get_parameter("gains.heater.p").value / 25.125
        )


def test_controller_node_starts_with_what_is_exported_for_it(tmp_path: Path) -> None:
    path = tmp_path / "gains.yaml"
    asked = ("--rule", "imc", "--export", "controller_node", "--command-max", "1e-5")
    assert main([*MODEL, *asked, "--output", str(path)]) == 0
    with started_with(path, "any_name") as node:
        found = {n: p.value for n, p in node.get_parameters_by_prefix("").items()}
    declared = {entry.name: entry for entry in CONTROLLER_PARAMETERS}
    given = {name: found[name] for name in found if name in declared}
    assert set(given) == {"kc", "ti", "td", "tf", "b", "command_max"}
    assert 25.0 < given["ti"] < 26.0 and given["command_max"] == pytest.approx(1e-5)
    for name, value in given.items():
        assert declared[name].problem(value) is None
