# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Make the bags of this folder: `. ./env.sh && python3 bags/make_bags.py [FOLDER]`.

The first two are recorded by relay_node from a whole tune in lockstep, in processes of their own
over DDS; the third is written as a foreign recorder would, and the fourth as the log of another
tool. What is there already is left alone: old bags stay as they are.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "test" / "support"))

from loop_rig import Rig  # noqa: E402
from ros_domain import free_domain  # noqa: E402

from relay_autotune.bag.writer import BagWriter, Topic, encode_float64  # noqa: E402
from relay_autotune.process.response import response  # noqa: E402
from relay_autotune.process.transfer_function import TransferFunction  # noqa: E402
from relay_autotune.record.record import PiecewiseConstant  # noqa: E402

GAIN, TIME_CONSTANT, DEAD_TIME = 1.65, 20.0, 10.0
PERIOD = 0.2
STEP_START_NS = 1_790_000_000_000_000_000


def record_tune(target: Path, *, plant: dict[str, Any], relay: dict[str, Any]) -> None:
    """Tune 1.65 e^(-10 s)/(20 s + 1) with the real nodes, and keep the bag."""
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain:
        rig = Rig(domain, Path(folder))
        try:
            rig.plant(
                mode="lockstep",
                sample_period=PERIOD,
                structure="fopdt",
                gain=GAIN,
                time_constants=[TIME_CONSTANT],
                dead_time=DEAD_TIME,
                operating_point=[40.0, 2.0],
                **plant,
            )
            node = rig.relay(amplitude=1.0, baseline=2.0, sample_period=PERIOD, **relay)
            rig.identifier()
            answer = rig.tune()
            rig.until(lambda: "is closed with model and gains" in node.log, "the closed bag")
            rig.run_for(1.0)
        finally:
            rig.close()
        shutil.move(rig.bag(answer), target)


def write_step_test(target: Path) -> None:
    """Write a step test of another process, as a robot's own recorder might record it.

    The measurement comes at about 10 Hz with jitter, the command only when it changes; the
    process is 0.8 e^(-3.4 s)/(12 s + 1), the noise white with 0.05 degC.
    """
    rng = np.random.default_rng(20)
    model = TransferFunction.fopdt(0.8, 12.0, 3.4)
    time = np.cumsum(rng.uniform(0.07, 0.13, 1200))
    command = PiecewiseConstant(np.array([20.0, 75.0]), np.array([45.0, 38.0]), 30.0)
    measured = 61.0 + response(model, time, command) + rng.normal(0.0, 0.05, time.size)
    messages = [(0.0, "/reactor/heater", 30.0)]
    messages += [
        (float(t), "/reactor/heater", float(u))
        for t, u in zip(command.times, command.values, strict=True)
    ]
    messages += [
        (float(t), "/reactor/temperature", float(y)) for t, y in zip(time, measured, strict=True)
    ]
    topics = [Topic("/reactor/temperature"), Topic("/reactor/heater")]
    with BagWriter(target, topics, start_ns=STEP_START_NS) as bag:
        for t, topic, value in sorted(messages):
            sent = STEP_START_NS + round(t * 1e9)
            # The recorder receives a message a little later.
            bag.write(
                topic, sent + int(rng.integers(80_000, 400_000)), sent, encode_float64(value)
            )


def write_heater_log(target: Path) -> None:
    """Write the log of a heater as a data logger does: a row for each 2 s, rounded.

    The process is 0.62 e^(-16 s)/(110 s + 1), the noise white with 0.05 degC.
    """
    rng = np.random.default_rng(7)
    model = TransferFunction.fopdt(0.62, 110.0, 16.0)
    time = np.arange(0.0, 900.0, 2.0)
    power = PiecewiseConstant(np.array([60.0, 480.0]), np.array([50.0, 20.0]), 0.0)
    measured = 23.4 + response(model, time, power) + rng.normal(0.0, 0.05, time.size)
    rows = zip(time, measured, power(time), strict=True)
    lines = [f"{t:.0f},{y:.2f},{u:.0f}\n" for t, y, u in rows]
    target.write_text("Time (sec),Temperature 1 (degC),Heater 1 (%)\n" + "".join(lines))


def main() -> int:
    """Make those bags that are missing."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    folder.mkdir(parents=True, exist_ok=True)
    bags = {
        "biased_relay": lambda path: record_tune(path, plant={}, relay={"bias_ratio": 0.3}),
        "unbiased_relay_with_noise": lambda path: record_tune(
            path, plant={"noise_std": 0.02, "seed": 11}, relay={"bias_ratio": 0.0}
        ),
        "step_test": write_step_test,
        "heater.csv": write_heater_log,
    }
    for name, make in bags.items():
        if (folder / name).exists():
            print(f"{folder / name} exists already, left alone", file=sys.stderr)
        else:
            make(folder / name)
            print(folder / name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
