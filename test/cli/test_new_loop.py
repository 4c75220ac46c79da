# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What tune_loop asks for, and what it starts its own nodes with."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from relay_autotune.cli import proof, tune_loop
from relay_autotune.cli.asking import agrees, asked_for_file, number_of, pair_of
from relay_autotune.cli.export import EXPORTS
from relay_autotune.cli.new_loop import add_new_loop, is_new_loop, nodes_for, with_flags
from relay_autotune.errors import LoopError, ParameterError, SelectionError
from relay_autotune.exchange.messages import fill_gains
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning import DesignOptions, DesignTask, design
from relay_autotune_msgs.action import Tune
from relay_autotune_msgs.msg import PidGains


class Looker:
    """A client of a loop whose topics have these types, with a present command."""

    def __init__(self, present: float = math.nan) -> None:
        self.present = present

    def kind_of(self, topic: str, patience: float, *, published: bool) -> str:
        return {"/tank/level": "std_msgs/msg/Float32"}.get(topic, "std_msgs/msg/Float64")

    def commanded(self, topic: str, type_name: str, field: str, others: str) -> float:
        return self.present

    def require_field(self, type_name: str, field: str) -> None:
        if field == "nothing":
            raise ParameterError(f"measurement_field: {type_name} has no field {field!r}")

    def require_uncontrolled(self) -> None:
        pass


def options(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_new_loop(parser)
    parser.set_defaults(namespace="tank", wait=1.0, amplitude=0.0, record_only=False)
    return parser.parse_args(["--measurement", "/tank/level", "--command", "/tank/valve", *words])


def arguments(client: Any, given: argparse.Namespace) -> dict[str, str]:
    """Return parameters and remappings of the relay_node that would be started."""
    words = nodes_for(client, given)._nodes["relay_node"]
    return dict(word.split(":=", 1) for word in words if ":=" in word)


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Answer each question with the next of these texts, as at a terminal."""
    answers: list[str] = []
    monkeypatch.setattr("builtins.input", lambda shown: answers.pop(0))
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
        "measurement_type": "std_msgs/msg/Float32",
        "measurement_field": "data",
        "command_type": "std_msgs/msg/Float64",
        "command_field": "data",
    }
    assert set(nodes_for(Looker(), given)._nodes) == {"relay_node", "identifier_node"}


def test_the_law_of_another_program_is_designed_for() -> None:
    given = options("--within", "30", "50", "--at", "2", "--command-within", "0", "5")
    given.law, given.sample_period = "simple_pid", 0.1
    words = nodes_for(Looker(), given)._nodes["identifier_node"]
    assert {"law:=simple_pid", "sample_period:=0.1"} < set(words)


def test_what_is_not_given_is_asked_for_until_it_can_be_read(typed: list[str]) -> None:
    typed += ["two", "2", "30", "30 50", "0, 5"]
    found = arguments(Looker(), options())
    assert not typed
    assert (found["baseline"], found["measurement_max"]) == ("2.0", "50.0")
    assert (found["command_min"], found["command_max"]) == ("0.0", "5.0")


def test_the_command_that_is_heard_needs_only_enter(typed: list[str]) -> None:
    typed += ["", "0 5"]
    assert arguments(Looker(present=2.25), options("--within", "1", "9"))["baseline"] == "2.25"


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
    typed += ["y", "iec_61131_3_pid", "~/gains.yaml", "no"]
    how = "replay bag --export NAME --sample-period S > FILE"
    assert asked_for_file("Write", EXPORTS, how) == str(Path("~/gains.yaml").expanduser())
    yes, law = capsys.readouterr().err.splitlines()
    assert "such as gains.yaml" in yes
    assert law.endswith("type replay bag --export iec_61131_3_pid --sample-period S > FILE")
    assert asked_for_file("Write", EXPORTS, how) == ""
    with pytest.raises(SystemExit):
        tune_loop.main(["--export", "iec_61131_3_pid"])


def test_what_failed_names_the_flag_and_no_node_that_ends_with_the_command() -> None:
    check = "NO    present       too low; type: ros2 param set /t/relay_node measurement_min LIMIT"
    assert with_flags(check) == "NO    present       too low; give --within"
    other = "note  model         no identifier_node; type: ros2 run relay_autotune identifier_node"
    assert with_flags(other) == other


def test_where_nobody_can_be_asked_the_flag_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    with pytest.raises(LoopError, match="give --at"):
        nodes_for(Looker(), options())
    with pytest.raises(LoopError, match="give --within"):
        nodes_for(Looker(), options("--at", "2"))
    with pytest.raises(LoopError, match="give --command-within"):
        nodes_for(Looker(), options("--at", "2", "--within", "1", "9"))
    with pytest.raises(LoopError, match="give --yes"):
        agrees("Start?", yes=False)
    assert agrees("Start?", yes=True)


def test_flags_of_a_new_loop_need_both_topics() -> None:
    assert is_new_loop(options())
    given = options("--within", "1", "9")
    given.command = None
    with pytest.raises(SelectionError, match="--measurement is for a loop without nodes"):
        is_new_loop(given)
    given.measurement = None
    with pytest.raises(SelectionError, match="--within is for a loop without nodes"):
        is_new_loop(given)
    given.within = None
    assert not is_new_loop(given)


def test_commands_within_messages_become_parameters() -> None:
    given = options(
        "--within", "0", "1", "--at", "0", "--command-within", "0", "1", "--field", "velocity[l]",
        "--command-field", "data[1]", "--command-message", "{data: [0, 0]}",
        "--command-period", "0.1",
    )  # fmt: skip
    found = arguments(Looker(), given)
    assert found["measurement_field"] == "velocity[l]"
    assert found["command_field"] == "data[1]"
    # The value of a parameter is read as YAML once more.
    assert yaml.safe_load(yaml.safe_load(found["command_message"])) == {"data": [0, 0]}
    assert found["command_period"] == "0.1"


def test_a_field_that_is_not_there_is_named_by_its_flag() -> None:
    with pytest.raises(SelectionError, match="--field: std_msgs/msg/Float32 has no field"):
        arguments(Looker(), options("--within", "0", "1", "--at", "0", "--field", "nothing"))


def ended(reason: str, **values: Any) -> Any:
    return Tune.Result(outcome=Tune.Result.ABORTED, reason=reason, **values)


def test_what_is_next_repeats_the_tune_with_its_answers() -> None:
    words = ["--measurement", "/tank/level", "--command", "/tank/valve"]
    given = tune_loop._parser().parse_args(words)
    given.typed = words
    given.at, given.within, given.command_within = 2.0, [30.0, 50.0], [0.0, 5.0]
    again = (
        f"{tune_loop._prefix()}tune_loop --measurement /tank/level --command /tank/valve "
        f"--at 2 --within 30 50 --command-within 0 5"
    )
    silent = ended("no measurement on /tank/level for 1.01 s")
    (what, command), (then, told) = tune_loop._repeated(silent, given, None)
    assert (what, command, then) == ("run it again", again, "if it happens again")
    assert "ros2 topic hz /tank/level" in told and "the load of the machine" in told
    assert tune_loop._repeated(ended("cancelled"), given, None) == [("run it again", again)]
    found = ended("", gains=PidGains(experiment_id="x"))
    assert tune_loop._repeated(found, given, None) == [("prove the gains", f"{again} --verify")]
    assert tune_loop._repeated(found, given, True) == []


def test_gains_that_failed_are_not_recommended_and_their_file_says_so(
    typed: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    message = PidGains()
    task = DesignTask(model=TransferFunction.fopdt(1.65, 1.0, 0.5), options=DesignOptions())
    fill_gains(message, design(task, "imc"), experiment_id="x")
    client = SimpleNamespace(
        result=Tune.Result(gains=message, verdict=Tune.Result.VERDICT_TRUSTED)
    )
    given = tune_loop._parser().parse_args([])
    nodes: Any = SimpleNamespace(require_alive=lambda: None)
    given.at = 35.0
    monkeypatch.chdir(tmp_path)

    def shown(passed: bool | None, against: str, file: str) -> str:
        typed.append(file)
        monkeypatch.setattr(proof, "_offered", lambda *_: proof.Outcome(passed, against))
        assert tune_loop._hand_over(client, given, nodes, None) is passed
        return " ".join(capsys.readouterr().out.split())

    failed = shown(False, "the step that was to prove them failed: it runs away", "failed.yaml")
    assert "the command stands at 35 u" in failed and "start your own" not in failed
    assert f"pid_controller: {tmp_path / 'failed.yaml'}" in failed
    first = (tmp_path / "failed.yaml").read_text().splitlines()[0]
    assert first == "# DOUBTFUL: the step that was to prove them failed: it runs away"
    assert "they are not proven" in shown(None, "few cycles", "")
    assert "start your own controller with these gains" in shown(True, "", "passed.yaml")
    assert "DOUBTFUL" not in (tmp_path / "passed.yaml").read_text()


@pytest.mark.parametrize(
    ("reason", "left", "next_step"),
    [
        (
            "the measurement rested at 6 y and is at 6.2 y",
            "which is not the one at",
            "once it rests",
        ),
        (
            "the measurement 9.1 at 3 s is outside its limits, 3 to 9",
            "look whether",
            "once it rests",
        ),
        ("cancelled", "the plant is left at the safe command 1040 u", "run it again"),
    ],
)
def test_after_the_process_was_driven_away_the_same_command_is_not_offered_again(
    reason, left, next_step
):
    words = ["--measurement", "/y", "--command", "/u", "--at", "1040", "--within", "3", "9"]
    given = tune_loop._parser().parse_args(words)
    given.typed = words
    result = SimpleNamespace(
        reason=reason, outcome=1, COMPLETED=2, gains=SimpleNamespace(experiment_id="")
    )
    assert left in tune_loop._left(result, 1040.0)
    ((name, told),) = tune_loop._repeated(result, given, None)
    assert name == next_step
    assert ("1040" in told) == (next_step == "run it again")
