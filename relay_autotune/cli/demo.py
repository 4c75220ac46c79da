# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The demo: plant, relay and identifier as three processes, tuned by one service call."""

from __future__ import annotations

import math
import os
import shutil
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from relay_autotune import threads  # noqa: F401  before numpy: live and replay are bit-equal
from relay_autotune.analysis import analyse
from relay_autotune.cli.arguments import run_command
from relay_autotune.cli.own_nodes import OwnNodes, free_domain
from relay_autotune.errors import RelayAutotuneError, system_says
from relay_autotune.exchange.messages import stamp_nanoseconds
from relay_autotune.exchange.models import document, model_fields, to_json
from relay_autotune.nodes.shell import ros_arguments
from relay_autotune.process.transfer_function import TransferFunction, process_text
from relay_autotune.quantities import NORMAL_95
from relay_autotune.recordings import read_experiments
from relay_autotune.report import write_page, write_picture
from relay_autotune.report.case import Case, case_of
from relay_autotune.result import Analysis
from relay_autotune.text import digits

TRUTH = TransferFunction.fopdt(1.65, 20.0, 10.0)
PERIOD = 0.1
NOISE_STD = 0.05
SEED = 1
BASELINE, REST = 2.0, 40.0
AMPLITUDE = 1.0
# Simulated seconds per second, slow enough to fit a model during each cycle.
SPEED = 40.0
PAGE_TITLE = "Relay test of a simulated process"

# The tune takes about 10 s. A slow computer, which also starts three nodes, takes several times
# as long.
_DEADLINE = 120.0
_LOOK_EVERY = 0.1


def main() -> int:
    """Run the demo; leave bag, result, picture and report in ``demo_output/``."""
    return run_command("demo", partial(_demonstrate, Path("demo_output")))


def _demonstrate(output: Path) -> int:
    try:
        if output.exists():
            shutil.rmtree(output)
        output.mkdir()
        with free_domain() as domain:
            bag, seen = _run(output, domain)
        shutil.move(bag, output / "bag")
        # The logs are only needed after an error.
        for left in (output / "records", output / "log"):
            shutil.rmtree(left, ignore_errors=True)
        return _finish(output, seen)
    except OSError as error:
        if error.filename is None:
            raise
        raise RelayAutotuneError(
            f"{error.filename} cannot be written: {system_says(error)}; run the demo where you "
            "may write"
        ) from error


def _run(output: Path, domain: int) -> tuple[Path, Any]:
    # The nodes have the same environment.
    os.environ |= {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(output / "log"),
    }
    plant = {
        "mode": "lockstep",
        "sample_period": PERIOD,
        "lockstep_speed": SPEED,
        "structure": TRUTH.structure,
        "gain": TRUTH.gain,
        "time_constants": f"[{TRUTH.time_constants[0].real}]",
        "dead_time": TRUTH.dead_time,
        "operating_point": f"[{REST}, {BASELINE}]",
        "noise_std": NOISE_STD,
        "seed": SEED,
    }
    relay = {
        "amplitude": AMPLITUDE,
        "baseline": BASELINE,
        "sample_period": PERIOD,
        # On a busy machine a late sample must not count as a failed sensor.
        "measurement_timeout": 10.0,
        "record_directory": str(output / "records"),
    }
    print("The process, which only plant_node knows:")
    print(f"  {process_text(TRUTH)}, noise {NOISE_STD} y, sampled every {PERIOD} s, in lockstep")
    print(f"  at {SPEED:g} times real time")
    print("Three processes in a ROS domain of their own:")
    with OwnNodes() as nodes:
        for name, parameters in (
            ("plant_node", plant),
            ("relay_node", relay),
            ("identifier_node", {}),
        ):
            process = nodes.start(name, ros_arguments("", values=parameters))
            print(f"  {name}, process {process}", flush=True)
        return _watch(nodes, output)


def _watch(nodes: OwnNodes, output: Path) -> tuple[Path, Any]:
    # ROS is looked for only when the demo runs, so that its errors are one line.
    from relay_autotune.nodes.loop_client import LoopClient
    from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment, TransferFunction
    from relay_autotune_msgs.srv import StartTune

    deadline = time.monotonic() + _DEADLINE
    with LoopClient("onlooker", "", "relay_node") as client:
        client.why_lost = nodes.why_lost

        def wait(condition: Callable[[], object]) -> None:
            if not client.wait(lambda: bool(condition()), deadline - time.monotonic()):
                raise RelayAutotuneError(
                    f"the tune took longer than {_DEADLINE:g} s; the logs are in {output}"
                )

        seen = SimpleNamespace(
            cycles=client.hearing(RelayCycle, "relay_cycle"),
            experiments=client.hearing(RelayExperiment, "relay_experiment"),
            models=client.hearing(TransferFunction, "transfer_function"),
            gains=client.hearing(PidGains, "pi_gains"),
        )
        start = f"{client.name}/start_tune"
        while not (answer := client.call(StartTune, start, StartTune.Request())).accepted:
            # The nodes may not have discovered each other yet.
            wait(lambda: time.monotonic() < deadline)
            client.rest(_LOOK_EVERY)
        print("One service call, relay_node/start_tune:")
        print(f"  accepted: experiment {answer.experiment_id}", flush=True)
        _show_cycles(seen, wait)
        wait(lambda: seen.gains)
        wait(lambda: "is closed" in nodes.log("relay_node"))
        return output / "records" / answer.experiment_id, seen.gains[-1]


def _show_cycles(seen: Any, wait: Callable[[Callable[[], object]], None]) -> None:
    print("  cycle   period s   high s   low s   peaks y           K_u so far")
    shown: list[Any] = []
    while not seen.experiments or len(shown) < len(seen.cycles):
        wait(lambda: seen.experiments or len(seen.cycles) > len(shown))
        for cycle in seen.cycles[len(shown) :]:
            wait(partial(_is_fitted, seen, cycle))
            fits = [m for m in seen.models if not m.final]
            so_far = f"{fits[-1].ultimate_gain:.3f}" if fits else ""
            if fits and math.isfinite(fits[-1].ultimate_gain_std):
                so_far += f" ± {NORMAL_95 * fits[-1].ultimate_gain_std:.3f}"
            settled = "   settled" if cycle.converged else ""
            print(
                f"  {cycle.index + 1:>5}   {cycle.period:>8.2f}   {cycle.period_high:>6.2f}   "
                f"{cycle.period_low:>5.2f}   {cycle.peak_min:>6.3f} {cycle.peak_max:>6.3f}   "
                f"{so_far}{settled}"
            )
            shown.append(cycle)
    end = seen.experiments[-1]
    print(f"  {end.reason}")


def _is_fitted(seen: Any, cycle: Any) -> bool:
    """Tell whether a model knows a cycle, or the next cycle or the end has come."""
    known = stamp_nanoseconds(cycle.header.stamp) + 1e9 * (cycle.time[-1] - PERIOD)
    return (
        bool(seen.experiments)
        or seen.cycles[-1].index > cycle.index
        or any(stamp_nanoseconds(m.header.stamp) >= known for m in seen.models)
    )


def _finish(output: Path, live: Any) -> int:
    recording = read_experiments(output / "bag")
    found = analyse(recording.experiments[0])
    if found.model is None or found.best_gains is None:
        raise RelayAutotuneError(f"nothing was identified: {found.reason}")
    case = case_of(found, str(output / "bag"), truth=TRUTH)
    _compare(case)
    gains = found.best_gains
    same = (live.kc, live.ti, live.ms) == (gains.kc, gains.ti, gains.ms)
    print(
        "The bag, replayed, gives "
        + ("the same gains to the last digit." if same else "OTHER gains than the live nodes.")
    )
    result = document(str(output / "bag"), [found])
    result["truth"] = model_fields(TRUTH)
    (output / "result.json").write_text(to_json(result) + "\n")
    write_picture(case, output / "figure.png", title=picture_title(found))
    write_page([case], output / "report.html", title=PAGE_TITLE)
    print(f"Left in {output}/: bag/, result.json, figure.png, report.html")
    print(f"  try: . ./env.sh && replay {output}/bag")
    return 0 if same else 1


def picture_title(found: Analysis) -> str:
    """Return the title of the demo's picture.

    :param found: with a model.
    """
    assert found.model is not None
    return f"Relay test: {found.model.model}  (true: {TRUTH})"


def _compare(case: Case) -> None:
    gains = case.best_gains
    assert gains is not None
    print("The process and what was identified (waveform fit):")
    print("                      true   identified     95 % interval          error")
    names = ("gain y/u", "time constant s", "dead time s", "K_u u/y", "w_u rad/s")
    for name, found in zip(names, (*case.parameters, *case.ultimate), strict=True):
        interval = f"{digits(found.low)} to {digits(found.high)}"
        error = 100.0 * (found.value / found.truth - 1.0)
        found_text = f"{digits(found.value):>10}     {interval:<20} {error:+.2f} %"
        print(f"  {name:<16} {found.truth:>7.4g}   {found_text}")
    kind, derivative = ("PID", f", td {digits(gains.td)} s") if gains.td else ("PI", "")
    print(f"{kind} gains ({gains.reason}):")
    print(
        f"  kc {digits(gains.kc)} u/y, ti {digits(gains.ti)} s{derivative}   "
        f"(parallel: p {digits(gains.p)}, i {digits(gains.i)})   "
        f"Ms {gains.ms:.2f}, for 95 % of the models below {gains.ms_95:.2f}"
    )


if __name__ == "__main__":
    sys.exit(main())
