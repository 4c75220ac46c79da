# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Forged results have no effect, and a running fit does not block the node."""

from __future__ import annotations

import math
import signal
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from faulty_loop import DEAD_TIME, DEFAULTS, LATCHED, TIME_CONSTANT, Loop
from loop_rig import Rig
from made_experiments import experiment_of
from mcap.reader import make_reader
from std_srvs.srv import Trigger

from relay_autotune.exchange.messages import float64_array
from relay_autotune.process.transfer_function import TransferFunction as Process
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Outcome
from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment, TransferFunction
from relay_autotune_msgs.srv import Identify

# The played loop, slow enough for a busy machine.
SLOWER = 8.0
LOOP = Process.fopdt(2.0, SLOWER * TIME_CONSTANT, SLOWER * DEAD_TIME)
PROCESS = Process.fopdt(2.0, 0.8, 0.4)
# A fit that computes until a file exists.
SLOW = """
import pathlib, sys
from relay_autotune.nodes import identifier
analyse = identifier.analyse
def slow(*given, **named):
    while not pathlib.Path({flag!r}).exists():
        sum(range(1000))
    return analyse(*given, **named)
identifier.analyse = slow
sys.exit(identifier.main())
"""


def model_of(process: Process, name: str, **changes: Any) -> TransferFunction:
    message = TransferFunction(experiment_id=name, final=True, dead_time=process.dead_time)
    message.numerator = float64_array(process.numerator)
    message.denominator = float64_array(process.denominator)
    for field, value in changes.items():
        setattr(message, field, value)
    return message


def gains_of(process: Process, name: str, **changes: Any) -> PidGains:
    point = ultimate_point(process)
    assert point is not None
    kc, ti = 0.35 * point.gain, 1.5 * point.period
    message = PidGains(experiment_id=name, final=True, kc=kc, ti=ti, b=1.0, p=kc, i=kc / ti)
    message.verdict = PidGains.VERDICT_TRUSTED
    for field, value in changes.items():
        setattr(message, field, value)
    return message


def test_forged_results_end_no_tune_and_are_not_stored(rig: Rig) -> None:
    loop = Loop(rig, slower=SLOWER)
    relay = loop.start()
    loop.set(**DEFAULTS | {"stop_when": "confident", "max_cycles": 1000, "min_cycles": 1000})
    models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
    gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)
    answer = loop.tune()
    name, point = answer.experiment_id, ultimate_point(LOOP)
    assert point is not None
    loop.until_it_oscillates(8)
    rig.until(lambda: loop.cycles, "a whole cycle")

    def refused() -> int:
        return relay.log.count(" refused: ")

    def send(publisher: Any, message: Any) -> None:
        count = refused()
        publisher.publish(message)
        rig.until(lambda: refused() > count, "a refusal")
        assert not loop.experiments, loop.experiments[-1].reason

    running = {"final": False, "ultimate_gain": point.gain, "ultimate_gain_std": 0.0}
    running |= dict.fromkeys(("ms", "ms_low", "ms_high"), math.nan)
    for wrong in (
        {"ultimate_gain": -point.gain},
        {"ultimate_gain": 1e308},
        {"ultimate_gain": math.inf},
        {"ultimate_gain_std": -1.0},
        {"ms": 0.1, "ms_low": 0.1, "ms_high": 0.1},
        {"numerator": float64_array([math.nan])},
        {"std": float64_array([0.0])},
        {"final": True},
    ):
        send(models, model_of(LOOP, name, **{**running, **wrong}))
    send(gains, gains_of(LOOP, name))
    # The same fault with other numbers is not logged again.
    count = refused()
    for k in range(20):
        wrong = {"ultimate_gain": -point.gain * (k + 1.5)}
        models.publish(model_of(LOOP, name, **{**running, **wrong}))
        rig.run_for(0.01)
    # A plausible result on the same topic ends the tune as requested.
    models.publish(model_of(LOOP, name, **running))
    ended = loop.ended()
    assert ended.outcome == RelayExperiment.COMPLETED
    assert "as narrow as asked" in ended.reason
    assert refused() == count
    gains.publish(gains_of(LOOP, name, kc=-1.0, p=-1.0, i=0.0, ti=0.0))
    models.publish(model_of(LOOP, name))
    rig.until(lambda: "the sign of the process" in relay.log, "a refusal")
    gains.publish(gains_of(LOOP, name))
    rig.until(lambda: "is closed with model and gains" in relay.log, "the closed bag")
    (file,) = Path(rig.bag(answer)).glob("*.mcap")
    with file.open("rb") as stream:
        topics = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert topics.count("/pi_gains") == 1
    assert topics.count("/transfer_function") == 2


def test_forged_gains_are_not_applied(rig: Rig) -> None:
    kinds = {
        "relay_experiment": RelayExperiment,
        "transfer_function": TransferFunction,
        "pi_gains": PidGains,
    }
    ends = {name: rig.node.create_publisher(kind, name, LATCHED) for name, kind in kinds.items()}
    controller = rig.start("controller_node", auto_apply=True, kc=0.3, ti=0.8)
    for end in ends.values():
        rig.until(end.get_subscription_count, "the controller_node")

    def in_force() -> list[float]:
        return rig.values("controller_node", "kc", "ti")

    def send(said: str, **messages: Any) -> None:
        # Messages of several topics come in any order, so they are sent until all have come.
        def is_said() -> bool:
            for topic, message in messages.items():
                ends[topic].publish(message)
            rig.run_for(0.1)
            return said in controller.log

        rig.until(is_said, said)
        assert in_force() == [0.3, 0.8]

    ends["relay_experiment"].publish(experiment_of(PROCESS, "ended", outcome=Outcome.ABORTED))
    send("gains come of completed ones alone", pi_gains=gains_of(PROCESS, "ended"))
    send("kc of the gains is nan", pi_gains=gains_of(PROCESS, "done", kc=math.nan))
    send("contradict each other", pi_gains=gains_of(PROCESS, "done", p=1e308))
    send("no record of their experiment has come", pi_gains=gains_of(PROCESS, "done"))
    ends["relay_experiment"].publish(experiment_of(PROCESS, "done"))
    send("no model of their experiment has come", pi_gains=gains_of(PROCESS, "done"))
    for gain, said in ((-2.0, "other sign"), (1e9, "y/u at")):
        send(said, transfer_function=model_of(Process.fopdt(gain, 0.8, 0.4), "done"))
    right = model_of(PROCESS, "done")
    for wrong, said in (
        ({"kc": -0.3, "p": 0.0, "i": 0.0}, "the sign of the process"),
        ({"kc": 1e12, "p": 0.0, "i": 0.0}, "loop gain"),
        ({"ti": 1e-9, "p": 0.0, "i": 0.0}, "does not go with a period"),
        ({"kc": 2.9, "ti": 0.4, "p": 0.0, "i": 0.0}, "unstable loop"),
        ({"law": "klipper_heater", "law_period": 0.1}, "which this node does not run"),
    ):
        send(said, pi_gains=gains_of(PROCESS, "done", **wrong), transfer_function=right)
        assert not rig.call(Trigger, "controller_node/apply", Trigger.Request()).success
        rig.call(Trigger, "controller_node/discard", Trigger.Request())
    good = gains_of(PROCESS, "done")
    ends["pi_gains"].publish(good)
    rig.until(lambda: in_force() == [good.kc, good.ti], "the gains of the experiment")


def test_forged_records_are_refused_and_the_next_one_is_identified(rig: Rig) -> None:
    gains = rig.listen("pi_gains", PidGains)
    identifier = rig.identifier()
    experiments = rig.node.create_publisher(RelayExperiment, "relay_experiment", LATCHED)
    progress = rig.node.create_publisher(RelayExperiment, "relay_progress", LATCHED)
    cycles = rig.node.create_publisher(RelayCycle, "relay_cycle", LATCHED)
    for end in (experiments, progress, cycles):
        rig.until(end.get_subscription_count, "the identifier")
    wrong = experiment_of(PROCESS, "next")
    wrong.settings.amplitude = -1e308
    running = experiment_of(PROCESS, "next", outcome=Outcome.UNKNOWN)
    running.command[7] = 1e308
    for end, message, said in (
        (experiments, wrong, "amplitude of the relay is"),
        (progress, running, "command[7] of the record is 1e+308"),
        (cycles, RelayCycle(experiment_id="other", lead_in=2**32 - 1), "cycle 0 has 0 times"),
    ):
        end.publish(message)
        if end is progress:
            # The message belongs to an experiment that has ended.
            message.experiment_id = "running"
            end.publish(message)
        rig.until(lambda said=said: said in identifier.log, said)
    assert not gains
    experiments.publish(experiment_of(PROCESS, "next"))
    rig.until(lambda: gains, "the gains")
    assert gains[-1].experiment_id == "next"


def begin_slow(rig: Rig, flag: Path) -> Any:
    """Start an identifier_node whose fits last until a file exists, and start a fit."""
    identifier = rig.start_python("identifier", SLOW.format(flag=str(flag)), structure="fopdt")
    experiments = rig.node.create_publisher(RelayExperiment, "relay_experiment", LATCHED)
    rig.until(experiments.get_subscription_count, "the identifier")
    experiments.publish(experiment_of(PROCESS, "first"))
    return identifier, experiments


def test_services_are_answered_while_a_fit_runs_and_results_keep_their_order(
    rig: Rig, tmp_path: Path
) -> None:
    flag = tmp_path / "go on"
    status: list[Any] = rig.listen("identifier_status", DiagnosticStatus)
    gains = rig.listen("pi_gains", PidGains)
    _, experiments = begin_slow(rig, flag)
    rig.until(lambda: status, "the fit")
    assert rig.values("identifier_node", "method") == ["waveform"]
    experiments.publish(experiment_of(PROCESS, "second"))
    client = rig.node.create_client(Identify, "identifier_node/identify")
    rig.until(client.service_is_ready, "the service")
    asked = client.call_async(Identify.Request(experiment=experiment_of(PROCESS, "asked")))
    # The next experiment is received during the fit of the first.
    rig.until(lambda: any(m.values[0].value == "second" for m in status), "the second record")
    assert not gains
    assert not asked.done()
    flag.touch()
    rig.until(lambda: len(gains) > 1 and asked.done(), "the gains")
    assert [message.experiment_id for message in gains] == ["first", "second"]
    assert gains[0].kc == gains[1].kc == asked.result().gains[0].kc


def test_ctrl_c_ends_a_fit(rig: Rig, tmp_path: Path) -> None:
    status = rig.listen("identifier_status", DiagnosticStatus)
    identifier, _ = begin_slow(rig, tmp_path / "never")
    rig.until(lambda: status, "the fit")
    identifier.signal(signal.SIGINT)
    assert identifier.wait() == 0
    assert "Traceback" not in identifier.log
