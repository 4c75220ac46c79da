"""Decoding our own messages by the definition that their bag holds."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

from relay_autotune.bag.mcap_records import Channel
from relay_autotune.bag.schema import first_line
from relay_autotune.errors import BagError

EXPERIMENT = "relay_autotune_msgs/msg/RelayExperiment"
CYCLE = "relay_autotune_msgs/msg/RelayCycle"

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

# What a field means that an older definition did not have. Whoever adds a field to one of these
# messages adds its default here, and old bags keep replaying.
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
    try:
        from rosbags.serde import SerdeError
        from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
    except ImportError:
        raise BagError(
            "reading recorded experiments needs the Python package rosbags; "
            "install it with: pip install rosbags"
        ) from None
    try:
        text = channel.definition.decode("utf-8").replace("\r\n", "\n")
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(text, channel.type))
    except (UnicodeDecodeError, TypesysError, KeyError, ValueError, RecursionError) as error:
        raise BagError(
            f"the definition of {channel.type} in the recording makes no sense: "
            f"{first_line(error)}"
        ) from None
    messages = []
    for data in payload:
        try:
            decoded = _decoded(store, channel.type, data)
        except (SerdeError, KeyError, ValueError, IndexError, struct.error, MemoryError) as error:
            raise BagError(
                f"a message of {channel.topic} does not fit its definition: {first_line(error)}"
            ) from None
        messages.append(_with_defaults(decoded, DEFAULTS.get(channel.type, {})))
    return messages


def _decoded(store: Any, type_name: str, data: bytes) -> Any:
    """Decode one message; bytes after its end are allowed.

    ROS 2's own serialization leaves some there: it makes room for the alignment of a sequence's
    elements even if the sequence is empty. `Typestore.deserialize_cdr` refuses such messages.
    """
    if data[:2] not in (b"\x00\x00", b"\x00\x01") or len(data) < 4:
        raise ValueError("it is not in plain CDR")
    definition = store.get_msgdef(type_name)
    decode = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
    message, end = decode(memoryview(data)[4:], 0, definition.cls, store)
    if end > len(data) - 4:
        raise ValueError(f"it has {len(data)} bytes, fewer than its fields take")
    return message


def _with_defaults(message: Any, defaults: Mapping[str, Any]) -> SimpleNamespace:
    fields = dict(vars(message)) if message is not None else {}
    for name, default in defaults.items():
        if isinstance(default, Mapping):
            fields[name] = _with_defaults(fields.get(name), default)
        else:
            fields.setdefault(name, default)
    return SimpleNamespace(**fields)
