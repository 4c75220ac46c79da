# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A thread that writes the bag of one experiment, so that no callback waits for a disk."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from rclpy.serialization import serialize_message

from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
from relay_autotune.errors import BagError

# Flush interval: the longest part that a killed process can lose [s].
FLUSH_PERIOD = 0.5

# The thread writes PORTION samples at a time and then yields the interpreter to the relay [s].
PORTION = 8
PAUSE = 5e-4

# Load the writer now, and not in the thread of the first experiment.
with contextlib.suppress(ImportError):
    import mcap.writer  # noqa: F401


class Recorder:
    """Record an experiment; any error becomes a sentence in `failure`, never an exception.

    :param path: the folder to create.
    :param topics: the topics to record; the first is the measurement, the second the command.
    :param start_ns: the present time [ns since the epoch].
    :param facts: facts about the bag, for its metadata.
    """

    def __init__(
        self, path: Path, topics: Sequence[Topic], *, start_ns: int, facts: Mapping[str, str]
    ) -> None:
        self.path = path
        self.failure: str | None = None
        self._topics = tuple(topics)
        self._measurement, self._command = (topic.name for topic in self._topics[:2])
        self._start_ns = start_ns
        self._facts = dict(facts)
        self._samples: SimpleQueue[tuple[int, int, float, int, float]] = SimpleQueue()
        self._messages: SimpleQueue[tuple[str, int, Any]] = SimpleQueue()
        self._opened = threading.Event()
        self._closing = threading.Event()
        self._finished: Callable[[], object] = bool
        self._writer: BagWriter | None = None
        # Looked up once, because it is called for each sample.
        self.sample = self._samples.put
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    sample: Any
    """Record ``(receive_ns, source_ns, measurement, command_ns, command)``."""

    def message(self, topic: str, time_ns: int, message: Any) -> None:
        """Record another message, which must not be changed afterwards.

        :param topic: resolved name of one of the topics given at the start.
        :param time_ns: when it was sent or received [ns since the epoch].
        :param message: the message.
        """
        self._messages.put((topic, time_ns, message))

    def wait_until_open(self, timeout: float) -> None:
        """Wait at most ``timeout`` seconds until the folder was created or could not be."""
        self._opened.wait(timeout)

    def close(self, finished: Callable[[], None]) -> None:
        """Request the end of the bag; returns at once.

        :param finished: called by the recorder's thread once the bag is complete.
        """
        self._finished = finished
        self._closing.set()

    def join(self, timeout: float) -> bool:
        """Wait until the bag is finished, for ``timeout`` seconds at most; True if it is."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._writer = BagWriter(
                self.path, self._topics, start_ns=self._start_ns, custom=self._facts
            )
        except (BagError, ImportError, OSError) as error:
            self.failure = f"not recorded: {error}"
        finally:
            self._opened.set()
        closing = False
        while not closing:
            # Sleep for a period: a wake-up for each sample would compete with the relay.
            closing = self._closing.wait(FLUSH_PERIOD)
            self._guarded(self._drain)
        self._guarded(self._finish)

    def _guarded(self, action: Callable[[BagWriter], None]) -> None:
        writer = self._writer
        if self.failure is None and writer is not None:
            try:
                action(writer)
            except Exception as error:  # noqa: BLE001  a recorder must not end an experiment
                self.failure = str(error) or type(error).__name__
        if self.failure is not None:
            # Nothing is written after a failure, so empty the queues.
            self._discard()

    def _drain(self, writer: BagWriter) -> None:
        with contextlib.suppress(Empty):
            for count in itertools.count(1):
                received, source, measurement, sent, command = self._samples.get_nowait()
                writer.write(self._measurement, received, source, encode_float64(measurement))
                writer.write(self._command, sent, sent, encode_float64(command))
                if count % PORTION == 0 and not self._closing.is_set():
                    time.sleep(PAUSE)
        with contextlib.suppress(Empty):
            while True:
                topic, time_ns, message = self._messages.get_nowait()
                writer.write(topic, time_ns, time_ns, serialize_message(message))
        writer.flush()

    def _finish(self, writer: BagWriter) -> None:
        writer.close()
        self._finished()

    def _discard(self) -> None:
        for queue in (self._samples, self._messages):
            with contextlib.suppress(Empty):
                while True:
                    queue.get_nowait()
