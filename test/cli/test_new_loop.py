# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What tune_loop asks for, and what it starts its own nodes with."""

from __future__ import annotations

import argparse
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from made_experiments import record_of
from rcl_interfaces.srv import SetParametersAtomically

from relay_autotune import reasons as core
from relay_autotune.bag.definitions import FLOAT64
from relay_autotune.cli import loops, replay, settings, terminal, tune_loop
from relay_autotune.cli.after_tune import AfterTune
from relay_autotune.cli.loops import Loop, TopicLoop
from relay_autotune.cli.own_nodes import OwnNodes, namespace_of_joint
from relay_autotune.cli.settings import Answers, Kind, kind_of
from relay_autotune.cli.terminal import (
    GoBack,
    agreed_step,
    agrees,
    asked_for_file,
    broken,
    number_of,
    pair_of,
)
from relay_autotune.cli.tune_page import _LoopOnPage
from relay_autotune.cli.tuned import Tuned
from relay_autotune.control.step_choice import StepRange
from relay_autotune.errors import LoopError, NotReadyError, ParameterError, SelectionError
from relay_autotune.exchange.export import EXPORTS, Target, exported
from relay_autotune.exchange.messages import fill_gains, fill_reason
from relay_autotune.nodes import loop_client, shell
from relay_autotune.nodes.controller import with_gains_file
from relay_autotune.nodes.loop_client import LoopClient
from relay_autotune.nodes.readiness import Checklist, answer_of
from relay_autotune.nodes.shell import ros_arguments
from relay_autotune.nodes.tables import CONTROLLER_PARAMETERS
from relay_autotune.nodes.tune_client import TuneClient
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.reasons import Code
from relay_autotune.record.record import Outcome
from relay_autotune.report.case import Case
from relay_autotune.text import in_units
from relay_autotune.tuning import design
from relay_autotune.tuning.task import DesignOptions, DesignTask
from relay_autotune.verdict import Verdict
from relay_autotune.web.live import Live, PageCommand, PagePlan
from relay_autotune_msgs.action import Tune
from relay_autotune_msgs.msg import PidGains

TOPICS = ("--measurement", "/a", "--command", "/b")


def test_the_last_line_of_a_node_that_died_ends_every_wait_for_it() -> None:
    with OwnNodes() as nodes:
        # It finds nothing to run.
        nodes.start("missing_node", [])
        client: Any = LoopClient.__new__(LoopClient)
        client._executor = SimpleNamespace(spin_once=lambda timeout_sec: None)
        client.why_lost = nodes.why_lost
        with pytest.raises(LoopError, match="missing_node has ended: ImportError: cannot import"):
            client.wait(lambda: False, 60.0)
        assert client.wait(lambda: True, 0.0)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("print('[INFO] [1.5] [loop.relay_node]: at rest'); ", ', after its line "at rest"'),
        ("", ""),
    ],
)
def test_a_node_that_was_killed_is_told_with_its_signal(words: str, told: str) -> None:
    with OwnNodes() as nodes, tempfile.TemporaryFile() as log:
        run = f"{words}import os; os.sys.stdout.flush(); os.kill(os.getpid(), 9)"
        nodes._logs["relay_node"] = log
        nodes._running["relay_node"] = killed = subprocess.Popen(
            [sys.executable, "-c", run], stdout=log
        )
        assert killed.wait(30.0) == -signal.SIGKILL
        assert nodes.why_lost() == f"relay_node was ended by signal 9 (Killed){told}"


def test_a_node_that_starts_late_is_asked_again_until_it_answers_or_has_ended() -> None:
    """Its services are there long before it answers, and a first answer can be lost."""
    client: Any = LoopClient.__new__(LoopClient)
    client.name, client.why_lost, client._answers_within = "/loop/node", lambda: "", 200.0
    asked: list[Any] = []

    def ask(*_: object) -> Any:
        answers = len(asked) % 2 == 1
        result = SetParametersAtomically.Response()
        result.result.successful = True
        asked.append(SimpleNamespace(done=lambda: answers, result=lambda: result))
        return asked[-1]

    there = SimpleNamespace(service_is_ready=lambda: True, call_async=ask)
    client._services = {
        f"{node}/{service}": there
        for node in ("/loop/node", "/other")
        for service in ("set_parameters_atomically", "revert")
    }
    with pytest.MonkeyPatch.context() as patch:
        now = iter(range(10_000))
        patch.setattr(loop_client.time, "monotonic", lambda: float(next(now)))
        client._executor = SimpleNamespace(spin_once=lambda timeout_sec: None)
        client.set_values("/loop/node", {"kc": 1.0})
        assert len(asked) == 2
        # What must not be done twice is asked once.
        with pytest.raises(LoopError, match="/loop/node/revert has not answered within 200 s"):
            client.call(None, "/loop/node/revert", None)
        assert len(asked) == 3
        # A node that this command has not started answers soon, or not at all.
        asked.append(None)
        with pytest.raises(LoopError, match="/other/revert has not answered within 10 s"):
            client.call(None, "/other/revert", None)
        asked.append(None)
        # Nor does one that takes a goal need the time of a start any more.
        goal = SimpleNamespace(done=lambda: True, result=lambda: SimpleNamespace(accepted=True))
        client._action = SimpleNamespace(send_goal_async=lambda *_, **__: goal)
        client._sent(None, None)
        with pytest.raises(LoopError, match="/loop/node/revert has not answered within 10 s"):
            client.call(None, "/loop/node/revert", None)
        asked.append(None)
        client.why_lost = lambda: "node has ended"
        with pytest.raises(LoopError, match="node has ended"):
            client.call(None, "/loop/node/revert", None)


@pytest.mark.parametrize(
    ("space", "node", "why"),
    [
        ("tank", "relay node", "topic name must not contain characters other"),
        ("ta nk", "relay_node", "namespace must not contain characters other"),
    ],
)
def test_what_cannot_be_a_node_is_refused_in_one_line(space: str, node: str, why: str) -> None:
    with pytest.raises(ParameterError, match=f"^no node can be {space}/{node}: {why}[^\n]*[^:]$"):
        LoopClient("own", space, node)


def test_no_two_joints_share_the_namespace_of_their_nodes() -> None:
    joints = (
        "odd/name",
        "odd_name",
        "odd__name",
        "odd_x2fzname",
        "odd-",
        "/x",
        "_",
        "__",
        "ö",
        "",
    )
    controllers = ("/wheel_pid", "/robot1/wheel_pid", "/robot2/wheel_pid")
    found = [namespace_of_joint(each, joint) for each in controllers for joint in joints]
    assert len(set(found)) == len(found)
    # As ROS takes them on the command line.
    for each in found[: len(joints)]:
        context = rclpy.Context()
        rclpy.init(args=["--ros-args", *ros_arguments(each)], context=context)
        context.try_shutdown()
    assert namespace_of_joint("/wheel_pid", "left_wheel") == "/wheel_pid/tune_left_wheel"


def test_a_file_that_exists_is_noticed_before_anything_is_looked_at(tmp_path, capsys) -> None:
    given = ["--controller", "pid", "--joint", "wheel", "--yes"]
    (tmp_path / "gains.yaml").write_text("mine")
    for flag, name, told in (
        ("--output", "gains.yaml", "exists already"),
        ("--export", "gains.yaml", "exists already"),
        ("--output", "none/gains.yaml", "no writable"),
        ("--report", "tune.txt", "does not say what the report is to be"),
        ("--report", "none/tune.html", "there is no folder"),
    ):
        assert tune_loop.main([*given, flag, str(tmp_path / name)]) == 2
        said = capsys.readouterr().err
        assert told in said and "looking at" not in said
    assert (tmp_path / "gains.yaml").read_text() == "mine"


@pytest.mark.parametrize("program", [tune_loop, replay])
def test_an_address_without_a_page_is_refused(program: Any, capsys) -> None:
    """It was passed over."""
    words = ["bags/step_test"] * (program is replay)
    assert program.main(["--web-address", "0.0.0.0", *words]) == 2
    told = "--web-address is that of a page: give --web, too\n"
    assert capsys.readouterr().err == f"{program.PROGRAM}: {told}"


class Looker:
    """A client of a loop whose topics have these types, with a present command."""

    takes = "std_msgs/msg/Float64"
    name = "/tank/relay_node"
    through = ""

    def __init__(
        self,
        present: float = math.nan,
        kind: str = "std_msgs/msg/Float32",
        measures: float = math.nan,
        others: str = "",
    ) -> None:
        self.present, self.kind, self.measures = present, kind, measures
        self.others = others

    def kind_of(self, topic: str, patience: float, *, published: bool) -> str:
        return self.kind if topic == "/tank/level" else self.takes

    def heard(self, kind: Any, topic: str, *_: Any, **__: Any) -> list[float]:
        found = self.measures if topic == "/tank/level" else self.present
        return [] if math.isnan(found) else [found]

    def others_on(self, topic: str) -> str:
        return self.through if topic == "controller_command" else self.others

    def claim(self, kind: Any, topic: str) -> Callable[[], object]:
        self.claims = True
        return lambda: setattr(self, "claims", False)


def options(*words: str) -> argparse.Namespace:
    given = ["--measurement", "/tank/level", "--command", "/tank/valve", "--namespace", "tank"]
    return tune_loop._parser().parse_args([*given, *words])


def arguments(client: Any, given: argparse.Namespace) -> dict[str, str]:
    """Return parameters and remappings of the relay_node that would be started."""
    words = TopicLoop(client, given).arguments()["relay_node"]
    return dict(word.split(":=", 1) for word in words if ":=" in word)


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Answer each question with the next of these texts, as at a terminal."""
    answers: list[str] = []
    monkeypatch.setattr("relay_autotune.cli.terminal._await_line", lambda shown: None)
    monkeypatch.setattr("builtins.input", lambda: answers.pop(0))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    return answers


def test_flags_become_limits_levels_topics_and_types_without_a_question() -> None:
    given = options("--within", "30", "50", "--at", "2", "--command-within", "0", "5")
    assert arguments(Looker(), given) == {
        "__ns": "/tank",
        "measurement": "/tank/level",
        "command": "/tank/valve",
        "baseline": "2.0",
        "baseline_is_present": "True",
        "safe_command": "2.0",
        "measurement_min": "30.0",
        "measurement_max": "50.0",
        "command_min": "0.0",
        "command_max": "5.0",
        "amplitude": "0.0",
        "measurement_timeout": "0.0",
        "measurement_type": "std_msgs/msg/Float32",
        "measurement_field": "data",
        "command_type": "std_msgs/msg/Float64",
        "command_field": "data",
    }
    assert set(TopicLoop(Looker(), given).arguments()) == {"relay_node", "identifier_node"}


def test_a_recording_alone_waits_for_no_model() -> None:
    words = ("--within", "30", "50", "--at", "2", "--command-within", "0", "5", "--record-only")
    loop = TopicLoop(Looker(), options(*words))
    assert set(loop.arguments()) == {"relay_node"}
    assert "model_timeout:=0.0" in loop.arguments()["relay_node"]


def test_the_law_of_another_program_is_designed_for() -> None:
    given = options("--within", "30", "50", "--at", "2", "--command-within", "0", "5")
    given.law, given.sample_period = "simple_pid", 0.1
    words = TopicLoop(Looker(), given).arguments()["identifier_node"]
    assert {"law:=simple_pid", "sample_period:=0.1"} < set(words)


@pytest.mark.parametrize(
    ("words", "given", "has_ros2", "do"),
    [
        (TOPICS, "measurement_timeout:=5.0", True, "give --measurement-timeout 5.0"),
        ((), "measurement_timeout:=5.0", True, "give --measurement-timeout 5.0"),
        (TOPICS, "hysteresis:=0.5", True, "leave it out"),
        ((), "hysteresis:=0.5", True, "type: ros2 param set /tank/relay_node hysteresis 0.5"),
        ((), "hysteresis:=0.5", False, "start /tank/relay_node with -p hysteresis:=0.5"),
    ],
)
def test_a_parameter_of_another_node_is_refused_with_what_sets_it(
    words: tuple[str, ...], given: str, has_ros2: bool, do: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(shell, "which", lambda name: "/opt" if has_ros2 else None)
    with pytest.raises(SystemExit):
        tune_loop.main(["--namespace", "tank", *words, "--ros-args", "-p", given])
    said = capsys.readouterr().err
    assert said.endswith(f"-p {given} sets nothing in relay_node: {do}\n")


def test_a_law_that_cannot_be_designed_for_is_refused_at_once() -> None:
    for words in (["--sample-period", "0"], ["--law", "simplepid"]):
        with pytest.raises(SystemExit):
            tune_loop.main(words)
    words = ["--controller", "wheel_controller", "--joint", "left_wheel", "--law", "px4_rate"]
    with pytest.raises(SelectionError, match="--law is for a loop of two topics"):
        kind_of(tune_loop._parser().parse_args(words))


def test_the_robot_of_a_joint_is_named_with_its_controller() -> None:
    """A --namespace beside it was that of the nodes, and the robot of the root was moved."""
    words = ["--controller", "wheel_pid", "--joint", "left", "--namespace", "robot1"]
    with pytest.raises(SelectionError, match=r"leave it out.* --controller /robot1/wheel_pid$"):
        kind_of(tune_loop._parser().parse_args(words))


def test_a_joint_is_tuned_on_a_page_too() -> None:
    words = ["--controller", "wheel_pid", "--joint", "left"]
    assert kind_of(tune_loop._parser().parse_args([*words, "--web"])) is Kind.JOINT
    assert kind_of(tune_loop._parser().parse_args([*words, "--open", "--at", "1"])) is Kind.OPENED
    with pytest.raises(SelectionError, match="--at is for --open: leave it out"):
        kind_of(tune_loop._parser().parse_args([*words, "--at", "1"]))
    with pytest.raises(SelectionError, match="leave out --json"):
        kind_of(tune_loop._parser().parse_args([*words, "--json"]))


def test_what_is_not_given_is_asked_for_until_it_can_be_read(typed: list[str]) -> None:
    typed += ["two", "2", "30", "30 50", "0, 5"]
    found = arguments(Looker(), options())
    assert not typed
    assert (found["baseline"], found["measurement_max"]) == ("2.0", "50.0")
    assert (found["command_min"], found["command_max"]) == ("0.0", "5.0")


def test_a_loop_that_somebody_else_commands_is_refused_before_any_question(
    typed: list[str],
) -> None:
    told = "/pid commands /tank/valve, 2.25 u now: end it first .* with --at 2.25, while"
    with pytest.raises(LoopError, match=told):
        TopicLoop(Looker(present=2.25, others="/pid"), options())
    with pytest.raises(LoopError, match=r"/gui commands /tank/valve: .* start again$"):
        TopicLoop(Looker(others="/gui"), options())
    controlled = Looker()
    controlled.through = "/tank/pid"
    with pytest.raises(LoopError, match="/tank/pid publishes /tank/controller_command: its"):
        TopicLoop(controlled, options())
    # A second tune_loop sees the first before its relay_node is there.
    loop = TopicLoop(client := Looker(), options("--web"))
    assert client.claims
    client.others = "/pid"
    with pytest.raises(LoopError, match="/pid commands"):
        loop.joined()
    client.others = ""
    loop.joined()
    assert not client.claims


def test_who_publishes_a_topic_is_known_only_after_all_have_announced_themselves() -> None:
    """In 30 starts a node took up to 3 s to know one that had long been there."""
    clock, unknown = [100.0], "_NODE_NAME_UNKNOWN_"
    own = SimpleNamespace(node_namespace="/t", node_name="relay_node")

    def ends(topic: str) -> list[Any]:
        name = "pid" if clock[0] > 103.3 else unknown
        other = SimpleNamespace(node_namespace="/", node_name=name)
        return [own, other][: 1 + (clock[0] > 103.0)]

    client: Any = LoopClient.__new__(LoopClient)
    client.name, client._joined, client.why_lost = "/t/relay_node", clock[0], lambda: ""
    client._node = SimpleNamespace(
        resolve_topic_name=lambda topic: topic, get_publishers_info_by_topic=ends,
        get_fully_qualified_name=lambda: "/t/tune_loop",
    )  # fmt: skip

    def spin_once(timeout_sec: float) -> None:
        clock[0] += timeout_sec

    client._executor = SimpleNamespace(spin_once=spin_once)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_client.time, "monotonic", lambda: clock[0])
        assert client.others_on("/u") == "/pid"
        # Later nothing is waited for, unless a node has no name yet.
        before, clock[0] = clock[0], 200.0
        assert client.others_on("/u") == "/pid" and clock[0] == 200.0 > before


@pytest.mark.parametrize(
    ("text", "pair"),
    [
        ("0 5", [0, 5]), ("0 to 5", [0, 5]), ("0,5", [0, 5]), ("0..5", [0, 5]),
        (" [0; 5.5] ", [0, 5.5]), ("-1.5 .. -.5", [-1.5, -0.5]), ("1e-3 and 2", [0.001, 2]),
        ("0-100", [0, 100]), ("800 - 1600 rpm", [800, 1600]), ("0 to 100 %", [0, 100]),
        ("0%-100%", [0, 100]), ("-5 5", [-5, 5]), ("-5 to 5", [-5, 5]), ("-5--1", [-5, -1]),
        ("-5 -1", [-5, -1]), ("20 °C, 30 °C", [20, 30]), ("0.5\N{EN DASH}2 m/s", [0.5, 2]),
        ("10 -20", None), ("0 to", None), ("0-", None), ("1k 2k", None), ("1e-3", None),
        ("5 0", None), ("0 5 6", None), ("0 five", None), ("", None),
    ],
)  # fmt: skip
def test_two_numbers_are_taken_as_people_type_them(text: str, pair: list[float] | None) -> None:
    assert pair_of(text) == pair


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1200 rpm", 1200.0), ("35 %", 35.0), ("-1e-3", -0.001), ("\N{MINUS SIGN}2.5degC", -2.5),
        (".5", 0.5), ("5.", 5.0), ("two", None), ("5 6", None), ("5 to 6", None), ("nan", None),
        ("2k", None), ("", None), ("1e999", None),
    ],
)  # fmt: skip
def test_a_number_is_taken_with_its_unit(text: str, value: float | None) -> None:
    assert number_of(text) == value


def test_neither_yes_nor_a_law_becomes_the_name_of_a_file(
    typed: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    typed += ["y", "~/gains.yaml", "IEC_61131_3_pid", "no"]
    assert asked_for_file("Write", EXPORTS) == str(Path("~/gains.yaml").expanduser())
    assert "such as gains.yaml" in capsys.readouterr().err
    assert asked_for_file("Write", EXPORTS) == "iec_61131_3_pid"
    typed[:0] = ["nonsense program", "Arduino", "simple-pid", "./gains"]
    assert asked_for_file("Write", EXPORTS) == "simple_pid"
    said = " ".join(capsys.readouterr().err.split())
    assert "nonsense program is neither a program nor" in said
    assert all(name in said for name in EXPORTS)
    assert asked_for_file("Write", EXPORTS) == "gains"
    assert asked_for_file("Write", EXPORTS) == ""
    with pytest.raises(SystemExit):
        tune_loop.main(["--export", "iec_61131_3_pid"])
    assert "--law iec_61131_3_pid, and the file as --output FILE" in capsys.readouterr().err


def test_what_failed_names_the_flag_and_no_node_that_ends_with_the_command() -> None:
    """What to set comes from the reason, whatever the line says."""
    node = Checklist()
    node.tell("limits", Code.NO_LIMITS(missing="measurement_min", limit="measurement_min"))
    node.tell("model", Code.NO_IDENTIFIER(where="", run=""))
    node.tell("time", "; type: ros2 param set /t/relay_node amplitude A")
    answer = answer_of(node, accepted=True)
    own: Any = TopicLoop.__new__(TopicLoop)
    limits, model, time = own.checklist(answer)
    assert limits.startswith("note  limits        measurement_min not given: nothing ends")
    assert limits.endswith("goes too far that way; give --within")
    assert [model, time] == answer.checks[1:]
    other: Any = Loop.__new__(Loop)
    other.client = SimpleNamespace(name="/t/relay_node")
    assert other.checklist(answer) == [limits, *answer.checks[1:]]
    free = Code.LITTLE_SPACE(folder="/", free=0.1)
    assert "relay_node" in other.to_type(free) and "record_directory" in other.to_type(free)
    # It has no flag, and the node is not there to be told.
    assert own.to_type(free) == ""
    # Another node's reason may lack a value.
    answer.refusals[0].names = answer.refusals[0].values = []
    assert own.checklist(answer) == answer.checks
    # One of an older version sends none.
    answer.refusals = []
    assert own.checklist(answer) == answer.checks


def test_what_is_given_and_cannot_be_is_refused_before_any_question(typed: list[str]) -> None:
    # Nothing is typed, so that a question would fail.
    with pytest.raises(SelectionError, match=r"--within 50 110: the measurement is 0.82 now"):
        TopicLoop(Looker(measures=0.82), options("--within", "50", "110"))


@pytest.mark.parametrize(
    ("measured", "example"),
    [(0.82, "0 2"), (44.0, "0 100"), (-3.0, "-10 0"), (0.0, "-1 1"), (math.nan, "30 50")],
)
def test_an_example_of_limits_has_the_present_value_in_it(
    measured: float, example: str, typed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []
    monkeypatch.setattr("relay_autotune.cli.terminal._await_line", shown.append)
    typed += ["-10 100"]
    given = options("--at", "2", "--command-within", "0", "5")
    TopicLoop(Looker(measures=measured), given)
    assert shown[0].endswith(f"such as {example}: ")


@pytest.mark.parametrize("words", [("--no-verify",), ("--yes",)])
def test_a_step_without_a_proof_is_refused(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        tune_loop.main([*words, "--step", "5"])
    assert "give --verify, too" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--within 50 30", "--within is 50 30, expected the lower number first"),
        ("--command-within 5 5", "--command-within is 5 5, expected the lower number first"),
        ("--command-period -1", "--command-period is -1, expected at least 0 s"),
        ("--measurement-timeout -1", "--measurement-timeout is -1, expected at least 0 s"),
        ("--sample-period 0", "--sample-period is 0, expected above 0 s"),
        ("--amplitude -1", "--amplitude is -1, expected at least 0 u"),
        ("--wait -1", "--wait is -1, expected at least 0 s"),
        ("--at 7 --command-within 0 5", "--at 7: expected a command from 0 to 5, the limits of"),
        ("--command /y", "--measurement and --command are both /y: give the topic of the sensor"),
        ("--web-address [::1]:99999", "argument --web-address: '[::1]:99999' is not an address"),
    ],
)
def test_a_number_out_of_its_range_is_refused_before_anything_is_loaded(
    words: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The node refused a period after its start; limits in the wrong order had no flag."""
    with pytest.raises(SystemExit) as ended:
        tune_loop.main(["--measurement", "/y", "--command", "/u", *words.split()])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"tune_loop: {told}") and said.count("\n") == 1


def test_a_question_shows_what_is_now_and_refuses_what_cannot_be(
    typed: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    typed += ["2", "30 40", "30 50", "3 9", "0 5"]
    found = arguments(Looker(measures=44.0), options())
    assert not typed
    assert (found["measurement_max"], found["command_max"]) == ("50.0", "5.0")
    said = capsys.readouterr().err
    assert "the measurement is 44 now: give limits around it" in said
    assert "the present command is 2: give limits around it" in said


def test_an_answer_that_was_mistyped_is_changed_at_the_next_question(
    typed: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    # The first question has none before it. Limits of the command need the present one.
    typed += ["<", "20", "30 50", "<", "<", "2", "30 60", "0 5"]
    client: Any = Looker(measures=44.0)
    client.name, sent = "/tank/relay_node", {}
    client.set_values = lambda node, values: sent.update(values)
    loop = TopicLoop(client, options())
    assert not typed
    given = loop.options
    assert (given.at, given.within, given.command_within) == (2.0, [30.0, 60.0], [0.0, 5.0])
    assert "< at a question goes back to the one before" in capsys.readouterr().err
    # Also at the last one, which shows the plan: then relay_node runs.
    typed += ["<"]
    with pytest.raises(GoBack):
        agrees("Start the tune?", yes=False, back=loop.answers.may_go_back)
    typed += ["<", "30 50", "1 6"]
    loop.ask_again()
    assert not typed
    assert sent == {
        "baseline": 2.0, "safe_command": 2.0, "measurement_min": 30.0, "measurement_max": 50.0,
        "command_min": 1.0, "command_max": 6.0,
    }  # fmt: skip
    typed += ["<", ""]
    assert not agrees("Start the tune?", yes=False)
    assert not typed


def test_a_tune_that_nobody_agrees_to_is_said_not_to_start(
    typed: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    typed += ["maybe", "no"]
    given = SimpleNamespace(yes=False, dry_run=False)
    loop: Any = SimpleNamespace(
        plan=list, check=lambda deadline: None, answers=SimpleNamespace(may_go_back=False)
    )
    session: Any = SimpleNamespace(options=given, _may_start=lambda loop, found: True)
    assert not tune_loop.Session._is_agreed(session, loop, math.inf)
    assert capsys.readouterr().err.endswith("expected y or n\ntune_loop: not started\n")


@pytest.mark.parametrize("dry", ["--dry-run", "--dry"])
def test_the_command_after_a_dry_run_starts_the_tune(
    dry: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = SimpleNamespace(dry_run=True, json=False, typed=[dry, "--within", "30", "50"])
    loop: Any = SimpleNamespace(
        plan=list, check=lambda deadline: None, answers=SimpleNamespace(may_go_back=False)
    )
    session: Any = SimpleNamespace(options=given, _may_start=lambda loop, found: True)
    assert tune_loop.Session._is_agreed(session, loop, math.inf)
    assert capsys.readouterr().out.endswith("tune_loop --within 30 50\n")


def test_units_that_are_typed_or_that_messages_say_stand_everywhere(
    typed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "UNITS", units := {})
    for module in (loops, settings):
        monkeypatch.setattr(module, "UNITS", units)
    typed += ["35 %", "30 50", "0 to 100 %"]
    found = arguments(Looker(kind="sensor_msgs/msg/Temperature", measures=44.0), options())
    # The message is about one number, and its variance is not that.
    assert found["measurement_field"] == "temperature"
    assert units == {"y": "°C", "u": "%"}
    assert broken("kc 0.6 u/y   i 2 u/(y s)   5 u", 99) == ["kc 0.6 %/°C   i 2 %/(°C s)   5 %"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("kc 1.2 u/y, 3 y/u, 4 u s/y, 5 y s/u", "kc 1.2 V/(m/s), 3 m/s/V, 4 V s/(m/s), 5 m/s s/V"),
        ("a step by +2 y: at 3 u", "a step by +2 m/s: at 3 V"),
        ("measurement [y]", "measurement [m/s]"),
        ("by you, 2 years, /u/y, u y", "by you, 2 years, /u/y, u y"),
    ],
)
def test_units_take_the_place_of_their_letters_and_of_nothing_else(text: str, found: str) -> None:
    assert in_units(text, {"y": "m/s", "u": "V"}) == found
    assert in_units(text, {}) == text


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--within", "1", "9"), "--within 1 9: the measurement is 44 now: give limits around it"),
        (("--command-within", "3", "9"), "--at 2: expected a command from 3 to 9, the limits"),
    ],
)
def test_a_flag_that_cannot_be_is_refused_at_once(words: tuple[str, ...], told: str) -> None:
    with pytest.raises(SelectionError, match=told):
        TopicLoop(Looker(measures=44.0), options("--at", "2", *words))


@pytest.mark.parametrize(
    "changed",
    [
        {"at": [2.0, 3.0]}, {"within": 5}, {"within": [50, 30]}, {"within": [30, 40]},
        {"amplitude": -1}, {"command_within": [3, 9]}, {"field": 1}, {"reboot": 1},
        {"at": 3, "within": [30, 40]},
    ],
)  # fmt: skip
def test_a_form_with_what_cannot_be_changes_nothing(changed: dict[str, Any]) -> None:
    given = options("--at", "2", "--within", "30", "50", "--command-within", "0", "5")
    loop = TopicLoop(Looker(measures=44.0), given)
    before = dict(vars(given))
    with pytest.raises(SelectionError):
        loop.set(changed)
    assert vars(given) == before


def test_a_plan_says_what_is_missing_or_which_answer_cannot_be_and_leaves_the_status() -> None:
    client: Any = Looker(measures=44.0)
    client.check, client.name, client.set_values = None, "/relay_node", None
    loop = TopicLoop(client, options("--web", "--within", "30", "50"))
    live = Live("tank")
    live.tell(status="proof passed", tone="good")
    shown: Any = _LoopOnPage.__new__(_LoopOnPage)
    shown.loop, shown.live = loop, live
    shown._show_plan(PageCommand("start", dry=7))
    plan = live.snapshot.plan
    assert "present command" in plan.refusal and "command of the actuator" in plan.refusal
    assert "measurement" not in plan.refusal and (plan.number, plan.refused) == (7, "")
    assert [row["values"] for row in plan.form] == [[None], [30.0, 50.0], None, [0.0]]
    answers = {"at": 2, "within": [50, 60], "command_within": [0, 5]}
    shown._show_plan(PageCommand("start", dry=8, settings=answers))
    assert (live.snapshot.plan.number, live.snapshot.plan.refused) == (8, "within")
    assert "the measurement is 44 now: give limits around it" in live.snapshot.plan.refusal
    assert (live.snapshot.phase, live.snapshot.status, live.snapshot.tone) == (
        "idle",
        "proof passed",
        "good",
    )
    # A given amplitude is not searched for between the limits of the command.
    loop.options.amplitude, loop.options.at = 1.0, 2.0
    assert loop.lacking() == []


def test_a_plan_that_relay_node_refuses_marks_the_answer_to_change() -> None:
    def one_way() -> None:
        raise NotReadyError(Code.ONE_WAY(baseline=5.0, where="at", limit="command_max", value=5.0))

    found = Checklist()
    # a note asks for nothing
    found.tell("limits", Code.NO_LIMITS(missing="measurement_min", limit="measurement_min"))
    found.do("levels", one_way)
    client: Any = Looker(measures=44.0)
    client.name, client.succeeded, client.not_ready_yet = "/relay_node", False, False
    answer = answer_of(found, accepted=False)
    client.set_values, client.check = lambda node, values: None, lambda amplitude: answer
    given = ("--at", "5", "--within", "30", "50", "--command-within", "0", "5")
    loop = TopicLoop(client, options("--web", *given))
    shown: Any = _LoopOnPage.__new__(_LoopOnPage)
    shown.loop, shown.live = loop, Live("tank")
    shown._show_plan(PageCommand("start", dry=7))
    plan = shown.live.snapshot.plan
    assert plan.refusal.startswith("refused: ") and plan.refused == "at"
    assert [line[:2] for line in plan.lines] == [("note", "limits"), ("NO", "levels")]


def test_what_one_page_agrees_to_while_the_plan_of_another_is_looked_at_is_done() -> None:
    """It was dropped, and its page showed nothing of it."""
    live, agreed = Live("tank"), PageCommand("revert")
    shown: Any = _LoopOnPage.__new__(_LoopOnPage)
    shown.live = live

    def looked_at(wish: PageCommand) -> PagePlan:
        live.wish(agreed)
        # its page asks again
        live.wish(PageCommand("verify", dry=8))
        return PagePlan()

    shown.plan = looked_at
    live.wish(PageCommand("verify", dry=9))
    shown._show_plan(PageCommand("verify", dry=7))
    assert live.next_wish() == agreed
    assert live.next_wish() is None


def test_a_form_that_can_be_goes_to_relay_node_as_numbers() -> None:
    client: Any = Looker(measures=44.0)
    client.name, sent = "/tank/relay_node", {}
    client.set_values = lambda node, values: sent.update(values)
    loop = TopicLoop(client, options("--web"))
    form = list(loop.answers.form(loop.form, needed=True))
    assert [row["values"] for row in form] == [[None], None, None, [0.0]]
    loop.set({"at": 2, "within": [30, 50], "command_within": [0, 5], "amplitude": 1})
    assert sent == {
        "baseline": 2.0, "safe_command": 2.0, "measurement_min": 30.0, "measurement_max": 50.0,
        "command_min": 0.0, "command_max": 5.0, "amplitude": 1.0,
    }  # fmt: skip
    assert all(isinstance(value, float) for value in sent.values())
    assert loop.options.amplitude == 1.0
    # The present command stands in the form already.
    form = loop.answers.form(loop.form, needed=True)
    assert [row["now"] for row in form] == ["", "44 y now", "", ""]
    # What excludes what was before, and not each other.
    loop.set({"at": 12, "command_within": [10, 20]})
    assert sent["baseline"] == 12.0


def test_where_nobody_can_be_asked_the_flags_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    with pytest.raises(LoopError, match=r"give --at, --within, --command-within$"):
        TopicLoop(Looker(), options())
    with pytest.raises(LoopError, match=r"give --within, --command-within$"):
        TopicLoop(Looker(), options("--at", "2"))
    with pytest.raises(LoopError, match=r"give --command-within$"):
        TopicLoop(Looker(), options("--at", "2", "--within", "1", "9"))
    with pytest.raises(LoopError, match=r"answers come from a terminal alone, .*: give --yes"):
        agrees("Start?", yes=False)
    assert agrees("Start?", yes=True)


@pytest.mark.parametrize(
    ("typed_ahead", "ask", "expected"),
    [
        ("y", lambda: agrees("Start?", yes=False), False),
        ("5", lambda: agreed_step("Prove?", 2.0, StepRange(1.0, 9.0)), 0.0),
        ("0 100", lambda: asked_for_file("Write", EXPORTS), ""),
    ],
)
def test_what_was_typed_before_a_question_moves_nothing(
    typed_ahead: str, ask: Callable[[], object], expected: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, inside = os.openpty()
    with os.fdopen(inside) as terminal_in:
        monkeypatch.setattr(sys, "stdin", terminal_in)
        # While the tune computed; then Enter at the question.
        os.write(window, f"{typed_ahead}\n".encode())
        wait = terminal._await_line

        def typed_then(shown: str) -> None:
            os.write(window, b"\n")
            wait(shown)

        monkeypatch.setattr(terminal, "_await_line", typed_then)
        assert ask() == expected
    os.close(window)


def test_flags_of_a_new_loop_need_both_topics() -> None:
    assert kind_of(options()) is Kind.TOPICS
    # Those of the command have their own names: another one was waited for in vain.
    with pytest.raises(SelectionError, match=r"--node is for nodes that run already: leave it"):
        kind_of(options("--node", "other"))
    given = options("--within", "1", "9")
    given.command = None
    with pytest.raises(SelectionError, match=r"--measurement .*: give --command, too"):
        kind_of(given)
    given.measurement = None
    assert kind_of(given) is Kind.NODES
    given.law = "simple_pid"
    with pytest.raises(SelectionError, match=r"--law .*: give --measurement and --command, too$"):
        kind_of(given)


@pytest.mark.parametrize("flags", [["--verify"], ["--step", "0.5"]])
def test_a_proof_of_nodes_that_run_names_the_program_that_proves(flags: list[str]) -> None:
    for words, how in (([], "apply_gains"), (["--namespace", "a"], "apply_gains --namespace a")):
        with pytest.raises(SelectionError, match=rf"prove the gains with: {how}$"):
            kind_of(tune_loop._parser().parse_args([*words, *flags]))


def test_what_is_given_for_a_loop_whose_nodes_run_goes_to_them_and_the_rest_comes_from_them():
    words = ("--at", "2", "--within", "30", "50", "--amplitude", "0.5")
    present = {
        "baseline": math.nan, "safe_command": 1.0, "measurement_min": -math.inf,
        "measurement_max": math.inf, "command_min": 0.0, "command_max": 5.0, "amplitude": 1.0,
    }  # fmt: skip
    client: Any = SimpleNamespace(
        name="/t/relay_node", set_values=lambda node, values: present.update(values),
        values=lambda node, names, patience=0.0: {name: present[name] for name in names},
    )  # fmt: skip
    before = dict(present)
    dry = Loop(client, tune_loop._parser().parse_args([*words, "--dry-run"]))
    dry.joined()
    assert present["safe_command"] == 2.0
    dry.restore()
    assert str(present) == str(before)
    Loop(client, tune_loop._parser().parse_args(words)).joined()
    assert (present["baseline"], present["measurement_max"]) == (2.0, 50.0)
    # An amplitude is that of one tune.
    assert (present["amplitude"], present["command_max"]) == (1.0, 5.0)
    page = Loop(client, tune_loop._parser().parse_args(["--web"]))
    page.joined()
    assert page.options.command_within == [0.0, 5.0] and page.options.amplitude == 1.0
    assert page.lacking() == []
    present["measurement_min"] = -math.inf
    page = Loop(client, tune_loop._parser().parse_args(["--web"]))
    page.joined()
    assert page.options.within is None and page.options.at == 2.0


def test_commands_within_messages_become_parameters() -> None:
    given = options(
        "--within", "0", "1", "--at", "0", "--command-within", "0", "1", "--field", "velocity[l]",
        "--command-field", "data[1]", "--command-message", "{data: [0, 0]}",
        "--command-period", "0.1", "--measurement-timeout", "5",
    )  # fmt: skip
    client = Looker(kind="sensor_msgs/msg/JointState")
    client.takes = "std_msgs/msg/Float64MultiArray"
    found = arguments(client, given)
    assert found["measurement_field"] == "velocity[l]"
    assert found["command_field"] == "data[1]"
    # The value of a parameter is read as YAML once more.
    assert yaml.safe_load(yaml.safe_load(found["command_message"])) == {"data": [0, 0]}
    assert found["command_period"] == "0.1"
    assert found["measurement_timeout"] == "5.0"


def test_a_field_that_is_not_there_is_asked_for_or_named_by_its_flag(typed: list[str]) -> None:
    words = "--within", "0", "1", "--at", "0", "--field", "nothing", "--command-within", "0", "1"
    typed += ["nothing", ""]
    assert arguments(Looker(), options(*words))["measurement_field"] == "data"
    assert not typed
    sys.stdin.isatty = lambda: False  # type: ignore[method-assign]
    with pytest.raises(SelectionError, match=r"Float32 has no field .*, such as --field data"):
        arguments(Looker(), options(*words))


def topic_loop(client: Any, given: argparse.Namespace) -> TopicLoop:
    """Return a loop that has been looked at."""
    loop = TopicLoop.__new__(TopicLoop)
    Loop.__init__(loop, client, given)
    loop._kind, loop._command_kind = "std_msgs/msg/Float32", FLOAT64
    return loop


def ended(why: core.Reason, **values: Any) -> Any:
    found = Tune.Result(outcome=Tune.Result.ABORTED, reason=str(why), **values)
    fill_reason(found.why, why)
    return found


def test_what_is_next_repeats_the_tune_with_its_answers() -> None:
    words = ["--measurement", "/tank/level", "--command", "/tank/valve"]
    given = tune_loop._parser().parse_args(words)
    given.typed = words
    given.at, given.within, given.command_within = 2.0, [30.0, 50.0], [0.0, 5.0]
    again = (
        f"{shell.prefix()}tune_loop --measurement /tank/level --command /tank/valve "
        f"--at 2 --within 30 50 --command-within 0 5"
    )
    inside = SimpleNamespace(measurement=np.array([40.0]))

    def repeated(result: Any, proven: bool | None) -> list[tuple[str, str]]:
        client: Any = SimpleNamespace(result=result, record=lambda patience: inside)
        return AfterTune(topic_loop(client, given)).repeated(proven)

    silent = ended(Code.SILENT_SENSOR(topic="/tank/level", silence=1.01))
    (what, command), (then, told) = repeated(silent, None)
    once = "once it measures and rests"
    assert (what, command, then) == (once, again, "if it happens again")
    # What can be typed on a machine without the ros2 command, too.
    assert "the sensor of /tank/level (--dry-run tells its rate)" in told
    assert told.endswith("for a longer silence give --measurement-timeout")
    assert repeated(ended(Code.CANCELLED()), None) == [("run it again", again)]
    trusted = Tune.Result.VERDICT_TRUSTED
    found = ended(core.NONE, gains=PidGains(experiment_id="x"), verdict=trusted)
    assert repeated(found, None) == [("prove the gains", f"{again} --verify")]
    assert repeated(found, True) == []
    # The file is written, and what is doubtful is proven only where a person agrees.
    given.export, given.yes = __file__, True
    assert repeated(found, None) == [("prove the gains", f"{again} --yes --verify")]
    found.verdict, found.verdict_reason = Tune.Result.VERDICT_DOUBTFUL, "clipped"
    assert repeated(found, None) == [("prove the gains", again)]


@pytest.fixture
def shown(
    typed: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> Callable[..., str]:
    """Return what is shown after a tune whose proof had an outcome and these answers came."""
    process = TransferFunction.fopdt(1.65, 1.0, 0.5)
    message, record = PidGains(), record_of(process, "x")
    result = Tune.Result(gains=message, verdict=Tune.Result.VERDICT_TRUSTED)
    result.experiment.settings.setpoint = 50.0
    found = result.transfer_function
    found.structure, found.dead_time, found.noise_std = "general", 0.5, 0.02
    found.numerator, found.denominator = [1.65], [1.0, 1.0]
    client: Any = SimpleNamespace(
        name="relay_node", result=result, record=lambda patience: record,
        identifier_values=lambda patience: None, others_on=lambda topic: "",
    )  # fmt: skip
    given = tune_loop._parser().parse_args(
        ["--measurement", "/tank/level", "--command", "/tank/valve"]
    )
    given.at, given.within, given.command_within = 35.0, [0.0, 90.0], [0.0, 100.0]
    words = ["-r", "__ns:=/tune_loop_1", "-r", "command:=/tank/valve", "-p", "baseline:=35.0"]
    nodes: Any = SimpleNamespace(why_lost=lambda: "")
    monkeypatch.chdir(tmp_path)

    def analysed(_: Any, __: Any, **changed: Any) -> Any:
        asked = DesignOptions(**changed)
        gains = design(DesignTask(model=process, options=asked), "imc")
        judgement = SimpleNamespace(reason="")
        return SimpleNamespace(best_gains=gains, verdict=Verdict.TRUSTED, judgement=judgement)

    # The whole analysis takes seconds.
    monkeypatch.setattr(AfterTune, "analysed", analysed)

    def show(
        passed: bool | None,
        against: str,
        *answers: str,
        command_type: str = FLOAT64,
        bag: str | None = None,
        command_within: list[float] | None = given.command_within,
        export: str | None = None,
        accept_doubtful: bool = False,
        at_joint: bool = False,
        **asked: Any,
    ) -> str:
        typed.extend(answers)
        gains = design(DesignTask(model=process, options=DesignOptions(**asked)), "imc")
        fill_gains(message, gains, experiment_id="x")
        given.command_within = command_within
        given.export, given.accept_doubtful = export, accept_doubtful
        result.bag = tempfile.mkdtemp(dir=tmp_path) if bag is None else bag
        # Gains that were not tried may be doubtful.
        doubt = against * (passed is None)
        result.verdict = Tune.Result.VERDICT_DOUBTFUL if doubt else Tune.Result.VERDICT_TRUSTED
        result.verdict_reason = doubt
        monkeypatch.setattr(AfterTune, "_offered", lambda _: (passed, against[len(doubt) :]))
        loop = topic_loop(client, given)
        loop._command_kind = command_type
        loop.nodes = nodes
        if at_joint:
            loop.proves = False
            loop.apply = lambda doubt: (passed, against)  # type: ignore[method-assign]
        loop.arguments = lambda: {"relay_node": words}  # type: ignore[method-assign]
        proven, steps = AfterTune(loop).hand_over()
        assert proven is passed
        assert not typed
        told = " ".join(" ".join(capsys.readouterr()).split())
        return " ".join([told, "NEXT", *(word for step in steps for word in step)])

    return show


def test_a_file_that_needs_limits_is_written_from_the_recording(
    shown: Callable[..., str], tmp_path: Path
) -> None:
    asked = ("arduino_pid_v1", "0.5", "sketch.ino")
    told = shown(None, "", *asked, "none", bag="tune", command_within=None)
    assert not (tmp_path / "sketch.ino").exists()
    assert "NEXT control with these gains" in told
    shown(None, "", *asked, bag="tune")
    assert "const auto OutputMax = 100.0;" in (tmp_path / "sketch.ino").read_text()


def test_a_typed_file_that_cannot_be_written_is_asked_for_again(
    shown: Callable[..., str], tmp_path: Path
) -> None:
    taken = tmp_path / "taken.yaml"
    taken.write_text("mine")
    told = shown(None, "", "taken.yaml", "nowhere/gains.yaml", "gains.yaml")
    assert taken.read_text() == "mine"
    assert f"controller_node: {tmp_path / 'gains.yaml'}" in told
    assert (tmp_path / "gains.yaml").exists()


def test_gains_that_failed_are_not_recommended_and_their_file_says_so(
    shown: Callable[..., str], tmp_path: Path
) -> None:
    failed = shown(False, "failed: it runs away", "failed.yaml")
    assert "the command stands at 35 u" in failed and "start your own" not in failed
    assert f"controller_node: {tmp_path / 'failed.yaml'}" in failed
    assert failed.endswith("NEXT")
    first = (tmp_path / "failed.yaml").read_text().splitlines()[0]
    assert first == "# NOT PROVEN: the step that was to prove them failed: it runs away"
    assert "they are not proven" in shown(None, "few cycles", "")
    assert "start your own controller with these gains" in shown(True, "", "passed.yaml")
    text = (tmp_path / "passed.yaml").read_text()
    assert "DOUBTFUL" not in text and "command_max: 100.0" in text
    assert "# Noise of 0.020 y in the measurement makes one of 0.0" in text
    assert "# From 35 u steps down to -" in text
    # It is what a controller_node of this loop starts with.
    words = with_gains_file(["--gains", "passed.yaml"])
    assert words[-1] == "controller_command:=/tank/valve"
    shown(True, "", "pid_controller", "0.1", "other.yaml")
    assert "u_clamp_max: 100.0" in (tmp_path / "other.yaml").read_text()


def test_doubtful_gains_are_exported_unasked_by_a_flag_alone(
    shown: Callable[..., str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "gains.yaml"
    told = shown(None, "few cycles", bag="tune", export=str(file))
    assert "not written: the gains are doubtful: few cycles; to have it: replay tune" in told
    assert not file.exists()
    shown(None, "few cycles", export=str(file), accept_doubtful=True)
    assert file.read_text().startswith("# DOUBTFUL: few cycles")


def test_gains_that_failed_at_a_joint_are_exported_with_that_or_not_at_all(
    shown: Callable[..., str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "gains.yaml"
    told = shown(False, "failed: it runs away", bag="tune", export=str(file), at_joint=True)
    assert "not written: the gains are not proven: the step" in told and "doubtful" not in told
    assert not file.exists()
    shown(False, "failed: it runs away", export=str(file), accept_doubtful=True, at_joint=True)
    first = file.read_text().splitlines()[0]
    assert first == "# NOT PROVEN: the step that was to prove them failed: it runs away"
    file.unlink()
    shown(True, "", export=str(file), at_joint=True)
    assert not re.search("DOUBTFUL|NOT PROVEN", file.read_text())


def test_a_program_that_is_named_gets_gains_of_its_own_and_a_start_without_a_bump(
    shown: Callable[..., str], tmp_path: Path
) -> None:
    told = shown(True, "", "iec_61131_3_pid", "", "pid.st")
    text = (tmp_path / "pid.st").read_text()
    # The block's output is KP X0 before it runs.
    values = dict(re.findall(r"^(\w+) := ([-\d.]+);$", text, re.MULTILINE))
    assert float(values["KP"]) * float(values["X0"]) == pytest.approx(35.0)
    (period,) = re.findall(r"Designed for iec_61131_3_pid every ([\d.]+) s", text)
    assert f"--law iec_61131_3_pid --sample-period {period} --verify" in told
    other = shown(False, "failed: it runs away", "px4_rate", "0.1", "px4.txt")
    told = "# NOT PROVEN: the step that was to prove them failed: it runs away"
    assert told in (tmp_path / "px4.txt").read_text()
    assert other.endswith("NEXT")


def test_the_period_of_the_tune_is_that_of_another_program(
    shown: Callable[..., str], tmp_path: Path
) -> None:
    asked = {"law": "simple_pid", "sample_period": 0.15}
    shown(True, "", "arduino_pid_v1", "", "sketch.ino", **asked)
    assert "const auto SampleTime = 150;" in (tmp_path / "sketch.ino").read_text()


def test_somebody_without_a_controller_is_told_how_to_start_one(
    shown: Callable[..., str],
) -> None:
    both, _, rest = (
        shown(None, "", "", bag="")
        .partition("NEXT control with these gains ")[2]
        .partition(" set-points for it ")
    )
    assert rest == "std_msgs/msg/Float64 on /setpoint"
    command = both.split()
    assert command[command.index("--ros-args") - 1] == "controller_node"
    given = dict(word.split(":=", 1) for word in command if ":=" in word)
    assert given["controller_command"] == "/tank/valve"
    assert float(given["kc"]) > 0.0 and float(given["initial_command"]) == 35.0
    assert (given["measurement_type"], given["command_max"]) == ("std_msgs/msg/Float32", "100.0")
    # The limits of the tune are not the sensor's range, beyond which the command is held for ever.
    assert not {"measurement_min", "measurement_max"} & given.keys()
    assert set(given) - {"measurement", "controller_command"} <= {
        e.name for e in CONTROLLER_PARAMETERS
    }
    # With a recording its folder keeps them, and the command is short.
    short = shown(None, "", "").partition(" set-points for it")[0].split()
    assert short[-3:-1] == ["controller_node", "--gains"]
    own, topics = yaml.safe_load(Path(short[-1]).read_text()).values()
    of_file = {name: str(value) for name, value in own["ros__parameters"].items()}
    assert of_file == {n: v for n, v in given.items() if n in of_file}
    assert set(given) - set(of_file) == {"measurement", "controller_command"}
    assert topics["ros__parameters"] == {n: given[n] for n in topics["ros__parameters"]}
    words = with_gains_file(["--gains", short[-1], "--ros-args", "-p", "kc:=1.0"])
    # What is typed beside the file counts: of parameters the last ones, of names the first.
    assert words[:4] == ["--ros-args", "--params-file", short[-1], "--"]
    assert words[4:7] == ["--ros-args", "-p", "kc:=1.0"]
    # It is typed in any folder, and goes with its recording.
    file = Path(short[-1])
    assert file.is_absolute()
    moved = file.parent.rename(f"{file.parent}_moved") / file.name
    assert with_gains_file(["--gains", str(moved)])[4:] == words[7:]
    assert words[7:] == [
        *("--ros-args", "-r", "measurement:=/tank/level"),
        *("-r", "controller_command:=/tank/valve"),
    ]
    # For another type relay_node stands between controller and actuator.
    both = shown(None, "", "", command_type="std_msgs/msg/Float32").partition("NEXT ")[2]
    assert "controller_command:=" not in both
    assert both.endswith(
        "relay_node --ros-args -r command:=/tank/valve -p baseline:=35.0 -p initial_command:=35.0"
    )


@pytest.mark.parametrize(
    "text",
    [
        "- kc: 1", "{kc: ", None, "kc: 1.0", "from simple_pid import PID\n\npid = PID(Kp=1.0)",
        "/pid_controller:\n  ros__parameters:\n    gains:\n      joint:\n        p: 0.6",
    ],
)  # fmt: skip
def test_a_file_of_gains_that_is_none_is_refused(text: str | None, tmp_path: Path) -> None:
    file = tmp_path / "gains.yaml"
    if text is not None:
        file.write_text(text)
    unread = r"cannot be read \(No such file"
    with pytest.raises(
        ParameterError, match=rf"--gains .*(no kc of a controller_node; expected|{unread})"
    ):
        with_gains_file(["--gains", str(file)])


@pytest.mark.parametrize("words", [[], ["--ros-args", "-p", "kc:=1.0"]])
def test_gains_without_a_file_are_refused(words: list[str]) -> None:
    """They were told as a directory that cannot be read."""
    with pytest.raises(ParameterError, match="--gains has no file; expected one that tune_loop"):
        with_gains_file(["--gains", *words])


def test_a_launch_file_starts_the_controller_with_limits_and_topics() -> None:
    gains = design(
        DesignTask(model=TransferFunction.fopdt(1.65, 1.0, 0.5), options=DesignOptions()), "imc"
    )
    target = Target(command_min=0.0, present=35.0, topics={"measurement": "/tank/level"})
    made: dict[str, Any] = {}
    launch: Any = SimpleNamespace(LaunchDescription=lambda nodes: nodes[0])
    ros: Any = SimpleNamespace(Node=lambda **given: given)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "launch", launch)
        patch.setitem(sys.modules, "launch_ros", SimpleNamespace(actions=ros))
        patch.setitem(sys.modules, "launch_ros.actions", ros)
        exec(exported(gains, "launch", target), made)
        node = made["generate_launch_description"]()
    assert (node["package"], node["executable"]) == ("relay_autotune", "controller_node")
    (values,) = node["parameters"]
    assert values["kc"] == pytest.approx(gains.kc) and values["initial_command"] == 35.0
    assert "command_min" in values and "command_max" not in values
    assert node["remappings"] == [("measurement", "/tank/level")]
    assert set(values) <= {each.name for each in CONTROLLER_PARAMETERS}


@pytest.mark.parametrize(
    ("why", "outside", "left_at", "next_step"),
    [
        (core.Reason(Code.NOT_AT_BASELINE), False, "not the one at", "once it rests"),
        (core.Reason(Code.OUTSIDE_LIMITS), True, "look whether", "once it rests"),
        # It left them while nothing but the command that was given went out.
        (
            core.Reason(Code.OUTSIDE_LIMITS, (("baseline", 1040.0),)),
            True,
            "not the one at",
            "once it rests",
        ),
        (core.Reason(Code.NODE_FAILED), False, "the plant is left at", "report it"),
        # The plant may still stand where the relay had it.
        (
            core.Reason(Code.SENSOR_GONE),
            False,
            "1040 u was sent, and no",
            "once it measures and rests",
        ),
        (
            core.Reason(Code.CANCELLED),
            False,
            "the plant is left at the safe command 1040 u",
            "run it again",
        ),
    ],
)
def test_after_an_end_that_would_come_again_the_same_command_is_not_offered_again(
    why, outside, left_at, next_step
):
    words = ["--measurement", "/y", "--command", "/u", "--at", "1040", "--within", "3", "9"]
    given = tune_loop._parser().parse_args(words)
    given.typed = words
    # The sentence lacks the values that matter to nobody here.
    result = ended(replace(why, said="it ended"))
    last = np.array([5.0, 9.1 if outside else 6.2])
    client: Any = SimpleNamespace(
        result=result, record=lambda patience: SimpleNamespace(measurement=last),
        is_taken=lambda topic: topic == "/u",
    )  # fmt: skip
    loop = topic_loop(client, given)
    assert loop.left_its_limits is outside
    assert left_at in loop.left()
    ((name, told),) = AfterTune(loop).repeated(None)
    assert name == next_step
    assert ("1040" in told) == (next_step in ("run it again", "once it measures and rests"))


def test_after_a_tune_beside_another_program_its_command_is_not_said_to_be_the_last() -> None:
    words = ["--measurement", "/y", "--command", "/u", "--at", "40", "--within", "3", "9"]
    given = tune_loop._parser().parse_args(words)
    given.typed = words
    why = Code.SECOND_PUBLISHER(topic="/u", others="a node not known yet")
    client: Any = SimpleNamespace(
        result=ended(why), record=lambda patience: SimpleNamespace(measurement=np.array([5.0])),
        others_on=lambda topic: "/pid", is_taken=lambda topic: True,
    )  # fmt: skip
    loop = topic_loop(client, given)
    assert loop.left() == "the safe command 40 u was sent, but /pid commands, too, and goes on"
    first, again = AfterTune(loop).repeated(None)
    assert first == ("first", "end /pid, which commands /u") and again[0] == "run it again"
    assert Loop(client, given).left().startswith("the safe command was sent, but a node not known")
    # relay_node passes on what comes on controller_command as soon as a tune has ended
    client.result = ended(Code.CANCELLED())
    assert Loop(client, given).left() == "the safe command was sent, and /pid commands again"


def test_a_plant_that_has_gone_is_not_said_to_be_left_at_the_safe_command() -> None:
    words = ["--measurement", "/y", "--command", "/u", "--at", "40", "--within", "3", "9"]
    why = Code.SILENT_SENSOR(topic="/y", silence=5.0)
    client: Any = SimpleNamespace(result=ended(why), is_taken=lambda topic: False)
    loop = topic_loop(client, tune_loop._parser().parse_args(words))
    assert loop.left() == (
        "the safe command 40 u was sent, but nobody takes commands from /u any more: see to the "
        "plant"
    )
    # One that was killed is known for some 20 s.
    client.is_taken = lambda topic: True
    told = "the safe command 40 u was sent, and no measurement shows whether the plant has it"
    assert loop.left() == told


def test_the_present_command_is_asked_about_as_it_was_given_and_not_as_measured() -> None:
    given = tune_loop._parser().parse_args(
        ["--measurement", "/y", "--command", "/u", "--at", "40"]
    )
    answers = Answers(given)
    answers.measured = 5.0
    assert answers.now("within") == "5 y now"
    assert answers.now("command_within") == answers.now("at") == "the present one given as 40 u"


def test_a_report_is_written_again_with_the_proof_and_stays_where_none_was_made(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    written: list[Any] = []
    monkeypatch.setattr(
        "relay_autotune.cli.report.write_report",
        lambda cases, output: written.append((cases[0].proof, output)),
    )
    case = Case("tank", "x", 0.0, 9.0, Outcome.COMPLETED, "")
    loop: Any = SimpleNamespace(client=None, options=SimpleNamespace(report="tune.html"))
    proof = (("verdict", "passed"),)
    for known, made in ((case, ()), (None, proof), (case, proof)):
        AfterTune(loop, known, made)._report_proof()
    assert written == [(proof, "tune.html")]


def test_a_joint_whose_model_was_cancelled_is_said_to_have_its_reference(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = Tune.Result(outcome=Tune.Result.COMPLETED, reason="no pi_gains: cancelled")
    found.experiment.experiment_id = "x"
    client: Any = SimpleNamespace(result=found, refused=(), cancelled=True, succeeded=False)
    given = tune_loop._parser().parse_args(["--controller", "pid", "--joint", "left"])
    given.typed = []
    loop: Any = SimpleNamespace(
        client=client, options=given, has_own_nodes=True, proves=False,
        left=lambda: "the reference of left is that of before",
    )  # fmt: skip
    assert AfterTune(loop).conclude() == 1
    told = capsys.readouterr().out
    assert "the reference of left is that of before; no gains" in " ".join(told.split())


@pytest.mark.parametrize(("words", "status"), [((), 1), (("--record-only",), 0)])
def test_a_recording_alone_is_complete_without_gains(words: tuple[str, ...], status: int) -> None:
    found = Tune.Result(outcome=Tune.Result.COMPLETED)
    client: Any = SimpleNamespace(result=found, succeeded=True)
    tune = Tuned(Loop(client, tune_loop._parser().parse_args(words)))
    assert (tune.is_complete, tune.status()) == (status == 0, status)


@pytest.mark.parametrize(
    ("other", "passes"),
    [("/t/tune_loop", True), ("/pid", False), ("/pid and /t/tune_loop", False)],
)
def test_a_publisher_of_its_own_that_has_ended_is_no_reason_to_give_up(other, passes):
    refused = Tune.Result()
    fill_reason(refused.why, Code.SECOND_PUBLISHER(topic="/u", others=other))

    class Client(TuneClient):
        succeeded, result = False, refused
        _first = SimpleNamespace(get_fully_qualified_name=lambda: "/t/tune_loop")

    assert Client.__new__(Client).not_ready_yet is passes
