# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What is watched in a tune: an actuator that does not follow, and two where one may be."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest
from virtual_tune import tuned

from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.nodes import watch
from relay_autotune.nodes.readiness import Mark, _expected, _rest_of
from relay_autotune.nodes.relay import RelayNode
from relay_autotune.nodes.watch import (
    FollowWatch,
    LastSamples,
    Overtime,
    Sensor,
    arrival,
    namesake,
    second_publisher,
    second_source,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
from relay_autotune.reasons import Code

LOW, HIGH = 0.5, 1.5
TIMEOUT = 0.4
EVERY = 0.01
UNKNOWN = "_NODE_NAME_UNKNOWN_"


def noticed(
    position: Callable[[float], float],
    stay: float,
    tolerance: Callable[[], float] = lambda: 0.25,
    end: float = 20.0,
) -> float:
    """Return when an actuator under a relay counts as one that does not follow; inf: never.

    :param position: over time [s].
    :param stay: of the relay at a level [s].
    """
    watch = FollowWatch(tolerance, TIMEOUT)
    for k in range(round(end / EVERY)):
        if watch.add(k * EVERY, command(k * EVERY, stay), position(k * EVERY)):
            return k * EVERY
    return float("inf")


def command(time: float, stay: float) -> float:
    return HIGH if int(time / stay + 1e-9) % 2 else LOW


@pytest.mark.parametrize("stay", [0.06, 0.35, 3.0])
@pytest.mark.parametrize("stuck_at", [LOW, 1.0, HIGH, 7.0])
def test_one_that_is_stuck_is_noticed_whether_the_relay_is_fast_or_slow(stay, stuck_at):
    began = 5.0
    found = noticed(lambda t: command(t, stay) if t < began else stuck_at, stay)
    assert began < found <= began + TIMEOUT + max(8.0 * stay, TIMEOUT) + EVERY


@pytest.mark.parametrize("stay", [0.06, 0.35, 3.0])
def test_one_that_lags_by_half_of_a_stay_follows(stay):
    lag = min(0.5 * stay, 0.5 * TIMEOUT)
    assert noticed(lambda t: command(max(t - lag, 0.0), stay), stay) == float("inf")


@pytest.mark.parametrize(("ends", "said"), [((0.0, 5.0), {"low": 0.0, "high": 5.0}), ((9, 9), {})])
def test_one_that_is_clipped_is_told_from_one_that_is_stuck(ends, said):
    watch = FollowWatch(lambda: 50.0, TIMEOUT)
    low, high = ends
    for k in range(400):
        told = 132.0 if k // 40 % 2 else -68.0
        if watch.add(k * EVERY, told, min(max(told, low), high)):
            break
    assert k < 399
    assert watch.rail == said


def test_one_that_lags_by_a_stay_does_not():
    stay = 0.1
    assert noticed(lambda t: command(max(t - stay, 0.0), stay), stay) < 3.0 * TIMEOUT


def test_what_is_told_late_for_less_than_the_timeout_is_no_fault():
    stay, held = 0.06, 0.35

    def position(time: float) -> float:
        since = time % 2.0
        return command(time - since if since < held else time, stay)

    assert noticed(position, stay) == float("inf")


def test_while_an_amplitude_is_found_no_distance_counts():
    stay, found = 0.06, 5.0
    told: list[float] = []

    def position(time: float) -> float:
        told.append(time)
        return LOW

    at = noticed(position, stay, lambda: float("inf") if told[-1] < found else 0.25)
    assert found < at < found + 2.0 * TIMEOUT


class Graph:
    """What a node sees of the graph, in its place.

    :param publishers: of a topic, each as namespace and name.
    :param nodes: each as name and namespace.
    """

    topic_name = "/tank/level"

    def __init__(self, publishers=(), nodes=(("relay_node", "/tank"),)) -> None:
        self.publishers, self.nodes = publishers, nodes

    def get_publisher_count(self) -> int:
        return len(self.publishers)

    def count_publishers(self, _: str) -> int:
        return len(self.publishers)

    def get_publishers_info_by_topic(self, topic: str):
        assert topic == self.topic_name
        return [SimpleNamespace(node_namespace=s, node_name=n) for s, n in self.publishers]

    def get_node_names_and_namespaces(self):
        return list(self.nodes)

    def get_name(self) -> str:
        return "relay_node"

    def get_namespace(self) -> str:
        return "/tank"

    def get_fully_qualified_name(self) -> str:
        return "/tank/relay_node"


def test_two_sources_are_told_with_their_names():
    assert second_source(Graph(), Graph()) is None
    assert second_source(one := Graph([("/tank", "sensor")]), one) is None
    both = Graph([("/tank", "sensor"), ("/", "old_sensor")])
    found = second_source(both, both)
    assert found.code is Code.SECOND_SOURCE and found["count"] == 2
    assert found["others"] == "/old_sensor and /tank/sensor"
    same = Graph([("/tank", "sensor"), ("/tank", "sensor")])
    assert second_source(same, same)["others"] == "/tank/sensor and /tank/sensor"
    new = Graph([("/tank", "sensor"), (UNKNOWN, UNKNOWN)])
    assert second_source(new, new)["others"] == "/tank/sensor and a node not known yet"


def test_a_second_publisher_of_the_own_name_is_told_too():
    mine = ("/tank", "relay_node")
    assert second_publisher(Graph([mine]), "/tank/level") is None
    for there, others in ([("/", "other")], "/other"), ([mine], "/tank/relay_node"):
        found = second_publisher(Graph([mine, *there]), "/tank/level")
        assert found == Code.SECOND_PUBLISHER(topic="/tank/level", others=others)


def test_a_namesake_has_the_name_and_the_namespace():
    mine = ("relay_node", "/tank")
    assert namesake(Graph(nodes=[mine, ("relay_node", "/kiln"), ("plant", "/tank")])) is None
    assert namesake(Graph(nodes=[mine, mine])) == Code.NAMESAKE(count=2, node="/tank/relay_node")


@pytest.mark.parametrize(
    ("rate", "most", "duration", "expected"),
    [
        # The samples' time over the steady clock's: as it is, a bit slow, stuck, nearly stuck.
        (1.0, 100.0, 0.0, None),
        (0.5, 100.0, 0.0, None),
        (0.0, 100.0, 0.0, (Code.TIME_STANDS, "still", 5.0)),
        (1e-6, 100.0, 0.0, (Code.OVERTIME, "lasted", 305.0)),
        (1e-6, math.inf, 40.0, (Code.OVERTIME, "lasted", 125.0)),
    ],
)
def test_a_tune_ends_by_the_steady_clock(monkeypatch, rate, most, duration, expected):
    tune = SimpleNamespace(
        elapsed=0.0,
        latest=most,
        parameters=SimpleNamespace(max_duration=duration, sample_period=0.0),
    )
    present = 1000.0
    monkeypatch.setattr(watch, "now", lambda: present)
    look, why = Overtime(tune, 2.5, simulated=False).problem, None
    # An experiment that goes on by its own time ends by its own limit.
    while why is None and rate * (present - 1000.0) <= most:
        present += 0.05
        tune.elapsed = rate * (present - 1000.0)
        why = look()
    found = why and (why.code, why[expected[1]])
    assert found == (expected and (expected[0], pytest.approx(expected[2], abs=0.1)))


def samples_of(every: float, count: int) -> LastSamples:
    """Return measurements of noise that a node took all at once, as after its start."""
    samples = LastSamples()
    for k in range(count):
        samples.add(1.0 + 0.01 * (-1) ** k, 1_795_714_809_000_000_000 + round(1e9 * every * k))
    return samples


def test_the_rate_of_a_sensor_is_that_at_which_it_publishes():
    assert samples_of(0.025, 100).interval == pytest.approx(0.025, rel=1e-3)
    # Half a second is too short for rest.
    few = samples_of(0.025, 20)
    assert not few.are_enough and few.rest() is None
    rest = samples_of(0.025, 100).rest()
    assert rest is not None and rest.is_steady and rest.span == pytest.approx(2.475, abs=1e-5)


@pytest.mark.parametrize(("every", "count", "span"), [(1e-4, 5000, 0.2), (1.0, 30, 19.0)])
def test_rest_is_told_of_any_sensor_in_the_end(every, count, span):
    """A fast one has no samples of 2 s among those that are kept, a slow one few in 10 s."""
    rest = samples_of(every, count).rest()
    assert rest is not None and rest.span == pytest.approx(span, rel=0.01)


@pytest.mark.parametrize("limit", [40.0, 0.9])
def test_the_swing_is_told_before_the_tune_that_makes_it(limit: float) -> None:
    """It grows to twenty times the noise, or as far as a third of the way to a limit."""
    model, noise = TransferFunction.fopdt(0.5, 1.0, 0.5), 0.02
    within = {"measurement_min": -limit, "measurement_max": limit}
    asked = ExperimentParameters(command_min=-20.0, command_max=20.0, **within)
    plant = VirtualProcess(model, disturbances=Disturbances(noise_std=noise), seed=4)
    samples = LastSamples()
    for k in range(100):
        samples.add(plant.measure(0.05 * k), round(1e9 * (100.0 + 0.05 * k)))
    told, _ = _expected(asked, samples, None)
    assert told.endswith(f"the tune ends at -{limit:g} and {limit:g} y")
    swing = float(told.partition("at least ")[2].partition(" y")[0])
    assert swing == pytest.approx(min(20.0 * noise, limit / 3.0), rel=0.15)
    *_, last = tuned(model, asked, period=0.05, seed=4, noise_std=noise).cycles
    assert 0.5 * (last.peak_max - last.peak_min) == pytest.approx(swing, rel=0.5)
    given = replace(asked, amplitude=1.0)
    told, _ = _expected(given, samples, None)
    assert "not known before the first tune; the tune ends at" in told
    told, mark = _expected(given, samples, (1.0, replace(last, peak_max=2.0, peak_min=-2.0)))
    beyond = f"would end the tune at -{limit:g} or {limit:g} y"
    assert (mark, beyond in told) == ((Mark.NOTE, True) if limit < 2.0 else (Mark.OK, False))
    # The swing that is clear of the noise itself reaches limits so close.
    close = replace(asked, measurement_min=-0.1, measurement_max=0.1)
    told, mark = _expected(close, samples, None)
    assert mark is Mark.NOTE
    assert told.endswith("it would end the tune at -0.1 or 0.1 y: give wider limits")


def test_a_tune_is_asked_for_once_every_other_publisher_must_be_known() -> None:
    """Asked within 3 s of its start, a relay_node overlooked another publisher of its command."""
    timers: list[tuple[float, Callable[[], None]]] = []
    timer = SimpleNamespace(cancel=lambda: None)
    node = SimpleNamespace(
        create_timer=lambda wait, work, clock: timers.append((wait, work)) or timer
    )
    relay = SimpleNamespace(_arrival=arrival(node), _request=lambda *asked: asked)
    request = SimpleNamespace(amplitude=0.5, dry_run=False)
    answer = RelayNode._on_start(relay, request, None)
    answer.send(None)
    ((wait, work),) = timers
    # Fast DDS announces a node every 3 s.
    assert wait > 3.0
    work()
    with pytest.raises(StopIteration) as done:
        answer.send(None)
    assert done.value.value == (0.5, False)


@pytest.mark.parametrize(
    ("given", "every", "timeout"), [(0.0, 0.02, 1.0), (0.0, 2.0, 10.0), (1.0, 2.0, 1.0)]
)
def test_a_silence_is_measured_by_the_rate_of_the_sensor_unless_it_is_given(given, every, timeout):
    values = {"repeat_period": 0.0, "measurement_timeout": given, "use_sim_time": False}
    node = SimpleNamespace(
        get_parameter=lambda name: SimpleNamespace(value=values[name]),
        create_subscription=lambda *_, **__: SimpleNamespace(topic_name="/level"),
        _parameter_overrides={},
    )
    sensor = Sensor(node, reader=SimpleNamespace(kind=None), take=None, repeat=None)
    sensor.samples = samples_of(every, 30)
    assert sensor.timeout == pytest.approx(timeout)
    # A tune begins with no samples of its own.
    sensor.samples.forget()
    assert sensor.timeout == pytest.approx(timeout)


@pytest.mark.parametrize(
    ("noise", "told"),
    [(0.0, "40 y for 10 s; the noise is below the sensor's resolution"), (0.1, "noise of 0.")],
)
def test_a_coarse_sensor_at_rest_is_not_said_to_be_without_noise(noise: float, told: str) -> None:
    samples, begin = LastSamples(), 1_700_000_000_000_000_000
    for k in range(101):
        samples.add(40.0 + noise * (k % 3), begin + k * 100_000_000)
    assert told in str(_rest_of(samples))
