# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""`controller_node --gains FILE`: parameters and topics of a file that tune_loop has written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from relay_autotune.errors import ParameterError
from relay_autotune.exchange.export import TOPICS

FLAG = "--gains"


def with_gains_file(words: Sequence[str]) -> list[str]:
    """Return a command line with --gains FILE as ROS takes it.

    :param words: the arguments of controller_node.
    :raises ParameterError: if the file cannot be read.
    """
    found = list(words)
    if FLAG not in found:
        return found
    at = found.index(FLAG)
    file = "".join(found[at + 1 : at + 2])
    given = ["--params-file", file]
    for name, topic in _topics(file).items():
        given += ["-r", f"{name}:={topic}"]
    return [*found[:at], *found[at + 2 :], "--ros-args", *given]


def _topics(file: str) -> dict[str, str]:
    """Return the names of the topics that a file of gains gives."""
    try:
        read = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
        section = read.get(TOPICS, {}).get("ros__parameters", {})
        return {str(name): str(topic) for name, topic in section.items()}
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f"{FLAG} {file}: it cannot be read ({error})") from None
    except (yaml.YAMLError, AttributeError) as error:
        what = str(error).partition("\n")[0]
        raise ParameterError(
            f"{FLAG} {file}: expected the parameters of a controller_node in YAML ({what})"
        ) from None
