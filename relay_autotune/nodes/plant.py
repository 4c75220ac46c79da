# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""plant_node: a simulated process on a measurement and a command topic."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Float64

from relay_autotune.errors import ParameterError
from relay_autotune.exchange.messages import set_stamp
from relay_autotune.nodes import quality
from relay_autotune.nodes.lifetime import STEADY, ServedNode, run
from relay_autotune.nodes.parameters import declare, values_of
from relay_autotune.nodes.quality import QUIET_AFTER_GO, REPEAT_AFTER
from relay_autotune.process.structures import FIELDS, TABLE, structure_named
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Actuator, Disturbances, VirtualProcess
from relay_autotune.quantities import Quantity, declared

MODES = ("realtime", "clock", "lockstep")

# Longest time that simulated time waits for a command [s].
LONGEST_WAIT = 0.2

# Simulated time begins here [s]: zero means "no time yet" to ROS.
CLOCK_START = 1.0

PARAMETERS = (
    Quantity("numerator", ()).means("Coefficients of s in the numerator, highest power first."),
    Quantity("denominator", ()).means(
        "Coefficients of s in the denominator, highest power first."
    ),
    Quantity("structure", "", choices=("", *TABLE)).means(
        "Named structure of the process, instead of the two polynomials."
    ),
    Quantity("gain", 1.0, "y/u").means("Gain of the structure."),
    Quantity("time_constants", (), "s").means("Lags of the structure."),
    Quantity("zeros", (), "s").means("Time constants of the structure's zeros."),
    Quantity("order", 0, "", 0, 50).means("Number of equal lags, for lag_n and lag_n_zero."),
    Quantity("damping", 0.0).means("Damping of the structure's complex pair."),
    Quantity("natural_frequency", 0.0, "rad/s", 0.0).means(
        "Natural frequency of the structure's complex pair."
    ),
    Quantity("dead_time", 0.0, "s", 0.0).means("Dead time of the process."),
    Quantity("sample_period", 0.1, "s", 1e-5).means("Time between samples."),
    Quantity("seed", 0, "", 0).means("Seed of the noise."),
    Quantity("operating_point", ()).means("Measurement [y] and command [u] at rest, y0 and u0."),
    *declared(Disturbances),
    Quantity("command_min", -math.inf, "u").means("Lower limit of the actuator."),
    Quantity("command_max", math.inf, "u").means("Upper limit of the actuator."),
    *declared(Actuator),
    Quantity("jitter", 0.0, "s", 0.0).means(
        "Largest delay of a sample after its time, evenly spread, in the mode realtime."
    ),
    Quantity("loss", 0.0, "", 0.0, 0.9).means(
        "Share of the samples that are not published, in the modes realtime and clock."
    ),
    Quantity("on_change", False).means(
        "True: a sample is published only if it differs from the last one; not in lockstep."
    ),
    Quantity("feedback", False).means(
        "True: the actuator's position is published on command_feedback after each command."
    ),
    Quantity("mode", "realtime", choices=MODES).means(
        "realtime; clock: publishes /clock; lockstep: one step for each command."
    ),
    Quantity("lockstep_speed", 0.0, "", 0.0, 1e4).means(
        "Largest number of simulated seconds per second, in lockstep; 0: no limit."
    ),
    Quantity("speed", 1.0, "", 1e-3, 1e4).means(
        "Simulated seconds in a second, in the mode clock."
    ),
)


def process_from(values: dict[str, Any]) -> VirtualProcess:
    """Build the process that a node's parameters describe.

    :param values: the parameters by name.
    :raises RelayAutotuneError: if they do not describe a process.
    """
    point = values["operating_point"] or (0.0, 0.0)
    if len(point) != 2:
        raise ParameterError(
            f"operating_point must be [measurement, command], found {list(point)}"
        )
    return VirtualProcess(
        model_from(values),
        rest_measurement=point[0],
        rest_command=point[1],
        actuator=Actuator(
            point[1],
            minimum=values["command_min"],
            maximum=values["command_max"],
            **_declared_of(Actuator, values),
        ),
        disturbances=Disturbances(**_declared_of(Disturbances, values)),
        seed=values["seed"],
    )


def _declared_of(kind: type, values: dict[str, Any]) -> dict[str, Any]:
    return {each.name: values[each.name] for each in declared(kind)}


def model_from(values: dict[str, Any]) -> TransferFunction:
    """Build the model that a node's parameters describe, by polynomials or by structure.

    :param values: the parameters by name.
    :raises RelayAutotuneError: if both are given, or neither, or the values contradict each other.
    """
    polynomials = bool(values["numerator"] or values["denominator"])
    if polynomials == bool(values["structure"]):
        raise ParameterError(
            "the process is to be given by numerator and denominator or by structure, "
            f"found {'both' if polynomials else 'neither'}"
        )
    if polynomials:
        return TransferFunction.from_polynomials(
            values["numerator"], values["denominator"], dead_time=values["dead_time"]
        )
    return structure_named(values["structure"]).of_fields(**{f: values[f] for f in FIELDS})


class ImperfectSensor:
    """Imperfections of a real sensor: late samples, lost samples, samples only on change.

    :param values: the node's parameters.
    :raises ParameterError: if one is asked for in lockstep, where every sample must arrive.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        self._jitter, self._loss = values["jitter"], values["loss"]
        self._on_change = values["on_change"]
        self._last = math.nan
        self._random = np.random.default_rng((values["seed"], 1))
        if values["mode"] == "lockstep" and (self._jitter or self._loss or self._on_change):
            raise ParameterError(
                "in lockstep each sample leads to a command and that to the next sample: jitter, "
                "loss and on_change are for the other modes"
            )

    def wait(self) -> None:
        """Delay a sample by a random part of the jitter."""
        if self._jitter > 0.0:
            time.sleep(float(self._random.uniform(0.0, self._jitter)))

    def speaks(self, value: float) -> bool:
        """Return True if a sample is to be published.

        :param value: the sample [y].
        """
        if self._loss > 0.0 and self._random.uniform() < self._loss:
            return False
        if self._on_change and value == self._last:
            return False
        self._last = value
        return True


class PlantNode(ServedNode):
    """A simulated process.

    Sample k is taken at k times the sample period. In real time a command takes effect when it
    arrives; with /clock at the simulated time at which it arrives, that of the last sample; in
    lockstep command k acts from sample k on and leads to sample k + 1.
    """

    def __init__(self) -> None:
        super().__init__("plant_node")
        declare(self, PARAMETERS, read_only=True)
        quality.require_apart(self)
        values = values_of(self, PARAMETERS)
        self._process = process_from(values)
        self._period: float = values["sample_period"]
        self._samples = 0
        self._message = Float64()
        self._sensor = ImperfectSensor(values)
        self._position: Any = None
        # No event callbacks: each one costs time in every turn of the executor.
        # A value that is published only on change must be latched for late subscribers.
        depth = quality.MEASUREMENT.depth
        offered = quality.latched(depth) if values["on_change"] else quality.MEASUREMENT
        self._measurement = quality.publisher(
            self, Float64, "measurement", offered, **quality.OVERRIDABLE
        )
        if values["feedback"]:
            self._position = quality.publisher(self, Float64, "command_feedback", quality.COMMAND)
        received = {
            "realtime": self._on_command_in_time,
            "clock": self._on_command_with_clock,
            "lockstep": self._on_command_in_lockstep,
        }[values["mode"]]
        self._command = quality.subscription(
            self, Float64, "command", received, QoSProfile(depth=1000), **quality.OVERRIDABLE
        )
        self._start = time.monotonic()
        if values["mode"] == "lockstep":
            self.favoured = self._command
            self._waiting = True
            speed = values["lockstep_speed"]
            self._pause = self._period / speed if speed > 0.0 else 0.0
            self._next = 0.0
            self._value = self._process.measure(0.0)
            self.create_timer(REPEAT_AFTER, self._repeat, clock=STEADY)
        elif values["mode"] == "clock":
            # Whether an answer to the last sample is expected, and whether it has come.
            self._waiting = self._answered = False
            self._ticked = 0.0
            self._clock = self.create_publisher(ClockMessage, "/clock", QoSProfile(depth=1))
            self.create_timer(self._period / values["speed"], self._tick, clock=STEADY)
        else:
            self.create_timer(self._period, self._sample, clock=STEADY)
        self.get_logger().info(
            f"mode {values['mode']}, sample period {self._period:g} s, "
            f"measurement on {self._measurement.topic_name}, command on {self._command.topic_name}"
        )

    # Real time: samples by a timer, commands on arrival.

    def _sample(self) -> None:
        self._sensor.wait()
        value = self._process.measure(time.monotonic() - self._start)
        if self._sensor.speaks(value):
            self._publish(value)

    def _on_command_in_time(self, message: Float64) -> None:
        self._process.command(message.data, time.monotonic() - self._start)
        self._tell_position()

    def _tell_position(self) -> None:
        if self._position is not None:
            self._position.publish(Float64(data=self._process.position))

    # Simulated time: constant between two messages of /clock.

    def _tick(self) -> None:
        # Wait for a controller that answered the last sample: on a busy machine simulated time
        # then runs slower, and the commands do not come later in simulated time.
        wall = time.monotonic()
        if self._waiting and wall - self._ticked < LONGEST_WAIT:
            return
        self._ticked = wall
        now = self._samples * self._period
        self._samples += 1
        value = self._process.measure(now)
        message = ClockMessage()
        set_stamp(message.clock, round((CLOCK_START + now) * 1e9))
        self._clock.publish(message)
        # A sample that is not published needs no answer.
        self._waiting = False
        if self._sensor.speaks(value):
            self._waiting, self._answered = self._answered, False
            self._publish(value)

    def _on_command_with_clock(self, message: Float64) -> None:
        self._process.command(message.data)
        self._tell_position()
        self._waiting, self._answered = False, True

    # Lockstep: each command advances the process by one sample.

    def _repeat(self) -> None:
        if not self._waiting:
            # The controller has left: its successor needs the present measurement.
            self._waiting = self._command.get_publisher_count() == 0
        elif self._measurement.get_subscription_count() and self._command.get_publisher_count():
            self._publish(self._value)

    def _on_command_in_lockstep(self, message: Float64, _: dict[str, Any]) -> None:
        self._process.command(message.data)
        self._tell_position()
        if self._waiting:
            self._waiting = False
            time.sleep(QUIET_AFTER_GO)
        if self._pause:
            now = time.monotonic()
            time.sleep(max(self._next - now, 0.0))
            self._next = max(self._next, now) + self._pause
        self._samples += 1
        self._value = self._process.measure(self._samples * self._period)
        self._publish(self._value)

    def _publish(self, value: float) -> None:
        self._message.data = value
        self._measurement.publish(self._message)


def main(args: list[str] | None = None) -> int:
    """Run plant_node."""
    return run(PlantNode, "plant_node", args, PARAMETERS)
