# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Ranges and refusals of the nodes' parameter tables."""

from __future__ import annotations

import math

import pytest
import rclpy

from relay_autotune.cli.own_nodes import free_domain
from relay_autotune.errors import ParameterError
from relay_autotune.nodes.controller import ControllerNode
from relay_autotune.nodes.parameters import descriptor_of
from relay_autotune.nodes.plant import PARAMETERS as PLANT
from relay_autotune.nodes.tables import FIXED_PARAMETERS, TUNE_PARAMETERS
from relay_autotune.quantities import Quantity

LENGTH = Quantity("length", 1.0, "m", 0.5, 2.0).means("How long.")
LIMIT = Quantity("limit", math.inf, "y").means("Where it ends.")
OPTIONAL = Quantity("optional", math.nan, "y").means("Perhaps.")
WORD = Quantity("word", "a", choices=("a", "b")).means("Which.")
TIME = Quantity("time", 0.0, "s").means("When.")
COUNT = Quantity("count", 0, lower=0).means("How many.")
LIST = Quantity("list", (), "s").means("Several.")


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        *((LENGTH, 0.5), (LENGTH, 2.0), (LIMIT, math.inf), (LIMIT, -3.0)),
        *((TIME, 0.0), (TIME, 1e-9), (TIME, -1e9), (COUNT, 10**20)),
        *((OPTIONAL, math.nan), (OPTIONAL, 0.0), (WORD, "b"), (LIST, []), (LIST, [1.0, 2.0])),
    ],
)
def test_what_may_be(entry: Quantity, value: object) -> None:
    assert entry.problem(value) is None


@pytest.mark.parametrize(
    ("entry", "value", "said"),
    [
        (LENGTH, 2.5, "length is 2.5, expected from 0.5 to 2 m"),
        (LENGTH, math.nan, "length is nan, expected from 0.5 to 2 m"),
        (LIMIT, math.nan, "limit is nan, expected any number [y]"),
        (LIMIT, -math.inf, "limit is -inf, expected a finite number"),
        (OPTIONAL, math.inf, "optional is inf, expected a finite number, or NaN where"),
        (OPTIONAL, -1e153, "optional is -1e+153, expected a number of at most 1e+152"),
        (TIME, 1e-10, "time is 1e-10, expected a time from 1e-09 to 1e+09 s, or 0"),
        (TIME, -1e300, "time is -1e+300, expected a time from 1e-09 to 1e+09 s, or 0"),
        (COUNT, 10**400, "count is a number of many digits, expected at least 0"),
        (COUNT, True, "count is True, expected at least 0"),
        (TIME, "9" * 400, f"time is '{'9' * 59}, expected any number [s]"),
        (WORD, "c", "word is 'c', expected one of a, b"),
        (LIST, [1.0, math.nan], "list is [1.0, nan], expected finite numbers"),
    ],
)
def test_what_may_not_be(entry: Quantity, value: object, said: str) -> None:
    problem = entry.problem(value)
    assert problem is not None
    assert problem.startswith(said)


@pytest.mark.parametrize("entry", [*TUNE_PARAMETERS, *FIXED_PARAMETERS, *PLANT])
def test_every_parameter_is_described_and_its_default_allowed(entry: Quantity) -> None:
    descriptor = descriptor_of(entry)
    assert "." in descriptor.description
    assert descriptor.additional_constraints
    if entry.name != "structure":
        assert entry.problem(entry.default) is None
    if descriptor.floating_point_range:
        (span,) = descriptor.floating_point_range
        assert span.from_value <= entry.default <= span.to_value


def test_a_set_point_that_the_sensor_cannot_tell_is_refused_at_the_start() -> None:
    values = ("initial_setpoint:=12.0", "measurement_min:=0.0", "measurement_max:=10.0")
    given = [word for value in values for word in ("-p", value)]
    with free_domain() as domain:
        rclpy.init(args=["--ros-args", *given], domain_id=domain)
        try:
            with pytest.raises(
                ParameterError, match=r"initial_setpoint is 12, beyond .* 0 to .* 10"
            ):
                ControllerNode()
        finally:
            rclpy.try_shutdown()
