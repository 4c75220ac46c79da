# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Exported gains through ROS's own two readers of parameter files."""

from __future__ import annotations

from pathlib import Path

import pytest
import rclpy
from rcl_interfaces.msg import ParameterType
from rclpy.node import Node
from rclpy.parameter import parameter_dict_from_yaml_file
from ros_domain import free_domain

from relay_autotune.cli.tune import main

MODEL = ("--gain", "1.65e5", "--time-constants", "20", "--dead-time", "10")
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


def test_as_a_node_reads_it_at_its_start(exported: Path) -> None:
    with free_domain() as domain:
        context = rclpy.Context()
        arguments = ["--ros-args", "--params-file", str(exported)]
        rclpy.init(args=arguments, context=context, domain_id=domain)
        try:
            node = Node(
                "pid_controller",
                context=context,
                automatically_declare_parameters_from_overrides=True,
            )
            for name in DOUBLES:
                value = node.get_parameter(f"gains.heater.{name}").value
                assert isinstance(value, float), name
            assert node.get_parameter("gains.heater.i").value == pytest.approx(
                node.get_parameter("gains.heater.p").value / 25.0
            )
            node.destroy_node()
        finally:
            rclpy.try_shutdown(context=context)
