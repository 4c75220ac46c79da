# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a robot's description and a manager's list tell of a joint."""

from __future__ import annotations

import math
import shlex
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from toolbox_pid import ToolboxPid

from relay_autotune.cli import joint_tune
from relay_autotune.cli.joint_tune import JointLoop
from relay_autotune.cli.loops import Loop
from relay_autotune.cli.settings import Answers
from relay_autotune.control.controller import PredictedLoop, Step
from relay_autotune.control.verification import compare
from relay_autotune.errors import LoopError
from relay_autotune.identification.judgement.table import CHECKS
from relay_autotune.loop import laws
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate
from relay_autotune.nodes import controller_manager
from relay_autotune.nodes import joint_loop as joint_loop_module
from relay_autotune.nodes.controller_manager import (
    ControllerManager,
    ManagedController,
    above,
    broadcasting,
    close,
    forwarding,
    in_the_way,
    opened,
)
from relay_autotune.nodes.gains_place import (
    controller_of,
    in_another_node,
    mapping_of,
)
from relay_autotune.nodes.joint_loop import (
    TRAJECTORY_CONTROLLER,
    DofState,
    is_continuous,
    joint_loop,
    limits_in,
)
from relay_autotune.nodes.loop_client import GoneError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.reasons import Code
from relay_autotune_msgs.action import Tune

STRATEGIES = ("back_calculation", "conditional_integration", "none", "legacy")
DESCRIPTION = """<?xml version="1.0"?>
<robot name="arm">
  <joint name="arm_1" type="revolute">
    <limit lower="-1.5" upper="2" effort="30" velocity="3"/>
  </joint>
  <joint name="wheel" type="continuous"><limit effort="5" velocity="8"/></joint>
  <joint name="free" type="continuous"/>
  <ros2_control name="arm" type="system"><joint name="arm_1">
    <command_interface name="effort"><param name="min">-10</param><param name="max">40</param>
    </command_interface></joint></ros2_control>
</robot>"""


@pytest.mark.parametrize(
    ("joint", "interface", "limits"),
    [
        ("arm_1", "position", (-1.5, 2.0)),
        ("arm_1", "velocity", (-3.0, 3.0)),
        ("arm_1", "effort", (-10.0, 30.0)),
        ("wheel", "effort", (-5.0, 5.0)),
        ("wheel", "position", None),
        ("free", "velocity", None),
        ("unknown", "velocity", None),
    ],
)
def test_the_narrower_of_joint_and_hardware_limits(joint, interface, limits) -> None:
    assert limits_in(DESCRIPTION, joint, interface) == limits


def test_a_description_that_is_none_tells_no_limits() -> None:
    assert limits_in("", "arm_1", "effort") is None
    assert limits_in("<robot><joint", "arm_1", "effort") is None
    assert not is_continuous("<robot><joint", "arm_1")


def test_a_joint_that_turns_without_end_is_told_by_its_type() -> None:
    assert is_continuous(DESCRIPTION, "wheel")
    assert not is_continuous(DESCRIPTION, "arm_1")
    assert not is_continuous(DESCRIPTION, "unknown")


def controller(name: str, kind: str, *needs: str, active: bool = True) -> ManagedController:
    state = "active" if active else "inactive"
    return ManagedController(name, kind, state, 100.0, needs, needs if active else ())


FORWARD = "forward_command_controller/ForwardCommandController"
LOADED = (
    controller("base", "diff_drive_controller/DiffDriveController", "pid/left/velocity"),
    controller("pid", "pid_controller/PidController", "left/effort", "right/effort"),
    controller("arm", "pid_controller/PidController", "arm/effort"),
    controller("all", FORWARD, "left/effort", "right/effort", "arm/effort", active=False),
    controller("one", FORWARD, "left/effort", active=False),
    controller("other", "pid_controller/PidController", "left/effort", active=False),
)


def test_a_chain_is_in_the_way_as_a_whole_and_nothing_else() -> None:
    # Who is written to stands before who writes, as a manager activates them.
    assert in_the_way(LOADED, ["left/effort"]) == ("pid", "base")
    assert above(LOADED, ["pid"]) == ("base",)
    assert above(LOADED, ["arm"]) == ()
    assert set(in_the_way(LOADED, ["arm/effort"])) == {"arm"}
    assert in_the_way(LOADED, ["gripper/effort"]) == ()


def test_the_forwarding_controller_with_the_fewest_joints_or_the_one_that_is_named() -> None:
    assert forwarding(LOADED, "left/effort", "").name == "one"
    assert forwarding(LOADED, "left/effort", "all").name == "all"
    with pytest.raises(LoopError, match=r"interface_name: effort.*spawner"):
        forwarding(LOADED, "gripper/effort", "")
    with pytest.raises(LoopError, match="type --forward with one of all, one"):
        forwarding(LOADED, "left/effort", "wrong")


def test_joints_that_would_go_limp_have_to_be_written_too() -> None:
    both = ("left/effort", "right/effort")
    assert forwarding(LOADED, "left/effort", "", both).name == "all"
    assert forwarding(LOADED, "left/effort", "one", both).name == "one"
    with pytest.raises(LoopError, match=r"commanded 0.*--forward with one of all, one.*arm, leg"):
        forwarding(LOADED, "left/effort", "", ("left/effort", "arm/effort", "leg/effort"))


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("velocity", ["", "_velocity"])
def test_gains_are_designed_for_the_law_of_the_strategy(strategy: str, velocity: str) -> None:
    period, gains = 0.01, Controller(0.8, 0.4, 0.05)
    running = laws.LAWS[f"control_toolbox_{strategy}{velocity}"].at(gains, period).running()
    law = ToolboxPid(gains.p, gains.i, gains.d, strategy)
    measured = np.random.default_rng(3).normal(size=200)
    rates = -np.diff(measured, prepend=0.0) / period if velocity else [None] * 200
    ours = [running.step(1.0, y) for y in measured]
    theirs = [law.step(1.0 - y, period, d) for y, d in zip(measured, rates, strict=True)]
    assert ours == pytest.approx(theirs, rel=1e-9)


@pytest.mark.long
def test_a_step_of_a_joint_with_a_velocity_state_is_predicted_as_it_is_made() -> None:
    """The velocity of the joint itself, which its difference lags by half a period."""
    period, lag, gains = 0.01, 0.3, Controller(6.448, 1.169, 0.1623)
    pid = ToolboxPid(gains.p, gains.i, gains.d, "none")
    seen, velocity, position, on_the_way = list[float](), 0.0, 0.0, [0.0] * 3
    for _ in range(300):
        seen.append(position)
        on_the_way.append(pid.step(1.0 - position, period, -velocity))
        held, left = on_the_way.pop(0), math.exp(-period / lag)
        position += held * period + (velocity - held) * lag * (1.0 - left)
        velocity = held + (velocity - held) * left
    arm = Arm()
    rate = LawRate(laws.LAWS[joint_loop(arm, arm, "arm", "arm_2").law], period)
    model = TransferFunction(1.0, (), (lag,), dead_time=0.03, integrators=1)
    loop = PredictedLoop(in_another_node(gains, rate, 0.0), model)
    found = compare(loop, Step(setpoint=1.0), period * np.arange(300), np.array(seen))
    assert found.passed, found.reason
    assert found.expected.overshoot == pytest.approx(found.measured.overshoot, abs=0.01)
    assert found.gain_ratio == pytest.approx(1.0, abs=0.03)


def test_the_strategies_differ_at_a_limit_of_the_command() -> None:
    left = {}
    for strategy in STRATEGIES:
        law = ToolboxPid(1.0, 2.0, 0.0, strategy, u_clamp_min=-1.0, u_clamp_max=1.0)
        for _ in range(100):
            law.step(2.0, 0.01)
        left[strategy] = law.integral
    assert left["conditional_integration"] == 0.0
    assert left["none"] == left["legacy"] == pytest.approx(4.0)
    # p e + I - u = tracking i e, with e 2, u 1 and a tracking of p/i.
    assert left["back_calculation"] == pytest.approx(1.0, abs=0.2)


def test_a_feedforward_is_a_weight_of_the_setpoint() -> None:
    rate = LawRate(laws.LAWS["control_toolbox_legacy"], 0.01)
    found = in_another_node(controller_of({"p": 0.5, "i": 1.0}), rate, 0.2)
    assert found.elsewhere and found.gains == Controller(0.5, 0.5, b=1.4)
    for setpoint, measured in ((2.0, 1.0), (-1.0, 0.3)):
        law = found.law.running()
        wanted = 0.5 * (setpoint - measured) + 1.0 * 0.01 * (setpoint - measured) + 0.2 * setpoint
        assert law.step(setpoint, measured) == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("name", "within", "there", "found"),
    [
        ("", None, ["/controller_manager"], "/controller_manager"),
        ("", "/b", ["/a/cm", "/b/cm"], "/b/cm"),
        ("", "", ["/cm", "/b/cm"], "/cm"),
        ("a/cm", None, ["/a/cm", "/b/cm"], "/a/cm"),
        ("a/cm", "/b", ["/a/cm", "/b/cm"], "no controller_manager /a/cm within 0 s"),
        ("", "/c", ["/a/cm", "/b/cm"], "no controller_manager in /c within 0 s"),
        ("", None, ["/a/cm", "/b/cm"], "/a/cm, /b/cm; type .* such as --controller /a/NAME"),
    ],
)
def test_the_manager_is_the_only_one_that_may_be_meant(name, within, there, found) -> None:
    client = SimpleNamespace(owners=lambda _: there, wait=lambda condition, _: condition())
    if not found.startswith("/") or ";" in found:
        with pytest.raises(LoopError, match=found):
            ControllerManager(client, name, within, 0.0)
        return
    manager = ControllerManager(client, name, within, 0.0)
    assert (manager.name, manager.namespace) == (found, found.rpartition("/")[0])
    # A second robot may be discovered after the first.
    there.append("/late/cm")
    with pytest.raises(LoopError, match="late") if not name and within is None else nullcontext():
        manager.require_alone()


class Switching:
    """Stands for the manager of a base, which switches as it is told."""

    def __init__(self) -> None:
        self.active = {"pid"}

    def controllers(self, patience=0.0):
        return tuple(
            replace(c, state="active" if c.name in self.active else "off") for c in LOADED
        )

    def switch(self, on, off, patience=0.0):
        self.active = self.active - set(off) | set(on)

    def command_for(self, activate, deactivate):
        return f"type {' '.join(activate)}"

    def still_active(self, name):
        return lambda: "" if name in self.active else f"{name} is off"


class Chained(Switching):
    """A chain whose states a broadcaster reads; no controller is left that one still reads."""

    states = ManagedController(
        "states", "joint_state_broadcaster/JointStateBroadcaster", "active", 100.0, (), (),
        ("left/velocity", "pid/left/velocity"),
    )  # fmt: skip

    def __init__(self) -> None:
        self.active = {"pid", "base", "states"}

    def controllers(self, patience=0.0):
        return (*super().controllers(), self.states)

    def switch(self, on, off, patience=0.0):
        if "pid" in off and "states" not in off:
            raise LoopError("Unable to deactivate controller with name 'pid'")
        super().switch(on, off)


def test_what_reads_the_states_of_a_chain_is_started_again_as_it_is_opened() -> None:
    manager: Any = Chained()
    with opened(manager, "one", ("pid", "base"), lambda: None):
        assert manager.active == {"one", "states"}
    assert manager.active == {"pid", "base", "states"}
    # A controller without others above it is switched off whoever reads its states.
    manager.active = {"pid", "states"}
    assert broadcasting(manager.controllers(), ("pid",)) == ()


@pytest.mark.parametrize("is_open", [True, False])
def test_controllers_are_off_until_the_relay_ends_and_no_longer(is_open: bool) -> None:
    manager, given = Switching(), []
    publishing = nullcontext(lambda: given.append("command"))
    tune = SimpleNamespace(
        _loop=SimpleNamespace(controller="pid"), _manager=manager, _former=("pid",),
        _forward=next(c for c in LOADED if c.name == "one") if is_open else None,
        _first_command=lambda: ("rest", "/one/commands"),
        _robot=SimpleNamespace(publishing=lambda *_: publishing),
        _give_references_back=lambda: given.append("references"),
        _put_back=lambda: given.append("references") or "the reference is back",
        nodes=SimpleNamespace(why_lost=lambda _: ""),
    )  # fmt: skip
    with JointLoop.opened(tune) as why_over:
        assert why_over(Tune.Feedback.STATE_RELAY) == ""
        assert manager.active == ({"one"} if is_open else {"pid"})
        # The model is still to be computed.
        assert why_over(Tune.Feedback.STATE_COMPLETED) == ""
        assert manager.active == {"pid"}
        assert why_over(Tune.Feedback.STATE_COMPLETED) == ""
    assert given == ["command", "references"] * is_open
    # relay_node is lost, and the reference is where the relay had it.
    given.clear()
    told = "has ended$" if is_open else "has ended; the reference is back$"
    with pytest.raises(LoopError, match=told), JointLoop.opened(tune):
        raise LoopError("relay_node has ended")
    assert given == (["command", "references"] if is_open else ["references"])
    assert manager.active == {"pid"}


def test_a_joint_whose_controller_is_off_is_told_with_what_to_type() -> None:
    class Silent(Switching):
        def controllers(self, patience=0.0):
            raise LoopError("it has not answered")

    manager, silent = Switching(), Silent()
    tune = SimpleNamespace(
        _loop=SimpleNamespace(
            joint="left", controller="pid", commanded="effort", why_not_moved=""
        ),
        _manager=manager,
    )
    tune.activation = lambda: JointLoop.activation(tune)
    assert JointLoop.left(tune) == "pid is active, the reference of left is that of before"
    assert tune.activation() == ""
    manager.switch([], ["pid"])
    assert JointLoop.left(tune) == "pid is not active: left has the last effort that it got"
    assert tune.activation() == "type pid"
    tune._manager = silent
    assert JointLoop.left(tune).startswith("it has not answered: left has the last effort")


def test_a_manager_that_is_gone_is_not_waited_for_beyond_the_time_of_the_way_back() -> None:
    asked = []

    class Gone(Switching):
        client = SimpleNamespace(rest=lambda _: None)

        def controllers(self, patience=0.0):
            asked.append(patience)
            # As if all of it had passed.
            now[0] += patience
            raise LoopError("no answer")

    now = [0.0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(controller_manager, "time", SimpleNamespace(monotonic=lambda: now[0]))
        with pytest.raises(LoopError, match=r"pid could not be .* \(no answer\).* type: type pid"):
            close(Gone(), "one", ("pid",))
    assert sum(asked) <= controller_manager._BACK_WITHIN


class Arm:
    """Stands for the client and the manager of an arm under a trajectory controller."""

    name, namespace = "/controller_manager", ""

    def __init__(self, **parameters):
        self._values = {
            "joints": ["arm_1", "arm_2"], "command_joints": [], "command_interfaces": ["effort"],
            "use_sim_time": False, "gains.arm_2.p": 5.0, "gains.arm_2.i": 1.0,
            "gains.arm_2.d": 0.5, "gains.arm_2.antiwindup_strategy": "none",
            "gains.arm_2.ff_velocity_scale": 0.7,
        } | parameters  # fmt: skip

    def controllers(self):
        return (controller("arm", TRAJECTORY_CONTROLLER, "arm_1/effort", "arm_2/effort"),)

    def command_interfaces(self):
        return tuple(f"arm_{k}/{kind}" for k in (1, 2) for kind in ("effort", "velocity"))

    def node_of(self, name):
        return f"/{name}"

    def values(self, node, names):
        if lacking := [name for name in names if name not in self._values]:
            raise LoopError(f"{node} does not have the parameters {', '.join(lacking)}")
        return {name: self._values[name] for name in names}

    def call(self, kind, service, request):
        names = [name for name in self._values if name.startswith(request.prefixes[0])]
        return SimpleNamespace(result=SimpleNamespace(names=names))

    def heard(self, kind, topic, enough, **_):
        def points(**values):
            return SimpleNamespace(**values)

        message = SimpleNamespace(
            joint_names=["arm_2", "arm_1"],
            reference=points(positions=[0.2, 0.1]),
            feedback=points(positions=[0.25, 0.15]),
            output=points(effort=[3.0, 1.0], velocities=[]),
        )
        return [message] * 5

    def latched(self, kind, topic, wanted, patience):
        assert topic == "/robot_description" and patience > 0.0
        return SimpleNamespace(data=DESCRIPTION.replace("free", "arm_2"))


@pytest.fixture(autouse=True)
def _messages_need_not_be_installed(monkeypatch):
    for module in (controller_manager, joint_loop_module):
        monkeypatch.setattr(module, "interface_class", lambda *_: object)


def test_a_trajectory_controller_tells_joints_gains_state_and_law() -> None:
    arm = Arm()
    loop = joint_loop(arm, arm, "arm", "arm_2")
    assert loop.joints == loop.dofs == ("arm_1", "arm_2")
    assert (loop.interface, loop.measured, loop.period) == ("arm_2/effort", "position", 0.01)
    assert loop.places == {name: f"gains.arm_2.{name}" for name in "pid"}
    assert (loop.gains, loop.feedforward) == ((5.0, 1.0, 0.5), 0.7)
    assert (loop.law, loop.wraps) == ("control_toolbox_none_velocity", True)
    # By the names of the message, whatever their order.
    assert loop.state == DofState(0.2, pytest.approx(0.25), pytest.approx(3.0))
    assert loop.why_not_moved == "its references are trajectories"


def test_with_back_calculation_its_time_goes_with_the_gains() -> None:
    # A pid_controller that runs would keep the one that it computed from the gains before.
    arm = Arm(**{"gains.arm_2.antiwindup_strategy": "back_calculation"})
    places = joint_loop(arm, arm, "arm", "arm_2").places
    assert places["tracking"] == "gains.arm_2.tracking_time_constant"
    gains = Controller(2.0, 0.9, 0.4)
    given = {name: getattr(gains, name) for name in places}
    assert set(mapping_of(",".join(map(":".join, places.items())))) == set(given)
    law = ToolboxPid(gains.p, gains.i, gains.d, "back_calculation")
    assert given["tracking"] == pytest.approx(law.tracking())
    assert Controller(2.0, 0.9).tracking == 0.9
    assert Controller(2.0, 0.0, 0.4).tracking == 0.0


def test_the_trajectory_to_type_holds_numbers_also_where_a_joint_is_almost_at_zero() -> None:
    arm = Arm()
    tune = SimpleNamespace(
        _loop=joint_loop(arm, arm, "arm", "arm_2"),
        options=SimpleNamespace(within=(-1.0, 2.0)),
        _position_of=lambda _: 5e-5,
    )
    *words, text = shlex.split(JointLoop._short_trajectory(tune, 0.3))
    assert words[-1] == "trajectory_msgs/msg/JointTrajectory"
    (point,) = yaml.safe_load(text)["points"]
    assert point["positions"] == [5e-5, 0.15005]


def test_an_opened_joint_without_limits_of_the_command_is_tuned_without_them() -> None:
    arm = Arm()
    loop = joint_loop(arm, arm, "arm", "arm_2")
    options = SimpleNamespace(
        open=True, amplitude=0.5, record_only=True, measurement=None, field="data", wait=0.0,
        within=(-1.0, 2.0), command_within=None, measurement_timeout=5.0, at=0.0,
    )  # fmt: skip
    tune = SimpleNamespace(
        _loop=loop, options=options, answers=Answers(options), _manager=arm, _held=[math.nan],
        _robot=SimpleNamespace(kind_of=lambda *_, **__: ""), space="/tune",
        form=Loop.form,
        _forward=SimpleNamespace(name="forward", needs=(loop.interface,)),
    )  # fmt: skip
    tune._opened_ends = lambda: JointLoop._opened_ends(tune)
    tune.parameters = tune.answers.parameters
    words = JointLoop.arguments(tune)["relay_node"]
    assert {"measurement_min:=-1.0", "measurement_timeout:=5.0"} < set(words)
    assert not any(word.startswith("command_m") and "inf" in word for word in words)


def test_a_joint_that_is_commanded_by_another_name_or_tells_no_output() -> None:
    arm = Arm(command_joints=["pid/a", "pid/b"], command_interfaces=["velocity"])
    arm.command_interfaces = lambda: ("pid/b/velocity",)
    loop = joint_loop(arm, arm, "arm", "arm_2")
    assert (loop.interface, loop.dof) == ("pid/b/velocity", "arm_2")
    assert np.isnan(loop.state.output)
    # Fewer are commanded than measured.
    assert joint_loop(Arm(command_joints=["arm_2"]), Arm(), "arm", "arm_2").joints == ("arm_2",)


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        ({"command_interfaces": ["position"]}, "/arm commands position, where its gains do nothi"),
        ({"command_interfaces": ["position", "effort"]}, "commands position, effort, where"),
        (
            {"command_interfaces": ["velocity"], "open_loop_control": True},
            "commands velocity in open loop, where",
        ),
        ({"joints": ["arm_1", "arm_3"]}, "arm has no joint arm_2: expected one of arm_1, arm_3"),
    ],
)
def test_a_trajectory_controller_without_gains_in_use_is_refused(parameters, told) -> None:
    with pytest.raises(LoopError, match=told):
        joint_loop(Arm(**parameters), Arm(), "arm", "arm_2")


@pytest.mark.parametrize(
    ("off", "takes", "told"),
    [
        (True, True, "pid is off; pid is not active: left has the last effort that it got; "
         "type: type pid; then publish the reference 1 on /pid/reference"),
        (False, True, "lost; pid is active, the reference of left is that of before"),
        (False, False, "lost; pid is active, and the reference may still be moved"),
    ],
)  # fmt: skip
def test_a_proof_that_is_lost_tells_how_its_joint_is_left(monkeypatch, off, takes, told):
    """Without a command of the controller, its controller_node waits for one in vain."""
    manager, did = Switching(), []
    loop = SimpleNamespace(
        controller="pid", node="/pid", places={"p": "p"}, why_not_moved="", clamps=(-1.0, 1.0),
        feedforward=0.0, state=SimpleNamespace(reference=1.0), joint="left", commanded="effort",
        reference_topic="/pid/reference",
    )  # fmt: skip
    tune = SimpleNamespace(
        _loop=loop, _manager=manager, _at_controller=lambda: ({}, {}), space="/tune",
        client=SimpleNamespace(),
        _start_controller=lambda: JointLoop._start_controller(tune),
        options=SimpleNamespace(keep_gains=False, yes=True, namespace="tune"),
        _put_back=lambda: JointLoop._put_back(tune), left=lambda: JointLoop.left(tune),
        activation=lambda: JointLoop.activation(tune),
        _give_references_back=lambda: did.append("reference") or takes,
        nodes=SimpleNamespace(
            start=lambda name, _: did.append(name), end=did.append, why_lost=lambda: ""
        ),
    )  # fmt: skip

    def proof(*_, **__):
        assert tune.client.why_lost() == ""
        manager.switch([], ["pid"] if off else [])
        raise GoneError(tune.client.why_lost() or "lost")

    monkeypatch.setattr(joint_tune, "apply_at", proof)
    with pytest.raises(GoneError) as lost:
        JointLoop.apply(tune, "")
    assert str(lost.value) == told
    assert did == ["controller_node", "controller_node"] + ["reference"] * (not off)


@pytest.mark.parametrize("export", ["gains.yaml", None])
def test_gains_that_only_run_are_told_with_what_keeps_them(monkeypatch, capsys, export) -> None:
    loop = SimpleNamespace(
        controller="pid", node="/pid", why_not_moved="",
        places={"p": "gains.left.p", "i": "gains.left.i"},
    )  # fmt: skip
    tune = SimpleNamespace(
        _loop=loop, _start_controller=lambda: None, space="/tune", client=SimpleNamespace(),
        _manager=SimpleNamespace(still_active=lambda _: lambda: ""),
        _robot=SimpleNamespace(values=lambda _, names: dict(zip(names, (1.25, 0.5), strict=True))),
        options=SimpleNamespace(keep_gains=False, yes=True, export=export),
        nodes=SimpleNamespace(why_lost=lambda: ""),
    )  # fmt: skip
    monkeypatch.setattr(joint_tune, "apply_at", lambda *_, **__: (True, ""))
    assert JointLoop.apply(tune, "") == (True, "")
    told = " ".join(capsys.readouterr().out.split())
    kept = "parameter file again: put there gains.left.p 1.25, gains.left.i 0.5"
    assert (kept in told) == (export is None)
    monkeypatch.setattr(joint_tune, "apply_at", lambda *_, **__: (False, "it runs away"))
    assert JointLoop.apply(tune, "") == (False, "it runs away")
    assert "after a restart" not in capsys.readouterr().out


def test_doubtful_gains_are_not_applied_unasked_and_that_is_no_failure(capsys) -> None:
    """The exit status is then that of doubtful gains, and not that of none."""
    tune = SimpleNamespace(options=SimpleNamespace(keep_gains=False, yes=True))
    assert JointLoop.apply(tune, "few cycles") == (None, "")
    assert "so that --yes does not apply them: few cycles" in capsys.readouterr().err


def test_a_controller_that_was_deactivated_is_told_as_such() -> None:
    """Its manager, or somebody who has typed it, may have done that."""
    listed = SimpleNamespace(result=lambda: SimpleNamespace(controller=[]), done=lambda: True)
    manager = ControllerManager.__new__(ControllerManager)
    manager.name, manager._kinds = "/cm", {"ListControllers": SimpleNamespace(Request=str)}
    manager.client = SimpleNamespace(begin=lambda *_: listed)
    look = manager.still_active("pid")
    assert look() == ""
    assert look() == "pid is not loaded: it was deactivated, and the log of /cm says when"


def test_clipping_names_no_parameter_that_the_user_of_a_joint_never_gave() -> None:
    """The levels are references there, and their limits are --within."""
    values = dict.fromkeys(("before", "now", "swing_before", "swing", "low", "high"), 1.0)
    remedy = next(check.remedy for check in CHECKS if check.name == "clipped")
    for told in (str(Code.CLIPPED(**values)), remedy):
        assert "limits" in told and "command_m" not in told
