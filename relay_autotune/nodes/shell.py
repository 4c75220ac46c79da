# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What can be typed here: not every machine has the `ros2` command."""

from __future__ import annotations

from collections.abc import Mapping
from shutil import which
from typing import Any

from relay_autotune.exchange.export import number


def prefix() -> str:
    """Return what stands before an executable of this package where the shell does not find it."""
    return "" if which("replay") else "ros2 run relay_autotune "


def typed_for_parameter(node: str, name: str, value: object) -> str:
    """Return what to do here so that a node of this package has a parameter.

    :param node: its full name.
    :param name: of the parameter.
    :param value: of the parameter.
    """
    if which("ros2"):
        return f"type: ros2 param set {node} {name} {value}"
    return f"start {node} with -p {name}:={value}"


def ros_arguments(
    namespace: str,
    topics: Mapping[str, str] | None = None,
    values: Mapping[str, Any] | None = None,
) -> list[str]:
    """Return the arguments for ROS of a node.

    :param namespace: of the node; empty: the root.
    :param topics: the names of its topics.
    :param values: of its parameters.
    """
    arguments = ["-r", f"__ns:=/{namespace.strip('/')}"] if namespace else []
    for name, topic in (topics or {}).items():
        arguments += ["-r", f"{name}:={topic}"]
    for name, value in (values or {}).items():
        shown = number(value) if isinstance(value, float) else value
        arguments += ["-p", f"{name}:={shown}"]
    return arguments
