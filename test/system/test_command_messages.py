# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A relay on one joint of a group, over DDS: what the others are told, and commands repeated."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from faulty_loop import RELIABLE, SAFE, Loop
from loop_rig import Rig
from ros_domain import free_domain
from std_msgs.msg import Float64MultiArray

from relay_autotune.reasons import Code


@pytest.fixture
def loop(tmp_path: Path) -> Iterator[Loop]:
    with free_domain() as domain:
        rig = Rig(domain, tmp_path)
        try:
            yield Loop(rig, "group")
        finally:
            rig.close()


def test_the_others_hold_what_they_were_told_and_commands_are_repeated(loop: Loop) -> None:
    rig = loop.rig
    others = rig.node.create_publisher(Float64MultiArray, "other_commands", RELIABLE)
    loop.start()
    loop.set(measurement_timeout=1.2)
    rig.until(lambda: "not known" in rig.ask_for_tune().reason, "a refusal", 20.0)
    assert "no message has come on other_commands" in rig.ask_for_tune().reason
    assert not loop.messages
    others.publish(Float64MultiArray(data=[9.0, 0.0, 3.0]))
    loop.tune()
    loop.until_it_oscillates(4)
    assert {(m.data[0], m.data[2]) for m in loop.messages} == {(9.0, 3.0)}
    # The others may move while the relay works.
    others.publish(Float64MultiArray(data=[8.0, 0.0, 4.0]))
    rig.until(lambda: loop.messages[-1].data[0] == 8.0, "the others' new commands")
    assert loop.messages[-1].data[2] == 4.0
    # A silent sensor is answered with nothing, but the actuator must not time out.
    loop.alter = lambda _: None
    rig.run_for(0.1)
    count, last = len(loop.commands), loop.commands[-1]
    rig.until(lambda: len(loop.commands) > count + 5, "repeated commands")
    assert set(loop.commands[count : count + 5]) == {last}
    loop.check_the_end(Code.SILENT_SENSOR)
    # ... nor after the tune.
    count = len(loop.messages)
    rig.until(lambda: len(loop.messages) > count + 5, "the safe command, again and again")
    assert {tuple(m.data) for m in loop.messages[count:]} == {(8.0, SAFE, 4.0)}
    # Others that lack the joint are a fault of their own.
    loop.tune()
    loop.until_it_oscillates(4)
    others.publish(Float64MultiArray(data=[1.0]))
    loop.check_the_end(Code.OTHERS_UNKNOWN)
    assert "not known" in rig.ask_for_tune().reason
