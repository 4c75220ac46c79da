# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the set-up finds missing it says in one line, and what it made it recognises."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def prepare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """Return the set-up's script, in an empty folder and a shell without ROS."""
    spec = importlib.util.spec_from_file_location("prepare", ROOT / "tools/prepare.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name, folder in (
        ("VENV", ".venv"),
        ("VENV_OLDEST", ".venv-oldest"),
        ("INSTALL", "install"),
    ):
        monkeypatch.setattr(module, name, tmp_path / folder)
    for name in ("ROS_DISTRO", "AMENT_PREFIX_PATH", "CC", "CXX"):
        monkeypatch.delenv(name, raising=False)
    return module


def refusal(call) -> str:
    with pytest.raises(SystemExit) as caught:
        call()
    text = str(caught.value)
    assert text.startswith("setup: ")
    assert "\n" not in text
    return text


@pytest.mark.parametrize("version", [(3, 10, 12), (3, 14, 0)])
def test_refuses_other_pythons(prepare, monkeypatch, version):
    monkeypatch.setattr(sys, "version_info", version)
    assert "3.11 to 3.13" in refusal(prepare.main)


def test_refuses_wheels_for_another_machine(prepare, monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert "apt" in refusal(prepare.prepare_main)


def test_names_all_that_is_missing_at_once(prepare, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    text = refusal(prepare.check_build_tools)
    assert "`apt install g++ gcc cmake make" in text


def test_names_the_missing_venv_module(prepare, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    assert f"python{version}-venv" in refusal(prepare.check_build_tools)


def test_uses_the_ros_that_is_sourced(prepare, monkeypatch, tmp_path):
    manifest = tmp_path / "ros/share/rclpy/package.xml"
    manifest.parent.mkdir(parents=True)
    manifest.touch()
    monkeypatch.setattr("platform.python_version", lambda: "3.12.3")
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    assert prepare.sourced_ros() is None
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}/overlay:{tmp_path}/ros")
    assert prepare.sourced_ros() == str(tmp_path / "ros")
    monkeypatch.setattr("platform.python_version", lambda: "3.11.7")
    assert "3.12" in refusal(prepare.sourced_ros)


def test_does_not_take_its_own_wheels_for_a_sourced_ros(prepare, monkeypatch):
    """Images of ROS set ROS_DISTRO without sourcing, and env.sh then adds its own prefix."""
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{prepare.INSTALL}/relay_autotune:{prepare.VENV}")
    assert prepare.sourced_ros() is None


def test_refuses_another_ros(prepare, monkeypatch):
    monkeypatch.setenv("ROS_DISTRO", "humble")
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/humble")
    assert "humble" in refusal(prepare.sourced_ros)


def test_refuses_a_ros_without_rclpy(prepare, monkeypatch, tmp_path):
    monkeypatch.setattr("platform.python_version", lambda: "3.12.3")
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert "apt install ros-jazzy-ros-base" in refusal(prepare.sourced_ros)


def test_a_changed_source_is_not_current(prepare, monkeypatch, tmp_path):
    monkeypatch.setattr(prepare, "ROOT", tmp_path)
    folder, source = tmp_path / "built", tmp_path / "sources"
    folder.mkdir()
    source.mkdir()
    (source / "A.msg").write_text("float64 a\n")
    stamp = prepare.digest([source], "3.12")
    assert not prepare.is_current(folder, stamp)
    prepare.mark(folder, stamp)
    assert prepare.is_current(folder, prepare.digest([source], "3.12"))
    assert not prepare.is_current(folder, prepare.digest([source], "3.13"))
    (source / "A.msg").write_text("float64 b\n")
    assert not prepare.is_current(folder, prepare.digest([source], "3.12"))


def test_exports_name_this_machine(prepare, monkeypatch, tmp_path):
    """The wheels' CMake files name the include folders of the machine that built them."""
    file = tmp_path / ".venv/share/std_msgs/cmake/export.cmake"
    file.parent.mkdir(parents=True)
    built = "/opt/python/cp311-cp311"
    file.write_text(
        f'INCLUDES "{built}/include/python3.11;'
        f'{built}/lib/python3.11/site-packages/numpy/_core/include;include/std_msgs"\n'
    )
    monkeypatch.setattr("subprocess.check_output", lambda *a, **k: "/here/python\n/here/numpy\n")
    prepare.repair_exports()
    assert file.read_text() == 'INCLUDES "/here/python;/here/numpy;include/std_msgs"\n'
    file.write_text(f"{built}/share/elsewhere\n")
    assert "export.cmake" in refusal(prepare.repair_exports)


def test_what_tests_it_is_installed_once_into_each_environment(prepare, monkeypatch):
    """A demo needs none of it, and an environment that is made anew has lost it."""
    prepare.VENV.mkdir()
    installed = []
    monkeypatch.setattr(prepare, "prepare_main", lambda: None)
    monkeypatch.setattr(
        prepare, "install", lambda path, wanted, environment: installed.append(path)
    )
    prepare.mark(prepare.VENV, "made")
    prepare.prepare_tests()
    prepare.prepare_tests()
    assert installed == [prepare.VENV]
    prepare.mark(prepare.VENV, "made anew")
    prepare.prepare_tests()
    assert installed == [prepare.VENV] * 2
