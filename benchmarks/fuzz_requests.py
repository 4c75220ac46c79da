# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Ask the page and the services what cannot be: `python3 benchmarks/fuzz_requests.py [--count N]`.

Half of the requests go to a page, over HTTP and its socket, the other half to relay_node and
identifier_node, over DDS: numbers of any size, texts with control characters, records that
contradict themselves, JSON that is cut, connections that vanish. A find is a traceback, "a
defect" in an answer or in a log, no answer within 25 s, a raw control character in a log, or a
node that has ended.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import socket
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr
from functools import partial
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import urlopen

import numpy as np
from markdown import table, three

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from loop_rig import Process, Rig
from made_experiments import experiment_of
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_domain import free_domain
from served import analysed, conversation, served, subject_of

from relay_autotune.analysis import PARAMETERS
from relay_autotune.exchange.messages import float64_array
from relay_autotune.loop.laws import LAWS
from relay_autotune.nodes.tables import TUNE_PARAMETERS
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning import RULES
from relay_autotune_msgs.srv import Identify, StartTune

COUNT, SECONDS, PATIENCE = 2000, 20.0, 300.0
# One in so many questions is one that can be answered: each of these takes a second.
_POSSIBLE = 40
_NUMBERS = (
    *("0", "-0.0", "1", "-1", "5e-324", "1e-300", "1e-9", "1e9", "1e152", "1e300", "1e400"),
    *("-1e400", "NaN", "Infinity", "9" * 400, "-" + "9" * 400, "null", "true", '"1"', "[]", "{}"),
)
_FLOATS = (0.0, -1.0, 5e-324, 1e-300, 1e-9, 1e9, 1e152, 1e300, 1.8e308, math.inf, math.nan)
_FORGED = "\x1b]0;taken\x07\x1b[2J\n[INFO] [1.0] [relay_node]: all is well\u202e"


def question(rng: np.random.Generator) -> str:
    """Return what a hostile page sends: JSON, perhaps cut."""
    names = ("ms", "setpoint_weight", "noise_share", "sample_period", "rule", "controller", "law")
    fields = {str(n): str(rng.choice(_NUMBERS)) for n in rng.choice(names, rng.integers(0, 4))}
    inner = "{" + ", ".join(f'"{name}": {value}' for name, value in fields.items()) + "}"
    if rng.integers(_POSSIBLE) == 0:
        rule, law = rng.choice(list(RULES)), rng.choice(["", *LAWS])
        period, ms = 10.0 ** rng.uniform(-9.0, 9.0), rng.uniform(1.2, 4.0)
        asked = {"rule": str(rule), "law": str(law), "sample_period": period, "ms": ms}
        inner = json.dumps(asked)
    of, n = (rng.choice(["0", *_NUMBERS]) if rng.integers(4) == 0 else "0" for _ in range(2))
    text = f'{{"of": {of}, "n": {n}, "asked": {inner}}}'
    return text[: rng.integers(len(text))] if rng.integers(8) == 0 else text


def ask_page(url: str, rng: np.random.Generator) -> str:
    """Ask the page once; return what became of it."""
    text, how = question(rng), rng.integers(6)
    if how == 0:
        host, port = url.removeprefix("http://").strip("/").split(":")
        with socket.create_connection((host, int(port))) as end:
            end.sendall(f"GET /socket HTTP/1.1\r\nHost: localhost\r\n{_FORGED}".encode())
        return "gone"
    if how == 1:
        path = ("report.html", "gains/yaml", "gains/none", "socket", "..")[rng.integers(5)]
        many = "&".join(f"f{k}=1" for k in range(rng.integers(50)))
        asked = quote(str(rng.choice(_NUMBERS)))
        try:
            with urlopen(f"{url}{path}?of={asked}&asked={asked}&{many}", timeout=PATIENCE) as page:
                return "refused" if b"a defect" not in page.read() else "a find"
        except HTTPError as error:
            return "refused" if error.code < 500 else "a find"
    answer = conversation(url, text)[-1]
    if answer is None:
        return "refused"
    if "a defect" in json.dumps(answer):
        return "a find"
    return "answered" if "shaped" in answer["answer"] else "refused"


def record(rng: np.random.Generator) -> Any:
    """Return a record that contradicts itself or the world."""
    made = experiment_of(TransferFunction.fopdt(2.0, 0.8, 0.4), _FORGED, cycles=3)
    for _ in range(rng.integers(1, 4)):
        name = str(rng.choice(["time", "measurement", "command", "receive_time", "command_time"]))
        values = np.array(getattr(made, name))
        how = rng.integers(4)
        if how == 0:
            values = values[: rng.integers(values.size + 1)]
        elif how == 1 and values.size:
            values[rng.integers(values.size)] = rng.choice(_FLOATS)
        elif how == 2:
            with np.errstate(all="ignore"):
                values = values * rng.choice(_FLOATS)
        else:
            made.settings.amplitude = float(rng.choice(_FLOATS))
        setattr(made, name, float64_array(values))
    made.outcome, made.reason = int(rng.integers(256)) if rng.integers(3) == 0 else 1, _FORGED
    return made


def ask_service(rig: Rig, rng: np.random.Generator) -> str:
    """Ask a service once; return what became of it."""
    how = rng.integers(4)
    if how == 0:
        asked = {"amplitude": float(rng.choice(_FLOATS)), "dry_run": bool(rng.integers(2))}
        answer = rig.call(StartTune, "relay_node/start_tune", StartTune.Request(**asked))
        said, fine = answer.reason + "".join(answer.checks), answer.accepted
    elif how == 1:
        request = Identify.Request(experiment=record(rng))
        request.method, request.rule = rng.choice(["", "wang", _FORGED]), rng.choice(["", _FORGED])
        answer = rig.call(Identify, "identifier_node/identify", request)
        said, fine = answer.reason, answer.success
    else:
        node = ("relay_node", "identifier_node")[how - 2]
        entries = TUNE_PARAMETERS if how == 2 else PARAMETERS
        entry = entries[rng.integers(len(entries))]
        held: Any = float(rng.choice(_FLOATS))
        if isinstance(entry.default, str):
            held = _FORGED
        elif isinstance(entry.default, int):
            held = int(rng.choice([-(2**63), -1, 0, 2**63 - 1]))
        given = [Parameter(entry.name, value=held).to_parameter_msg()]
        request = SetParameters.Request(parameters=given)
        answer = rig.call(SetParameters, f"{node}/set_parameters", request)
        said, fine = answer.results[0].reason, answer.results[0].successful
        if fine:
            default = Parameter(entry.name, value=entry.default).to_parameter_msg()
            back = SetParameters.Request(parameters=[default])
            rig.call(SetParameters, f"{node}/set_parameters", back)
    if "a defect" in said:
        print(said, file=sys.stderr)
        return "a find"
    return "answered" if fine else "refused"


def used(processes: list[Process]) -> float:
    """Return the time of the processor that processes have used so far [s]."""
    ticks = 0
    for each in processes:
        fields = Path(f"/proc/{each.pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def timed(
    found: Counter[str], slowest: list[float], clock: Callable[[], float], ask: Any, *given: Any
) -> None:
    """Ask, and count what became of it."""
    begun = clock()
    try:
        found[ask(*given)] += 1
    except (OSError, AssertionError, TimeoutError) as error:
        print(f"no answer: {error}", file=sys.stderr)
        found["a find"] += 1
    slowest.append(clock() - begun)
    if slowest[-1] > SECONDS:
        found["a find"] += 1


def is_clean(log: str) -> bool:
    """Return whether a log holds no traceback, no defect and no text that acts."""
    texts = ("Traceback", "a defect", "Error:")
    return not any(t in log for t in texts) and all(c.isprintable() or c == "\n" for c in log)


def main() -> None:
    """Ask, and print what became of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng, half = np.random.default_rng(options.seed), options.count // 2
    page, services = Counter[str](), Counter[str]()
    times: tuple[list[float], list[float]] = ([], [])
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "page.log"
        with log.open("w") as said, redirect_stderr(said), served([subject_of(analysed())]) as url:
            for _ in range(half):
                timed(page, times[0], time.process_time, ask_page, url, rng)
        page["a find"] += not is_clean(log.read_text())
        print(log.read_text(), end="", file=sys.stderr)
        with free_domain() as domain:
            rig = Rig(domain, Path(folder))
            try:
                rig.plant(sample_period=0.02, structure="fopdt", time_constants=[1.0])
                nodes = [rig.relay(amplitude=0.5, baseline=1.0), rig.identifier()]
                for _ in range(half):
                    timed(services, times[1], partial(used, nodes), ask_service, rig, rng)
                for node in nodes:
                    if not (node.running and is_clean(node.log)):
                        print(node.log[-2000:].encode("unicode_escape"), file=sys.stderr)
                        services["a find"] += 1
            finally:
                rig.close()
    names = ("answered", "refused", "gone", "a find")
    rows = [(name, str(page[name]), str(services[name])) for name in names]
    rows.append(("slowest, of the processor [s]", three(max(times[0])), three(max(times[1]))))
    print(table((f"{2 * half} requests", "page", "services"), rows))


if __name__ == "__main__":
    main()
