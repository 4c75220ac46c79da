# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Nodes that tune_loop starts for itself, for a loop that has none: look at it, ask, start them.

They end with the command, however that ends. The flags of a joint of ros2_control stand here, too,
since they exclude some of these.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import json
import math
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import IO, TYPE_CHECKING, Any

from relay_autotune.bag.field_path import first_numbers
from relay_autotune.cli.arguments import finite
from relay_autotune.cli.terminal import Working, asked, broken, number_of, pair_of, width
from relay_autotune.errors import ParameterError, RelayAutotuneError, SelectionError
from relay_autotune.exchange.export import number
from relay_autotune.loop.laws import LAWS

if TYPE_CHECKING:
    from relay_autotune.nodes.tune_client import TuneClient


# How long a node may take to end: relay_node sends its last command first [s].
_END_WITHIN = 8.0
# prctl's request that a process gets a signal when its parent ends.
_PR_SET_PDEATHSIG = 1
# What stands before the text in a line of a node's log, and in the one of its program.
_PREFIX = re.compile(r"\[[A-Z]+\] \[[0-9.]+\] \[\S+\]: |\w+_node: ")


def own_namespace(options: argparse.Namespace) -> str:
    """Return the namespace of the nodes: that of the flag, else one of this process alone."""
    return str(options.namespace or f"tune_loop_{os.getpid()}")


def namespace_of_joint(controller: str, joint: str) -> str:
    """Return the namespace of the nodes that tune a joint, which no other joint has.

    It is the same each time, so that the next tune puts right what a loss of power has left of a
    verification.

    :param controller: full name of the controller's node.
    :param joint: name of the joint, any text.
    """
    # Characters that a name cannot have, as two underscores in a row, stand as _x, their number
    # and z. So does an underscore that would begin such a text.
    escaped = re.sub(
        r"[^0-9A-Za-z_]|_(?![0-9A-Za-z])|_(?=x[0-9a-f]+z)",
        lambda found: f"_x{ord(found[0]):x}z",
        f"_{joint}",
    )
    return f"{controller}/tune{escaped}"


def own_node(options: argparse.Namespace, name: str) -> str:
    """Return the full name of a node of this command.

    :param name: its name in their namespace.
    """
    return f"/{own_namespace(options).strip('/')}/{name}"


def ros_arguments(
    namespace: str,
    topics: Mapping[str, str] | None = None,
    values: Mapping[str, Any] | None = None,
) -> list[str]:
    """Return the arguments for ROS of a node.

    :param namespace: of the node; empty: the root.
    :param topics: the names of its topics.
    :param values: of its parameters.
    """
    arguments = ["-r", f"__ns:=/{namespace.strip('/')}"] if namespace else []
    for name, topic in (topics or {}).items():
        arguments += ["-r", f"{name}:={topic}"]
    for name, value in (values or {}).items():
        shown = number(value) if isinstance(value, float) else value
        arguments += ["-p", f"{name}:={shown}"]
    return arguments


def ranges(
    measurement: Sequence[float] | None, command: Sequence[float] | None
) -> dict[str, float]:
    """Return the parameters of a node that say between what measurement and command stay.

    :param measurement: lowest and highest [y]; None: not given.
    :param command: lowest and highest [u]; None: not given.
    """
    found: dict[str, float] = {}
    for name, limits in (("measurement", measurement), ("command", command)):
        if limits is not None:
            found |= dict(zip((f"{name}_min", f"{name}_max"), limits, strict=True))
    return found


class OwnNodes:
    """Start nodes as processes of the command, and end all of them with the block.

    They are not in the terminal's group, so that Ctrl-C reaches the command alone, which ends the
    tune in order. If the command itself is killed, each of them gets SIGTERM from the system, and
    `relay_node` sends the safe command.

    :param nodes: the arguments for ROS of each node, by the name of its executable, in the order
        in which they end; more of them can be started later.
    """

    def __init__(self, nodes: Mapping[str, Sequence[str]] = MappingProxyType({})) -> None:
        self._nodes = nodes
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._logs: dict[str, IO[bytes]] = {}

    def __enter__(self) -> OwnNodes:
        for name, arguments in self._nodes.items():
            self.start(name, arguments)
        return self

    def start(self, name: str, arguments: Sequence[str]) -> int:
        """Start one node more, and return the id of its process.

        :param name: of its executable.
        :param arguments: its arguments for ROS.
        """
        # Loaded before the fork: after it only few calls are allowed.
        prctl = ctypes.CDLL(None).prctl
        run = f"from relay_autotune.start import {name}; raise SystemExit({name}())"
        log = tempfile.TemporaryFile()  # noqa: SIM115  it is closed at the end of the block
        self._logs[name] = log
        self._running[name] = subprocess.Popen(
            [sys.executable, "-c", run, "--ros-args", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=lambda: prctl(_PR_SET_PDEATHSIG, signal.SIGTERM),
        )
        return self._running[name].pid

    def log(self, name: str) -> str:
        """Return what a node has logged.

        :param name: of its executable.
        """
        file = self._logs[name].fileno()
        # A plain read would move the place at which the node writes.
        return os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace")

    def arguments(self, name: str) -> Sequence[str]:
        """Return the arguments for ROS with which a node was started.

        :param name: of its executable.
        """
        return self._nodes[name]

    def end(self, name: str) -> None:
        """End one node before the others, if it was started.

        :param name: of its executable.
        """
        if (process := self._running.pop(name, None)) is not None:
            with Working(f"ending {name}"):
                _end([process])

    def why_lost(self, only: str = "") -> str:
        """Return which of them has ended by itself, with its last line; empty: none has.

        :param only: the one that is looked at; empty: all.
        """
        for name, process in self._running.items():
            if only in ("", name) and (status := process.poll()) is not None:
                by = f" ({signal.strsignal(-status)})" if status < 0 else ""
                lines = self.log(name).strip().splitlines() or ["without a word"]
                return f"{name} has ended{by}: {_PREFIX.sub('', lines[-1])}"
        return ""

    def __exit__(self, *_: object) -> None:
        with Working("ending the nodes"):
            _end(self._running.values())
        for log in self._logs.values():
            log.close()


def _end(processes: Collection[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + _END_WITHIN
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def free_domain() -> Iterator[int]:
    """Take a domain from 1 to 101 whose lock is free and whose ports are unused.

    :raises RelayAutotuneError: if there is none.
    """
    folder = Path(tempfile.gettempdir()) / "relay_autotune_domains"
    folder.mkdir(exist_ok=True)
    with suppress(OSError):
        folder.chmod(0o777)
    candidates = list(range(1, 102))
    random.SystemRandom().shuffle(candidates)
    for domain in candidates:
        lock = os.open(folder / f"{domain}.lock", os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        if _is_used(domain):
            os.close(lock)
            continue
        try:
            yield domain
        finally:
            os.close(lock)
        return
    raise RelayAutotuneError("no free ROS domain between 1 and 101: end what uses them")


def ports(domain: int) -> range:
    """Return the UDP ports of a domain, by the rule of the DDS standard."""
    return range(7400 + 250 * domain, 7400 + 250 * (domain + 1))


def _is_used(domain: int) -> bool:
    # The first participants of a domain listen at these ports, whoever started them.
    for offset in (10, 12):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", ports(domain)[offset]))
            except OSError:
                return True
    return False


PROGRAM = "tune_loop"
# How long the nodes may take to start on a busy machine [s].
START_WITHIN = 30.0
# What a checklist says to type, and the flags that give these parameters here.
_TYPED = re.compile(r"; type: ros2 param set \S+ (\w+) \w+$")
_FLAGS = {
    "measurement_field": "--field",
    "command_field": "--command-field",
    "command_message": "--command-message",
    "baseline": "--at",
    "measurement_min": "--within",
    "measurement_max": "--within",
    "command_min": "--command-within",
    "command_max": "--command-within",
}


_LIMITS = {"type": finite, "nargs": 2, "metavar": ("LOW", "HIGH")}
_OF_NEW_LOOP: dict[str, dict[str, Any]] = {
    "measurement": {"metavar": "TOPIC", "help": "topic that measures"},
    "command": {"metavar": "TOPIC", "help": "topic that commands the actuator"},
    "field": {
        "default": "data", "metavar": "PATH",
        "help": "the number in the messages of --measurement (%(default)s)",
    },
    "command_field": {
        "metavar": "PATH",
        "help": "the number in the messages of --command, such as linear.x",
    },
    "command_message": {
        "metavar": "YAML",
        "help": "what stands in their other elements, such as '{data: [0.0, 1.5]}'",
    },
    "command_period": {
        "type": finite, "metavar": "S",
        "help": "send the last command again after this time, for an actuator that stops without",
    },
    "at": {
        "type": finite, "metavar": "U",
        "help": "the present command, at which the process rests",
    },
    "within": {**_LIMITS, "help": "the tune ends where the measurement leaves these [y]"},
    "command_within": {**_LIMITS, "help": "no command beyond these is sent [u]"},
    "law": {
        "choices": tuple(LAWS), "metavar": "LAW",
        "help": "design the gains for the law of another program, such as simple_pid, and prove "
        "them with that law",
    },
    "sample_period": {
        "type": finite, "metavar": "S",
        "help": "time between two runs of that program [s]; default: that of the measurement",
    },
    "verify": {
        "action": argparse.BooleanOptionalAction,
        "help": "prove the gains with a step of the set-point, by a controller_node of its own; "
        "without either flag it asks, with --yes it does not",
    },
    "step": {
        "type": finite, "metavar": "Y",
        "help": "height of that step [y]; default: half of the swing of the tune, at least twenty "
        "times the noise (forty if that is within a third of the way to a limit), as far as "
        "--within and --command-within allow",
    },
    "yes": {
        "default": False, "action": "store_true",
        "help": "do not ask, for scripts; gains are then proven with --verify alone",
    },
    "export": {
        "metavar": "FILE",
        "help": "write the gains for ros2_controllers' pid_controller, or for the controller of "
        "the joint; an existing file is refused at once",
    },
}  # fmt: skip

# Flags of a loop without nodes that a joint takes with --open alone, and those it never takes.
_OF_OPENED = ("measurement", "at", "command_within", "command_message", "forward")
_OF_TOPICS = (
    "command", "command_field", "command_period", "verify", "step", "law", "sample_period",
)  # fmt: skip


def add_new_loop(parser: argparse.ArgumentParser) -> None:
    """Add the flags of a loop that has no nodes yet.

    :param parser: of tune_loop.
    """
    group = parser.add_argument_group(
        "a loop without nodes",
        "with --measurement and --command it starts relay_node and identifier_node itself, asks "
        "for what it must know, shows the plan, tunes, and ends them",
    )
    for name, how in _OF_NEW_LOOP.items():
        group.add_argument(f"--{name.replace('_', '-')}", **how)


def is_new_loop(options: argparse.Namespace) -> bool:
    """Return whether the command is to start the nodes itself.

    :param options: with the flags of `add_new_loop`.
    :raises SelectionError: if only some of the flags are given.
    """
    if options.measurement and options.command:
        return True
    for name, how in _OF_NEW_LOOP.items():
        # One with a default is not told from one that is not given.
        if "default" not in how and getattr(options, name) is not None:
            raise SelectionError(
                f"--{name.replace('_', '-')} is for a loop without nodes: give --measurement and "
                f"--command, too"
            )
    return False


def add_joint(parser: argparse.ArgumentParser) -> None:
    """Add the flags of a joint of ros2_control.

    :param parser: of tune_loop.
    """
    group = parser.add_argument_group(
        "a joint of ros2_control",
        "with --controller and --joint it finds topics, limits and gains by itself, tunes, and "
        "applies and verifies the gains",
    )
    group.add_argument(
        "--controller", metavar="NAME",
        help="an active pid_controller, or with --open a joint_trajectory_controller; of several "
        "robots with its namespace, such as /robot1/wheel_pid",
    )  # fmt: skip
    group.add_argument("--joint", metavar="NAME", help="the joint, or degree of freedom")
    group.add_argument(
        "--controller-manager", default="", metavar="NAME",
        help="full name of the controller_manager; default: the only one that is there",
    )  # fmt: skip
    group.add_argument(
        "--open", action="store_true",
        help="switch its controllers off for the tune, and command the joint itself; default: "
        "the controller stays active, and its reference is moved",
    )  # fmt: skip
    group.add_argument(
        "--forward", metavar="NAME",
        help="with --open: the controller that passes commands on; default: found",
    )  # fmt: skip
    group.add_argument(
        "--keep-gains", action="store_true", help="leave the gains of the controller as they are"
    )


def is_of_joint(options: argparse.Namespace) -> bool:
    """Return whether a joint is to be tuned.

    :param options: with the flags of `add_joint` and `add_new_loop`.
    :raises SelectionError: if the flags do not go together.
    """
    if not (options.controller or options.joint):
        if options.open or options.forward or options.keep_gains or options.controller_manager:
            raise SelectionError("--open and the like are for a joint: give --controller, --joint")
        return False
    if not (options.controller and options.joint):
        raise SelectionError("--controller and --joint go together: give both")
    if options.web or (options.json and not (options.keep_gains or options.dry_run)):
        raise SelectionError(
            "a joint is tuned in the terminal: leave out --web, and --json without --keep-gains"
        )
    for name in (*_OF_TOPICS, *(() if options.open else _OF_OPENED)):
        if getattr(options, name) is not None:
            what = "a loop of two topics" if name in _OF_TOPICS else "--open"
            raise SelectionError(
                f"--{name.replace('_', '-')} is for {what}: leave it out, since the controller "
                f"tells it"
            )
    return True


def nodes_for(client: TuneClient, options: argparse.Namespace) -> OwnNodes:
    """Look at the loop, ask for what is not given, and return the nodes to start.

    The answers become options.

    :param client: a node of the graph.
    :param options: with the flags of `add_new_loop`.
    :raises LoopError: if a topic is not there, or something is not known and nobody can be asked.
    """
    with Working(f"looking at {options.measurement} and {options.command}"):
        kind = client.kind_of(options.measurement, options.wait, published=True)
        command_kind = client.kind_of(options.command, options.wait, published=False)
        others = options.command_message or ""
        client.require_uncontrolled()
    _choose_field(kind, options)
    command_field = options.command_field or "data"
    try:
        with Working(f"listening to {options.command}"):
            present = client.commanded(options.command, command_kind, command_field, others)
    except ParameterError as error:
        raise SelectionError(_as_flags(str(error))) from None
    if sys.stdin.isatty() and None in (options.at, options.within, options.command_within):
        print("u is the command's unit, y the measurement's", file=sys.stderr)
    told = "" if math.isnan(present) else f"{present:.6g}"
    if options.at is None:
        what = "present command, at which the process rests [u]"
        options.at = asked(what, "--at", told, told or "2.5", number_of)
    what = "lowest and highest measurement that the process may see [y]"
    options.within = options.within or asked(what, "--within", "", "30 50", pair_of)
    if options.command_within is None and not options.amplitude:
        # The amplitude is found between these.
        what = "lowest and highest command of the actuator [u]"
        options.command_within = asked(what, "--command-within", "", "0 5", pair_of)
    values: dict[str, Any] = {
        "baseline": options.at,
        "baseline_is_present": True,
        # Also where a controller_node in front of it has ended.
        "safe_command": options.at,
        **ranges(options.within, options.command_within),
        "measurement_type": kind,
        "measurement_field": options.field,
        "command_type": command_kind,
        "command_field": command_field,
        "amplitude": options.amplitude,
    }
    if others:
        # The value of a parameter is YAML itself, so that this text needs quotes.
        values["command_message"] = json.dumps(others)
    if options.command_period is not None:
        values["command_period"] = options.command_period
    space = own_namespace(options)
    topics = {"measurement": options.measurement, "command": options.command}
    nodes = {"relay_node": ros_arguments(space, topics, values)}
    if not options.record_only:
        asked_for = {name: getattr(options, name) for name in ("law", "sample_period")}
        given = {name: value for name, value in asked_for.items() if value is not None}
        nodes["identifier_node"] = ros_arguments(space, values=given)
    return OwnNodes(nodes)


def _choose_field(kind: str, options: argparse.Namespace) -> None:
    """Ask for the number that measures where the messages do not have the one of --field.

    :param kind: message type of the measurement.
    :param options: with the flags of `add_new_loop`.
    :raises SelectionError: if nobody can be asked.
    """
    # Imported here, because it needs ROS.
    from relay_autotune.nodes.live_types import message_class, reader_of, struct_of

    while True:
        try:
            reader_of(kind, options.field)
            return
        except ParameterError as error:
            told = _as_flags(str(error))
        first = "".join(first_numbers(struct_of(message_class(kind, "measurement_type")), 1))
        if not (first and sys.stdin.isatty()):
            raise SelectionError(f"{told}: give it, such as --field {first}" if first else told)
        print("\n".join(broken(told, width())), file=sys.stderr)
        what = "the number that measures"
        options.field = asked(what, "--field", first, first, lambda text: text or None)


def with_flags(check: str) -> str:
    """Return a line of the checklist with the flag to give in place of a node's parameter.

    :param check: the line; its node ends with the command, so that nothing can be set on it.
    """
    return _TYPED.sub(lambda found: f"; give {_FLAGS.get(found[1], found[1])}", check)


def _as_flags(text: str) -> str:
    """Return an error's text with the flags in place of the parameters of the same meaning."""
    for parameter, flag in _FLAGS.items():
        text = re.sub(rf"\b{parameter}\b", flag, text)
    return text
