# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Bags of valid framing that lie inside it: `python3 benchmarks/fuzz_framing.py [--count N]`.

A small recording is taken apart into its records, and one to three of them are changed: lengths
and counts within messages, schemas, names, times, what chunks and their indexes declare, what the
indexes list, the summary. Then it is put together again with correct lengths, sizes, checksums
and places, except for the lie. Each bag is read twice: as it is, and without indexes and
statistics, so that only its messages count. A find is an error or a warning that is not one of
ours; an answer that differs between the two without a message; a control character in a message;
more than 5 s, or more than 1 GB.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import lz4.frame
import numpy as np
import zstandard
from fuzz_bags import Trial, run
from made_recordings import seeds

from relay_autotune.bag.signals import Selection
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.recordings import Recording, read_experiments

T = TypeVar("T")

MAGIC = b"\x89MCAP0\r\n"
(
    HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX
) = range(1, 9)  # fmt: skip
STATISTICS, METADATA, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0C, 0x0E, 0x0F

# Numbers that stand for a length, an offset or a count.
_ODD = (0, 1, 7, 8, 9, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)

_HOSTILE = (
    "\x1b[31mred\x1b[0m", "a\nb", "\x07", "\x9b2J", "\u202egnp", "", "=1+1", "x" * 5000,
    "\x1b]0;title\x07", "/measurement", "/command", "../../etc/passwd", "<script>", "\x00",
)  # fmt: skip


def _doubling(depth: int) -> str:
    parts = ["x_msgs/T0 a\nx_msgs/T0 b\n"]
    for k in range(depth):
        inner = f"x_msgs/T{k + 1}" if k < depth - 1 else "string"
        parts.append(f"{'=' * 80}\nMSG: x_msgs/T{k}\n{inner} a\n{inner} b\n")
    return "".join(parts)


_SCHEMAS: tuple[tuple[str, str], ...] = (
    ("ros2msg", "float64 data\n"),
    ("ros2msg", "float32 data\n"),
    ("ros2msg", "string data\n"),
    ("ros2msg", "float64[] data\n"),
    ("ros2msg", "float64[4294967295] data\n"),
    ("ros2msg", "string[4000000000] names\nfloat64 data\n"),
    ("ros2msg", "wstring name\nfloat64 data\n"),
    ("ros2msg", "x_msgs/Self a\n" + "=" * 80 + "\nMSG: x_msgs/Self\nx_msgs/Self a\n"),
    ("ros2msg", _doubling(20)),
    ("ros2msg", _doubling(39)),
    ("ros2msg", "".join(f"float64 f{k}\n" for k in range(6000))),
    ("ros2msg", "".join(f"string f{k}\n" for k in range(4900)) + "float64 data\n"),
    ("ros2msg", "\x1b[31mfloat64 data\n"),
    ("ros2idl", "module a { struct S { double data; }; };"),
    ("ros2idl", "module a { " * 60 + "struct S { double data; };" + " }; " * 60),
    ("ros2idl", "struct S { " + "sequence<" * 60 + "double" + ">" * 60 + " data; };"),
    ("ros2idl", "struct S { " + "".join(f"double f{k};" for k in range(3000)) + " };"),
    ("ros2idl", "const long A = " + "(" * 80 + "1" + ")" * 80 + ";"),
    ("ros2idl", "@a(" * 50),
    ("protobuf", "syntax"),
    ("", ""),
)


@dataclass
class Message:
    """A message, or another record inside of a chunk."""

    opcode: int
    body: bytearray


@dataclass
class Chunk:
    """A chunk and what follows from it; what is not None is a lie.

    :param records: inside of it.
    :param compression: as declared.
    :param entries: changes what its message indexes list.
    :param head: changes its head.
    :param index: changes its index in the summary.
    :param has_indexes: whether message indexes follow it.
    """

    records: list[Message]
    compression: str
    entries: Callable[[dict[int, list[tuple[int, int]]]], None] | None = None
    head: Callable[[bytearray], None] | None = None
    index: Callable[[bytearray], None] | None = None
    has_indexes: bool = True


@dataclass
class Bag:
    """A recording taken apart.

    :param parts: records and chunks of the data section, in order.
    :param summary: schemas and channels that its end repeats.
    :param statistics: changes the counts.
    :param footer: changes the footer.
    :param has_summary: whether there is a summary.
    :param has_statistics: whether there are statistics in it.
    """

    parts: list[Message | Chunk]
    summary: list[Message] = field(default_factory=list)
    statistics: Callable[[bytearray], None] | None = None
    footer: Callable[[bytearray], None] | None = None
    has_summary: bool = True
    has_statistics: bool = True

    def chunks(self) -> list[Chunk]:
        """Return its chunks."""
        return [part for part in self.parts if isinstance(part, Chunk)]

    def records(self, opcode: int) -> list[Message]:
        """Return the records of an opcode among the data."""
        found: list[Message] = []
        for part in self.parts:
            found += part.records if isinstance(part, Chunk) else [part]
        return [record for record in found if record.opcode == opcode]


def _split(data: bytes) -> Iterator[Message]:
    at = 0
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield Message(opcode, bytearray(data[at + 9 : at + 9 + length]))
        at += 9 + length


def _text(value: str | bytes) -> bytes:
    raw = value if isinstance(value, bytes) else value.encode("utf-8", "surrogatepass")
    return struct.pack("<I", len(raw)) + raw


def _texts(body: bytes | bytearray, at: int, count: int) -> tuple[list[bytes], int]:
    found = []
    for _ in range(count):
        (size,) = struct.unpack_from("<I", body, at)
        found.append(bytes(body[at + 4 : at + 4 + size]))
        at += 4 + size
    return found, at


def taken_apart(data: bytes) -> Bag:
    """Return the records of a recording that is whole."""
    bag, at_end = Bag([]), False
    for record in _split(data[len(MAGIC) :]):
        body = bytes(record.body)
        if record.opcode in (DATA_END, FOOTER):
            at_end = True
        elif at_end:
            if record.opcode in (SCHEMA, CHANNEL):
                bag.summary.append(record)
        elif record.opcode == CHUNK:
            (compression, content), _ = _chunk_of(body)
            bag.parts.append(Chunk(list(_split(_expanded(compression, content))), compression))
        elif record.opcode != MESSAGE_INDEX:
            bag.parts.append(record)
    return bag


def _chunk_of(body: bytes) -> tuple[tuple[str, bytes], int]:
    (compression,), at = _texts(body, 28, 1)
    return (compression.decode(), body[at + 8 :]), at


def _expanded(compression: str, data: bytes) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=1 << 24)
    return bytes(lz4.frame.decompress(data)) if compression == "lz4" else data


def _compressed(compression: str, data: bytes) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdCompressor(level=1).compress(data)
    return bytes(lz4.frame.compress(data)) if compression == "lz4" else data


def _record(opcode: int, body: bytes | bytearray) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + bytes(body)


def put_together(bag: Bag, *, bare: bool = False) -> bytes:
    """Return the file.

    :param bag: its parts.
    :param bare: leave out all indexes and the summary; what that declares stands at the front.
    """
    declared = b"".join(_record(r.opcode, r.body) for r in bag.summary if bag.has_summary)
    out = bytearray(MAGIC + (declared if bare else b""))
    counts: dict[int, int] = {}
    indexes: list[bytes] = []
    for part in bag.parts:
        if isinstance(part, Message):
            _count(part, counts)
            out += _record(part.opcode, part.body)
            continue
        content, entries = bytearray(), dict[int, list[tuple[int, int]]]()
        for record in part.records:
            if record.opcode == MESSAGE and len(record.body) >= 22:
                channel, _, stamp = struct.unpack_from("<HIQ", record.body)
                entries.setdefault(channel, []).append((stamp, len(content)))
            _count(record, counts)
            content += _record(record.opcode, record.body)
        data = _compressed(part.compression, bytes(content))
        stamps = [stamp for listed in entries.values() for stamp, _ in listed] or [0]
        span = (min(stamps), max(stamps))
        body = bytearray(struct.pack("<QQQI", *span, len(content), zlib.crc32(content)))
        body += _text(part.compression) + struct.pack("<Q", len(data))
        if part.head is not None:
            part.head(body)
        begin = len(out)
        out += _record(CHUNK, body + data)
        end, places = len(out), b""
        if bare or not part.has_indexes:
            entries = {}
        elif part.entries is not None:
            part.entries(entries)
        for channel, listed in entries.items():
            places += struct.pack("<HQ", channel & 0xFFFF, len(out))
            flat = b"".join(struct.pack("<QQ", t % 2**64, o % 2**64) for t, o in listed)
            out += _record(MESSAGE_INDEX, struct.pack("<HI", channel & 0xFFFF, len(flat)) + flat)
        index = bytearray(struct.pack("<QQQQI", *span, begin, end - begin, len(places)))
        index += places + struct.pack("<Q", len(out) - end) + _text(part.compression)
        index += struct.pack("<QQ", len(data), len(content))
        if part.index is not None:
            part.index(index)
        indexes.append(_record(CHUNK_INDEX, index))
    out += _record(DATA_END, struct.pack("<I", 0))
    start = len(out)
    if bag.has_summary and not bare:
        out += declared
        if bag.has_statistics:
            listed = b"".join(struct.pack("<HQ", *item) for item in counts.items())
            about = struct.pack(
                "<QHIIIIQQI", sum(counts.values()), 1, len(counts), 0, 0, len(indexes), 0, 0,
                len(listed),
            )  # fmt: skip
            body = bytearray(about + listed)
            if bag.statistics is not None:
                bag.statistics(body)
            out += _record(STATISTICS, body)
        out += b"".join(indexes)
    else:
        start = 0
    footer = bytearray(struct.pack("<QQI", start, 0, 0))
    if bag.footer is not None and not bare:
        bag.footer(footer)
    return bytes(out + _record(FOOTER, footer) + MAGIC)


def _count(record: Message, counts: dict[int, int]) -> None:
    if record.opcode == MESSAGE and len(record.body) >= 22:
        (channel,) = struct.unpack_from("<H", record.body)
        counts[channel] = counts.get(channel, 0) + 1


# --- lies


def _any(rng: np.random.Generator, things: Sequence[T]) -> T | None:
    return things[int(rng.integers(len(things)))] if things else None


def _odd(rng: np.random.Generator) -> int:
    return _ODD[int(rng.integers(len(_ODD)))]


def lie_in_message(bag: Bag, rng: np.random.Generator) -> None:
    """Change lengths, kind, size, channel or times of some messages."""
    messages = bag.records(MESSAGE)
    for _ in range(int(rng.integers(1, 6))):
        message = _any(rng, messages)
        if message is None or len(message.body) < 30:
            return
        body, size = message.body, len(message.body)
        match int(rng.integers(8)):
            case 0:
                struct.pack_into("<I", body, int(rng.integers(22, size - 3)), _odd(rng) % 2**32)
            case 1:
                body[22:26] = bytes(rng.integers(0, 12, 4, dtype=np.uint8))
            case 2:
                del body[int(rng.integers(0, size)) :]
            case 3:
                body += bytes(int(rng.integers(1, 300)))
            case 4:
                struct.pack_into("<H", body, 0, int(rng.integers(0, 7)))
            case 5:
                struct.pack_into("<Q", body, 6 + 8 * int(rng.integers(2)), _odd(rng) % 2**64)
            case 6:
                value = float(rng.choice([np.nan, np.inf, 1e308, -1e300, 0.0]))
                struct.pack_into("<d", body, size - 8, value)
            case _:
                words = _HOSTILE[int(rng.integers(len(_HOSTILE)))].encode("utf-8")[:60]
                at = int(rng.integers(26, size))
                body[at : at + len(words)] = words


def lie_in_schema(bag: Bag, rng: np.random.Generator) -> None:
    """Give a type another definition, name or encoding, in the data, the summary or both."""
    where = [bag.records(SCHEMA), [r for r in bag.summary if r.opcode == SCHEMA]]
    chosen = _any(rng, where[0])
    if chosen is None:
        return
    (name, encoding, text), _ = _texts(chosen.body, 2, 3)
    match int(rng.integers(4)):
        case 0:
            name = _HOSTILE[int(rng.integers(len(_HOSTILE)))].encode()
        case 1:
            encoding = rng.choice([b"ros2idl", b"omgidl", b"jsonschema", b"\x1b[2J"])
        case 2:
            words = (b"float64", b"string", b"[99999999]", b"[]", b"\xff\xfe", b"MSG: x/Y\n")
            at = int(rng.integers(0, len(text) + 1))
            text = text[:at] + words[int(rng.integers(len(words)))] + text[at + 7 :]
        case _:
            kind, definition = _SCHEMAS[int(rng.integers(len(_SCHEMAS)))]
            encoding, text = kind.encode(), definition.encode()
    body = bytes(chosen.body[:2]) + _text(name) + _text(bytes(encoding)) + _text(text)
    number, old = bytes(chosen.body[:2]), bytes(chosen.body)
    for place in where if rng.integers(3) else [where[int(rng.integers(2))]]:
        for record in place:
            if bytes(record.body) == old or bytes(record.body[:2]) == number:
                record.body[:] = body


def lie_in_channel(bag: Bag, rng: np.random.Generator) -> None:
    """Give a channel another topic, type or encoding, or leave it out."""
    where = [bag.records(CHANNEL), [r for r in bag.summary if r.opcode == CHANNEL]]
    chosen = _any(rng, where[0])
    if chosen is None:
        return
    number = bytes(chosen.body[:2])
    (topic, encoding), at = _texts(chosen.body, 4, 2)
    rest, schema = bytes(chosen.body[at:]), bytes(chosen.body[2:4])
    match int(rng.integers(5)):
        case 0:
            topic = _HOSTILE[int(rng.integers(len(_HOSTILE)))].encode()
        case 1:
            schema = struct.pack("<H", int(rng.integers(0, 6)))
        case 2:
            encoding = rng.choice([b"json", b"\x1b[2J", b"", b"cdr2"])
        case 3:
            pairs = b"".join(_text(w) + _text(w) for w in _HOSTILE[:3])
            rest = _text(pairs)
        case _:
            other = _any(rng, where[0])
            number = bytes(other.body[:2]) if other else number
    body = number + schema + _text(topic) + _text(bytes(encoding)) + rest
    for place in where if rng.integers(3) else [where[int(rng.integers(2))]]:
        for record in place:
            if bytes(record.body[:2]) == bytes(chosen.body[:2]) and record is not chosen:
                record.body[:] = body
    if rng.integers(2):
        chosen.body[:] = body


def lie_in_metadata(bag: Bag, rng: np.random.Generator) -> None:
    """Add metadata as relay_node writes them, that name anything."""
    words = [_HOSTILE[int(rng.integers(len(_HOSTILE)))] for _ in range(3)]
    names = ("measurement", "command", "experiment_id")
    pairs = b"".join(_text(n) + _text(w) for n, w in zip(names, words, strict=True))
    bag.parts.insert(1, Message(METADATA, bytearray(_text("relay_autotune") + _text(pairs))))


def lie_in_index(bag: Bag, rng: np.random.Generator) -> None:
    """Let a message index leave out, repeat, move or rename what it lists."""
    chunk = _any(rng, bag.chunks())
    if chunk is None:
        return
    what, seed = int(rng.integers(8)), int(rng.integers(2**31))
    if what == 7:
        chunk.has_indexes = False
        return

    def change(entries: dict[int, list[tuple[int, int]]]) -> None:
        own = np.random.default_rng(seed)
        channel = _any(own, sorted(entries))
        if channel is None:
            return
        listed = entries[channel]
        at = int(own.integers(len(listed))) if listed else 0
        match what:
            case 0:
                del listed[at : at + int(own.integers(1, 5))]
            case 1:
                listed.clear()
            case 2:
                del entries[channel]
            case 3:
                listed[at:at] = listed[at : at + 1] * int(own.integers(1, 4))
            case 4:
                other = entries[_any(own, sorted(entries)) or channel]
                listed[:] = other
            case 5:
                entries[int(own.integers(0, 8))] = entries.pop(channel)
            case _:
                if listed:
                    stamp, place = listed[at]
                    listed[at] = (stamp, place + _odd(own) if own.integers(2) else _odd(own))

    chunk.entries = change


def _changed_number(
    rng: np.random.Generator, places: list[tuple[int, str]]
) -> Callable[[bytearray], None]:
    at, form = places[int(rng.integers(len(places)))]
    near, odd, exact = int(rng.integers(-40, 40)), _odd(rng), bool(rng.integers(2))

    def change(body: bytearray) -> None:
        size = struct.calcsize(form)
        if at + size <= len(body):
            (value,) = struct.unpack_from(form, body, at)
            struct.pack_into(form, body, at, (odd if exact else value + near) % 2 ** (8 * size))

    return change


def lie_in_chunk(bag: Bag, rng: np.random.Generator) -> None:
    """Change what a chunk declares of itself, or how its records follow each other."""
    chunk = _any(rng, bag.chunks())
    if chunk is None:
        return
    match int(rng.integers(4)):
        case 0:
            places = [(0, "<Q"), (8, "<Q"), (16, "<Q"), (24, "<I"), (28, "<I"), (32, "<Q")]
            chunk.head = _changed_number(rng, places)
        case 1:
            chunk.records.insert(
                int(rng.integers(0, len(chunk.records) + 1)),
                Message(int(rng.integers(0, 20)), bytearray(int(rng.integers(0, 60)))),
            )
        case 2:
            rng.shuffle(chunk.records)  # type: ignore[arg-type]
        case _:
            chunk.records = chunk.records * int(rng.integers(2, 4))


def lie_in_chunk_index(bag: Bag, rng: np.random.Generator) -> None:
    """Change what the summary says of a chunk, or the list of its message indexes."""
    chunk = _any(rng, bag.chunks())
    if chunk is None:
        return
    places = [(16, "<Q"), (24, "<Q"), (32, "<I"), (36, "<H"), (38, "<Q"), (46, "<H"), (48, "<Q")]
    changed, drop = _changed_number(rng, places), bool(rng.integers(2))
    which = int(rng.integers(6))

    def change(body: bytearray) -> None:
        (size,) = struct.unpack_from("<I", body, 32)
        if not drop or size < 10:
            changed(body)
            return
        at = 36 + 10 * (which % (size // 10))
        del body[at : at + 10]
        struct.pack_into("<I", body, 32, size - 10)

    chunk.index = change


def lie_in_summary(bag: Bag, rng: np.random.Generator) -> None:
    """Change the statistics or the footer, or leave parts of the summary out."""
    match int(rng.integers(5)):
        case 0:
            places = [(0, "<Q"), (42, "<I"), *((46 + 10 * k + 2, "<Q") for k in range(4))]
            bag.statistics = _changed_number(rng, places)
        case 1:
            bag.has_statistics = False
        case 2:
            bag.has_summary = False
        case 3:
            bag.footer = _changed_number(rng, [(0, "<Q"), (8, "<Q"), (16, "<I")])
        case _:
            if bag.summary:
                del bag.summary[int(rng.integers(len(bag.summary)))]


def drop_records(bag: Bag, rng: np.random.Generator) -> None:
    """Leave out whole records of the data, schemas and channels among them."""
    chunk = _any(rng, bag.chunks())
    records = chunk.records if chunk is not None else bag.parts
    if records:
        at = int(rng.integers(len(records)))
        del records[at : at + int(rng.integers(1, 4))]


LIES = (
    lie_in_message, lie_in_schema, lie_in_channel, lie_in_metadata, lie_in_index, lie_in_index,
    lie_in_chunk, lie_in_chunk_index, lie_in_summary, drop_records,
)  # fmt: skip


def lying(number: int, bags: list[bytes]) -> Bag:
    """Return the bag of a number; the same for ever."""
    rng = np.random.default_rng([20_261_122, number])
    whole = [bag for bag in bags if bag.startswith(MAGIC)]
    bag = taken_apart(whole[int(rng.integers(len(whole)))])
    for _ in range(int(rng.integers(1, 4))):
        LIES[int(rng.integers(len(LIES)))](bag, rng)
    return bag


def made(number: int, bags: list[bytes]) -> bytes:
    """Return the file of a number."""
    return put_together(lying(number, bags))


SELECTIONS = (
    Selection(),
    Selection("/measurement", "/command", start=0.0),
    Selection("/joints:position[1]", "/command", clock="header", start=0.0),
    Selection("/imu:linear_acceleration.y", "/command", clock="log", start=0.0),
)


def _read(path: Path, number: int) -> tuple[Recording | None, tuple[str, ...]]:
    try:
        found = read_experiments(path, SELECTIONS[number % len(SELECTIONS)])
    except RelayAutotuneError as error:
        return None, (str(error),)
    return found, found.notes


def judge(path: Path, number: int) -> str:
    """Read a bag as it is, and without all that it says of itself; return what came of it."""
    found, said = _read(path, number)
    words = "".join(said).replace("\n  --measurement", "")
    if found is not None:
        words += "".join(r.reason + r.experiment_id for r in found.experiments)
    if not words.isprintable():
        return f"control characters in {words!r}"
    if found is None:
        return "refused"
    bare = path.with_name("bare.mcap")
    bare.write_bytes(put_together(lying(number, seeds_once()), bare=True))
    plain, also = _read(bare, number)
    if not set(said) - {note.replace(bare.name, path.name) for note in also} and not _same(
        found, plain
    ):
        return f"another answer without a word; by the messages alone: {also}"
    return "read, with a note" if said else "read"


def _same(one: Recording, other: Recording | None) -> bool:
    if other is None or len(one.experiments) != len(other.experiments):
        return False
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for a, b in zip(one.experiments, other.experiments, strict=True)
        for name in ("time", "measurement", "command", "command_time")
    )


_SEEDS: list[bytes] = []


def seeds_once() -> list[bytes]:
    """Return the seeds, which take a moment to make."""
    if not _SEEDS:
        _SEEDS.extend(seeds())
    return _SEEDS


def main() -> int:
    """Print the table; keep what is found."""
    return run(__doc__.splitlines()[0], "bags that lie", Trial(made, judge))


if __name__ == "__main__":
    sys.exit(main())
