# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a node logs of the progress that it tells its clients."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

from relay_autotune.nodes import goals
from relay_autotune.nodes.goals import Narrator


def test_a_log_has_a_sentence_of_which_only_numbers_change_every_ten_seconds(
    monkeypatch: Any,
) -> None:
    node, told, now = Mock(), [], 0.0
    monkeypatch.setattr(goals, "time", SimpleNamespace(monotonic=lambda: now))
    words = ""
    narrator = Narrator(node, lambda: words, told.append)
    for k in range(31):
        now = 0.8 * k
        words = f"computing the model, {now:.1f} s: {'comparing' if k < 20 else 'judging'}"
        narrator.now()
    logged = [call.args[0] for call in node.get_logger().info.call_args_list]
    assert logged == [told[k] for k in (0, 13, 20)]
    assert len(told) == 31
    words = ""
    narrator.now()
    words = told[-1]
    narrator.now()
    assert node.get_logger().info.call_count == 4
