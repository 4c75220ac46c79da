# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Bags made for the tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from relay_autotune.bag.definitions import Definition, find_definition
from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
from relay_autotune.exchange.messages import fill_experiment
from relay_autotune.record.record import Outcome, Record, RelaySettings

REPOSITORY = Path(__file__).parents[2]
START = 1_790_000_000_000_000_000


def definition(type_name: str, folder: Path) -> Definition:
    """Find a definition of our messages without an installed workspace.

    :param folder: folder in which they are laid out as if installed.
    """
    share = folder / "prefix" / "share"
    if not share.exists():
        texts = {
            "std_msgs": {"Header": "builtin_interfaces/Time stamp\nstring frame_id\n"},
            "builtin_interfaces": {"Time": "int32 sec\nuint32 nanosec\n"},
        }
        for package, messages in texts.items():
            (share / package / "msg").mkdir(parents=True)
            for name, text in messages.items():
                (share / package / "msg" / f"{name}.msg").write_text(text)
        (share / "relay_autotune_msgs").symlink_to(REPOSITORY / "relay_autotune_msgs")
    return find_definition(type_name, [share.parent])


def serialize(type_name: str, text: str, value: Any) -> bytes:
    """Serialize an object by a definition, with rosbags as independent implementation."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, type_name))
    return bytes(store.serialize_cdr(_built(store, type_name, value), type_name))


def _built(store: Any, type_name: str, value: Any) -> Any:
    fields = {}
    for name, (kind, what) in store.fielddefs[type_name][1]:
        item = getattr(value, name)
        if kind.name == "NAME":
            item = _built(store, what, item)
        elif kind.name in ("ARRAY", "SEQUENCE"):
            inner, held = what[0]
            if inner.name == "NAME":
                item = [_built(store, held, each) for each in item]
            elif held[0] == "string":
                item = list(item)
            else:
                item = np.asarray(item, dtype=held[0])
        fields[name] = item
    return store.types[type_name](**fields)


def blank_experiment() -> SimpleNamespace:
    """Return a RelayExperiment message as a plain object with default values."""
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id=""),
        experiment_id="",
        outcome=0,
        reason="",
        why=SimpleNamespace(code=0, names=[], values=[]),
        notes=[],
        settings=SimpleNamespace(
            setpoint=0.0,
            baseline=0.0,
            amplitude=0.0,
            bias=0.0,
            hysteresis=0.0,
            extra_delay=0.0,
            sample_period=0.0,
            reverse_acting=False,
        ),
        noise_std=0.0,
        time=[],
        receive_time=[],
        command_time=[],
        measurement=[],
        command=[],
        cycle_start=[],
        lost_samples=0,
        sought="",
        sought_width=0.0,
    )


def experiment_message(record: Record) -> SimpleNamespace:
    """Return a RelayExperiment message with a record."""
    message = blank_experiment()
    fill_experiment(message, record)
    return message


def relay_record(samples: int = 400, *, experiment_id: str = "run-1") -> Record:
    """Return the record of a relay experiment with stamps of two clocks."""
    k = np.arange(samples)
    time = k * 0.1
    phase = time % 8.0
    return Record(
        time=time,
        measurement=20.0 + np.sin(time * 2.0 * np.pi / 8.0),
        command=np.where(phase < 4.0, 7.0, 3.0),
        receive_time=time + 0.0011,
        command_time=time + 0.0013,
        settings=RelaySettings(setpoint=20.0, baseline=5.0, amplitude=2.0, hysteresis=0.1),
        noise_std=0.01,
        cycle_start=tuple(range(0, samples, 80)),
        outcome=Outcome.COMPLETED,
        reason="converged",
        experiment_id=experiment_id,
        start=START / 1e9,
    )


def write_samples(
    bag: BagWriter, record: Record, measurement: str = "/measurement", command: str = "/command"
) -> None:
    """Write the samples of a record as relay_node does."""
    for t, r, c, y, u in zip(
        record.time,
        record.receive_time,
        record.command_time,
        record.measurement,
        record.command,
        strict=True,
    ):
        taken, received, sent = (START + round(s * 1e9) for s in (t, r, c))
        bag.write(measurement, received, taken, encode_float64(y))
        bag.write(command, sent, sent, encode_float64(u))


def write_pair(
    path: Path,
    measurement: Sequence[tuple[float, float]],
    command: Sequence[tuple[float, float]],
    names: tuple[str, str] = ("/measurement", "/command"),
) -> None:
    """Write two topics, each value given with its time in seconds."""
    messages = [(t, names[0], y) for t, y in measurement]
    messages += [(t, names[1], u) for t, u in command]
    with BagWriter(path, [Topic(name) for name in names], start_ns=START) as bag:
        for t, name, value in sorted(messages, key=lambda m: m[0]):
            stamp = START + round(t * 1e9)
            bag.write(name, stamp, stamp, encode_float64(value))


def assert_same_record(found: Record, expected: Record, *, stamps: float = 0.0) -> None:
    """Compare records column by column; ``stamps`` is the tolerance of their times [s]."""
    for name in ("measurement", "command"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for name in ("time", "receive_time", "command_time"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=0.0, atol=stamps
        )
