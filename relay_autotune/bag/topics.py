"""The topics of a bag, over all of its files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from relay_autotune.bag.decode import FLOAT64, decode_float64, decode_messages
from relay_autotune.bag.mcap_file import Channel, McapFile, Messages
from relay_autotune.bag.signals import Signal


@dataclass(frozen=True)
class TimedSignal:
    """The values of a topic, and what is to be known of its clock.

    :param signal: the values by the time at which they were published, or, where that is not
        known, recorded.
    :param lag_ns: smallest time from publishing to recording [ns]: the delay of the transport
        and the difference of the two clocks.
    :param note: a sentence if the publish times cannot be used; empty otherwise.
    """

    signal: Signal
    lag_ns: int
    note: str = ""


@dataclass
class Topics:
    """The open files of one bag, read as one recording.

    :param path: the bag, as it was given.
    :param files: its files in the order in which they were written.
    """

    path: Path
    files: Sequence[McapFile]
    _signals: dict[str, TimedSignal] = field(default_factory=dict)

    @property
    def notes(self) -> list[str]:
        """What was found amiss in the files so far."""
        return [note for file in self.files for note in file.notes]

    def types(self) -> dict[str, str]:
        """Return the type of each topic."""
        return {
            channel.topic: channel.type or "unknown type"
            for file in self.files
            for channel in file.channels.values()
        }

    def listing(self, looks: Mapping[str, str] | None = None) -> str:
        """Return the topics with their types for a message.

        :param looks: what else to say of some of them.
        """
        known = looks or {}
        described = (
            f"{topic} ({kind}, {known[topic]})" if topic in known else f"{topic} ({kind})"
            for topic, kind in sorted(self.types().items())
        )
        return ", ".join(described) or "no topic"

    def metadata(self, name: str) -> list[dict[str, str]]:
        """Return the metadata records of a name."""
        return [about for file in self.files for key, about in file.metadata if key == name]

    def messages(self, names: Iterable[str], type_name: str) -> dict[str, Messages]:
        """Return the messages of topics in the order of the files, with one count for all.

        :param names: the topics; those without a channel of the type are left out.
        :param type_name: the type that their messages must have.
        """
        wanted = set(names)
        parts: dict[str, list[Messages]] = {}
        count = 0
        for file in self.files:
            channels = [
                c for c in file.channels.values() if c.topic in wanted and c.type == type_name
            ]
            found = file.read([channel.id for channel in channels]) if channels else {}
            for channel in channels:
                part = found[channel.id]
                part.order += count
                parts.setdefault(channel.topic, []).append(part)
            count += sum(map(len, found.values()))
        return {topic: _joined(found) for topic, found in parts.items()}

    def decoded(self, type_name: str) -> list[Any]:
        """Return all messages of one of our types, in the order in which they were recorded."""
        found: list[tuple[int, Any]] = []
        for file in self.files:
            channels: list[Channel] = [c for c in file.channels.values() if c.type == type_name]
            messages = file.read([channel.id for channel in channels]) if channels else {}
            for channel in channels:
                part = messages[channel.id]
                found += zip(
                    part.log_time.tolist(), decode_messages(channel, part.payload), strict=True
                )
        return [message for _, message in sorted(found, key=lambda item: item[0])]

    def signals(self, names: Iterable[str] | None = None) -> dict[str, TimedSignal]:
        """Return the values of topics of std_msgs/Float64.

        :param names: the topics; default: all of that type.
        """
        chosen = (
            [name for name, kind in self.types().items() if kind == FLOAT64]
            if names is None
            else list(names)
        )
        unread = [name for name in chosen if name not in self._signals]
        if unread:
            for name, messages in self.messages(unread, FLOAT64).items():
                self._signals[name] = _timed(name, messages)
        return {name: self._signals[name] for name in chosen}


def _joined(parts: Sequence[Messages]) -> Messages:
    if len(parts) == 1:
        return parts[0]
    order = np.concatenate([part.order for part in parts])
    payload = [data for part in parts for data in part.payload]
    by_order = np.argsort(order)
    return Messages(
        order[by_order],
        np.concatenate([part.log_time for part in parts])[by_order],
        np.concatenate([part.publish_time for part in parts])[by_order],
        [payload[i] for i in by_order],
    )


def _timed(name: str, messages: Messages) -> TimedSignal:
    by_log = np.argsort(messages.log_time, kind="stable")
    log_time, publish_time = messages.log_time[by_log], messages.publish_time[by_log]
    values = decode_float64(messages.payload)[by_log]
    if bool(np.any(publish_time == 0)):
        return TimedSignal(Signal(name, log_time, values), 0)
    if bool(np.any(np.diff(publish_time) < 0)):
        note = f"the publish times of {name} go backwards; its log times are used instead"
        return TimedSignal(Signal(name, log_time, values), 0, note)
    lag = int(np.min(log_time - publish_time)) if len(messages) else 0
    return TimedSignal(Signal(name, publish_time, values), lag)
