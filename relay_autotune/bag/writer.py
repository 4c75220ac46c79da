# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Writing a rosbag2 directory that stays readable if the process is killed."""

from __future__ import annotations

import contextlib
import math
import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import yaml

import relay_autotune
from relay_autotune.bag.definitions import (
    EXPERIMENT_METADATA,
    FLOAT64,
    Definition,
    find_definition,
)
from relay_autotune.errors import BagError, system_says

if TYPE_CHECKING:
    from mcap.writer import Writer

# Largest size of what is not flushed [bytes]: it is lost if the process is killed.
_LARGEST_BUFFER = 1 << 20

# A time without end in rmw: the largest signed 64-bit number of nanoseconds.
_FOREVER = {"sec": 9223372036, "nsec": 854775807}

_FLOAT64_CDR = struct.Struct("<4sd")


def encode_float64(value: float) -> bytes:
    """Return a std_msgs/Float64 in CDR, as the middleware would serialize it."""
    return _FLOAT64_CDR.pack(b"\x00\x01\x00\x00", value)


@dataclass(frozen=True)
class Qos:
    """The quality of service that a publisher offered, in the words of rosbag2.

    :param reliability: ``reliable`` or ``best_effort``.
    :param durability: ``volatile`` or ``transient_local``.
    :param history: ``keep_last`` or ``keep_all``.
    :param depth: messages kept, with keep_last.
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "keep_last"
    depth: int = 10

    @property
    def profiles(self) -> list[dict[str, Any]]:
        """What rosbag2 keeps of a topic with one publisher."""
        return [
            {
                "history": self.history,
                "depth": self.depth,
                "reliability": self.reliability,
                "durability": self.durability,
                "deadline": _FOREVER,
                "lifespan": _FOREVER,
                "liveliness": "automatic",
                "liveliness_lease_duration": _FOREVER,
                "avoid_ros_namespace_conventions": False,
            }
        ]


class _Dumper(yaml.SafeDumper):
    """Writes what occurs twice twice, since readers of bags need not know references."""

    def ignore_aliases(self, _data: Any) -> bool:
        return True


def _as_yaml(value: Any) -> str:
    return str(yaml.dump(value, Dumper=_Dumper, sort_keys=False, width=math.inf))


@dataclass(frozen=True)
class Topic:
    """A topic to record.

    :param name: fully resolved name, such as ``/tank/measurement``.
    :param type: message type, such as ``std_msgs/msg/Float64``.
    :param qos: what its publisher offers.
    :param definition: definition and hash of the type; default: those installed.
    """

    name: str
    type: str = FLOAT64
    qos: Qos = field(default_factory=Qos)
    definition: Definition | None = None


class _Stream:
    """Collect bytes, and put them into the file in whole records when flushed.

    A write that fails half-way is taken back, so that the file ends where the last one that
    succeeded ended.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._pending = bytearray()
        self._written = 0

    def tell(self) -> int:
        return self._written + len(self._pending)

    def write(self, data: bytes) -> int:
        self._pending += data
        return len(data)

    def flush(self) -> None:
        view = memoryview(bytes(self._pending))
        done = 0
        try:
            while done < len(view):
                done += os.write(self._file, view[done:])
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._written)
            raise
        self._written += done
        self._pending.clear()

    def close(self) -> None:
        os.close(self._file)


class BagWriter:
    """A rosbag2 directory with one MCAP file, being written.

    Made for one thread. The directory is complete from the start: metadata.yaml is there, and
    what was flushed can be read although no footer follows. After an error of the file system
    the bag keeps what was flushed before; every later `write` or `flush` raises the same error.

    :param path: the directory to make; must not exist.
    :param topics: the topics to record.
    :param start_ns: time of the recording's beginning, for the metadata written at the start
        [ns since the epoch].
    :param custom: facts about the bag, kept as custom_data of metadata.yaml and, from the first
        byte on, as the metadata record ``relay_autotune``. The keys ``measurement``,
        ``command`` and ``experiment_id`` let a bag that was cut short be read as an experiment.
    :raises BagError: if the directory exists or cannot be made, or a definition is missing.
    """

    def __init__(
        self,
        path: Path | str,
        topics: Sequence[Topic],
        *,
        start_ns: int,
        custom: Mapping[str, str] | None = None,
    ) -> None:
        self.path = Path(path)
        self._custom = {str(k): str(v) for k, v in (custom or {}).items()}
        self._start_ns = int(start_ns)
        self._first_ns: int | None = None
        self._last_ns = 0
        self._failure: str | None = None
        self._closed = False
        self._unflushed = 0
        self._topics = {topic.name: topic for topic in topics}
        if len(self._topics) != len(topics):
            raise BagError("two topics of a bag to be written have the same name")
        self._definitions = {
            topic.type: topic.definition or find_definition(topic.type) for topic in topics
        }
        self._counts = dict.fromkeys(self._topics, 0)
        self._file_name = f"{self.path.name}_0.mcap"
        try:
            self.path.mkdir(parents=True)
            self._write_metadata()
            self._stream = _Stream(self.path / self._file_name)
        except FileExistsError:
            raise BagError(f"{self.path} exists already, not overwriting") from None
        except OSError as error:
            raise BagError(f"cannot make the bag {self.path}: {system_says(error)}") from error
        self._writer, self._channels = self._begin()
        self.flush()

    def _begin(self) -> tuple[Writer, dict[str, int]]:
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise BagError(
                "recording needs the Python package mcap; install it with: pip install mcap"
            ) from error
        # Without compression, as rosbag2 writes by default: of a chunk torn by a crash or a
        # full disk the whole messages can still be read.
        writer = Writer(self._stream, compression=CompressionType.NONE)  # type: ignore[arg-type]
        writer.start("ros2", f"relay_autotune {relay_autotune.__version__}")
        if self._custom:
            writer.add_metadata(EXPERIMENT_METADATA, self._custom)
        schemas = {
            name: writer.register_schema(name, "ros2msg", definition.text.encode())
            for name, definition in self._definitions.items()
        }
        channels = {
            topic.name: writer.register_channel(
                topic.name,
                "cdr",
                schemas[topic.type],
                {
                    "offered_qos_profiles": _as_yaml(topic.qos.profiles),
                    "topic_type_hash": self._definitions[topic.type].type_hash,
                },
            )
            for topic in self._topics.values()
        }
        return writer, channels

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def write(self, topic: str, log_time_ns: int, publish_time_ns: int, cdr: bytes) -> None:
        """Add a message to the recording; it is safe after the next `flush`.

        :param topic: name of one of the topics given at the start.
        :param log_time_ns: when it arrived or left here [ns since the epoch].
        :param publish_time_ns: when its publisher sent it [ns since the epoch].
        :param cdr: the message, serialized with the 4 bytes of its encapsulation.
        :raises BagError: if the file system refused this or an earlier write, the topic is
            unknown, or the bag is closed.
        """
        self._check()
        if topic not in self._channels:
            raise BagError(
                f"{topic} is not a topic of the bag {self.path}, "
                f"which has {', '.join(self._channels) or 'none'}"
            )
        self._writer.add_message(
            self._channels[topic], int(log_time_ns), cdr, int(publish_time_ns)
        )
        self._counts[topic] += 1
        first = log_time_ns if self._first_ns is None else self._first_ns
        self._first_ns = min(log_time_ns, first)
        self._last_ns = max(log_time_ns, self._last_ns)
        self._unflushed += len(cdr)
        if self._unflushed > _LARGEST_BUFFER:
            self.flush()

    def flush(self) -> None:
        """Close the chunk and hand everything to the operating system.

        Afterwards it outlives this process, though not a loss of power.

        :raises BagError: if the file system refuses.
        """
        self._check()
        self._unflushed = 0
        try:
            self._writer.flush()
        except OSError as error:
            raise self._fail(error) from error

    def close(self) -> None:
        """Write the summary and the final metadata.yaml; after that, nothing more can be added.

        Does nothing if the bag was closed, or failed, before.

        :raises BagError: if the file system refuses; what was flushed stays readable.
        """
        if self._closed:
            return
        self._closed = True
        if self._failure is not None:
            with contextlib.suppress(OSError):
                self._write_metadata()
            return
        try:
            self._writer.flush()
            self._writer.add_metadata(
                "rosbag2", {"serialized_metadata": _as_yaml(self._information())}
            )
            self._writer.finish()
            self._stream.flush()
            self._stream.close()
            self._write_metadata()
        except OSError as error:
            raise self._fail(error) from error

    def _check(self) -> None:
        if self._failure is not None:
            raise BagError(self._failure)
        if self._closed:
            raise BagError(f"the bag {self.path} is closed already")

    def _fail(self, error: OSError) -> BagError:
        with contextlib.suppress(OSError):
            self._stream.close()
        self._failure = (
            f"recording to {self.path} has stopped: {system_says(error)}; "
            f"what was written before stays readable"
        )
        return BagError(self._failure)

    def _information(self) -> dict[str, Any]:
        """Return what metadata.yaml of version 9 says of the bag."""
        start_ns = self._start_ns if self._first_ns is None else self._first_ns
        span = {
            "duration": {"nanoseconds": 0 if self._first_ns is None else self._last_ns - start_ns},
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "message_count": sum(self._counts.values()),
        }
        topics = [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": topic.qos.profiles,
                    "type_description_hash": self._definitions[topic.type].type_hash,
                },
                "message_count": self._counts[topic.name],
            }
            for topic in self._topics.values()
        ]
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file_name],
            "files": [{"path": self._file_name, **span}],
            "custom_data": self._custom or None,
            "ros_distro": os.environ.get("ROS_DISTRO") or "jazzy",
        }

    def _write_metadata(self) -> None:
        path = self.path / "metadata.yaml"
        new = path.with_name("metadata.yaml.tmp")
        try:
            information = {"rosbag2_bagfile_information": self._information()}
            new.write_text(_as_yaml(information), encoding="utf-8")
            new.replace(path)
        except OSError:
            with contextlib.suppress(OSError):
                new.unlink(missing_ok=True)
            raise
