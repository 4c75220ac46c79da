# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which gains are in force: what always holds, and the cases that came up."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from relay_autotune.control.gains_history import (
    GainSet,
    GainsHistory,
    HistoryError,
    Standing,
    Work,
)
from relay_autotune.errors import TuningError


def gains(kc: float, ti: float = 1.0) -> GainSet:
    return GainSet.of({"kc": kc, "ti": ti})


G, A, B = gains(0.3), gains(0.5), gains(0.9)


def applied(history: GainsHistory, wanted: GainSet) -> GainsHistory:
    return history.apply(wanted).settled()


def test_before_any_apply_there_is_nothing_to_go_back_to():
    for given in (None, G):
        with pytest.raises(HistoryError, match="no gains before"):
            GainsHistory.begun(given).revert()


def test_after_two_changes_by_hand_the_whole_set_before_them_comes_back():
    history = GainsHistory.begun(gains(0.3, 20.0)).edit(gains(0.5, 20.0)).edit(gains(0.5, 8.0))
    assert history.gains == gains(0.5, 8.0)
    assert history.revert().gains == gains(0.3, 20.0)


def test_what_was_set_by_hand_and_left_is_whole():
    history = applied(GainsHistory.begun(G).edit(A), B)
    assert history.revert().gains == A
    # Further changes by hand do not lose it.
    assert history.revert().edit(gains(7.0)).revert().gains == A


def test_the_first_gains_ever_do_not_stay_after_a_fail():
    history = applied(GainsHistory.begun(None), A).verify().fail()
    assert history.gains is None
    with pytest.raises(HistoryError, match="failed their verification"):
        history.apply(A)
    with pytest.raises(HistoryError, match="failed their verification"):
        history.edit(A)
    with pytest.raises(HistoryError, match="no gains before"):
        history.revert()


def test_failed_gains_do_not_come_back_by_the_digits_that_are_shown():
    """Each number that is set by hand makes a whole set, and the last one completes those."""
    failed = gains(0.53612837, 12.345678)
    told, other = gains(0.5361, 12.35), gains(0.5361, 20.0)
    history = applied(applied(GainsHistory.begun(G), told), failed).verify().fail()
    assert history.gains == G
    history = history.edit(other)
    for event in (history.edit, history.apply, history.verify):
        with pytest.raises(HistoryError, match="failed their verification"):
            event(told)
    assert not history.is_open_to(told) and history.is_open_to(gains(0.54, 12.35))
    assert history.after_restart(told).gains == G


def test_a_second_fail_does_not_bring_the_first_failed_set_back():
    history = applied(GainsHistory.begun(G), A).verify().fail()
    assert history.gains == G
    history = history.verify().fail()
    assert history.gains is None
    history = applied(applied(GainsHistory.begun(G), A).verify().passed(), B).verify().fail()
    assert history.gains == A
    assert history.verify().fail().gains == G


def test_a_restart_begins_with_what_was_proven():
    proven = applied(GainsHistory.begun(G), A).verify().passed()
    tried = applied(proven, B)
    for state in (proven, proven.apply(B), tried, tried.verify(), tried.edit(gains(3.0))):
        assert state.after_restart(G).gains == A
    # What is set anew in the configuration counts more.
    assert proven.after_restart(gains(0.1)).gains == gains(0.1)
    assert proven.after_restart(gains(0.1)).revert().gains == A
    assert proven.after_restart(None).gains is None
    failed = proven.verify().fail()
    assert failed.after_restart(G).gains == G
    assert failed.after_restart(A).gains == G


def test_gains_whose_verification_was_cut_short_come_by_hand_alone():
    history = applied(GainsHistory.begun(None), A).verify().after_restart(None)
    assert history.gains is None
    assert not history.is_open_to(A)
    assert history.is_open_to(B)
    assert applied(history, A).verify().passed().is_open_to(A)


def test_where_the_gains_outlive_the_process_an_apply_that_was_finished_stays():
    begun = GainsHistory().observe(G)
    assert applied(begun, A).cut_short().gains == A
    assert begun.apply(A).cut_short().gains == G
    assert applied(begun, A).verify().cut_short().gains == G


def test_a_proof_that_is_cut_short_leaves_what_was_in_force_before_it():
    begun = GainsHistory.begun(G)
    for on_trial in (begun.verify(A), applied(begun, A).verify(), begun.edit(A).verify()):
        history = on_trial.cut_short()
        assert (history.gains, history.work) == (G, Work.NOTHING)
        assert not history.is_open_to(A)
    assert begun.verify(A).passed().verify().cut_short().gains == A
    assert GainsHistory.begun(None).verify(A).cut_short().gains is None
    # Found in another node later, they are not trusted either.
    found = begun.verify(A).cut_short().observe(A)
    assert not found.in_force.is_trusted


def test_gains_beyond_the_present_limits_do_not_come_back():
    history = applied(applied(GainsHistory.begun(G), B), A).verify().passed()
    within = history.within(lambda gains: gains.by_name()["kc"] < 0.4, present=True)
    assert within.after_restart(G).gains == G
    assert history.within(lambda gains: gains != B).revert().gains == G
    # Where none is left, those of the configuration are.
    assert replace(within, before=()).after_restart(G).gains == G


def test_many_sets_do_not_push_out_the_last_that_can_be_trusted():
    history = GainsHistory.begun(G)
    for k in range(100):
        history = applied(history, gains(1.0 + k))
    assert len(history.before) <= 20
    assert history.revert().gains == gains(99.0)
    assert history.after_restart(G).gains == G


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_gains_are_numbers(value):
    with pytest.raises(TuningError, match="expected a finite number"):
        gains(value)


def test_a_mixture_is_told_from_gains_of_another_hand():
    one, other = gains(1.0, 2.0), gains(3.0, 4.0)
    assert gains(1.0, 4.0).is_mixture(one, other)
    assert not gains(1.0, 5.0).is_mixture(one, other)
    assert gains(1.0 + 1e-12, 2.0).is_near(one)
    assert not gains(1.001, 2.0).is_near(one)


SETS = st.builds(gains, st.sampled_from([0.1, 0.2, 0.3]), st.sampled_from([1.0, 2.0]))


class Controllers(RuleBasedStateMachine):
    """Any events in any order, beside plain sets of what has happened."""

    def __init__(self) -> None:
        super().__init__()
        self.given: GainSet | None = gains(0.1)
        self.history = GainsHistory.begun(self.given)
        self.failed: set[GainSet] = set()
        self.trusted: set[GainSet] = {gains(0.1)}
        # Sets that nobody was in the midst of changing by hand.
        self.whole: set[GainSet] = {gains(0.1)}
        self.by_hand = False

    def leave(self) -> None:
        """Leave what was set by hand as it is."""
        if self.history.gains is not None:
            self.whole.add(self.history.gains)
        self.by_hand = False

    def attempt(self, event: str, wanted: GainSet | None) -> bool:
        try:
            state = getattr(self.history, event)(wanted)
        except HistoryError:
            assert self.history.work is not Work.NOTHING or wanted in self.failed
            return False
        if event in ("apply", "verify"):
            self.leave()
        self.history = state
        assert self.history.gains == wanted
        return True

    @rule(wanted=SETS)
    def apply(self, wanted: GainSet) -> None:
        if self.attempt("apply", wanted):
            self.whole.add(wanted)

    @precondition(lambda self: self.history.work is Work.APPLY)
    @rule()
    def applied(self) -> None:
        self.history = self.history.settled()

    @rule(wanted=SETS)
    def put_on_trial(self, wanted: GainSet) -> None:
        if self.attempt("verify", wanted):
            self.whole.add(wanted)

    @rule(wanted=st.none() | SETS)
    def edit(self, wanted: GainSet | None) -> None:
        self.attempt("edit", wanted)

    @rule()
    def revert(self) -> None:
        left = self.history.gains
        try:
            self.history = self.history.revert()
        except HistoryError:
            return
        assert self.history.gains != left
        assert self.history.gains in self.whole - self.failed

    @precondition(lambda self: self.history.work is Work.NOTHING and self.history.gains)
    @rule()
    def verify(self) -> None:
        self.leave()
        self.history = self.history.verify()

    @precondition(lambda self: self.history.work is Work.VERIFY)
    @rule(passed=st.none() | st.booleans())
    def judge(self, passed: bool | None) -> None:
        tried = self.history.gains
        assert tried is not None
        if passed is None:
            before = self.history
            self.history = self.history.cut_short()
            assert self.history.gains == tried or not before.in_force.is_trusted
            assert self.history.gains in {None, *self.whole} - self.failed
            assert self.history.gains != tried or tried in self.trusted
        elif passed:
            self.history = self.history.passed()
            self.trusted.add(tried)
        else:
            self.history = self.history.fail()
            self.failed.add(tried)
            assert self.history.gains in {None, *self.whole} - self.failed

    @rule(given=st.none() | SETS, changed=st.booleans())
    def restart(self, given: GainSet | None, changed: bool) -> None:
        if not changed:
            given = self.given
        elif given is not None:
            self.trusted.add(given)
            self.whole.add(given)
        self.given = given
        self.history = self.history.after_restart(given)
        assert self.history.gains in {None, *self.trusted} - self.failed
        assert self.history.work is Work.NOTHING

    @invariant()
    def nothing_that_failed_is_in_force(self) -> None:
        assert self.history.gains not in self.failed
        assert not {entry.gains for entry in self.history.before} & self.failed
        assert {entry.gains for entry in self.history.before} <= self.whole
        assert Standing.EDITED not in {entry.standing for entry in self.history.before}


TestControllers = Controllers.TestCase
TestControllers.settings = settings(max_examples=50, stateful_step_count=40, deadline=None)


@pytest.mark.nightly
class TestManyControllers(Controllers.TestCase):
    settings = settings(max_examples=500, stateful_step_count=40, deadline=None)
