# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Every bad input is refused with a reason."""

from __future__ import annotations

import math
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from loop_rig import LATCHED, RELIABLE, Rig
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_domain import free_domain
from std_msgs.msg import Float32, Float64

from relay_autotune.exchange.messages import reason_from_message
from relay_autotune.nodes.shell import prefix
from relay_autotune.recordings import read_experiments
from relay_autotune_msgs.msg import PidGains, RelayExperiment, TransferFunction

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED_ONLY = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Start a relay that must refuse the requested tunes."""
    with free_domain() as domain:
        rig = Rig(domain, tmp_path_factory.mktemp("idle"))
        try:
            rig.relay(amplitude=1.0, baseline=0.0, command_min=-2.0, command_max=2.0)
            yield rig
        finally:
            rig.close()


def test_apply_gains_without_a_controller_node_says_how_to_start_one(idle: Rig) -> None:
    done = subprocess.run(
        [shutil.which("apply_gains"), "--yes"], env=idle.environment,
        capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert (
        f"Start it: {prefix()}controller_node --ros-args "
        "-r measurement:=/measurement -p initial_command:=0.0 -p command_min:=-2.0 "
        "-p command_max:=2.0, or name another"
    ) in done.stderr


class RelayTopics:
    """Sensor and actuator of the loop, made by the test's node."""

    def __init__(
        self,
        rig: Rig,
        measurement: tuple[Any, QoSProfile] | None = (Float64, RELIABLE),
        command: tuple[Any, QoSProfile] | None = (Float64, RELIABLE),
        value: Callable[[int], float] = lambda k: 0.0,
    ) -> None:
        self.node = rig.node
        self.count = 0
        self.value = value
        self.made: list[Callable[[], Any]] = []
        self.commands: list[Any] = []
        if measurement is not None:
            self.kind, qos = measurement
            self.publisher = self.node.create_publisher(self.kind, "measurement", qos)
            timer = self.node.create_timer(0.01, self.publish)
            self.made += [
                lambda: self.node.destroy_timer(timer),
                lambda: self.node.destroy_publisher(self.publisher),
            ]
        if command is not None:
            kind, qos = command
            subscription = self.node.create_subscription(
                kind, "command", self.commands.append, qos
            )
            self.made.append(lambda: self.node.destroy_subscription(subscription))

    def publish(self) -> None:
        self.publisher.publish(self.kind(data=self.value(self.count)))
        self.count += 1

    def __enter__(self) -> RelayTopics:
        return self

    def __exit__(self, *_: object) -> None:
        for undo in self.made:
            undo()


def refused(rig: Rig, said: str, **request: Any) -> str:
    """Ask until the answer is the expected one, because discovery takes time."""

    def reason() -> str:
        answer = rig.ask_for_tune(**request)
        assert not answer.accepted
        assert not answer.experiment_id
        if said in answer.reason:
            return answer.reason
        rig.run_for(0.1)
        return ""

    return str(rig.until(reason, f"a refusal with {said!r}"))


def test_no_measurement_arriving(idle: Rig) -> None:
    with RelayTopics(idle, measurement=None):
        reason = refused(idle, "no measurement has come yet: /measurement has no publisher")
        assert "\n" not in reason


def test_a_measurement_of_another_type(idle: Rig) -> None:
    with RelayTopics(idle, measurement=(Float32, RELIABLE)):
        refused(idle, "/onlooker has type std_msgs/msg/Float32, expected std_msgs/msg/Float64")


def test_no_subscriber_on_the_command(idle: Rig) -> None:
    with RelayTopics(idle, command=None):
        refused(idle, "no command would arrive: /command has no subscriber")


def test_a_command_subscriber_with_incompatible_qos(idle: Rig) -> None:
    with RelayTopics(idle, command=(Float64, LATCHED_ONLY)):
        reason = refused(idle, "/onlooker has an incompatible QoS")
        assert "transient local" in reason.lower()


@pytest.mark.parametrize(
    ("amplitude", "said"),
    [
        (-1.0, "amplitude is -1"),
        (math.nan, "amplitude is nan"),
        (math.inf, "amplitude is inf"),
        (5.0, "expected from command_min -2 to command_max 2"),
    ],
)
def test_an_amplitude_that_cannot_be(idle: Rig, amplitude: float, said: str) -> None:
    with RelayTopics(idle):
        refused(idle, said, amplitude=amplitude)


def set_parameter(rig: Rig, name: str, value: float) -> Any:
    value_message = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    request = SetParameters.Request(parameters=[Parameter(name=name, value=value_message)])
    return rig.call(SetParameters, "relay_node/set_parameters", request).results[0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("amplitude", -1.0),
        ("amplitude", math.nan),
        ("cycle_tolerance", 1.5),
        ("measurement_timeout", -1.0),
        ("measurement_timeout", math.nan),
        ("bias", math.inf),
        ("baseline", math.inf),
        ("baseline", 2.5),
    ],
)
def test_a_parameter_out_of_range(idle: Rig, name: str, value: float) -> None:
    result = set_parameter(idle, name, value)
    assert not result.successful
    assert name in result.reason


def test_an_unknown_baseline(idle: Rig) -> None:
    assert set_parameter(idle, "baseline", math.nan).successful
    with RelayTopics(idle):
        refused(idle, "the baseline is not known")
        assert set_parameter(idle, "baseline", -2.0).successful
        reason = refused(idle, "is at the actuator's end, command_min -2", amplitude=0.5)
        assert "at which command does the process rest at its working point?" in reason
        why = idle.ask_for_tune(dry_run=True).refusals[0]
        assert reason_from_message(why).typed == "baseline COMMAND"
    assert set_parameter(idle, "baseline", 0.0).successful


def test_a_dry_run_says_what_would_be_done_and_moves_nothing(idle: Rig) -> None:
    with RelayTopics(idle) as ends:

        def accepted() -> Any:
            answer = idle.ask_for_tune(dry_run=True)
            idle.run_for(0.1)
            return answer if answer.accepted else None

        answer = idle.until(accepted, "a dry run")
        assert (
            "relay between -0.7 and 1.3 u about the baseline 0; for the first cycle between "
            "-0.175 and 0.325 u: the swing has to grow with the levels if the actuator goes as "
            "far; that takes about 2 oscillations;"
        ) in answer.reason
        assert "about 7 oscillations of the loop" in answer.reason
        assert answer.experiment_id == ""
        idle.run_for(0.2)
        assert not ends.commands
        marks = {line[6:18].strip(): line[:4].strip() for line in answer.checks}
        found = "\n".join(answer.checks)
        good = ("levels", "measurement", "command", "alone", "present", "recording", "time")
        assert {marks[name] for name in good} == {"ok"}
        assert (marks["limits"], marks["model"]) == ("note", "note")
        assert "/measurement from /onlooker (std_msgs/msg/Float64, reliable), " in found
        assert reason_from_message(answer.refusals[5]).typed == "measurement_min LIMIT"
        assert set_parameter(idle, "measurement_max", -1.0).successful
        try:
            reason = refused(idle, "the measurement is 0, outside of its limits")
            assert "give a higher measurement_max" in reason
            answer = idle.ask_for_tune(dry_run=True)
            (failed,) = (n for n, line in enumerate(answer.checks) if line.startswith("NO"))
            why = reason_from_message(answer.refusals[failed])
            assert why.typed == "measurement_max LIMIT"
        finally:
            assert set_parameter(idle, "measurement_max", math.inf).successful


@pytest.mark.parametrize(
    ("executable", "parameters", "said"),
    [
        ("relay_node", {"amplitude": -1.0}, "amplitude is -1.0, expected at least 0 u"),
        ("relay_node", {"amplitude": math.nan}, "amplitude is nan"),
        ("relay_node", {"amplitude": 1}, "amplitude is 1, expected a number with a decimal"),
        ("relay_node", {"min_cycles": 1}, "min_cycles is 1"),
        ("relay_node", {"max_cycles": 2}, "max_cycles is 2, expected at least min_cycles"),
        (
            "relay_node",
            {"safe_command": 20.0, "command_max": 5.0},
            "safe_command is 20, expected from command_min -inf to command_max 5",
        ),
        (
            "relay_node",
            {"baseline": -1.0, "command_min": 0.0},
            "baseline is -1, expected from command_min 0 to command_max inf",
        ),
        (
            "relay_node",
            {"measurement_min": 5.0, "measurement_max": 1.0},
            "measurement_min is 5, expected less than measurement_max, which is 1",
        ),
        ("identifier_node", {"method": "guess"}, "method is 'guess', expected one of waveform"),
        ("plant_node", {}, "found neither"),
        ("relay_node", {"measurment_max": 50.0}, "did you mean measurement_max?"),
    ],
)
def test_a_bad_parameter_at_the_start_is_one_line(
    rig: Rig, executable: str, parameters: dict[str, Any], said: str
) -> None:
    process = rig.start(executable, **parameters)
    assert process.wait() == 2
    (line,) = process.log.strip().splitlines()
    assert line.startswith(f"{executable}: ")
    assert said in line


@pytest.mark.parametrize("executable", ["relay_node", "plant_node"])
def test_one_topic_for_measurement_and_command_is_refused(rig: Rig, executable: str) -> None:
    """The node took its own commands for the measurement."""
    process = rig.start(executable, "-r", "measurement:=command")
    assert process.wait() == 2
    said = f"{executable}: measurement and command are both /command: remap them to two topics\n"
    assert process.log.endswith(said)


def test_a_misspelt_name_in_a_file_is_told(rig: Rig) -> None:
    """The name may be meant for another node, so the node only warns."""
    file = rig.folder / "parameters.yaml"
    file.write_text("/**:\n  ros__parameters:\n    measurment_max: 50.0\n    amplitude: 1.0\n")
    process = rig.relay("--params-file", str(file))
    rig.until(lambda: "did you mean measurement_max?" in process.log, "the warning")
    assert "[WARN]" in process.log
    process.end()


# The safe command after either is one of the faults of test_faults.py.
@pytest.mark.parametrize("bad", [math.nan, pytest.param(math.inf, marks=pytest.mark.nightly)])
def test_a_measurement_that_is_no_number_ends_the_tune(rig: Rig, bad: float) -> None:
    experiments = rig.listen("relay_experiment", RelayExperiment)
    relay = rig.relay(amplitude=1.0, baseline=0.5)
    with RelayTopics(rig, value=lambda k: math.sin(0.1 * k)) as ends:
        answer = rig.tune()
        rig.until(lambda: len(ends.commands) > 50, "commands")
        ends.value = lambda _: bad
        ended = rig.until(lambda: experiments, "the record")[-1]
        rig.until(lambda: ends.commands[-1].data == 0.5, "the safe command")
    rig.until(lambda: "is closed" in relay.log, "the bag")
    assert ended.outcome == RelayExperiment.FAILED
    assert f"is {bad:g}, expected" in ended.reason
    (record,) = read_experiments(rig.bag(answer)).experiments
    assert len(record) == len(ended.time) >= 50


def test_a_constant_measurement_ends_the_tune(rig: Rig) -> None:
    experiments = rig.listen("relay_experiment", RelayExperiment)
    gains = rig.listen("pi_gains", PidGains)
    rig.relay(amplitude=1.0, baseline=0.5, max_duration=1.5, settle_time=0.3)
    rig.identifier()
    with RelayTopics(rig, value=lambda _: 20.0) as ends:
        rig.tune()
        ended = rig.until(lambda: experiments, "the record")[-1]
        rig.until(lambda: ends.commands[-1].data == 0.5, "the safe command")
    assert ended.outcome == RelayExperiment.FAILED
    assert "max_duration 1.5 s" in ended.reason
    rig.run_for(0.3)
    assert not gains


def test_while_a_tune_runs(rig: Rig) -> None:
    relay = rig.relay(amplitude=1.0, baseline=0.5, settle_time=60.0)
    with RelayTopics(rig):
        first = rig.tune()
        second = rig.ask_for_tune()
        assert not second.accepted
        assert f"tune {first.experiment_id} is running" in second.reason
        result = set_parameter(rig, "amplitude", 0.5)
        assert not result.successful
        assert f"while tune {first.experiment_id} runs" in result.reason
        assert relay.running


def test_a_best_effort_sensor_is_taken_as_it_comes(rig: Rig) -> None:
    relay = rig.relay(amplitude=1.0, baseline=0.5, settle_time=60.0)
    with RelayTopics(rig, measurement=(Float64, BEST_EFFORT)):
        assert rig.tune(dry_run=True).accepted
        said = "/measurement is taken best effort, as "
        rig.until(lambda: said in relay.log, said)
        answer = rig.tune()
        rig.until(lambda: "settling, " in relay.log, "the first words")
    rig.until(lambda: "is closed" in relay.log, "the bag")
    metadata = (rig.bag(answer) / "metadata.yaml").read_text()
    assert "best_effort" in metadata


def test_a_reliability_that_the_user_gives_is_kept(rig: Rig) -> None:
    override = "qos_overrides./measurement.subscription.reliability"
    rig.relay(amplitude=1.0, baseline=0.5, **{override: "reliable"})
    with RelayTopics(rig, measurement=(Float64, BEST_EFFORT)):
        reason = refused(rig, "/onlooker has an incompatible QoS")
        assert "reliab" in reason.lower()


def test_a_wrong_topic_is_told_with_the_nearest_of_its_type(idle: Rig) -> None:
    tank = idle.node.create_publisher(Float64, "/tank/measurement", RELIABLE)
    level = idle.node.create_publisher(Float64, "/other", RELIABLE)
    fan = idle.node.create_publisher(Float32, "/fan/measurement", RELIABLE)
    try:
        with RelayTopics(idle, measurement=None):
            reason = refused(idle, "start the node with -r measurement:=/tank/measurement")
            reason = refused(idle, "(others: /other)")
            assert "/fan" not in reason
    finally:
        for publisher in (tank, level, fan):
            idle.node.destroy_publisher(publisher)


def test_a_folder_that_cannot_be_written_is_said_and_the_tune_goes_on(rig: Rig) -> None:
    blocked = rig.folder / "a_file"
    blocked.write_text("not a folder")
    status = rig.listen("/diagnostics", DiagnosticArray, QoSProfile(depth=10))
    gains = rig.listen("pi_gains", PidGains)
    start_plant(rig)
    relay = rig.relay(
        amplitude=1.0, baseline=0.0, sample_period=0.1, record_directory=str(blocked)
    )
    rig.identifier()
    answer = rig.tune()
    assert "not recorded: cannot make the bag" in answer.reason
    rig.until(lambda: gains, "gains")
    rig.until(
        lambda: any("not recorded" in s.message for m in status for s in m.status),
        "the diagnostics",
    )
    assert "the tune goes on, but not recorded" in relay.log


def start_plant(rig: Rig) -> None:
    """Start e^(-s)/(2 s + 1) in lockstep, for tests of the time after a tune."""
    rig.plant(
        sample_period=0.1,
        mode="lockstep",
        lockstep_speed=15.0,
        structure="fopdt",
        time_constants=[2.0],
        dead_time=1.0,
    )


def test_without_an_identifier_the_bag_is_closed_with_the_reason(rig: Rig) -> None:
    start_plant(rig)
    relay = rig.relay(amplitude=1.0, baseline=0.0, sample_period=0.1, model_timeout=0.5)
    answer = rig.tune()
    said = (
        "is closed without transfer_function and pi_gains: "
        "identifier_node did not send them within 0.5 s"
    )
    rig.until(lambda: said in relay.log, "the end of the recording")
    (record,) = read_experiments(rig.bag(answer)).experiments
    assert record.experiment_id == answer.experiment_id


LATE = """
import sys, time
from relay_autotune.nodes import identifier
analyse = identifier.analyse
def late(record, **asked):
    time.sleep(3.5)
    if len(record.cycle_start) > 6:
        raise RuntimeError("too much for it")
    return analyse(record, **asked)
identifier.analyse = late
sys.exit(identifier.main())
"""


@pytest.mark.nightly
def test_an_identifier_that_takes_long_is_waited_for_and_says_if_nothing_comes(rig: Rig) -> None:
    start_plant(rig)
    identifier = rig.start_python("late_identifier", LATE)
    rig.until(lambda: "ready" in identifier.log, "the identifier")
    limits = {"sample_period": 0.1, "model_timeout": 2.0, "amplitude": 1.0, "baseline": 0.0}
    relay = rig.relay(**limits)
    rig.tune()
    rig.until(lambda: "is closed with model and gains" in relay.log, "the end of the recording")
    relay.signal(signal.SIGTERM)
    relay.wait()
    relay = rig.relay(**limits, min_cycles=8)
    rig.tune()
    said = "is closed without transfer_function and pi_gains: the experiment could not be analysed"
    rig.until(lambda: said in relay.log, "the end of the recording")


def test_the_identifier_survives_messages_that_make_no_sense(rig: Rig) -> None:
    models = rig.listen("transfer_function", TransferFunction)
    identifier = rig.identifier()
    publisher = rig.node.create_publisher(RelayExperiment, "relay_experiment", LATCHED)
    rig.until(publisher.get_subscription_count, "the identifier")
    empty = RelayExperiment(experiment_id="empty", outcome=1)
    nowhere = RelayExperiment(experiment_id="nowhere", outcome=77)
    torn = RelayExperiment(experiment_id="torn", outcome=1, time=[0.0, 1.0], measurement=[1.0])
    backwards = RelayExperiment(experiment_id="backwards", outcome=1)
    backwards.time = [0.0, 2.0, 1.0]
    backwards.measurement = backwards.command = [1.0, 1.0, 1.0]
    for message in (empty, nowhere, torn, backwards):
        publisher.publish(message)
        said = f"the record of {message.experiment_id} refused"
        rig.until(lambda said=said: said in identifier.log, said)
    assert identifier.running
    assert not models
