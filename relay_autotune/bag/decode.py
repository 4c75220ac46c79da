# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Decoding our own messages by the definition that their bag holds."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.bag.limits import MOST_ELEMENTS
from relay_autotune.bag.mcap_records import Channel
from relay_autotune.bag.names import CYCLE, EXPERIMENT
from relay_autotune.bag.schema import Number, Struct, Text, Type, first_line, message_type
from relay_autotune.errors import BagError
from relay_autotune.escape import visible

_LENGTH = Number("uint32", "u4")
# numpy's types as the module struct names them
_FORMATS = {
    "u1": "B", "i1": "b", "u2": "H", "i2": "h", "u4": "I", "i4": "i", "u8": "Q", "i8": "q",
    "f4": "f", "f8": "d",
}  # fmt: skip

_STAMP = {"sec": 0, "nanosec": 0}
_HEADER: dict[str, Any] = {"stamp": _STAMP, "frame_id": ""}
_SETTINGS: dict[str, Any] = {
    "setpoint": 0.0,
    "baseline": 0.0,
    "amplitude": 0.0,
    "bias": 0.0,
    "hysteresis": 0.0,
    "extra_delay": 0.0,
    "sample_period": 0.0,
    "reverse_acting": False,
}

# Defaults of the fields that an older definition lacks. A field that is added to one of these
# messages needs its default here, so that old bags can still be replayed.
DEFAULTS: dict[str, dict[str, Any]] = {
    EXPERIMENT: {
        "header": _HEADER,
        "experiment_id": "",
        "outcome": 0,
        "reason": "",
        "settings": _SETTINGS,
        "noise_std": float("nan"),
        "time": (),
        "receive_time": (),
        "command_time": (),
        "measurement": (),
        "command": (),
        "cycle_start": (),
        "lost_samples": 0,
        "sought": "",
        "sought_width": 0.0,
    },
    CYCLE: {
        "header": _HEADER,
        "experiment_id": "",
        "index": 0,
        "lead_in": 0,
        "settings": _SETTINGS,
        "time": (),
        "measurement": (),
        "command": (),
        "period": float("nan"),
        "period_high": float("nan"),
        "period_low": float("nan"),
        "peak_max": float("nan"),
        "peak_min": float("nan"),
        "time_to_peak_max": float("nan"),
        "time_to_peak_min": float("nan"),
        "converged": False,
        "disturbed": False,
    },
}


def decode_messages(channel: Channel, payload: Iterable[bytes]) -> list[Any]:
    """Decode messages by the definition in their bag; fields it lacks get their defaults.

    :param channel: the channel of the messages.
    :param payload: the serialized messages.
    :return: objects with the fields as attributes, more than today's if the bag has more.
    :raises BagError: if the definition or a message makes no sense.
    """
    if channel.encoding != "cdr" or channel.schema_encoding != "ros2msg":
        raise BagError(
            f"{channel.topic} is encoded as {channel.encoding!r} with a definition in "
            f"{channel.schema_encoding!r}; expected 'cdr' with 'ros2msg'"
        )
    root = message_type(channel)
    messages = []
    budget = _Budget()
    for data in payload:
        try:
            decoded = _decoded(root, data, budget)
        except (ValueError, struct.error, MemoryError) as error:
            raise BagError(
                f"a message of {channel.topic} does not fit its definition: {first_line(error)}"
            ) from None
        messages.append(_with_defaults(decoded, DEFAULTS.get(channel.type, {})))
    return messages


def decoded_message(root: Struct, data: bytes) -> Any:
    """Decode one message of any type.

    :param root: its type.
    :param data: the serialized message.
    :return: an object with the fields as attributes.
    :raises BagError: if it does not fit its type.
    """
    try:
        return _decoded(root, data, _Budget())
    except (ValueError, struct.error, MemoryError) as error:
        raise BagError(f"a message does not fit its definition: {first_line(error)}") from None


class _Budget:
    """Limits the number of structures and elements, each of which takes memory."""

    def __init__(self) -> None:
        self._left = MOST_ELEMENTS

    def take(self, count: int) -> None:
        """Take a number of structures or elements.

        :raises ValueError: if there are too many.
        """
        self._left -= count
        if self._left < 0:
            raise ValueError(f"more than {MOST_ELEMENTS} structures and elements of lists")


def _decoded(root: Struct, data: bytes, budget: _Budget) -> Any:
    """Decode one message; bytes after its end are allowed.

    ROS 2's own serialization leaves some there: it makes room for the alignment of a sequence's
    elements even if the sequence is empty.
    """
    if data[:2] not in (b"\x00\x00", b"\x00\x01") or len(data) < 4:
        raise ValueError("it is not in plain CDR")
    return _Decoder(memoryview(data)[4:], "<" if data[1] else ">", budget).take(root)


class _Decoder:
    """Takes one value after another out of a message in plain CDR, see `cdr`."""

    def __init__(self, data: memoryview, order: str, budget: _Budget) -> None:
        self._data = data
        self._order = order
        self._budget = budget
        self._at = 0

    def take(self, kind: Type) -> Any:
        """Return the next value: a number, a text, an array, a list, or an object with fields."""
        if isinstance(kind, Number):
            return self._number(kind)
        if isinstance(kind, Text):
            return self._text(kind)
        if isinstance(kind, Struct):
            self._budget.take(1)
            return SimpleNamespace(**{name: self.take(inner) for name, inner in kind.fields})
        count = self._number(_LENGTH) if kind.count is None else kind.count
        if isinstance(kind.item, Number):
            return self._array(kind.item, count)
        self._budget.take(count)
        return [self.take(kind.item) for _ in range(count)]

    def _number(self, kind: Number) -> Any:
        self._align(kind.size)
        (value,) = struct.unpack_from(self._order + _FORMATS[kind.form], self._data, self._at)
        self._at += kind.size
        return bool(value) if kind.name == "bool" else value

    def _array(self, kind: Number, count: int) -> NDArray[Any]:
        if count == 0:
            # Where a sequence is empty nothing is aligned.
            return np.empty(0, dtype=kind.form)
        self._align(kind.size)
        values = np.frombuffer(self._data, self._order + kind.form, count, self._at)
        self._at += count * kind.size
        return values

    def _text(self, kind: Text) -> str:
        if kind.wide:
            raise ValueError("the length of a wstring differs between middlewares")
        end = self._number(_LENGTH) + self._at
        if end > len(self._data):
            raise ValueError(f"a text ends {end - len(self._data)} bytes behind the message")
        text = bytes(self._data[self._at : end]).removesuffix(b"\0").decode("utf-8")
        self._at = end
        return visible(text)

    def _align(self, size: int) -> None:
        self._at = (self._at + size - 1) & -size


def _with_defaults(message: Any, defaults: Mapping[str, Any]) -> SimpleNamespace:
    fields = dict(vars(message)) if message is not None else {}
    for name, default in defaults.items():
        if isinstance(default, Mapping):
            fields[name] = _with_defaults(fields.get(name), default)
        else:
            fields.setdefault(name, default)
    return SimpleNamespace(**fields)
