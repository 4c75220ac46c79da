"""Things that are known by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from relay_autotune.errors import RelayAutotuneError

T = TypeVar("T")


def look_up(registry: Mapping[str, T], name: str, kind: str, error: type[RelayAutotuneError]) -> T:
    """Return what has a name.

    :param registry: all that there is, by name.
    :param name: which one.
    :param kind: what it is, for the message.
    :param error: class of the error.
    :raises RelayAutotuneError: of that class, if there is none of that name; the message lists
        those there are.
    """
    if name not in registry:
        raise error(f"unknown {kind} {name!r}; known: {', '.join(registry)}")
    return registry[name]
