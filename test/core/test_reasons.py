# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The table of reasons: codes, sentences, and their way through messages."""

import re
from types import SimpleNamespace

import pytest

from relay_autotune.errors import NotReadyError, RecordError
from relay_autotune.exchange.messages import fill_reason, reason_from_message
from relay_autotune.reasons import NONE, Code, Reason, joined, may_pass, other, reason_of
from tools.attribute_docs import attribute_docs

MEANINGS = attribute_docs(Code)
WORDS = re.compile(r"{(\w+)(?::([^}]*))?}")


def values_of(code: Code, *, optional: bool) -> dict[str, float | int | str]:
    """Return a value of the kind that the sentence of a code wants, for each of its names."""
    text = code.row.found + code.row.remedy + code.row.typed
    if not optional:
        text = re.sub(r"\[.*?\]", "", text)
    found: dict[str, float | int | str] = {}
    for name, how in WORDS.findall(text):
        found[name] = 3 if how.startswith("#") else 1.25 if how else "a word"
    return found


def message() -> SimpleNamespace:
    return SimpleNamespace(code=0, names=[], values=[])


@pytest.mark.parametrize("code", [c for c in Code if c is not Code.NONE], ids=lambda c: c.name)
def test_every_reason_has_a_sentence_without_holes(code):
    for optional in (False, True):
        said = str(code(**values_of(code, optional=optional)))
        assert said and not re.search(r"[{}\[\]]|  | ,|;$", said), said
    assert code.row.typed == "" or code.name in MEANINGS


def test_a_reason_without_a_value_that_its_sentence_needs_is_a_defect():
    with pytest.raises(TypeError, match="SILENT_SENSOR needs silence"):
        Code.SILENT_SENSOR(topic="/level")


def test_a_part_of_a_sentence_is_left_out_where_its_values_are():
    still = Code.NO_RESPONSE(level=3.0, baseline=2.0, time=9.0, still=40.0)
    moved = Code.NO_RESPONSE(level=3.0, baseline=2.0, time=9.0, band=0.1, rest=40.0)
    assert "the measurement stayed at 40;" in str(still)
    assert "the measurement stayed within 0.1 of its rest 40;" in str(moved)


def test_notes_follow_the_reason_and_its_place():
    ended = Code.REQUESTED().plus(Code.NOTE_LOST(samples=1), ended_at=3.0, where="while settling")
    assert str(ended) == "aborted on request (at 3 s, while settling); 1 sample lost on the way"
    assert ended.code is Code.REQUESTED and ended["ended_at"] == 3.0
    assert joined([NONE, ended, Code.CANCELLED()]).notes[-1].code is Code.CANCELLED
    assert not NONE and not joined([]) and ended


def test_an_error_carries_a_reason_or_a_sentence():
    assert reason_of(NotReadyError(Code.NO_CLOCK())).code is Code.NO_CLOCK
    assert str(NotReadyError(Code.NO_CLOCK())) == str(Code.NO_CLOCK())
    assert reason_of(RecordError("no sample")) == other("no sample")


def test_a_sentence_alone_tells_whether_it_may_pass():
    wrapped = f"the gains of x are not in force: {Code.GAINS_AT_WORK()}; try later"
    assert may_pass(wrapped)
    few = str(Code.FEW_SAMPLES(samples=1, needed=50))
    assert may_pass(few) and few == "only 1 of 50 samples have come with a command"
    assert not may_pass(str(Code.NOT_AUTOMATIC())) and not may_pass("")


@pytest.mark.parametrize("code", Code, ids=lambda c: c.name)
def test_a_reason_goes_through_a_message_and_back(code):
    reason = code(**values_of(code, optional=True))
    sent = message()
    fill_reason(sent, reason)
    found = reason_from_message(sent, str(reason))
    assert (found.code, found.values, str(found)) == (code, reason.values, str(reason))


def test_a_recording_of_before_has_a_sentence_alone():
    assert reason_from_message(message(), "it ended") == other("it ended")
    assert reason_from_message(message()) == NONE


@pytest.mark.parametrize("number", [65535, Code.SILENT_SENSOR])
def test_a_foreign_reason_has_a_sentence_whatever_it_holds(number):
    sent = SimpleNamespace(code=number, names=["a\x1b[2J", "b"], values=["1\n2"])
    found = reason_from_message(sent)
    assert isinstance(found, Reason) and str(found).isprintable()
    assert found.code is (Code.OTHER if number == 65535 else Code.SILENT_SENSOR)
    assert found["a\\x1b[2J"] == "1\\n2"
