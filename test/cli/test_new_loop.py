# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What tune_loop asks for, and what it starts its own nodes with."""

from __future__ import annotations

import argparse
import math
import sys
from typing import Any

import pytest
import yaml

from relay_autotune.cli import tune_loop
from relay_autotune.cli.asking import agrees, pair_of
from relay_autotune.cli.new_loop import add_new_loop, is_new_loop, nodes_for, with_flags
from relay_autotune.errors import LoopError, ParameterError, SelectionError
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
        ("5 0", None), ("0 5 6", None), ("0 five", None), ("", None),
    ],
)  # fmt: skip
def test_two_numbers_are_taken_as_people_type_them(text: str, pair: list[float] | None) -> None:
    assert pair_of(text) == pair


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
