# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The records of an MCAP file: reading each without trusting what it declares.

Layout: https://mcap.dev/spec. Every length is checked against what is there before it is used.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import IntArray
from relay_autotune.bag.limits import MOST_DECLARATIONS
from relay_autotune.text import visible

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
MESSAGE_INDEX, CHUNK_INDEX, STATISTICS = 0x07, 0x08, 0x0B
METADATA, DATA_END = 0x0C, 0x0F

RECORD = struct.Struct("<BQ")
# Channel, sequence, log time and publish time, before the message itself.
MESSAGE_HEAD_SIZE = 22
FOOTER_SIZE = 20


class DamageError(Exception):
    """Bytes that are no MCAP records."""


def unsigned(data: bytes, at: int, form: str) -> int:
    """Return the number at a place of a record."""
    if at + struct.calcsize(form) > len(data):
        raise DamageError("a record is cut")
    return int(struct.unpack_from(form, data, at)[0])


def sized_bytes(data: bytes, at: int) -> tuple[bytes, int]:
    """Return the bytes after their length, and the place after them."""
    length = unsigned(data, at, "<I")
    if length > len(data) - at - 4:
        raise DamageError("a text is longer than its record")
    return data[at + 4 : at + 4 + length], at + 4 + length


def text(data: bytes, at: int) -> tuple[str, int]:
    """Return the text after its length, made visible, and the place after it."""
    raw, at = sized_bytes(data, at)
    try:
        return visible(raw.decode("utf-8")), at
    except UnicodeDecodeError:
        raise DamageError("a name is not UTF-8") from None


def map_of_text(data: bytes, at: int) -> tuple[dict[str, str], int]:
    """Return the texts by their names, and the place after them."""
    body, after = sized_bytes(data, at)
    found: dict[str, str] = {}
    at = 0
    while at < len(body):
        key, at = text(body, at)
        found[key], at = text(body, at)
    return found, after


@dataclass(frozen=True)
class Channel:
    """A topic as the file declares it.

    :param id: number that its messages carry.
    :param topic: name.
    :param type: message type, the name of the schema; empty: unknown.
    :param encoding: of the messages, such as ``cdr``.
    :param schema_encoding: such as ``ros2msg``.
    :param definition: text of the schema.
    :param metadata: what the recorder noted, such as QoS.
    """

    id: int
    topic: str
    type: str
    encoding: str
    schema_encoding: str
    definition: bytes
    metadata: dict[str, str]


_DECLARING = (SCHEMA, CHANNEL, METADATA, STATISTICS)


class Declarations:
    """What the records of a file declare: its channels, metadata and number of messages.

    What is declared twice is expected to be the same; if it is not, the first one counts, and
    `contradictions` says so.
    """

    def __init__(self) -> None:
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.message_counts: dict[int, int] | None = None
        self.contradictions: list[str] = []
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._channels: dict[int, tuple[str, int, str, dict[str, str]]] = {}
        self._taken: set[tuple[int, bytes]] = set()

    @property
    def channels(self) -> dict[int, Channel]:
        """The channels by their ids, each with its type, wherever that is declared."""
        return {
            number: Channel(number, topic, name, encoding, schema_encoding, definition, metadata)
            for number, (topic, schema, encoding, metadata) in self._channels.items()
            for name, schema_encoding, definition in [self._schemas.get(schema, ("", "", b""))]
        }

    @property
    def have_all_types(self) -> bool:
        """True if the type of each channel is declared; 0 stands for a channel without a type."""
        return all(
            schema in self._schemas or schema == 0 for _, schema, *_ in self._channels.values()
        )

    def take_all(self, content: bytes | memoryview, offsets: IntArray) -> None:
        """Take in those of the records inside of a chunk that declare channels.

        :param content: the records.
        :param offsets: where each begins, shape (n,).
        :raises DamageError: if one contradicts itself, or there are too many; the others are
            taken in.
        """
        opcodes = np.ndarray((len(content),), "u1", content)[offsets]
        damage: DamageError | None = None
        for at in offsets[(opcodes == SCHEMA) | (opcodes == CHANNEL)].tolist():
            opcode, length = RECORD.unpack_from(content, at)
            begin = at + RECORD.size
            try:
                self.take(opcode, bytes(content[begin : begin + length]))
            except DamageError as error:
                damage = damage or error
        if damage is not None:
            raise damage

    def take(self, opcode: int, body: bytes) -> None:
        """Take in a record, if it declares anything.

        :raises DamageError: if it contradicts itself, or there are too many.
        """
        if opcode not in _DECLARING:
            return
        if (opcode, body) in self._taken:
            return
        if len(self._taken) >= MOST_DECLARATIONS:
            raise DamageError(f"more than {MOST_DECLARATIONS} schemas, channels and metadata")
        self._taken.add((opcode, body))
        if opcode == SCHEMA:
            number = unsigned(body, 0, "<H")
            name, at = text(body, 2)
            encoding, at = text(body, at)
            definition, _ = sized_bytes(body, at)
            schema = (name, encoding, definition)
            if self._schemas.setdefault(number, schema) != schema:
                self.contradictions.append(f"two different types have the number {number}")
        elif opcode == CHANNEL:
            number, schema_number = unsigned(body, 0, "<H"), unsigned(body, 2, "<H")
            topic, at = text(body, 4)
            encoding, at = text(body, at)
            metadata, _ = map_of_text(body, at)
            first = self._channels.setdefault(number, (topic, schema_number, encoding, metadata))
            if first[:3] != (topic, schema_number, encoding):
                self.contradictions.append(
                    f"channel {number} is declared as {first[0]} and, differently, as {topic}"
                )
        elif opcode == METADATA:
            name, at = text(body, 0)
            self.metadata.append((name, map_of_text(body, at)[0]))
        elif self.message_counts is None:
            counts, _ = sized_bytes(body, 42)
            if len(counts) % 10:
                raise DamageError("statistics of impossible length")
            self.message_counts = dict(struct.iter_unpack("<HQ", counts))
