# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The gains in force in controller_node after any event, in a loop stepped by the test."""

from __future__ import annotations

import json
import math
import signal

import pytest
from hand_loop import COMMAND, SETPOINT, HandLoop
from loop_rig import RELIABLE, Rig
from made_experiments import experiment_of
from std_msgs.msg import Float64

from relay_autotune.process.transfer_function import TransferFunction as Process
from relay_autotune.reasons import Code
from relay_autotune_msgs.action import Verify

GOOD, WILD = (0.5, 0.6), (0.9, 0.3)


def test_revert_leads_to_the_last_whole_set_or_is_refused(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0)
    for service in ("revert", "before"):
        refused = loop.trigger(service)
        assert not refused.success
        assert "no gains before these" in refused.message
    assert loop.gains_shown() == (0.3, 1.0)
    assert loop.set(kc=0.7).successful
    assert loop.set(ti=3.0).successful
    assert loop.trigger("before").message == "kc 0.3, ti 1 s, td 0 s"
    assert loop.trigger("revert").success
    assert loop.node.log.count("kc 0.3, ti 1 s, td 0 s in force again") == 1
    assert loop.gains_shown() == (0.3, 1.0)
    assert "~/revert brings back those before" in loop.apply(*GOOD, "one").message
    assert loop.trigger("revert").success
    assert loop.gains_shown() == (0.3, 1.0)
    assert not loop.trigger("revert").success


def test_failed_gains_stay_nowhere_and_never_come_back(rig: Rig) -> None:
    """Their model has a third of the gain of the process."""
    loop = HandLoop(rig)
    assert loop.gains_shown()[0] == 0.0
    assert "revert" not in loop.apply(*WILD, "wild", gain=0.7).message
    result = loop.verify(setpoint_step=0.3)
    assert result.verdict == result.FAILED
    # The first gains ever: there are no earlier ones.
    assert "the command is held" in result.reason
    assert loop.gains_shown()[0] == 0.0
    assert loop.answer_to(SETPOINT) == loop.answer_to(SETPOINT + 0.4)
    again = loop.trigger("apply")
    assert not again.success
    by_hand = loop.set(kc=WILD[0], ti=WILD[1])
    assert not by_hand.successful
    assert "failed their verification" in by_hand.reason
    # Nor do they come one by one, rounded.
    assert loop.set(ti=WILD[1]).successful
    assert "failed their verification" in loop.set(kc=0.9001).reason
    # The latched topic offers them to each node that starts.
    loop.node.signal(signal.SIGTERM)
    assert loop.node.wait() == 0
    loop.start(auto_apply=True)
    rig.until(lambda: "gains of wild refused: these gains failed" in loop.node.log, "the gains")
    assert loop.gains_shown()[0] == 0.0
    # Other gains are accepted; their failure does not restore the first failed set.
    loop.offer(0.8, 0.3, "second", gain=0.7)
    rig.until(lambda: loop.gains_shown() == (0.8, 0.3), "auto_apply")
    assert loop.verify(setpoint_step=0.3).verdict == Verify.Result.FAILED
    assert loop.gains_shown()[0] == 0.0
    assert not loop.trigger("revert").success


def test_a_kc_of_the_wrong_sign_is_not_taken_without_a_word(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0)
    assert loop.set(kc=-0.2).successful
    said = "of the other sign than the gains in force: the loop may run away"
    assert loop.node.log.count(said) == 1
    # Setting it right is no cause for a warning.
    loop.offer(*GOOD, "good")
    assert loop.set(kc=0.2).successful
    refused = loop.set(kc=-0.2)
    assert "of the other sign than the process by its model" in refused.reason
    assert loop.gains_shown() == (0.2, 1.0)
    # Without integral action it is stable.
    assert loop.set(kc=-0.2, ti=0.0).successful
    assert loop.node.log.count("kc is -0.2, of the other sign") == 2


@pytest.mark.parametrize("moment", ["applied", "verifying"])
def test_after_a_kill_the_proven_gains_are_in_force(rig: Rig, moment: str) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0)
    loop.apply(*GOOD, "good")
    result = loop.verify(setpoint_step=0.3)
    assert result.verdict == result.PASSED, result.reason
    loop.apply(*WILD, "wild")

    def kill() -> None:
        loop.node.signal(signal.SIGKILL)
        loop.node.wait()
        raise InterruptedError

    if moment == "verifying":
        with pytest.raises(InterruptedError):
            loop.verify(kill, setpoint_step=0.3)
    else:
        loop.node.signal(signal.SIGKILL)
        loop.node.wait()
    # The gains of the interrupted trial are not taken from the latched topic either.
    loop.start(auto_apply=moment == "verifying")
    rig.until(lambda: "gains of wild wait" in loop.node.log, "the latched gains")
    assert loop.gains_shown() == GOOD
    assert "starts with kc 0.5" in loop.node.log, loop.node.log
    # A changed configuration takes precedence.
    loop.node.signal(signal.SIGTERM)
    loop.node.wait()
    loop.start(kc=0.2, auto_apply=False)
    assert loop.gains_shown() == (0.2, 1.0)


def test_a_journal_that_cannot_be_read_or_written(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0)
    journal = rig.records / "gains.controller_node"
    name = next(rig.records.glob("gains.controller_node*.json"))
    assert name.name.startswith(journal.name)
    second = rig.start("controller_node", **loop.parameters)
    assert second.wait() == 2
    assert "another process has" in second.log
    loop.node.signal(signal.SIGTERM)
    loop.node.wait()
    assert json.loads(name.read_text())["in_force"]["standing"] == "given"
    name.write_text("torn")
    third = rig.start("controller_node", **loop.parameters)
    assert third.wait() == 2
    assert "is not a journal of gains" in third.log
    name.unlink()
    name.with_suffix(".lock").unlink()
    rig.records.rmdir()
    rig.records.write_text("no folder")
    loop.start()
    assert "cannot be kept in" in loop.node.log
    loop.offer(*GOOD, "good")
    applied = loop.trigger("apply")
    assert not applied.success
    assert "cannot be kept in" in applied.message
    assert loop.gains_shown() == (0.3, 1.0)


@pytest.mark.parametrize("limits", [(0.0, 5.0), (-math.inf, math.inf)])
def test_one_wild_sample_is_forgotten(rig: Rig, limits: tuple[float, float]) -> None:
    low, high = limits
    wild = [1.7e308, -1.7e308, 1e20, 1e13]
    if math.isfinite(low):
        wild += [65535.0, -65535.0]
    loop = HandLoop(rig, kc=0.3, ti=0.6, command_min=low, command_max=high)
    loop.step(40)
    for value in wild:
        command = loop.answer_to(value)
        assert low <= command <= high
        assert math.isfinite(command)
        loop.step(120)
        assert loop.command == pytest.approx(1.0, abs=0.02), value


def test_a_range_of_the_measurement_holds_the_command(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=0.6, measurement_min=0.0, measurement_max=10.0)
    loop.step(40)
    assert loop.answer_to(65535.0) == loop.command
    assert loop.answer_to(-1.0) == loop.command
    assert "outside of its range" in loop.node.log
    setpoints = rig.node.create_publisher(Float64, "setpoint", RELIABLE)
    rig.until(lambda: setpoints.get_subscription_count() > 0, "the controller")
    setpoints.publish(Float64(data=1e300))
    rig.until(lambda: "the set-point 1e+300 is outside" in loop.node.log, "the refusal")
    loop.step(40)
    assert loop.command == pytest.approx(1.0, abs=0.02)


def test_gains_out_of_bounds_are_left_alone(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0, kc_max=2.0, ti_min=0.1, auto_apply=True)
    for kc, ti in ((-1e300, 1.0), (0.5, 0.01), (math.nan, 1.0), (0.5, math.inf)):
        name = f"{kc:g}_{ti:g}"
        loop.publish(kc, ti, name)
        rig.until(lambda name=name: f"gains of {name} refused" in loop.node.log, name)
    loop.offer(*GOOD, "good")
    rig.until(lambda: loop.gains_shown() == GOOD, "those within the bounds")
    # No other gains were in force in between.
    assert loop.trigger("revert").success
    assert loop.gains_shown() == (0.3, 1.0)
    assert not loop.set(kc=-2.5).successful


def test_verify_is_bounded_and_ends_without_a_verdict_where_time_is_wrong(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0)
    loop.apply(*GOOD, "good")
    assert "verify_step_max allows 1" in loop.verify(setpoint_step=1e6).reason
    assert "verify_step_max allows 1" in loop.verify(setpoint_step=-1.01).reason
    for later, reason in (
        (0.0, "the time of the samples stands still"),
        (-3600.0, "time went backwards, by 3.6e+03 s"),
        (1e6, "time went on by 1e+06 s"),
    ):
        result = loop.verify(lambda later=later: loop.step(later=later), setpoint_step=0.3)
        assert result.verdict == result.NONE
        assert reason in result.reason
        # Unproven gains go back, and wait to be tried again.
        assert "kc 0.3, ti 1 s, td 0 s in force again" in result.reason
        assert loop.gains_shown() == (0.3, 1.0)
        assert loop.trigger("apply").success
    # Before the step as well.
    result = loop.verify(setpoint_step=0.3)
    assert result.verdict == result.PASSED, result.reason


def test_a_set_point_of_the_operator_is_no_failure_of_the_gains(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0)
    loop.apply(*GOOD, "good")
    setpoints = rig.node.create_publisher(Float64, "setpoint", RELIABLE)
    rig.until(lambda: setpoints.get_subscription_count() > 0, "the controller")

    def same() -> None:
        setpoints.publish(Float64(data=SETPOINT))
        loop.step()

    # A set-point equal to the present one changes nothing.
    assert loop.verify(same, setpoint_step=0.3).verdict == Verify.Result.PASSED

    def other() -> None:
        setpoints.publish(Float64(data=5.6))
        loop.step()

    result = loop.verify(other, setpoint_step=0.3)
    assert result.verdict == result.NONE
    assert "the set-point was changed to 5.6" in result.reason
    # They were proven before.
    assert loop.gains_shown() == GOOD
    loop.step(120)
    # It stays in force: a deviation of 0.6 needs 0.3 of command.
    assert loop.command == pytest.approx(1.3, abs=0.02)


def test_a_step_that_the_noise_hides_changes_nothing(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0, noise_std=0.01)
    loop.apply(*GOOD, "good")
    for step in (1e-9, 0.001):
        result = loop.verify(setpoint_step=step)
        assert result.verdict == result.NONE
        assert "y cannot be judged" in result.reason
        assert loop.gains_shown() == GOOD
    # It was not on trial, so that it did not fail.
    assert loop.verify(setpoint_step=0.3).verdict == Verify.Result.PASSED


def test_a_loop_that_rests_away_from_its_set_point_makes_no_step(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0, initial_setpoint=SETPOINT + 0.1, command_max=COMMAND)
    loop.offer(0.3, 1.0, "those in force")
    result = loop.verify(setpoint_step=0.3)
    assert result.why.code == Code.NOT_AT_REST, result.reason
    assert "at its set-point: the measurement is 0.1 away from it" in result.reason
    assert loop.set(command_max=5.0).successful
    assert loop.verify(setpoint_step=0.3).verdict == Verify.Result.PASSED


def test_gains_are_put_in_force_and_proven_in_one_go_or_not_at_all(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0, noise_std=0.002)
    loop.offer(*GOOD, "good")
    # The loop settles with them before the step.
    result = loop.verify(lambda: loop.set_automatic(False), setpoint_step=0.3, apply=True)
    assert "switched to manual; kc 0.3, ti 1 s, td 0 s in force again" in result.reason
    assert loop.gains_shown() == (0.3, 1.0)
    for _ in range(2):
        loop.set_automatic(True)
    assert loop.node.log.count("]: automatic\n") == loop.node.log.count("]: manual: ") == 1
    result = loop.verify(setpoint_step=1e-9, apply=True, patience=60.0)
    assert "y cannot be judged; kc 0.3" in result.reason
    assert loop.gains_shown() == (0.3, 1.0)
    result = loop.verify(setpoint_step=0.3, apply=True, patience=60.0)
    assert result.verdict == result.PASSED, result.reason
    assert loop.gains_shown() == GOOD
    # Who has reverted may think better of it, and none before are lost.
    assert loop.trigger("revert").success
    assert loop.gains_shown() == (0.3, 1.0)
    for _ in range(2):
        assert loop.trigger("apply").success
        assert loop.gains_shown() == GOOD
    assert (
        loop.verify(setpoint_step=0.3, apply=True, patience=60.0).verdict == Verify.Result.PASSED
    )
    assert loop.trigger("before").message == "kc 0.3, ti 1 s, td 0 s"
    assert loop.trigger("discard").success
    assert "no gains wait" in loop.verify(setpoint_step=0.3, apply=True).reason


def test_gains_that_were_taken_back_are_not_applied_without_being_asked(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0, auto_apply=True)
    loop.offer(*GOOD, "good")
    rig.until(lambda: loop.gains_shown() == GOOD, "auto_apply")
    assert loop.trigger("revert").success
    # A record or a model that comes late makes it look at them again.
    loop.experiments.publish(experiment_of(Process.fopdt(2.0, 0.5, 0.2), "another"))
    loop.step(20)
    assert loop.gains_shown() == (0.3, 1.0)
    assert loop.trigger("apply").success
    assert loop.gains_shown() == GOOD


def test_a_change_that_cannot_be_stored_is_refused(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0)
    loop.apply(*GOOD, "good")
    (journal,) = rig.records.glob("gains.controller_node*.json")
    # As good as a full disk: nothing can be written there.
    journal.with_suffix(".tmp").mkdir()
    by_hand, reverted = loop.set(kc=0.7), loop.trigger("revert")
    assert not by_hand.successful and "cannot be kept in" in by_hand.reason
    assert not reverted.success and "cannot be kept in" in reverted.message
    assert loop.gains_shown() == GOOD
    assert "cannot be kept in" in loop.verify(setpoint_step=0.3).reason
    journal.with_suffix(".tmp").rmdir()
    assert loop.trigger("revert").success


def test_gains_beyond_new_limits_do_not_come_back_after_a_restart(rig: Rig) -> None:
    loop = HandLoop(rig, kc=0.3, ti=1.0)
    loop.apply(*GOOD, "good")
    assert loop.verify(setpoint_step=0.3).verdict == Verify.Result.PASSED
    loop.node.signal(signal.SIGTERM)
    loop.node.wait()
    loop.start(kc_max=0.4)
    assert loop.gains_shown() == (0.3, 1.0)
    assert "expected at most 0.4" in loop.node.log
