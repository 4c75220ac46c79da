# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Exported gains arrive as the numbers they are, the way `ros2 param load` reads them."""

from __future__ import annotations

import configparser
import json
import math
import re
import shutil
import subprocess
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml
from fopdt_plant import FopdtPlant
from hypothesis import given
from hypothesis import strategies as st

from relay_autotune.cli import replay, terminal, tune
from relay_autotune.errors import ParameterError, SelectionError
from relay_autotune.exchange.export import Target, exported, number, plain, settings
from relay_autotune.loop.gains import Gains, Performance
from relay_autotune.loop.laws import LAWS
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning import tune as tune_model
from relay_autotune.tuning.task import DesignOptions

PERFORMANCE = Performance(
    ms=1.4,
    mt=1.0,
    gain_margin=math.inf,
    phase_margin=1.0,
    delay_margin=20.0,
    iae_load=31.0,
)


def gains(*values: float, **more: float) -> Gains:
    reason = 'so "fast": it is'
    return Gains(*values, **vars(PERFORMANCE), **more, rule="imc", ms_95=1.41, reason=reason)


def pid_controller(made: Gains, target: Target) -> str:
    return settings(made, LAWS["pid_controller"], target)


def as_loaded(text: str, prefix: str = "") -> dict[str, object]:
    """Read parameters the way rclpy does: YAML, then each value as text, then YAML again."""
    (section,) = yaml.safe_load(text).values()

    def flat(values: dict[str, object], before: str) -> dict[str, object]:
        found: dict[str, object] = {}
        for name, value in values.items():
            assert isinstance(name, str), f"the name {name!r} is no text"
            if isinstance(value, dict):
                found |= flat(value, f"{before}{name}.")
            else:
                found[before + name] = yaml.safe_load(str(value))
        return found

    return flat(section["ros__parameters"], prefix)


# Below these a number has fewer digits.
@given(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False))
def test_every_number_arrives_as_a_double(value):
    text = number(value)
    read = yaml.safe_load(text)
    assert type(read) is float
    again = yaml.safe_load(str(read))
    assert type(again) is float
    assert again == pytest.approx(value, rel=1e-9, abs=0.0)


@pytest.mark.parametrize(
    "value", [2.0, 1e-5, 1e16, 3e-5, -1e-7, 1e22, 0.00012, np.float64(1e-5), 0]
)
def test_the_numbers_that_are_known_to_fail_otherwise(value):
    assert type(yaml.safe_load(str(yaml.safe_load(number(value))))) is float


def test_what_pid_controller_gets():
    text = pid_controller(gains(0.82, 59.9), Target("/oven/pid_controller", "heater", 0.0, 100.0))
    assert list(yaml.safe_load(text)) == ["/oven/pid_controller"]
    assert as_loaded(text) == {
        "gains.heater.p": pytest.approx(0.82),
        "gains.heater.i": pytest.approx(0.82 / 59.9),
        "gains.heater.d": 0.0,
        "gains.heater.u_clamp_max": 100.0,
        "gains.heater.u_clamp_min": 0.0,
        "gains.heater.antiwindup_strategy": "back_calculation",
        "gains.heater.tracking_time_constant": pytest.approx(59.9),
    }


@pytest.mark.nightly
def test_an_export_says_what_was_predicted(capsys):
    asked = ["--law", "ardupilot_rate", "--pid", "--noise-std", "0.02", "--amplitude", "0.5"]
    for how in ("ardupilot_rate", "yaml"):
        assert tune.main([*OVEN, *asked, "--export", how]) == 0
        text = capsys.readouterr().out
        made = tune_model(
            TransferFunction.fopdt(1.65, 20.0, 10.0),
            options=DesignOptions(
                controller="pid", sample_period=0.5, law="ardupilot_rate", noise_std=0.02,
                amplitude=0.5,
            ),
        )  # fmt: skip
        # What the program does at the first sample of a step from rest.
        first = LAWS["ardupilot_rate"].at(made, 0.5).running().step(1.0, 0.0)
        predicted = [100.0 * made.overshoot, 2.0, made.settling_time, first]
        predicted += [0.02, 0.02 * made.noise_gain]
        told = re.findall(r"\d+(?:\.\d+)?", "".join(text.splitlines()[3:5]))
        assert [float(word) for word in told] == pytest.approx(predicted, rel=0.03)
    bare = exported(replace(gains(1.0, 2.0), noise_gain=3.0), "yaml", Target())
    assert "# The command has 3.00 u/y times the measurement's noise." in bare
    assert "step of the set-point" not in bare


@pytest.mark.parametrize("law", ["iec_61131_3_pid", "arduino_pid_v1", "control_toolbox_none"])
@pytest.mark.parametrize("gain", [1.65, -1.65])
def test_an_export_says_up_to_which_step_its_promise_holds(law, gain):
    process = TransferFunction.fopdt(gain, 20.0, 10.0)
    asked = DesignOptions(controller="pid", sample_period=0.5, law=law)
    made = tune_model(process, "imc", options=asked)
    oven = Target(command_min=0.0, command_max=100.0, present=40.0, model=process)
    words = r"From 40 u steps down to (\S+) and up to (\S+) y meet no limit\."
    (ends,) = re.findall(words, exported(made, law, oven))
    for end in map(float, ends):
        for share, fits in ((0.97, True), (1.03, False)):
            running, plant = LAWS[law].at(made, 0.5).running(), FopdtPlant(gain, 20.0, 10.0)
            command, commands = 0.0, []
            for k in range(400):
                command = running.step(share * end, plant.advance(0.5 * k, command))
                commands.append(40.0 + command)
            assert (min(commands) >= 0.0 and max(commands) <= 100.0) == fits
    assert "meet no limit" not in exported(made, law, replace(oven, present=math.nan))


def test_infinite_clamps_are_left_out():
    text = pid_controller(gains(0.82, 59.9), Target(command_max=5.0))
    assert "inf" not in text
    assert "gains.joint.u_clamp_min" not in as_loaded(text)
    assert as_loaded(text)["gains.joint.u_clamp_max"] == 5.0


def test_gains_without_integral_action_have_nothing_to_wind_up():
    found = as_loaded(pid_controller(gains(0.5, 0.0), Target()))
    assert found["gains.joint.antiwindup_strategy"] == "none"
    assert found["gains.joint.i"] == 0.0
    assert "gains.joint.tracking_time_constant" not in found


def test_negative_gains_are_said_in_the_file():
    text = pid_controller(gains(-2.0, 4.0, 1.0), Target())
    assert "All gains are negative" in text
    assert as_loaded(text)["gains.joint.tracking_time_constant"] == pytest.approx(2.0)


def test_gains_for_no_program_are_not_written_for_one_that_lacks_their_filter():
    with pytest.raises(SelectionError, match="give --law pid_controller"):
        exported(gains(2.0, 4.0, 1.0, 0.1, b=0.0), "pid_controller", Target())


@pytest.mark.parametrize("law", [name for name, law in LAWS.items() if law.sets_gains])
def test_gains_of_a_controller_that_runs_can_be_loaded_whatever_its_strategy(law: str) -> None:
    made = gains(2.0, 4.0, law=law, law_period=0.01)
    target = Target("/robot1/arm", "odd/name", is_set_up=True)
    text = exported(made, law, target)
    assert list(yaml.safe_load(text)) == ["/robot1/arm"]
    found = {"p": 2.0, "i": 0.5, "d": 0.0}
    row = law.removesuffix("_velocity")
    if row in ("pid_controller", "control_toolbox_back_calculation"):
        found["tracking_time_constant"] = 4.0
    assert as_loaded(text) == {f"gains.odd/name.{n}": v for n, v in found.items()}
    # Its rate is known, and it has no such flag.
    assert "--sample-period" not in text
    strategy = as_loaded(exported(made, law, Target()))["gains.joint.antiwindup_strategy"]
    assert row in ("pid_controller", f"control_toolbox_{strategy}")


@pytest.mark.parametrize("name", ["yes", "on", "null", "Off", "2nd", "1.5", "-", "a-b", "a/b"])
def test_a_name_that_yaml_has_other_plans_for(name):
    assert f"gains.{name}.p" in as_loaded(pid_controller(gains(1.0, 1.0), Target(dof=name)))


@pytest.mark.parametrize(
    "wrong",
    [
        {"node": "pid controller"},
        {"node": "/a//b"},
        {"dof": "2nd/"},
        {"dof": "a: b"},
        {"command_min": 3.0, "command_max": 3.0},
        {"command_min": math.nan},
    ],
)
def test_targets_that_cannot_be(wrong):
    with pytest.raises(SelectionError):
        Target(**wrong)


def test_a_file_for_controller_node_begins_with_the_line_that_starts_it():
    names = " --ros-args -r measurement:=TOPIC -r controller_command:=TOPIC"
    topics = {"measurement": "/level", "controller_command": "/valve"}
    for target, more in ((Target(), names), (Target(topics=topics), "")):
        first, *_ = exported(of_law(""), "controller_node", target).splitlines()
        assert first == f"# controller_node --gains FILE{more}"


def test_plain_lines():
    found = yaml.safe_load(plain(gains(1e-5, 2.0), Target()))
    assert found["kc"] == pytest.approx(1e-5)
    assert all(type(found[name]) is float for name in ("kc", "ti", "td", "p", "i", "d", "b", "ms"))
    assert (found["rule"], found["form"]) == ("imc", "isa")
    assert found["gain_margin"] is None
    assert found["reason"] == 'so "fast": it is'


def test_a_file_is_never_overwritten(tmp_path):
    path = tmp_path / "gains.yaml"
    terminal.write("a: 1.0\n", str(path))
    assert path.read_text() == "a: 1.0\n"
    with pytest.raises(SelectionError, match="not overwriting"):
        terminal.write("a: 2.0\n", str(path))
    with pytest.raises(SelectionError, match="cannot be written"):
        terminal.write("a: 2.0\n", str(tmp_path / "none" / "gains.yaml"))


def test_numbers_of_numpy_are_written_like_any_other():
    model = TransferFunction.fopdt(1.0, 1.0, 1.0)
    assert model.gain == 1.0
    text = pid_controller(gains(np.float64(0.5), np.float64(2.0)), Target())
    assert "float64" not in text


@pytest.mark.nightly
def test_replay_exports_the_gains_of_a_recording(capsys):
    bag = "bags/biased_relay"
    asked = ["--rule", "imc", "--loop-delay", "0.5", "--export", "pid_controller", "--dof", "oven"]
    assert replay.main([*asked, bag]) == 0
    found = as_loaded(capsys.readouterr().out)
    # 1.65 e^(-10 s)/(20 s + 1) with half a second more, and half of the recording's 0.2 s.
    assert found["gains.oven.p"] == pytest.approx(25.3 / (1.65 * 1.7 * 10.6), rel=1e-6)
    # The program has neither a filter nor a set-point weight, which those of robust have.
    assert replay.main(["--export", "pid_controller", "--pid", "bags/step_test"]) == 0
    text = capsys.readouterr().out
    assert "tf 0 s, b 1." in text and "Designed for pid_controller every 0.0985 s." in text
    assert "# PID with the smallest IAE after a load step, with Ms <= 1.4 " in text
    told = "one bag alone, and 2 are given: name one, such as bags/biased_relay"
    for more, why in (("bags/step_test", told), ("--json", "leave out --json")):
        assert replay.main([*asked, bag, more]) == 2
        assert why in capsys.readouterr().err
    assert replay.main(["--ms", "9", bag]) == 2
    assert "--ms is 9, expected from 1.2 to 4" in capsys.readouterr().err


OVEN = ("--gain", "1.65", "--time-constants", "20", "--dead-time", "10", "--sample-period", "0.5")


def settings_of(text: str) -> dict[str, str]:
    """Read lines of `name: value`, `name = value` and the like."""
    found = re.findall(
        r"^ *(?:const auto |#define |param set )?(\w+)(?:: | :?= |=|,| )([^;\n]+?),?;?$",
        text,
        re.M,
    )
    return {name: value for name, value in found if not name.startswith("_")}


@pytest.mark.long
@pytest.mark.parametrize("name", [n for n, law in LAWS.items() if not law.sets_gains])
def test_a_law_gets_its_settings_in_the_words_of_its_program(name, capsys):
    limits = ["--command-min", "0", "--command-max", "1"] * bool(LAWS[name].unset)
    assert tune.main([*OVEN, "--pid", "--rule", "imc", "--export", name, *limits]) == 0
    text = capsys.readouterr().out
    law = LAWS[name]
    lines = text.splitlines()
    assert all(line.startswith(law.remark) for line in lines[:6])
    assert f"Designed for {name} every 0.5 s." in text
    found = settings_of("\n".join(line for line in lines if not line.startswith(law.remark)))
    assert [n for n in found if n in {s.name for s in law.settings}] == [
        each.name for each in law.settings
    ]
    gains = tune_model(
        TransferFunction.fopdt(1.65, 20.0, 10.0),
        "imc",
        options=DesignOptions(controller="pid", sample_period=0.5, law=name),
    )
    for each in law.settings:
        value = each.of(law.at(gains, 0.5))
        told = found[each.name]
        assert told == value if isinstance(value, str) else float(told) == pytest.approx(value)


@pytest.mark.parametrize(("gain", "kp"), [("1.65", "negative"), ("-1.65", "positive")])
def test_a_block_with_the_other_error_says_the_sign_of_its_gain(gain, kp, capsys):
    asked = [*OVEN, "--gain", gain, "--rule", "imc", "--export", "iec_61131_3_pid"]
    assert tune.main(asked) == 0
    text = capsys.readouterr().out
    assert f"// This block forms ERROR = PV - SP, so KP is {kp} here, with kc " in text
    assert (float(settings_of(text)["KP"]) > 0.0) == (kp == "positive")


def of_law(law: str, kc: float = 2.0) -> Gains:
    return replace(gains(kc, 5.0), law=law, law_period=0.5)


PERCENT = {"y": "°C", "u": "%"}
OF_OVEN = Target(command_min=0.0, command_max=100.0, present=35.0)


@pytest.mark.parametrize("target", [OF_OVEN, Target()], ids=["told", "unknown"])
def test_simple_pid_runs_what_is_exported(target):
    module = pytest.importorskip("simple_pid")
    made: dict[str, Any] = {}
    exec(exported(of_law("simple_pid"), "simple_pid", target), made)
    pid = made["pid"]
    assert isinstance(pid, module.PID)
    assert pid.tunings == pytest.approx((2.0, 0.4, 0.0))
    assert (pid.sample_time, pid.proportional_on_measurement) == (0.5, False)
    known = target is OF_OVEN
    assert pid.output_limits == ((0.0, 100.0) if known else (None, None))
    pid.setpoint = 20.0
    (said,) = re.findall("# command = (.*)", exported(of_law("simple_pid"), "simple_pid", target))
    # However soon after the call before: a timer's come early half of the time.
    expected = (35.0, 37.2, 37.4, 100.0) if known else (0.0, 2.2, 2.4, 264.4)
    told = [eval(said, {"pid": pid, "measurement": y}) for y in (20.0, 19.0, 19.0, -100.0)]
    assert told == pytest.approx(expected)


def test_a_sketch_is_not_written_without_the_limits_of_its_command():
    # PID_v1 has 0 to 255 unless it is told others, which fits a command of analogWrite alone.
    for some in (Target(), Target(command_min=0.0), Target(command_max=100.0)):
        with pytest.raises(SelectionError, match="--command-min and --command-max"):
            exported(of_law("arduino_pid_v1"), "arduino_pid_v1", some)


@pytest.mark.parametrize(
    ("known", "limits"),
    [
        ({"command_max": 80.0}, (0.0, 80.0)),
        ({"command_min": -20.0}, (-20.0, 100.0)),
        # A brake, and a pump above its rated speed.
        ({"recorded": (-40.0, 40.0)}, (-100.0, 100.0)),
        ({"recorded": (0.0, 110.0), "command_max": 120.0}, (0.0, 120.0)),
    ],
)
def test_a_command_in_percent_has_its_limits_in_every_program(known, limits):
    in_percent = Target(units=PERCENT, present=30.0, **known)
    low, high = limits
    sketch = exported(of_law("arduino_pid_v1"), "arduino_pid_v1", in_percent)
    found = settings_of(sketch)
    assert (found["OutputMin"], found["OutputMax"]) == (f"{low}", f"{high}")
    assert found["StartOutput"] == "30.0"
    assert "scale them for the output." in sketch
    assert "kc 2 %/°C" in sketch and "rested at 30 %" in sketch
    told = f"Commands are in %, from {low:g} to {high:g} (0 to 100 unless others are given)"
    script = exported(of_law("simple_pid"), "simple_pid", in_percent)
    assert f"output_limits=({low}, {high})" in script
    block = exported(of_law("iec_61131_3_pid"), "iec_61131_3_pid", in_percent)
    assert f"set in the program; set them to {low:g} and {high:g}." in block
    assert all(told in text for text in (sketch, script, block))
    clamps = list(as_loaded(pid_controller(gains(2.0, 5.0), in_percent)).values())[-2:]
    assert clamps == [high, low]


def test_a_command_in_percent_beyond_its_range_has_no_limit_there():
    beyond = Target(units=PERCENT, recorded=(-1.0, 110.0))
    assert "output_limits=(-100.0, None)" in exported(of_law("simple_pid"), "simple_pid", beyond)


@pytest.mark.parametrize(
    "target", [OF_OVEN, replace(OF_OVEN, command_min=20.0, present=math.nan)], ids=str
)
def test_an_arduino_sketch_compiles_and_starts_from_the_present_command(tmp_path, target):
    text = exported(of_law("arduino_pid_v1", -2.0), "arduino_pid_v1", target)
    (tmp_path / "PID_v1.h").write_text(PID_V1)
    (tmp_path / "sketch.cpp").write_text(text + SHOW)
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    program = tmp_path / "sketch"
    given = [compiler, "-I", str(tmp_path), str(tmp_path / "sketch.cpp"), "-o", str(program)]
    subprocess.run(given, check=True)
    told = subprocess.run([program], check=True, capture_output=True, text=True).stdout.split()
    known = target is OF_OVEN
    low, start = (0.0, 35.0) if known else (20.0, 20.0)
    assert ("The process rested at 35 u." in text) == known
    assert ("It is not known here: put it in place of 20." in text) != known
    assert [float(word) for word in told] == [
        2.0,
        0.4,
        0.0,
        1.0,
        1.0,
        low,
        100.0,
        500.0,
        1.0,
        start,
        21.0,
        21.0,
    ]


# The interface of the library, which keeps what it is given.
PID_V1 = """
#include <cstdio>
#define AUTOMATIC 1
#define DIRECT 0
#define REVERSE 1
#define P_ON_M 0
#define P_ON_E 1
class PID {
 public:
  PID(double* input, double* output, double* setpoint, double p, double i, double d, int on,
      int direction)
      : input(input), output(output), setpoint(setpoint) {
    std::printf("%g %g %g %d %d ", p, i, d, on, direction);
  }
  void SetOutputLimits(double low, double high) { std::printf("%g %g ", low, high); }
  void SetSampleTime(int period) { std::printf("%d ", period); }
  void SetMode(int mode) { std::printf("%d %g %g %g", mode, *output, *input, *setpoint); }
 private:
  double *input, *output, *setpoint;
};
"""
SHOW = "int main() { startController(21.0); }"


def test_a_printer_reads_its_heater():
    of_heater = Target(command_min=0.0, command_max=0.8, present=0.35)
    text = exported(of_law("klipper_heater"), "klipper_heater", of_heater)
    printer = configparser.RawConfigParser(strict=False, inline_comment_prefixes=(";", "#"))
    printer.optionxform = str
    printer.read_string(text)
    (section,) = printer.sections()
    assert dict(printer[section]) == {
        "control": "pid",
        "pid_Kp": "510.0",
        "pid_Ki": "102.0",
        "pid_Kd": "0.0",
        "max_power": "0.8",
    }


def test_esphome_gets_a_climate():
    of_heater = Target(command_min=0.0, command_max=1.0, present=0.35)
    (climate,) = yaml.safe_load(exported(of_law("esphome_pid"), "esphome_pid", of_heater))[
        "climate"
    ]
    assert climate["platform"] == "pid"
    assert climate["control_parameters"] == {
        "kp": 2.0,
        "ki": pytest.approx(0.4),
        "kd": 0.0,
        "output_averaging_samples": 1,
        "starting_integral_term": 0.35,
    }


@pytest.mark.parametrize(
    ("law", "factor"), [("klipper_heater", 255.0), ("marlin_heater", 255.0), ("esphome_pid", 1.0)]
)
@pytest.mark.parametrize(
    ("target", "full"),
    [
        (Target(units=PERCENT, recorded=(0.0, 60.0)), 100.0),
        # The full command, not the limit, is what the program calls 1.
        (Target(units=PERCENT, command_min=0.0, command_max=80.0), 100.0),
        (Target(command_min=0.0, command_max=255.0, recorded=(0.0, 200.0)), 255.0),
        (Target(recorded=(0.0, 0.9)), 1.0),
        (Target(), 1.0),
    ],
    ids=["percent", "limited percent", "counts", "already", "unknown"],
)
def test_a_program_of_outputs_from_0_to_1_gets_gains_for_them(law, factor, target, full):
    """Its loop is that of the record: gain times full command is the same in both."""
    text = exported(of_law(law), law, target)
    p, i, _ = gains_in(text)
    assert full * p / factor == pytest.approx(2.0)
    assert full * i / factor == pytest.approx(0.4)
    assert (f"is 1 where the command is {full:g}" in text) == (full > 1.0)


def gains_in(text: str) -> tuple[float, ...]:
    """Return the three gains of a file, in its own words."""
    found = settings_of(text)
    named = {name.lower()[-2:]: value for name, value in found.items()}
    return tuple(float(named[name]) for name in ("kp", "ki", "kd"))


@pytest.mark.parametrize("law", [name for name, law in LAWS.items() if law.full])
def test_commands_beyond_a_program_are_refused_where_their_full_range_is_not_known(law):
    for beyond in (Target(recorded=(0.0, 60.0)), Target(present=60.0), Target(command_min=-5.0)):
        with pytest.raises(SelectionError, match=r"commands here go to \d+: say .*--command-max"):
            exported(of_law(law), law, beyond)


def test_a_printer_gets_its_largest_power_in_its_own_scale():
    limited = Target(units=PERCENT, command_min=0.0, command_max=80.0)
    found = settings_of(exported(of_law("klipper_heater"), "klipper_heater", limited))
    assert float(found["max_power"]) == pytest.approx(0.8)


def test_esphome_cools_by_its_negative_half():
    """Its kp is positive; cool_output gets -output (write_output_ of its pid_climate.cpp)."""
    text = exported(
        of_law("esphome_pid", -2.0), "esphome_pid", Target(units=PERCENT, present=30.0)
    )
    (climate,) = yaml.safe_load(text)["climate"]
    found = climate["control_parameters"]
    setpoint, measured = 20.0, 21.0
    output = found["kp"] * (setpoint - measured) + found["starting_integral_term"]
    # A degree too warm: 2 % more cooling than the 30 % at rest.
    assert -output == pytest.approx(0.32)
    assert "let it be the cool_output" in text


@pytest.mark.parametrize(
    ("law", "name", "unset"),
    [
        ("simple_pid", "starting_output", "0.0"),
        ("esphome_pid", "starting_integral_term", None),
        ("iec_61131_3_pid", "X0", None),
    ],
)
def test_a_program_starts_from_the_command_at_which_the_process_rests(law, name, unset):
    unknown = exported(of_law(law, -2.0), law, Target())
    assert "Start without a bump" in unknown and settings_of(unknown).get(name) == unset
    done = ", and is left out." if unset is None else ": put it in place of 0."
    assert f"It is not known here{done}" in unknown
    found = settings_of(exported(of_law(law, -2.0), law, Target(present=0.35)))
    # Before it runs, the block of IEC 61131-3 gives KP X0; the others' first output is theirs, of
    # which that of ESPHome is negative where it cools.
    factor = {"X0": float(found.get("KP", 1.0)), "starting_integral_term": -1.0}.get(name, 1.0)
    assert factor * float(found[name]) == pytest.approx(0.35)


@pytest.mark.long
def test_replay_writes_the_gains_for_the_cycle_that_the_recording_shows(tmp_path, capsys):
    file = tmp_path / "fb.txt"
    asked = ["--export", "iec_61131_3_pid", "-o", str(file), "bags/step_test"]
    assert replay.main(asked) == 0
    shown = capsys.readouterr()
    assert shown.out == ""
    text = file.read_text()
    assert "CYCLE := T#98.5ms;" in text
    # A block whose error is a share of a measuring range would get a gain far too low.
    assert "// KP is in u/y: a block that scales to measuring ranges takes" in text
    # The tank of this recording rests at 30 before its steps.
    found = settings_of(text)
    assert float(found["KP"]) * float(found["X0"]) == pytest.approx(30.0)
    assert "If it runs at another period, export again with --sample-period." in text
    # What a block without a filter costs stands in the file, and is said beside it.
    (cost,) = re.findall("// (iec_61131_3_pid does worse .*)", text)
    assert re.search(r"an overshoot of \d+ % instead of \d+ %.*; it has no filter to set", cost)
    assert f"bags/step_test: {cost}" in shown.err
    # At once, before what takes seconds.
    assert replay.main([*asked[:-1], "no_such_bag"]) == 2
    assert "exists already, not overwriting it" in capsys.readouterr().err


def test_gains_for_one_law_are_not_exported_for_another(capsys):
    asked = [*OVEN, "--rule", "imc", "--law", "simple_pid"]
    assert tune.main([*asked, "--export", "klipper_heater"]) == 2
    assert "the gains are for simple_pid: give --law klipper_heater" in capsys.readouterr().err
    assert tune.main([*asked, "--export", "simple_pid", "--command-max", "1"]) == 0
    assert "output_limits=(None, 1.0)" in capsys.readouterr().out
    assert tune.main([*asked, "--export", "yaml"]) == 0
    plain_law = exported(gains(1.0, 5.0), "yaml", Target())
    assert "law" not in plain_law
    with pytest.raises(SelectionError, match="give --law esphome_pid"):
        exported(gains(1.0, 5.0), "esphome_pid", Target())


def test_a_document_tells_the_law_and_without_one_nothing(capsys):
    tune.main([*OVEN, "--rule", "imc", "--law", "oscat_ft_pid", "--json"])
    (told,) = json.loads(capsys.readouterr().out)["gains"]
    assert (told["law"], told["law_period"]) == ("oscat_ft_pid", 0.5)
    tune.main([*OVEN, "--rule", "imc", "--json"])
    (told,) = json.loads(capsys.readouterr().out)["gains"]
    assert "law" not in told
    assert "law_period" not in told


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_number_that_is_not_finite_is_refused(value):
    with pytest.raises(ParameterError, match="expected a finite number"):
        number(value)
