# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The errors that this package raises: found, expected, what to do; and look-up by name."""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar


class RelayAutotuneError(Exception):
    """Base of every error that the package raises on purpose.

    >>> from relay_autotune import RelayAutotuneError, TransferFunction
    >>> try:
    ...     TransferFunction.fopdt(0.0, 20.0, 10.0)
    ... except RelayAutotuneError as error:
    ...     print(error)
    the gain of a transfer function must not be zero
    """


class ModelError(RelayAutotuneError, ValueError):
    """A transfer function is not valid, or does not support the request."""


class RecordError(RelayAutotuneError, ValueError):
    """Recorded data are inconsistent or too few."""


class ParameterError(RelayAutotuneError, ValueError):
    """A parameter is out of its range, or two contradict each other."""


class IdentificationError(RelayAutotuneError, ValueError):
    """The method cannot identify a model from the record."""


class TuningError(RelayAutotuneError, ValueError):
    """A rule does not apply to the model, or gains are not acceptable."""


class BagError(RelayAutotuneError, ValueError):
    """A recording cannot be read or written."""


class SelectionError(BagError):
    """A recording does not have the chosen topics or columns, or has them twice.

    :param said: what was found and expected.
    :param choices: the flags of each selection that would do, with what speaks for it.
    """

    def __init__(self, said: str, choices: Sequence[tuple[str, str]] = ()) -> None:
        super().__init__(said)
        self._choices = tuple(choices)

    def __str__(self) -> str:
        return self.with_choices()

    def with_choices(self, command: str = "") -> str:
        """Return the error with a line to copy for each choice.

        :param command: to which the flags are added; empty: they stand alone.
        """
        flags = ("\n  " + f"{command} {flags}".strip() for flags, _ in self._choices)
        reasons = (f"  # {why}" * bool(why) for _, why in self._choices)
        return super().__str__() + "".join(map("".join, zip(flags, reasons, strict=True)))


class NotThereError(SelectionError):
    """A recording does not have a topic or column of the name that was given.

    :param lacking: what it does not have.
    :param there: what it has; empty: ``lacking`` says it already.
    """

    def __init__(self, lacking: str, there: str = "") -> None:
        super().__init__("; ".join(filter(None, (lacking, there))))
        self.lacking = lacking


class FieldError(RelayAutotuneError, ValueError):
    """A message has no such field, or its names do not tell which element is meant."""


class MissingPackageError(RelayAutotuneError, ImportError):
    """An optional Python package is needed and not installed."""


class LoopError(RelayAutotuneError, RuntimeError):
    """The nodes of a running loop are missing, or do not answer."""


class NotReadyError(RelayAutotuneError):
    """A tune, or a verification, that cannot start."""


def visible(text: str, keep: str = "") -> str:
    """Return a text with each unprintable character as an escape sequence of Python.

    These are control characters, line breaks, marks of the direction of writing, characters
    without width, and bytes that were no text. Visible characters stay unchanged.

    :param text: the text.
    :param keep: unprintable characters that stay unchanged.
    """
    if text.isprintable():
        return text
    return "".join(
        char if char.isprintable() or char in keep else char.encode("unicode_escape").decode()
        for char in text
    )


def defect(error: BaseException) -> str:
    """Return the message for an unexpected error: a request to report it, with its place.

    The error's own text would not help a user, and may quote a hostile file.

    :param error: the error.
    """
    if isinstance(error, MemoryError):
        return "it takes more memory than there is"
    frames = traceback.extract_tb(error.__traceback__)
    package = Path(__file__).parent
    own = [frame for frame in frames if Path(frame.filename).is_relative_to(package)]
    place = "an unknown place"
    if own:
        place = f"{Path(own[-1].filename).relative_to(package)}:{own[-1].lineno}"
    return (
        f"a defect of relay_autotune, {type(error).__name__} at {place}; please report this line, "
        f"with the recording if you can"
    )


def system_says(error: Exception) -> str:
    """Return what the system says of a file that it refuses, without its number.

    :param error: of the system, or another one.
    """
    return getattr(error, "strerror", None) or str(error)


@contextmanager
def os_errors_as(error: type[RelayAutotuneError], what: str, advice: str = "") -> Iterator[None]:
    """Raise an error of this package where the system refuses something in the block.

    :param error: its class.
    :param what: cannot be done, with the file.
    :param advice: what follows the system's own words.
    """
    try:
        yield
    except OSError as refusal:
        raise error(f"{what}: {system_says(refusal)}{advice}") from refusal


# A pipe without a reader; a disk, or what stands for one, that takes no more.
_REFUSED = (errno.EPIPE, errno.ENOSPC, errno.EIO, errno.EDQUOT)


def output_refused(program: str, error: Exception) -> bool:
    """Tell whether standard output takes no more; then nothing is flushed to it at the end.

    :param program: says so on standard error, unless the reader closed the pipe, as `head` does.
    :param error: with which something was written.
    """
    if not isinstance(error, OSError) or error.errno not in _REFUSED:
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if error.errno != errno.EPIPE:
        sys.stderr.write(f"{program}: standard output cannot be written: {error.strerror}\n")
    return True


T = TypeVar("T")


def look_up(registry: Mapping[str, T], name: str, kind: str, error: type[RelayAutotuneError]) -> T:
    """Return the entry of a name.

    :param registry: all entries by name.
    :param name: of the entry.
    :param kind: of the entry, for the message.
    :param error: class of the error.
    :raises RelayAutotuneError: of that class, if there is none of that name; the message lists
        the names.
    """
    if name not in registry:
        raise error(f"unknown {kind} {name!r}; known: {', '.join(registry)}")
    return registry[name]
