# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Refuse misspelt launch arguments, which `ros2 launch` would ignore without a message.

The other launch files include this one first; `known` lists their own arguments.
"""

import difflib
from collections.abc import Iterable

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

DEFAULTS = PathJoinSubstitution([FindPackageShare("relay_autotune"), "config", "parameters.yaml"])


def generate_launch_description() -> LaunchDescription:
    """Check the arguments that were given, before any node starts."""
    known = DeclareLaunchArgument("known", description="Names of the arguments, with blanks")
    return LaunchDescription([known, OpaqueFunction(function=check)])


def check(context: LaunchContext) -> None:
    """Compare what was given with what there is.

    :raises RuntimeError: if a name is nearly that of an argument, or that of a parameter.
    """
    with open(DEFAULTS.perform(context), encoding="utf-8") as file:  # noqa: PTH123
        nodes = yaml.safe_load(file).values()
    parameters = {name for node in nodes for name in node["ros__parameters"]}
    known = LaunchConfiguration("known").perform(context).split()
    wrong = problems(context.launch_configurations, known, parameters)
    if wrong:
        raise RuntimeError("; ".join(wrong))


def problems(given: Iterable[str], known: Iterable[str], parameters: Iterable[str]) -> list[str]:
    """Return a sentence on each name that has no effect and was meant to have one.

    Other names are left alone: they may be arguments of a launch file that includes ours.

    :param given: names of all launch configurations.
    :param known: names of the arguments of the launch file.
    :param parameters: names of the nodes' parameters.
    """
    known, parameters, found = [*known, "known"], set(parameters), []
    for name in given:
        if name in known:
            continue
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.8)
        if near:
            found.append(f"there is no launch argument {name}; did you mean {near[0]}?")
        elif name in parameters:
            found.append(
                f"{name} is a parameter of a node, not a launch argument; write it into a file, "
                "and give the file with params:=FILE"
            )
    return found
