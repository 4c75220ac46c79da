# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The control laws that other programs run, as rows of one table.

A row says which law it is, how its program names and scales the gains, and what a file of its
settings looks like. From it follow the design for it, that file, and the table in the guide. A row
is written from the source of the program, in the version that it names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from relay_autotune.loop.law import (
    FIRST_ORDER,
    FOUR_SAMPLES,
    MEAN,
    ON_MEASUREMENT,
    Integral,
    Law,
    LawRate,
    SampledLaw,
    Slope,
    averaged_over,
)


@dataclass(frozen=True)
class Setting:
    """A parameter of the program that runs a law.

    :param name: its name there.
    :param value: its value, or a function of the law with its gains; text is written as it is.
    """

    name: str
    value: float | str | Callable[[SampledLaw], float | str | None]

    def of(self, law: SampledLaw) -> float | str | None:
        """Return the value for a law with its gains; None: it is left out."""
        return self.value(law) if callable(self.value) else self.value


# Returns names and values for the lowest and the highest command; None: it is left out.
Bounds = Callable[[float, float], tuple[tuple[str, float | str | None], ...]]


@dataclass(frozen=True)
class Start:
    """How a program begins from the present command.

    :param words: what to do, a sentence.
    :param name: the input that takes the value; empty: it has none.
    :param value: of that input, from the law with its gains and the command [u].
    :param needs: True if its text is code, which has a value to replace where none is known.
    """

    words: str
    name: str = ""
    value: Callable[[SampledLaw, float], float] = lambda _law, command: command
    needs: bool = False


@dataclass(frozen=True, kw_only=True)
class ProgramLaw(Law):
    """A control law, and the program that runs it.

    :param program: the program and the version whose source was read.
    :param equation: the difference equation.
    :param limits: what happens at the limits of the command.
    :param settings: its parameters.
    :param form: of its gains, parallel (p, i, d) or ideal (gain and times).
    :param command: unit and scale of the command.
    :param full: its largest command; 0: it may be any.
    :param turned: what to know where a higher command lowers the measurement and its program takes
        that command with the other sign; empty: it takes it as it is.
    :param head: what stands above its settings, with ``{node}`` and ``{dof}``.
    :param line: how a setting is written, with ``{name}`` and ``{value}``.
    :param tail: what stands below them.
    :param bounds: its settings for the limits of the command, of which each may be infinite;
        None: they are set elsewhere in the program.
    :param unset: the limits that its program takes where none are set; empty: it has none then.
    :param remark: beginning of a line that is a comment.
    :param sign: what to know where its gains have not the sign of kc; ``{sign}`` is theirs.
    :param start: how it begins from the present command; None: its program has no way.
    :param ending: of the name of a file with its settings.
    :param scale: what to know where its program scales the gains; empty: it does not.
    """

    program: str
    equation: str
    limits: str
    settings: tuple[Setting, ...]
    form: str = "parallel"
    command: str = "any"
    full: float = 0.0
    turned: str = ""
    head: str = ""
    line: str = "{name}: {value}"
    tail: str = ""
    bounds: Bounds | None = None
    unset: str = ""
    remark: str = "#"
    sign: str = ""
    start: Start | None = None
    ending: str = "yaml"
    scale: str = ""

    @property
    def sets_gains(self) -> bool:
        """True if its parameters p, i and d are the gains themselves."""
        return [each.name for each in self.settings[:3]] == ["p", "i", "d"]


def _gains(
    names: str, fields: str = "p i d", of: Callable[[float], float] = lambda gain: gain
) -> tuple[Setting, ...]:
    """Return the settings that are gains.

    :param names: of the settings.
    :param fields: which of the gains each is; default: those of the parallel form.
    :param of: returns what is written for a gain.
    """

    def setting(name: str, field: str) -> Setting:
        return Setting(name, lambda law: of(float(getattr(law.gains, field))))

    return tuple(map(setting, names.split(), fields.split()))


def _or_none(limit: float) -> float | None:
    return limit if math.isfinite(limit) else None


def _of_255(gain: float) -> float:
    return 255.0 * gain


def _strategy(name: str) -> Setting:
    """Return the anti-windup strategy of control_toolbox; none without an integral."""
    return Setting("antiwindup_strategy", lambda law: name if law.gains.ti > 0.0 else "none")


# Blocks of a PLC often work in shares of measuring ranges.
_SHARES = (
    "KP is in u/y: a block that scales to measuring ranges takes KP times the range of its "
    "measurement over that of its command."
)
_TOOLBOX = "control_toolbox::Pid of ros-controls, 4.11.0 (branch jazzy)"
_CONTROLLERS = "ros2_controllers, 4.42.1 (branch jazzy),"
_ON_Y = "I_k = I_{k-1} + i h e_k, then u_k = p (b r_k - y_k) + I_k - d (y_k - y_{k-1})/h"


def _control_toolbox(
    strategy: str, limits: str, *others: Setting, integral: Integral = Integral.AFTER
) -> tuple[ProgramLaw, ProgramLaw]:
    """Return the law of control_toolbox with an anti-windup strategy, and that with a velocity.

    Controllers with a velocity state give it the error of the velocity. A driver that
    differentiates its encoder, and a simulator that moves by the new velocity, have for velocity
    the difference of the position.
    """
    equation = "I_k = I_{k-1} + i h e_k, then u_k = p e_k + I_k + d s_k"
    if integral is Integral.AFTER:
        equation = "u_k = p e_k + I_k + d s_k, then I_{k+1} = I_k + i h e_k"
    plain = ProgramLaw(
        name=f"control_toolbox_{strategy}",
        program=_TOOLBOX,
        equation=f"{equation}; s_k = (e_k - e_{{k-1}})/h",
        limits=limits,
        settings=(*_gains("p i d"), _strategy(strategy), *others),
        integral=integral,
        slope=Slope.ERROR,
        head="# ros2 param load {node} FILE\n{node}:\n  ros__parameters:\n    gains:\n"
        "      {dof}:",
        line="        {name}: {value}",
        # Infinite ones would be read as text.
        bounds=lambda low, high: (
            ("u_clamp_max", _or_none(high)),
            ("u_clamp_min", _or_none(low)),
        ),
    )
    return plain, replace(
        plain,
        name=f"{plain.name}_velocity",
        program=f"{_TOOLBOX}, as {_CONTROLLERS} give it the velocity state of a joint",
        equation=f"{equation}; s_k is minus the velocity, (y_{{k-1}} - y_k)/h",
        slope=Slope.MEASUREMENT,
    )


_BACK_CALCULATION = _control_toolbox(
    "back_calculation",
    "the integral also gets h (u limited - u)/tracking_time_constant",
    # That which control_toolbox takes for 0; written out, since a program that runs keeps the one
    # of the gains before.
    Setting("tracking_time_constant", lambda law: law.gains.tracking or None),
)

_ROWS = (
    ProgramLaw(
        name="controller_node",
        program="controller_node of this package",
        equation="I_k = I_{k-1} + i h (r_k - v_k), then u_k = kc (b r_k - v_k - td s_k) + I_k; v "
        "and s are y and its derivative after 1/(1 + tf s + (tf s)^2/2), exact for a y that is "
        "linear between samples",
        limits="back-calculation with sqrt(ti td), without derivative ti",
        settings=_gains("kc ti td tf b", "kc ti td tf b"),
        smoothing=ON_MEASUREMENT,
        weights=(),
        form="ideal",
        head="/**:\n  ros__parameters:",
        line="    {name}: {value}",
        bounds=lambda low, high: (("command_min", _or_none(low)), ("command_max", _or_none(high))),
        start=Start("initial_command is the present command.", "initial_command"),
    ),
    *_BACK_CALCULATION,
    *_control_toolbox("conditional_integration", "no integration while u is limited and e u > 0"),
    *_control_toolbox("none", "the integral winds up"),
    *_control_toolbox(
        "legacy",
        "the integral stays between i_clamp_min and i_clamp_max",
        integral=Integral.BEFORE,
    ),
    replace(
        _BACK_CALCULATION[0],
        name="pid_controller",
        program=f"pid_controller of {_CONTROLLERS} with one state interface; it runs {_TOOLBOX}",
    ),
    ProgramLaw(
        name="arduino_pid_v1",
        program="PID_v1 of br3ttb/Arduino-PID-Library, 1.2.1",
        equation=f"{_ON_Y}; b is 1, with P_ON_M 0",
        limits="the integral stays within the output limits",
        settings=(
            # Their sign is that of ControllerDirection.
            *_gains("Kp Ki Kd", of=abs),
            Setting("SampleTime", lambda law: f"{1000.0 * law.period:.10g}"),
            Setting("POn", lambda law: "P_ON_E" if law.gains.b > 0.5 else "P_ON_M"),
            Setting(
                "ControllerDirection", lambda law: "DIRECT" if law.gains.kc > 0.0 else "REVERSE"
            ),
        ),
        weights=(0.0, 1.0),
        head="#include <PID_v1.h>\n",
        line="const auto {name} = {value};",
        bounds=lambda low, high: (("OutputMin", low), ("OutputMax", high)),
        unset="0 to 255",
        tail="""
double Setpoint = 0.0, Input = 0.0, Output = StartOutput;
PID controller(&Input, &Output, &Setpoint, Kp, Ki, Kd, POn, ControllerDirection);

// at the end of setup(), with what the sensor reads; then in loop(): read Input, give Setpoint,
// controller.Compute(), write Output
void startController(double measurement) {
  Input = Setpoint = measurement;  // SetMode takes it for the last one
  controller.SetOutputLimits(OutputMin, OutputMax);
  controller.SetSampleTime(SampleTime);
  controller.SetMode(AUTOMATIC);
}""",
        remark="//",
        sign="Its gains are never negative: ControllerDirection says the sign",
        start=Start(
            "Output is the present command before SetMode(AUTOMATIC).", "StartOutput", needs=True
        ),
        ending="ino",
    ),
    ProgramLaw(
        name="simple_pid",
        program="simple-pid of m-lundberg, 2.0.1",
        equation=f"{_ON_Y}; b is 1, with proportional_on_measurement 0",
        limits="the integral stays within output_limits",
        settings=(
            *_gains("Kp Ki Kd"),
            Setting("sample_time", lambda law: law.period),
            Setting("proportional_on_measurement", lambda law: str(law.gains.b < 0.5)),
        ),
        weights=(0.0, 1.0),
        head="from simple_pid import PID\n\npid = PID(",
        line="    {name}={value},",
        # Without dt a call that comes a bit early is left out: a third of those of a timer.
        tail=(
            ")\n# pid.setpoint = ...; then, every sample_time, with dt so that none is left out:\n"
            "# command = pid(measurement, dt=pid.sample_time)"
        ),
        bounds=lambda low, high: (("output_limits", f"({_or_none(low)}, {_or_none(high)})"),),
        start=Start("starting_output is the present command.", "starting_output", needs=True),
        ending="py",
    ),
    ProgramLaw(
        name="esphome_pid",
        program="the PID climate of ESPHome, 2024.11.0-dev",
        equation="I_k = I_{k-1} + i h e_k, then u_k = p e_k + I_k - d (y_k - y_{k-N})/(N h), N = "
        "derivative_averaging_samples; without deadband, output_averaging_samples 1",
        limits="the integral stays between min_integral and max_integral",
        settings=(
            *_gains("kp ki kd"),
            Setting(
                "derivative_averaging_samples",
                lambda law: str(averaged_over(law.gains.tf, law.period)) if law.gains.td else None,
            ),
            Setting("output_averaging_samples", "1"),
        ),
        smoothing=MEAN,
        command="level of the output, -1 (cool) to 1 (heat)",
        full=1.0,
        turned="A higher command cools: let it be the cool_output, the negative half of the "
        "output, so that gains are positive",
        head="climate:\n  - platform: pid\n    control_parameters:",
        line="      {name}: {value}",
        start=Start("starting_integral_term is the present command.", "starting_integral_term"),
    ),
    ProgramLaw(
        name="klipper_heater",
        program="the pid heater of Klipper, v0.13.0-730-g84104bbb",
        equation="I_k = I_{k-1} + h e_k, then u_k = (Kp e_k + Ki I_k - Kd s_k)/255; s_k = (1 - "
        "a) s_{k-1} + a (y_k - y_{k-1})/h, a = h/smooth_time, at most 1; u acts one report later",
        limits="the integral keeps its value while u is limited; small changes of u may be left "
        "out",
        settings=(
            *_gains("pid_Kp pid_Ki pid_Kd", of=_of_255),
            Setting(
                "smooth_time", lambda law: max(law.gains.tf, law.period) if law.gains.td else None
            ),
        ),
        smoothing=FIRST_ORDER,
        delay=1,
        command="power of the heater, 0 to 1; the gains are in parts of 255",
        full=1.0,
        only_positive=True,
        head="# of printer.cfg; likewise [heater_bed] or [heater_generic NAME]\n"
        "[extruder]\ncontrol: pid",
        bounds=lambda _low, high: (("max_power", _or_none(high)),),
        ending="cfg",
    ),
    ProgramLaw(
        name="marlin_heater",
        program="PID_t of Marlin's temperature.h, commit 000b34772776",
        equation="I_k = I_{k-1} + e_k, then u_k = (Kp e_k + Ki h I_k - Kd s_k)/255; s_k = K1 "
        "s_{k-1} + (1 - K1) (y_k - y_{k-1})/h, K1 = PID_K1; within PID_FUNCTIONAL_RANGE",
        limits="the integral, Ki h I, stays between 0 and the largest output",
        settings=(
            *_gains("DEFAULT_Kp DEFAULT_Ki DEFAULT_Kd", of=_of_255),
            Setting(
                "PID_K1",
                lambda law: (
                    1.0 - law.period / max(law.gains.tf, law.period) if law.gains.td else None
                ),
            ),
        ),
        smoothing=FIRST_ORDER,
        command="power of the heater, 0 to 1; the output is 0 to 255",
        full=1.0,
        only_positive=True,
        line="#define {name} {value}",
        remark="//",
        ending="h",
    ),
    ProgramLaw(
        name="px4_rate",
        program="RateControl of PX4, rate_control.cpp of commit 0155b3a86295, for small errors; "
        "its D acts on an acceleration that another module filters, and is left at 0",
        equation="u_k = p e_k + I_k, then I_{k+1} = I_k + i h e_k",
        limits="no integration further into the limit of the allocator; the integral within its "
        "limit",
        settings=_gains("MC_ROLLRATE_P MC_ROLLRATE_I MC_ROLLRATE_D"),
        integral=Integral.AFTER,
        slope=Slope.NONE,
        command="normalised torque",
        full=1.0,
        line="param set {name} {value}",
        ending="txt",
    ),
    ProgramLaw(
        name="ardupilot_rate",
        program="AC_PID::update_all of ArduPilot, commit 00e79c1a8aca, with FLTT, FLTE, SMAX and "
        "FF at 0",
        equation="s_k = s_{k-1} + a ((e_k - e_{k-1})/h - s_{k-1}), a = h/(h + 1/(2 pi FLTD)); "
        "I_k = I_{k-1} + i h e_k, then u_k = p e_k + I_k + d s_k",
        limits="the integral may only shrink while the limit flag is set; the integral within "
        "IMAX",
        settings=(
            *_gains("ATC_RAT_RLL_P ATC_RAT_RLL_I ATC_RAT_RLL_D"),
            Setting(
                "ATC_RAT_RLL_FLTD",
                lambda law: (
                    1.0 / (2.0 * math.pi * (law.gains.tf - law.period))
                    if law.gains.tf > law.period
                    else 0.0
                ),
            ),
            Setting("ATC_RAT_RLL_FLTT", 0.0),
            Setting("ATC_RAT_RLL_FLTE", 0.0),
            Setting("ATC_RAT_RLL_FF", 0.0),
        ),
        slope=Slope.ERROR,
        smoothing=FIRST_ORDER,
        command="normalised torque",
        full=1.0,
        line="{name},{value}",
        ending="param",
    ),
    ProgramLaw(
        name="iec_61131_3_pid",
        program="the example PID of IEC 61131-3, final draft of the 2nd edition (2001)",
        equation="its error is y - r: X_k = X_{k-1} + h (y_k - r_k), then u_k = KP (E_k + X_k/TR "
        "+ TD (3 (E_k - E_{k-3}) + E_{k-1} - E_{k-2})/(10 h)), E = y - r",
        limits="the integral winds up",
        settings=(
            Setting("KP", lambda law: -law.gains.kc),
            *_gains("TR TD", "ti td"),
            Setting("CYCLE", lambda law: f"T#{1000.0 * law.period:.10g}ms"),
        ),
        slope=Slope.ERROR,
        smoothing=FOUR_SAMPLES,
        form="ideal",
        needs_integral=True,
        line="{name} := {value};",
        remark="//",
        sign="This block forms ERROR = PV - SP, so KP is {sign} here",
        start=Start(
            "call it once with AUTO false and X0 the present command over KP, since its output "
            "is KP X0 then.",
            "X0",
            lambda law, command: -command / law.gains.kc,
        ),
        ending="st",
        scale=_SHARES,
    ),
    ProgramLaw(
        name="oscat_ft_pid",
        program="FT_PID 2.1 of OSCAT BASIC 3.33, with the error as IN",
        equation="u_k = KP (e_k + I_k + TV (e_k - e_{k-1})/h), I_k = I_{k-1} + h (e_k + "
        "e_{k-1})/(2 TN)",
        limits="the integral stays between ILIM_L and ILIM_H",
        settings=_gains("KP TN TV", "kc ti td"),
        integral=Integral.TRAPEZOID,
        slope=Slope.ERROR,
        form="ideal",
        line="{name} := {value};",
        remark="//",
        start=Start(
            "this block begins at 0, so add the present command to its output Y, and take it "
            "off the limits."
        ),
        ending="st",
        scale=_SHARES,
    ),
)

OWN_LAW = _ROWS[0].name
LAWS: dict[str, ProgramLaw] = {law.name: law for law in _ROWS}
# The limit of controller_node's law for a sampling period of 0.
CONTINUOUS = LawRate(LAWS[OWN_LAW], 0.0)
