# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The life of a node's process: its signals, its executor, its deferred work and its end.

rclpy's own signal handlers invalidate the context before any Python code runs, so that nothing
can be published afterwards. Here the process owns its handlers; the context lives until the
node has brought its loop to a safe state. A closed terminal sends SIGHUP and then refuses output.
A terminal paused by Ctrl-S, or a pipe without a reader, blocks a write for any time. Neither may
end or delay a process whose last command is in force.

rclpy's executor checks every service, timer and event of a node twice for each message. Ours
waits for the favoured subscription alone while its messages follow each other closely, and checks
everything else a few hundred times a second.
"""

from __future__ import annotations

import ctypes
import gc
import itertools
import os
import signal
import stat
import sys
import textwrap
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import (
    ConditionReachedException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.nodes.parameters import unknown_parameters
from relay_autotune.quantities import Quantity
from relay_autotune.reasons import NONE, Code, Reason
from relay_autotune.text import apart, visible

# Messages further apart than this take the ordinary path [s].
CLOSE = 0.002
# Interval at which everything else is checked while messages follow closely [s].
LOOK_AROUND = 0.005
# After this time without a callback all work is done; it also lets the last message leave [s].
_NOTHING_MORE = 0.02


class Executor(SingleThreadedExecutor):
    """rclpy's single-threaded executor, one callback at a time, with a favoured subscription.

    :param node: the only one.
    """

    def __init__(self, node: ServedNode) -> None:
        super().__init__()
        self.add_node(node)
        self._node = node
        with self.context.handle:
            self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, self.context.handle)
        self._flowing = False
        self._look_around_at = 0.0

    def turn(self, timeout_sec: float | None) -> bool:
        """Wait for a callback and run it; return False if none became ready.

        :param timeout_sec: how long to wait [s]; None: as long as it takes.
        """
        if self._flowing:
            now = time.monotonic()
            if now >= self._look_around_at:
                self._look_around_at = now + LOOK_AROUND
                if self._any(0.0):
                    return True
            if self._take_favoured(CLOSE if timeout_sec is None else 0.0):
                return True
            self._flowing = False
        return self._any(timeout_sec)

    def finish(self, within: float) -> None:
        """Finish pending tasks, such as the answer to an ended goal; take no new messages.

        :param within: how long it may take [s].
        """
        deadline = time.monotonic() + within
        # A wait is needed to see work that one task has started.
        while time.monotonic() < deadline and self._any(_NOTHING_MORE, []):
            pass

    def _take_favoured(self, timeout_sec: float) -> bool:
        subscription = self._node.favoured
        assert subscription is not None
        handle = subscription.handle
        with handle:
            taken = handle.take_message(subscription.msg_type, False)
            if taken is None and timeout_sec > 0.0:
                self._wait_set.clear_entities()
                self._wait_set.add_subscription(handle)
                self._wait_set.wait(int(timeout_sec * 1e9))
                taken = handle.take_message(subscription.msg_type, False)
        if taken is None:
            return False
        subscription.callback(*taken)
        return True

    def _any(self, timeout_sec: float | None, nodes: list[Node] | None = None) -> bool:
        try:
            handler, entity, _ = self.wait_for_ready_callbacks(timeout_sec, nodes)
        except (ConditionReachedException, ShutdownException, TimeoutException):
            return False
        handler()
        error = handler.exception()
        if error is not None:
            raise error
        # A task has no entity, and a node may have no favoured subscription.
        if entity is not None and entity is self._node.favoured:
            self._flowing = True
        return True


# The clock of timers that must go on whatever becomes of /clock.
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
# Longest delay of a measurement by a computing thread [s]; Python's default is 5 ms.
_SWITCH_INTERVAL = 5e-5
# Time limit for tasks at the end of a node, such as the answer to a goal [s].
_FINISH_WITHIN = 0.2
# Time in which a process that is otherwise done has to leave the ROS graph [s]; it takes a tenth.
LEAVE_WITHIN = 2.0
# Byte that ends the thread at the pipe of signals.
_NO_SIGNAL = 0
# After these ROS expects NAME:=VALUE.
_FLAGS_OF_RULES = ("-p", "--param", "-r", "--remap")


class _Log:
    """The log of a node, in which text of other nodes cannot pass for lines of ours.

    :param log: that of rclpy.
    """

    def __init__(self, log: Any) -> None:
        self._log = log

    # A line of code has one severity; with another one rclpy raises.
    def info(self, text: str) -> None:
        self._log.info(visible(text))

    def warning(self, text: str, throttle_duration_sec: float = 0.0) -> None:
        # A line of code is throttled always or never.
        if throttle_duration_sec:
            self._log.warning(visible(text), throttle_duration_sec=throttle_duration_sec)
        else:
            self._log.warning(visible(text))

    def error(self, text: str, throttle_duration_sec: float = 0.0) -> None:
        if throttle_duration_sec:
            self._log.error(visible(text), throttle_duration_sec=throttle_duration_sec)
        else:
            self._log.error(visible(text))

    def fatal(self, text: str) -> None:
        self._log.fatal(visible(text))

    def __getattr__(self, name: str) -> Any:
        # What rclpy itself asks of it.
        return getattr(self._log, name)


class ServedNode(Node):
    """A node with work that waits until its callbacks have returned."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._deferred: deque[Callable[[], object]] = deque()
        self.favoured: Subscription | None = None
        """The subscription whose messages have the fast path.

        Its callback takes the message and the middleware's facts, and does not rely on what other
        callbacks do in between, such as that of /clock."""
        self._when_idle: deque[Callable[[], object]] = deque()

    def get_logger(self) -> _Log:
        """Return the log, in which text of other nodes is made visible."""
        return _Log(super().get_logger())

    def defer(self, work: Callable[[], object]) -> None:
        """Do ``work`` after the present callback, in the order of the calls."""
        self._deferred.append(work)

    def defer_until_idle(self, work: Callable[[], object]) -> None:
        """Do ``work`` once no message, timer or request waits."""
        self._when_idle.append(work)

    def tidy_when_idle(self) -> None:
        """Free what a finished experiment leaves behind, once nothing waits.

        Full collections are far apart here, so that none falls into a running experiment; objects
        that refer to each other would pile up from one experiment to the next.
        """
        self.defer_until_idle(gc.collect)

    def work(self, *, idle: bool) -> bool:
        """Do one piece of deferred work; return True if there is more.

        :param idle: True if nothing else waits, so that idle work may be done.
        """
        if self._deferred:
            self._deferred.popleft()()
        elif idle and self._when_idle:
            self._when_idle.popleft()()
        return bool(self._deferred or self._when_idle)

    def work_off(self) -> None:
        """Do all deferred work, and drop the idle work."""
        self._when_idle.clear()
        while self._deferred:
            self.work(idle=False)

    def compute(self, work: Callable[[], Any], taken: Callable[[Any], None]) -> None:
        """Do ``work`` in a thread while the callbacks go on, then hand over its result.

        :param work: called in the thread; it must not touch the node.
        :param taken: called by the node's executor with what ``work`` returned or raised.
        """
        executor = self.executor

        def run() -> None:
            try:
                found = work()
            except Exception as error:  # `taken` handles it
                found = error
            executor.create_task(taken, found)

        # A daemon thread, so that a running computation does not delay the end of the process.
        threading.Thread(target=run, name="computation", daemon=True).start()

    async def computed(self, work: Callable[[], Any]) -> Any:
        """Return what ``work`` returns in a thread, or raise what it raises; callbacks go on.

        :param work: as of `compute`.
        """
        done: Future = Future()
        self.compute(work, done.set_result)
        found = await done
        if isinstance(found, Exception):
            raise found
        return found

    def end(self, reason: Reason) -> None:
        """Bring the loop to a safe state first, then finish open work.

        :param reason: why the process ends, for people.
        """


def run(
    create: Callable[[], ServedNode],
    name: str,
    args: Sequence[str] | None = None,
    parameters: Sequence[Quantity] = (),
) -> int:
    """Run a node until a signal ends it, or until a callback raises.

    :param create: makes the node.
    :param name: name of the executable, for messages on standard error.
    :param args: command line; default: that of the process.
    :param parameters: parameters of the node, for ``--help`` and to find unknown names.
    :return: exit status: 0 after a signal, 1 after an error, 2 for arguments it cannot take.
    """
    words = sys.argv[1:] if args is None else list(args)
    own, _ = apart(words)
    if {"-h", "--help"} & set(own):
        # A pager may have been closed early.
        with suppress(BrokenPipeError):
            print(_help(name, str(sys.modules[create.__module__].__doc__), parameters), flush=True)
        return 0
    if own:
        # ROS ignores them without a message; an ignored limit is dangerous.
        return _refuse(
            name,
            f"{' '.join(own)} has no effect outside of --ros-args; expected such as "
            f"{name} --ros-args -p NAME:=VALUE; --help lists the names",
        )
    for word in _without_flag(words):
        return _refuse(
            name,
            f"{word} has no flag before it; type -p {word} for a parameter, -r {word} to rename "
            "a topic",
        )
    for unknown in unknown_parameters(_typed_parameters(words), parameters):
        return _refuse(name, unknown)
    signals = _Signals()
    for output in (1, 2):
        never_wait_for(output)
    try:
        rclpy.init(
            args=None if args is None else list(args),
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except Exception as error:  # rclpy has no common base for what it raises here.
        return _refuse(name, _first_line(error))
    sys.setswitchinterval(_SWITCH_INTERVAL)
    try:
        node = create()
    except RelayAutotuneError as error:
        status = _refuse(name, str(error))
        end_soon(status)
        rclpy.try_shutdown()
        return status
    status = 1
    try:
        for unknown in unknown_parameters(list(node._parameter_overrides), parameters):
            # Only a warning: a file may hold parameters of other nodes.
            node.get_logger().warning(unknown)
        status = _serve(node, signals)
    finally:
        end_soon(status)
        node.destroy_node()
        rclpy.try_shutdown()
    return status


class _SignalEvent(ctypes.Structure):
    """The C library's `struct sigevent`, with a function to call in a thread of its own."""

    _fields_ = (
        ("value", ctypes.c_int),
        ("_", ctypes.c_int),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("rest", ctypes.c_char * 40),
    )


_SIGEV_THREAD = 2


def end_soon(status: int) -> None:
    """End the process within `LEAVE_WITHIN`, wherever it is; to be called once all is in order.

    The middleware may compute without end while it leaves the graph, in C code that holds the
    interpreter and blocks all signals. So a timer of the C library calls `_exit`, which needs
    neither.

    :param status: its exit status then.
    """
    for output in (sys.stdout, sys.stderr):
        # A closed output, or a full one, takes nothing.
        with suppress(OSError, ValueError):
            output.flush()
    library = ctypes.CDLL(None)
    leave = ctypes.cast(library._exit, ctypes.c_void_p)
    event = _SignalEvent(value=status, notify=_SIGEV_THREAD, function=leave)
    timer = ctypes.c_void_p()
    library.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer))
    # Interval and first expiry, each in seconds and nanoseconds.
    whole, rest = divmod(round(LEAVE_WITHIN * 1e9), 1_000_000_000)
    library.timer_settime(timer, 0, (ctypes.c_long * 4)(0, 0, whole, rest), None)


def _refuse(name: str, why: str) -> int:
    """Say why a node cannot run; return the exit status."""
    # Standard error may be closed.
    with suppress(OSError):
        print(visible(f"{name}: {why}"), file=sys.stderr)
    return 2


def _without_flag(words: Sequence[str]) -> list[str]:
    """Return the words that look like NAME:=VALUE and follow no flag that takes one."""
    pairs = itertools.pairwise(("", *words))
    return [word for before, word in pairs if ":=" in word and before not in _FLAGS_OF_RULES]


def _typed_parameters(words: Sequence[str]) -> list[str]:
    """Return the names of the parameters that were given with ``-p``."""
    pairs = itertools.pairwise(words)
    given = [after.split(":=")[0] for flag, after in pairs if flag in ("-p", "--param")]
    # NODE:NAME addresses one node of a process.
    return [name.rsplit(":", maxsplit=1)[-1] for name in given]


def _help(name: str, purpose: str, parameters: Sequence[Quantity]) -> str:
    lines = [
        f"usage: {name} [--ros-args [-p NAME:=VALUE ...] [-r NAME:=NAME ...]",
        f"{'':<{len(name) + 8}}[--params-file FILE] ...]",
        "",
        purpose.strip(),
    ]
    if parameters:
        lines += ["", "parameters, with their defaults:"]
    for entry in parameters:
        unit = f" {entry.unit}" if entry.unit else ""
        lines.append(f"  {entry.name} ({entry.default!s}{unit})".replace("()", "(none)"))
        lines += textwrap.wrap(
            entry.description, 80, initial_indent=" " * 6, subsequent_indent=" " * 6
        )
    return "\n".join(lines)


def _serve(node: ServedNode, signals: _Signals) -> int:
    executor = Executor(node)
    signals.wake(executor)
    # Imported objects stay for ever, so keep the garbage collector away from them.
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)
    status, reason = 0, NONE
    try:
        more = False
        while not signals.came:
            busy = executor.turn(0.0 if more else None)
            more = node.work(idle=not busy)
        reason = Code.SIGNAL(signal=signal_name(signals.came[0]))
    except Exception as error:
        status, reason = 1, Code.NODE_FAILED(error=_where(error))
    # The safe command goes out before the reason is logged.
    for end in (partial(node.end, reason), partial(executor.finish, _FINISH_WITHIN)):
        try:
            end()
        except Exception as error:
            status = 1
            node.get_logger().fatal(f"could not end in order: {_where(error)}")
    if status:
        node.get_logger().fatal(str(reason))
    signals.end()
    executor.shutdown(timeout_sec=0.0)
    return status


# The first two cannot be caught. The next four report a defect of the process itself; a handler
# would return to the same instruction for ever. The next four end nothing. The last two stop a
# background process that uses its terminal.
_OTHERS = {
    signal.SIGKILL, signal.SIGSTOP,
    signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL,
    signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH,
    signal.SIGTTIN, signal.SIGTTOU,
}  # fmt: skip
# These are obeyed even if the process was started with them ignored: a shell ignores the first two
# for the background jobs of a script. An ignored SIGHUP stays ignored, for nohup.
_ALWAYS = {signal.SIGINT, signal.SIGQUIT, signal.SIGTERM}


def ending_signals() -> set[int]:
    """Return the signals that would end or stop this process, and can be caught."""
    others = signal.valid_signals() - _OTHERS
    return {n for n in others if n in _ALWAYS or signal.getsignal(n) is not signal.SIG_IGN}


def signal_name(number: int) -> str:
    """Return the name of a signal, such as SIGHUP."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"SIGRTMIN+{number - signal.SIGRTMIN}"


def never_wait_for(output: int) -> Callable[[], None]:
    """Drop writes to a terminal or a pipe when they would block.

    The blocking mode belongs to the open file, which the process shares with its shell and others.
    So the file is opened once more, for this process alone. A regular file never blocks and is
    left unchanged.

    :param output: file descriptor, 1 or 2.
    :return: the function that undoes this.
    """
    try:
        if stat.S_ISREG(os.fstat(output).st_mode):
            return lambda: None
        before, waited = os.dup(output), os.get_blocking(output)
    except OSError:
        # The descriptor is not open.
        return lambda: None
    try:
        own = os.open(f"/proc/self/fd/{output}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError:
        # A socket (systemd's journal) or a file of another user cannot be opened again.
        os.set_blocking(output, False)
    else:
        os.dup2(own, output)
        os.close(own)

    def undo() -> None:
        with suppress(OSError):
            os.dup2(before, output)
            os.set_blocking(output, waited)
            os.close(before)

    return undo


class _Signals:
    """Record the signals that would end the process, in order of arrival.

    A second signal changes nothing, because the end of a node is bounded in time. A Python handler
    runs only when the main thread returns from C code, and the executor waits in C code. But the
    interpreter writes the signal's number into a pipe at once. A thread reads the pipe and wakes
    the executor.
    """

    def __init__(self) -> None:
        self.came: list[int] = []
        self._heeded = ending_signals()
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        for number in self._heeded:
            signal.signal(number, lambda n, _: self.came.append(n))
        # The default action would stop a background node that writes to its terminal.
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        self._thread: threading.Thread | None = None

    def wake(self, executor: Executor) -> None:
        """Wake an executor at each signal, also for signals that came before this call."""

        def read() -> None:
            while _NO_SIGNAL not in os.read(self._reader, 64):
                executor.create_task(lambda: None)

        self._thread = threading.Thread(target=read, name="signals", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Ignore further signals."""
        # `ros2 launch` sends a second SIGINT besides the terminal's. It may arrive while the
        # interpreter shuts down, after Python has removed its handlers, and would kill the node.
        for number in self._heeded:
            signal.signal(number, signal.SIG_IGN)
        signal.set_wakeup_fd(-1)
        # The pipe stays open: a handler that has already started may still write to it.
        os.write(self._writer, bytes([_NO_SIGNAL]))
        if self._thread is not None:
            self._thread.join()


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {_first_line(error)}{place}"


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
