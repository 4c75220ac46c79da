# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What nodes do with command lines that ROS does not know."""

from __future__ import annotations

import importlib

import pytest

from tools.fill_docs import TABLES


def run(name: str, *arguments: str) -> int:
    module = importlib.import_module(f"relay_autotune.nodes.{name.removesuffix('_node')}")
    return module.main(list(arguments))


@pytest.mark.parametrize("name", sorted(TABLES))
def test_help_lists_every_parameter_and_starts_nothing(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(name, "--help") == 0
    told = capsys.readouterr().out
    assert told.startswith(f"usage: {name} ")
    for entry in TABLES[name]:
        assert f"\n  {entry.name} (" in told


@pytest.mark.parametrize("name", sorted(TABLES))
def test_what_ros_would_pass_over_in_silence_is_refused(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--ros-args", "-p", "use_sim_time:=false", "--", "-p", "measurement_max:=50.0")
    assert run(name, *arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"{name}: -p measurement_max:=50.0 has no effect outside of --ros-args")
    assert said.count("\n") == 1


@pytest.mark.parametrize("name", sorted(TABLES))
def test_a_parameter_without_its_flag_is_refused_with_what_to_type(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("--ros-args", "-p", "use_sim_time:=false", "-r", "a:=b", "amplitude:=1.0")
    assert run(name, *given) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"{name}: amplitude:=1.0 has no flag before it; type -p amplitude:=1.0")
    assert said.count("\n") == 1
