# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The topics of a bag, over all of its files, and the names of numbers in them.

A number is named by `TOPIC[:FIELD]`, such as `/imu:linear_acceleration.x`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.bag.arrays import FloatArray, IntArray
from relay_autotune.bag.bag_file import BagFile
from relay_autotune.bag.cdr import Decoder, Path
from relay_autotune.bag.definitions import Channel, message_type
from relay_autotune.bag.field_path import (
    UNITS,
    Number,
    Struct,
    Type,
    first_numbers,
    some_numbers,
    steps_of,
    unit_of_field,
)
from relay_autotune.bag.limits import MOST_DEFINITIONS, MOST_EXPECTED
from relay_autotune.bag.mcap_records import Messages
from relay_autotune.bag.signals import Signal, SignalReader
from relay_autotune.errors import BagError, FieldError, SelectionError

# Called with the progress of reading: bytes done, bytes in all.
Progress = Callable[[int, int], None]


@dataclass
class Columns:
    """Times and values of one topic in the order of the file.

    :param order: position among all messages that were read, shape (n,).
    :param log_time: when each was recorded [ns], shape (n,).
    :param publish_time: when each was sent [ns]; 0: unknown; shape (n,).
    :param values: shape (n,).
    """

    order: IntArray
    log_time: IntArray
    publish_time: IntArray
    values: FloatArray


# Topics that a message lists: a robot's bag has some hundred.
_MOST_LISTED = 1000


@dataclass
class Topics:
    """The open files of one bag, read as one recording.

    :param path: the bag, as it was given.
    :param files: its files in the order in which they were written.
    :param clock: which time of a message counts, one of ``CLOCKS``.
    :param progress: called with the progress of reading the files.
    """

    path: FilePath
    files: Sequence[BagFile]
    clock: str = "publish"
    progress: Progress | None = None
    _signals: dict[str, Signal] = field(default_factory=dict)
    _types: dict[tuple[str, str, str, bytes], Struct] = field(default_factory=dict)
    _by_topic: dict[str, list[tuple[int, Channel]]] = field(default_factory=dict)
    _defined: int = 0

    @property
    def notes(self) -> list[str]:
        """Faults found in the files so far."""
        return [note for file in self.files for note in file.notes]

    def types(self) -> dict[str, str]:
        """Return the type of each topic."""
        return {channel.topic: channel.type or "unknown type" for _, channel in self._channels()}

    def listing(self, looks: Mapping[str, str] | None = None) -> str:
        """Return the topics with their types for a message.

        :param looks: what else to say of some of them.
        """
        said = {
            c.topic: "" if c.encoding == "cdr" else f", encoded as {c.encoding!r}"
            for _, c in self._channels()
        }
        said |= {topic: f", {look}" for topic, look in (looks or {}).items()}
        described = (f"{name} ({kind}{said[name]})" for name, kind in sorted(self.types().items()))
        first = ", ".join(islice(described, _MOST_LISTED))
        more = len(self.types()) - _MOST_LISTED
        return first + (f" and {more} more" if more > 0 else "") or "no topic"

    def metadata(self, name: str) -> list[dict[str, str]]:
        """Return the metadata records of a name."""
        return [about for file in self.files for key, about in file.metadata if key == name]

    def field_of(self, topic: str, wanted: str) -> str:
        """Return ``TOPIC[:FIELD]`` of a number, without the field where it is the only one.

        :raises SelectionError: if the topic holds no such number.
        """
        alone = True
        for _, channel in self._channels(topic):
            root = self._type(channel)
            path = named_field(root, wanted, topic)
            only = only_field(root)
            alone &= only is not None and named_field(root, only, topic) == path
        return topic if alone else f"{topic}:{wanted}"

    def definition_of(self, topic: str) -> bytes:
        """Return the definition of a topic's messages; of several, all."""
        return b"\n".join(channel.definition for _, channel in self._channels(topic))

    def root_of(self, topic: str) -> Struct:
        """Return the type of a topic's messages, the first one's.

        :raises BagError: if its definition makes no sense.
        """
        return self._type(self._channels(topic)[0][1])

    def first_messages(self, topic: str, count: int) -> list[Any]:
        """Return the first messages of a topic, decoded, those that fit its first type.

        :param topic: its name.
        :param count: how many at most.
        """
        root, found = self.root_of(topic), []
        key, channel = self._channels(topic)[0]
        for _, _, messages in self._messages({(key, channel.id): None}):
            for payload in messages.payloads():
                with suppress(BagError):
                    found.append(Decoder(root).decoded(payload))
                if len(found) == count:
                    return found
        return found

    def unit(self, name: str) -> str:
        """Return the unit that the type of a signal's messages says; empty: it says none.

        :param name: ``TOPIC`` or ``TOPIC:FIELD``.
        """
        topic, field = split_name(name)
        return unit_of_field(self.types()[topic], field or only_field(self.root_of(topic)) or "")

    def single_numbers(self) -> list[str]:
        """Return the topics whose messages are about one number."""
        found: dict[str, bool] = {}
        for _, channel in self._channels():
            try:
                alone = may_be_single(channel) and only_field(self._type(channel)) is not None
            except BagError:
                alone = False
            found[channel.topic] = alone and found.get(channel.topic, True)
        return [topic for topic, alone in found.items() if alone]

    def columns(self, names: Iterable[str], type_name: str) -> dict[str, Columns]:
        """Return the values of topics in the order of the files, with one count for all.

        :param names: the topics; those without a channel of the type are left out.
        :param type_name: the type that their messages must have, one of a single number.
        """
        wanted = {
            (number, channel.id): (name, named_field(self._type(channel), "", name))
            for name in set(names)
            for number, channel in self._channels(name)
            if channel.type == type_name
        }
        parts: dict[str, list[tuple[NDArray[Any], ...]]] = {}
        for key, before, messages in self._messages(wanted):
            name, path = wanted[key]
            values, good = _values(path, messages, name)
            order = (messages.order + before)[good]
            times = (messages.log_time[good], messages.publish_time[good])
            parts.setdefault(name, []).append((order, *times, values[good].astype(np.float64)))
        return {
            name: Columns(*(np.concatenate(column) for column in zip(*found, strict=True)))
            for name, found in parts.items()
        }

    def decoded(self, type_name: str) -> list[Any]:
        """Return all messages of a type, in the order in which they were recorded.

        :param type_name: such as ``std_msgs/msg/Float64``.
        :return: objects with the fields as attributes, as the definition in the bag has them.
        :raises BagError: if the definition or a message makes no sense.
        """
        wanted = {
            (number, channel.id): channel
            for number, channel in self._channels()
            if channel.type == type_name
        }
        found: list[tuple[int, Any]] = []
        for key, _, messages in self._messages(wanted):
            channel = wanted[key]
            decoder = Decoder(self._type(channel), f" of {channel.topic}")
            decoded = map(decoder.decoded, messages.payloads())
            found += zip(messages.log_time.tolist(), decoded, strict=True)
        return [message for _, message in sorted(found, key=lambda item: item[0])]

    def signals(self, names: Iterable[str] | None = None) -> dict[str, Signal]:
        """Return the values of topics.

        :param names: the topics, each with a field where its type has several numbers; default:
            all topics whose messages are about one number.
        :raises SelectionError: if there is no such number.
        :raises BagError: if no message of a topic fits its definition.
        """
        chosen = self.single_numbers() if names is None else list(names)
        unread = [name for name in dict.fromkeys(chosen) if name not in self._signals]
        if unread:
            self._signals.update(self._read(unread))
        return {name: self._signals[name] for name in chosen}

    def _read(self, names: Sequence[str]) -> dict[str, Signal]:
        readers = self._readers(names)
        again = [name for name, reader in readers.items() if not reader.in_order]
        if again:
            # The recorder's times are needed only where these are not in order.
            readers |= self._readers(again, both=True)
        return {name: readers[name].signal() for name in names}

    def _readers(self, names: Sequence[str], *, both: bool = False) -> dict[str, SignalReader]:
        wanted: dict[tuple[int, int], list[tuple[SignalReader, Path, Any]]] = {}
        readers: dict[str, SignalReader] = {}
        for name in names:
            topic, wanted_field = split_name(name)
            channels = self._channels(topic)
            stamps = {key: stamp_of(self._type(channel)) for key, channel in channels}
            # A topic without a header, as a command often is, has no such time.
            headless = self.clock == "header" and None in stamps.values()
            clock = "publish" if headless else self.clock
            reader = SignalReader(name, clock, both=both, expected=self._expected(name))
            if headless:
                reader.notes.append(
                    f"the messages of {topic} have no header; the times at which they were "
                    "published are used instead"
                )
            readers[name] = reader
            for key, channel in channels:
                path = named_field(self._type(channel), wanted_field, topic)
                stamp = stamps[key] if clock == "header" else None
                wanted.setdefault((key, channel.id), []).append((reader, path, stamp))
        for place, _, messages in self._messages(wanted):
            for reader, path, stamp in wanted[place]:
                values, good = _values(path, messages, reader.name)
                if not reader.why_unfit:
                    reader.why_unfit = _why_unfit(path, messages, good)
                times = messages.log_time if reader.clock == "log" else messages.publish_time
                if stamp is not None:
                    times, dated = _stamps(stamp, messages)
                    good = good & dated
                reader.take(values, good, times, messages.log_time)
        return readers

    def _messages(
        self, wanted: Mapping[tuple[int, int], Any]
    ) -> Iterator[tuple[tuple[int, int], int, Messages]]:
        """Yield the messages of channels, each named by the number of its file and its own."""
        before, done = 0, 0
        total = sum(file.size for file in self.files)
        for number, file in enumerate(self.files):
            channels = [channel for n, channel in wanted if n == number]
            last = before
            if channels:
                for channel, position, messages in file.read(channels):
                    last = max(last, before + position + int(messages.order.max()) + 1)
                    yield (number, channel), before + position, messages
                    if self.progress is not None:
                        self.progress(done + min(position, file.size), total)
            before, done = last, done + file.size

    def _expected(self, name: str) -> int:
        """Return how many messages of a topic the files say they have, within reason."""
        counts = [
            min(self.files[number].message_counts.get(channel.id, 0), self.files[number].size)
            for number, channel in self._channels(split_name(name)[0])
        ]
        return min(sum(counts), MOST_EXPECTED)

    def _channels(self, topic: str | None = None) -> list[tuple[int, Channel]]:
        """Return the channels of a topic, or of all, each after the number of its file."""
        if not self._by_topic:
            for number, file in enumerate(self.files):
                for channel in file.channels.values():
                    self._by_topic.setdefault(channel.topic, []).append((number, channel))
        if topic is not None:
            return self._by_topic.get(topic, [])
        return [each for own in self._by_topic.values() for each in own]

    def _type(self, channel: Channel) -> Struct:
        key = (channel.type, channel.encoding, channel.schema_encoding, channel.definition)
        if key not in self._types:
            self._defined += len(channel.definition)
            if self._defined > MOST_DEFINITIONS:
                raise BagError(
                    f"the definitions of types in {self.path} have more than {MOST_DEFINITIONS} "
                    f"bytes together; name the topics with --measurement and --command"
                )
            self._types[key] = message_type(channel)
        return self._types[key]


def _values(
    path: Path, messages: Messages, name: str = ""
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    try:
        return path.read(messages.content, messages.begin, messages.end)
    except FieldError as error:
        raise SelectionError(f"{split_name(name)[0]}: {error}") from None


def _why_unfit(path: Path, messages: Messages, good: NDArray[np.bool_]) -> str:
    """Return why the first message without the number has none, "" where it cannot be said."""
    if bool(good.all()):
        return ""
    return path.why(messages.payload(int(np.argmin(good))))


def _stamps(stamp: tuple[Path, Path], messages: Messages) -> tuple[IntArray, NDArray[np.bool_]]:
    """Return the time stamps of messages [ns], and which messages have one."""
    (seconds, good), (rest, also) = (_values(path, messages) for path in stamp)
    times = seconds.astype(np.int64) * 1_000_000_000 + rest.astype(np.int64)
    # No clock was set to a time before 1970.
    return np.maximum(times, 0), good & also


_FIELDS_OF_SINGLE = 2


def split_name(wanted: str) -> tuple[str, str]:
    """Return topic and field of ``TOPIC[:FIELD]``; the field is empty where there is none."""
    topic, _, field = wanted.partition(":")
    return topic, field


def named_field(root: Struct, field: str, topic: str) -> Path:
    """Return the number that a field's name means.

    :param root: type of the topic's messages.
    :param field: a path, see `relay_autotune.bag.field_path`; empty: the only number.
    :param topic: for the error.
    :raises SelectionError: if there is no such number, or no name was given and there are several.
    """
    if not field:
        only = only_field(root)
        if only is None and not first_numbers(root, 1):
            raise SelectionError(f"{topic} is of type {root.name}, which holds no numbers")
        if only is None:
            raise SelectionError(
                f"{topic} is of type {root.name}, which holds several numbers; name one, as in "
                f"{topic}:{first_numbers(root, 1)[0]}; it has {some_numbers(root)}"
            )
        field = only
    try:
        return Path(root, steps_of(root, field, topic))
    except FieldError as error:
        raise SelectionError(str(error)) from None


def only_field(root: Struct) -> str | None:
    """Return the number that a message is about; None if it may be any of several."""
    units = UNITS.get(root.name, {})
    meant = [name for name, kind in root.fields if name in units and isinstance(kind, Number)]
    found = meant or first_numbers(root, 2)
    return found[0] if len(found) == 1 and "[" not in found[0] else None


def may_be_single(channel: Channel) -> bool:
    """Return whether a topic's messages may be about one number, by a look at the definition.

    A robot's bag holds hundreds of types; to parse all of them takes seconds.
    """
    if channel.type in UNITS or channel.schema_encoding != "ros2msg":
        return True
    own = channel.definition.split(b"\n===", 1)[0]
    lines = (line.split(b"#", 1)[0].strip() for line in own.splitlines())
    # A header, and the field; a line with a value is that of a constant.
    return sum(bool(line) and b"=" not in line for line in lines) <= _FIELDS_OF_SINGLE


def stamp_of(root: Struct) -> tuple[Path, Path] | None:
    """Return seconds and nanoseconds of a message's own time stamp; None if it has none."""
    for steps in (("header", "stamp"), ("stamp",)):
        kind: Type | None = root
        for step in steps:
            kind = dict(kind.fields).get(step) if isinstance(kind, Struct) else None
        if isinstance(kind, Struct) and {"sec", "nanosec"} <= dict(kind.fields).keys():
            return Path(root, (*steps, "sec")), Path(root, (*steps, "nanosec"))
    return None
