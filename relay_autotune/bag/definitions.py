# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Names, definitions and type hashes of messages, as the installed packages have them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from relay_autotune.bag.ros2msg import PRIMITIVE
from relay_autotune.errors import BagError

# Types in the recordings of relay_node.
EXPERIMENT = "relay_autotune_msgs/msg/RelayExperiment"
CYCLE = "relay_autotune_msgs/msg/RelayCycle"
FLOAT64 = "std_msgs/msg/Float64"

# The metadata record of the file that names the loop's topics.
EXPERIMENT_METADATA = "relay_autotune"

SEPARATOR = "=" * 80

# Known without any installed package, so that a CSV becomes a bag on a machine without ROS.
_BUILT_IN = {
    FLOAT64: (
        "float64 data\n",
        "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
    )
}

_FIELD = re.compile(r"\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[(?:<=)?\d*\])?\s+[A-Za-z]\w*")


@dataclass(frozen=True)
class Definition:
    """The definition of a message type in a bag.

    :param text: the ros2msg definition, followed by those it depends on, each after a line of
        80 ``=`` and ``MSG: package/msg/Type``.
    :param type_hash: REP-2011 hash, ``RIHS01_`` and 64 digits; empty: unknown.
    """

    text: str
    type_hash: str = ""


def installed_prefixes() -> tuple[Path, ...]:
    """Return the prefixes in which interface packages are looked for, nearest overlay first."""
    listed = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    return tuple(Path(p) for p in (*listed, sys.prefix))


def find_definition(type_name: str, prefixes: Sequence[Path] | None = None) -> Definition:
    """Return the definition of an installed message type with all that it depends on.

    :param type_name: such as ``std_msgs/msg/Float64``.
    :param prefixes: install prefixes; default: AMENT_PREFIX_PATH, then this environment.
    :raises BagError: if the type, or one that it depends on, is not installed.
    """
    where = installed_prefixes() if prefixes is None else tuple(prefixes)
    texts: dict[str, str] = {}
    wanted = [type_name]
    while wanted:
        name = wanted.pop(0)
        if name not in texts:
            texts[name] = _message_text(name, where)
            wanted.extend(_dependencies(name, texts[name]))
    parts = [texts.pop(type_name)]
    parts.extend(f"{SEPARATOR}\nMSG: {name}\n{text}" for name, text in texts.items())
    return Definition("\n".join(parts), _type_hash(type_name, where))


def _installed(type_name: str, suffix: str, prefixes: Sequence[Path]) -> Iterator[str]:
    """Yield the content of a type's files, nearest overlay first."""
    parts = type_name.split("/")
    if len(parts) != 3 or not all(re.fullmatch(r"\w+", part) for part in parts):
        raise BagError(
            f"{type_name!r} is not a message type; expected a name like std_msgs/msg/Float64"
        )
    for prefix in prefixes:
        path = prefix.joinpath("share", *parts).with_suffix(suffix)
        with contextlib.suppress(OSError, UnicodeDecodeError):
            yield path.read_text(encoding="utf-8")


def _message_text(type_name: str, prefixes: Sequence[Path]) -> str:
    for text in _installed(type_name, ".msg", prefixes):
        return text if text.endswith("\n") else text + "\n"
    if type_name in _BUILT_IN:
        return _BUILT_IN[type_name][0]
    raise BagError(
        f"the definition of {type_name} is not installed in any of the {len(prefixes)} prefixes "
        f"of AMENT_PREFIX_PATH; build {type_name.split('/')[0]} and source its install folder"
    )


def _dependencies(type_name: str, text: str) -> list[str]:
    package = type_name.split("/", 1)[0]
    found: list[str] = []
    for line in text.splitlines():
        match = _FIELD.match(line.split("#", 1)[0])
        if match is None or PRIMITIVE.fullmatch(match.group(1)):
            continue
        name = match.group(1)
        if name == "Header":
            name = "std_msgs/msg/Header"
        elif "/" not in name:
            name = f"{package}/msg/{name}"
        elif name.count("/") == 1:
            name = name.replace("/", "/msg/")
        if name not in found:
            found.append(name)
    return found


def _type_hash(type_name: str, prefixes: Sequence[Path]) -> str:
    for text in _installed(type_name, ".json", prefixes):
        with contextlib.suppress(ValueError, KeyError, TypeError, StopIteration):
            hashes = json.loads(text)["type_hashes"]
            return next(str(h["hash_string"]) for h in hashes if h["type_name"] == type_name)
    return _BUILT_IN.get(type_name, ("", ""))[1]
