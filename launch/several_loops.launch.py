# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Several loops from a file that lists them, each in a namespace of its own with what tunes it.

ros2 launch relay_autotune several_loops.launch.py loops:=plant.yaml
"""

from pathlib import Path

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("relay_autotune")
KEYS = {"namespace", "measurement", "command", "params", "use_sim_time", "simulate"}


def generate_launch_description() -> LaunchDescription:
    """Declare the one argument; the loops follow once its value is known."""
    loops = DeclareLaunchArgument(
        "loops",
        default_value=PathJoinSubstitution([SHARE, "config", "several_loops.yaml"]),
        description="File that lists the loops",
    )
    check = IncludeLaunchDescription(
        AnyLaunchDescriptionSource(PathJoinSubstitution([SHARE, "launch", "arguments.launch.py"])),
        launch_arguments=[("known", "loops")],
    )
    return LaunchDescription([loops, check, OpaqueFunction(function=loops_of)])


def loops_of(context: LaunchContext) -> list[GroupAction]:
    """Return the nodes of each loop that the file lists."""
    file = Path(LaunchConfiguration("loops").perform(context))
    content = yaml.safe_load(file.read_text())
    if not isinstance(content, dict) or not isinstance(content.get("loops"), list):
        raise RuntimeError(f"{file} has no list `loops`; config/several_loops.yaml is an example")
    actions = []
    for loop in content["loops"]:
        unknown = set(loop) - KEYS
        if unknown or "namespace" not in loop:
            raise RuntimeError(
                f"{file}: a loop has {', '.join(map(str, loop))}; expected `namespace` and, where "
                f"wanted, {', '.join(sorted(KEYS - {'namespace'}))}"
            )
        actions.append(nodes_of(loop, file.parent))
    return actions


def nodes_of(loop: dict[str, object], folder: Path) -> GroupAction:
    """Return the nodes of one loop.

    :param loop: its entry in the file.
    :param folder: where the file is, and a file of parameters that it names by a relative path.
    """
    arguments = {key: str(value) for key, value in loop.items() if key != "simulate"}
    if isinstance(loop.get("use_sim_time"), bool):
        arguments["use_sim_time"] = str(loop["use_sim_time"]).lower()
    if "params" in arguments:
        arguments["params"] = str(folder / arguments["params"])
    tune = IncludeLaunchDescription(
        AnyLaunchDescriptionSource(PathJoinSubstitution([SHARE, "launch", "tune.launch.xml"])),
        launch_arguments=arguments.items(),
    )
    if not loop.get("simulate"):
        return GroupAction([tune])
    plant = Node(
        package="relay_autotune",
        executable="plant_node",
        namespace=arguments["namespace"],
        output="screen",
        parameters=[arguments["params"]] if "params" in arguments else [],
        remappings=[(end, arguments.get(end, end)) for end in ("measurement", "command")],
    )
    return GroupAction([plant, tune])
