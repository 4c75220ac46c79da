# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of an experiment: the table and what is refused."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest

from relay_autotune.errors import ParameterError
from relay_autotune.experiment.parameters import PARAMETERS, ExperimentParameters
from relay_autotune.experiment.relay_law import Levels


def test_the_table_describes_every_field():
    described = [(p.name, p.default) for p in PARAMETERS]
    for (name, default), field in zip(described, fields(ExperimentParameters), strict=True):
        assert name == field.name
        assert type(default) is type(field.default)
        assert default == field.default or (math.isnan(default) and math.isnan(field.default))
    for parameter in PARAMETERS:
        assert parameter.description.endswith(".")
        assert parameter.problem(parameter.default) is None
        assert parameter.range_text


def test_defaults_with_an_amplitude_are_valid():
    ExperimentParameters(amplitude=1.0).validate(baseline=0.0)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (
            {"amplitude": 0.0},
            "amplitude is 0, to be found within the limits of the command; command_min and "
            "command_max not given: give both limits, or the amplitude",
        ),
        (
            {"amplitude": 0.0, "command_min": 0.0},
            "amplitude is 0, to be found within the limits of the command; command_max not given",
        ),
        ({"amplitude": -1.0}, "amplitude is -1, expected at least 0 u"),
        ({"amplitude": math.nan}, "amplitude is nan, expected"),
        ({"amplitude": math.inf}, "amplitude is inf, expected a finite number"),
        ({"hysteresis": -0.1}, "hysteresis is -0.1, expected at least 0 y"),
        ({"hysteresis": math.nan}, "hysteresis is nan"),
        ({"bias": math.nan}, "bias is nan"),
        ({"bias": 1.0}, "bias is 1, expected less than the amplitude 1"),
        ({"bias_ratio": 1.0}, "bias_ratio is 1, expected between -1 and 1"),
        ({"bias_ratio": -math.inf}, "bias_ratio is -inf"),
        ({"setpoint": math.inf}, "setpoint is inf, expected a finite number"),
        ({"process_gain_sign": 2}, "process_gain_sign is 2, expected from -1 to 1"),
        ({"min_cycles": 1}, "min_cycles is 1, expected from 2"),
        ({"min_cycles": 5, "max_cycles": 4}, "max_cycles is 4, expected at least min_cycles"),
        ({"min_cycles": 2.5}, "min_cycles is 2.5, expected a whole number"),
        ({"min_cycles": math.nan}, "min_cycles is nan, expected"),
        ({"cycle_tolerance": 0.0}, "cycle_tolerance is 0, expected between 0 and 1"),
        ({"settle_time": -1.0}, "settle_time is -1, expected at least 0 s"),
        ({"max_duration": math.inf}, "max_duration is inf, expected a finite number"),
        ({"max_duration": 5.0, "settle_time": 5.0}, "max_duration is 5 s, expected more than"),
        ({"measurement_min": 2.0, "measurement_max": 1.0}, "measurement_min is 2, expected less"),
        ({"measurement_max": math.nan}, "measurement_max is nan"),
        ({"measurement_max": 1.0, "setpoint": 2.0}, "setpoint is 2, expected between"),
        ({"command_max": 1.2}, "the high level of the relay is 1.3"),
        ({"command_min": -0.6}, "the low level of the relay is -0.7"),
        ({"command_min": 0.1}, "the baseline of the relay is 0"),
    ],
)
def test_refused_with_a_sentence(values, sentence):
    with pytest.raises(ParameterError) as error:
        ExperimentParameters(**{"amplitude": 1.0, **values}).validate(baseline=0.0)
    assert str(error.value).startswith(sentence)


def test_without_a_baseline_the_levels_are_not_checked():
    ExperimentParameters(amplitude=1.0, command_max=0.5).validate()


@pytest.mark.parametrize(
    ("given", "baseline", "said"),
    [
        ({}, 0.0, "is at the actuator's end, command_min 0: "),
        ({}, 1.0, "is at the actuator's end, command_max 1: "),
        ({}, 0.005, "is too near to the actuator's end, command_min 0: "),
        ({}, 0.99, "is too near to the actuator's end, command_max 1: "),
        ({"bias": 0.2}, 0.05, "is too near to the actuator's end, command_min 0: "),
        ({"amplitude": 0.1}, 0.0, "is at the actuator's end, command_min 0: "),
    ],
)
def test_an_end_of_the_actuator_is_no_working_point(given, baseline, said):
    parameters = ExperimentParameters(**given, command_min=0.0, command_max=1.0)
    with pytest.raises(ParameterError, match=f"{said}.* at which command does the process rest"):
        parameters.validate(baseline)


def test_the_smallest_relay_fits_where_a_baseline_is_accepted():
    parameters = ExperimentParameters(command_min=0.0, command_max=1.0)
    for baseline in np.linspace(0.0, 1.0, 201):
        uncut = Levels(parameters, float(baseline)).amplitude == pytest.approx(0.01)
        assert uncut == (parameters.why_one_way(float(baseline)) is None)


def test_levels_that_a_load_has_shifted_to_one_side_still_have_a_patience():
    levels = Levels(ExperimentParameters(command_min=0.0, command_max=1.0), 0.01)
    levels.shift(0.1)
    assert levels.low > 0.01
    assert levels.balance > 0.0


@pytest.mark.parametrize("baseline", [math.nan, math.inf])
def test_a_baseline_that_is_no_number_is_refused(baseline):
    with pytest.raises(ParameterError, match="the baseline is"):
        ExperimentParameters(amplitude=1.0).validate(baseline)


def test_levels_that_rounding_makes_equal_are_refused():
    with pytest.raises(ParameterError, match="to tell the two levels apart"):
        ExperimentParameters(amplitude=1.0).validate(baseline=1e20)
