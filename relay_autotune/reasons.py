# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Why something ended, failed or was refused: a code with values, and one table of sentences.

A program compares codes; a sentence is for people alone. :class:`Code` is the table. Reason.msg
has the same numbers as constants, and docs/troubleshooting.md is made from it.
"""

from __future__ import annotations

import enum
import re
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from relay_autotune.text import counted, duration

Value = float | int | str
"""A fact of a reason."""


@dataclass(frozen=True)
class Reason:
    """What has happened.

    >>> from relay_autotune.reasons import Code
    >>> reason = Code.SILENT_SENSOR(topic="/level", silence=1.5)
    >>> reason.code is Code.SILENT_SENSOR, reason["silence"]
    (True, 1.5)
    >>> print(reason)
    no measurement on /level for 1.5 s

    :param code: which of the reasons that the table has.
    :param facts: names and values.
    :param notes: what else is to be known of the same event.
    :param said: the sentence of the program that raised it; empty: that of the table.
    """

    code: Code
    facts: tuple[tuple[str, Value], ...] = ()
    notes: tuple[Reason, ...] = ()
    said: str = ""

    def __getitem__(self, name: str) -> Value:
        return self.values[name]

    def __bool__(self) -> bool:
        """Tell whether there is a reason at all."""
        return self.code is not Code.NONE or bool(self.said)

    @property
    def values(self) -> dict[str, Value]:
        """The values by name."""
        return dict(self.facts)

    @property
    def typed(self) -> str:
        """The parameter to set, and a value or what it stands for; empty: another remedy."""
        typed, values = self.code.row.typed, self.values
        # That of another node may lack a value.
        return _filled(typed, values) if _names(typed) <= values.keys() else ""

    @property
    def parameter(self) -> str:
        """The name of the parameter to set; empty: another remedy."""
        return self.typed.partition(" ")[0]

    def plus(self, *notes: Reason, **values: Value) -> Reason:
        """Return the reason with further notes and values.

        :param notes: added behind those that it has.
        :param values: by name.
        """
        return replace(self, facts=(*self.facts, *values.items()), notes=(*self.notes, *notes))

    def __str__(self) -> str:
        """Return the sentence for people, the notes behind it."""
        if self.said:
            return self.said
        row = self.code.row
        text, remedy, place = (_filled(t, self.values) for t in (row.found, row.remedy, _PLACE))
        if remedy:
            text += f"{'; ' if ': ' in text else ': '}{remedy}"
        return "; ".join((text + place, *map(str, self.notes)))


# Parts of several sentences.
_LOST = (
    "no oscillation after {cycles:#whole cycle}[, and {shifted} stays ended only when the levels "
    "were shifted]: the measurement is {value:g} and did not come back to {setpoint:g} -/+ "
    "{hysteresis:g} within {time:.3g} s (process_gain_sign was taken as {sign})"
)
_AWAY = (
    f"{_LOST}; it moved away[ {{faster}}], against the relay's push: process_gain_sign may be "
    "wrong, the process was not at rest at the start"
)
_FAST = "the relay switches fast"
_LOOK = "check the sensor and the actuator"
_REACH = (
    "whether the actuator goes as far as the levels could not be told, since no oscillation at a "
    "quarter of the amplitude stood clear of the noise: look whether it goes from {low:g} to "
    "{high:g}"
)
# A limit is passed while settling, or once the relay's levels move the process.
_MOVED_BY = (
    "[, and only {baseline:g} u was commanded: that is not the present command, or a load came; "
    "set the command at which the process rests][: give a smaller amplitude than "
    "{amplitude:.3g} u, or wider limits if the plant allows]"
)
# Where a running experiment was when something from outside ended it.
_PLACE = "[ (at {ended_at:.6g} s, {where})]"
_OPTIONAL = re.compile(r"\[(.*?)\]")


class _Words(string.Formatter):
    """Format values; ``{n:#whole cycle}`` is a number of things, ``{t:~}`` a duration [s]."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec.startswith("#"):
            return counted(value, format_spec[1:])
        if format_spec == "~":
            return duration(value)
        return str(super().format_field(value, format_spec))


_WORDS = _Words()


def _names(text: str) -> set[str]:
    return {name for _, name, _, _ in _WORDS.parse(text) if name}


def _filled(text: str, values: Mapping[str, Value]) -> str:
    """Return a sentence; what stands in brackets is left out where a value of it is missing."""

    def optional(part: re.Match[str]) -> str:
        return part[1] if _names(part[1]) <= values.keys() else ""

    return _WORDS.vformat(_OPTIONAL.sub(optional, text), (), values)


class _Row(NamedTuple):
    """A row of the table.

    :param number: of the code.
    :param found: sentence with the names of values; a part in brackets needs its values.
    :param remedy: what to do, which follows in the sentence; empty: nothing, or it depends.
    :param typed: parameter to set, and a value or what it stands for; empty: another remedy.
    :param transient: True if it may go away by itself, as until the nodes have found each other.
    """

    number: int
    found: str
    remedy: str = ""
    typed: str = ""
    transient: bool = False


class Code(enum.IntEnum):
    """The reasons.

    A number keeps its meaning for ever; one that is no longer used is not used again. Reasons of
    up to 99 are none or not in the table, those from 100 on end an experiment from inside, from
    200 on from outside, from 300 on refuse a tune, from 400 on concern models and gains, from 500
    on a verification, and those of 900 are defects. The number of samples that were lost, and the
    like, are notes: they stand behind a reason. The docstring of a reason tells what is usually
    behind it and what helps; the guide has it, too. A note has none.
    """

    def __new__(cls, number: int, *_: Any) -> Code:
        """Make a member whose value is its number."""
        member = int.__new__(cls, number)
        member._value_ = number
        return member

    def __init__(self, *cells: Any) -> None:
        self.row = _Row(*cells)
        """The row of the table."""

    def __call__(self, *notes: Reason, **values: Value) -> Reason:
        """Return the reason with its values.

        :param notes: what else is to be known.
        :param values: by name.
        :raises TypeError: if a value that its sentence needs is missing.
        """
        missing = _names(_OPTIONAL.sub("", self.row.found + self.row.remedy)) - values.keys()
        if missing:
            raise TypeError(f"{self.name} needs {', '.join(sorted(missing))}")
        return Reason(self, tuple(values.items()), notes)

    NONE = _Row(0, "")
    OTHER = _Row(1, "{sentence}")
    """The sentence says it; it has no code of its own."""

    # The experiment ends as planned.
    CYCLES_AGREE = _Row(100, "{which} cycles agree within {percent:g} %, allowing for noise")
    """The limit cycle has settled."""
    MAX_CYCLES = _Row(
        101,
        "max_cycles, {most}, reached[; the last {needed} cycles do not agree within {percent:g} "
        "%]",
    )
    """The cycles go on changing: noise, loads, or a drift."""
    CONFIDENT = _Row(
        102,
        "after {switches} switches, {cycles} whole cycles, the 95 % interval of {quantity} is "
        "within {width:.3g} of it, as narrow as asked, {wanted:g}",
    )
    """stop_when is confident, and the interval is narrow enough."""

    # The experiment fails by its samples.
    BAD_MEASUREMENT = _Row(
        110,
        "the measurement after {samples} samples is {value:g}, expected a finite number",
        "check the sensor",
    )
    """The sensor, or its driver, reports NaN or infinity."""
    BAD_TIME = _Row(
        111, "the time after {samples} samples is {time:g} s, expected a finite number"
    )
    """A stamp is no time."""
    TIME_BACKWARDS = _Row(
        112,
        "time went backwards, from {before:g} s to {time:g} s after the first sample",
        "check the clock that stamps the measurement",
    )
    """A clock was set back, a bag started again, or two sensors publish."""
    TIME_REPEATS = _Row(
        113,
        "{samples} samples carry the same time, {time:g} s after the first",
        "check the clock that stamps the measurement",
    )
    """The clock stands still while samples come."""
    FROZEN_SENSOR = _Row(
        114,
        "the sensor is frozen: its last {samples} samples are all {value:g}, {where}",
        "check the sensor",
    )
    """A dead sensor, or one that repeats itself far longer than before."""
    SILENT_TOO_LONG = _Row(
        115,
        "the measurement does not respond any more: silent for {silence:.3g} s, much longer than "
        "before, {where}",
        "check the sensor",
    )
    """A sensor that publishes only on change has stopped, or the process no longer moves."""
    OUTSIDE_LIMITS = _Row(
        116,
        "the measurement {value:g} at {time:g} s is outside its limits, {low:g} to {high:g}"
        f"{_MOVED_BY}",
    )
    """The measurement reached a limit. While settling: the baseline is not the command at which
    the process rested; set that one. Later: take a smaller amplitude, or wider limits if the
    plant allows."""
    TOO_FAR = _Row(
        117,
        "the measurement {value:g} at {time:g} s is {away:g} away from the set-point, more than "
        f"max_deviation, {{most:g}}{_MOVED_BY}",
    )
    """The measurement swung further than allowed: as code 116, with a larger max_deviation for
    wider limits."""
    MAX_DURATION = _Row(
        118, "max_duration {limit:g} s was over {where}", "allow more time or fewer cycles"
    )
    """The process is slower than max_duration allows."""
    TOO_LONG = _Row(
        119,
        "the experiment was not over after {time:.4g} s, longer than its parts may take, {where}",
        "let the process rest and look at the recording first",
    )
    """Something goes on for ever that no other limit ends."""
    NOT_AT_BASELINE = _Row(
        120,
        "the measurement rested at {rest:.6g} y and is at {value:.6g} y, {time:.3g} s after "
        "{baseline:g} u was commanded: {baseline:g} u is not the present command, or a load came",
        "set the command at which the process rests",
    )
    """The baseline is not the command at which the process rested before the tune."""
    NOT_STEADY = _Row(
        121,
        "the measurement was not steady within {time:g} s, {motion}",
        "wait until the process is at rest, or give settle_time to start anyway",
    )
    """The measurement drifts, or still moves."""
    NO_RESPONSE = _Row(
        122,
        "no response to the kick: the command was {level:g} instead of {baseline:g} for "
        "{time:g} s, and the measurement stayed[ within {band:g} of its rest {rest:g}][ at "
        "{still:g}]",
        "check that command and measurement belong to one loop, or give a larger amplitude",
    )
    """The amplitude is too small, the actuator does not follow, or the process is slower than
    ten minutes: give settle_time or max_duration then."""

    # The relay switches, and there is no limit cycle.
    NO_ANSWER = _Row(
        130,
        f"{_LOST}; it does not respond: it has stood still since the command last changed",
        "check the sensor, and that the actuator follows",
    )
    """The measurement does not move at all."""
    MOVED_AWAY_LOAD = _Row(131, f"{_AWAY}, or a load has come that the relay cannot compensate")
    """The measurement rests beyond the band. If process_gain_sign is given, let it be found
    (0)."""
    MOVED_AWAY_UNSTABLE = _Row(
        132, f"{_AWAY}, or the process is unstable and the amplitude too small to hold it"
    )
    """The measurement goes on away. If process_gain_sign is given, let it be found (0); give
    process_type."""
    SATURATED = _Row(
        133,
        f"{_LOST}; the response saturates before the relay's band: the amplitude may be too small "
        "for the hysteresis or the set-point, a load may have come, or the actuator is at its end",
    )
    """The set-point is out of reach of the two levels: leave setpoint away, which takes the
    measured mean, or give a larger amplitude."""
    TOO_SLOW = _Row(
        134,
        f"{_LOST}; it moves towards the band, but too slowly for what was seen before",
        "give a larger amplitude or max_half_cycle, and let the process rest before the start",
    )
    """A half cycle takes far longer than those before."""
    TOO_FEW_SAMPLES = _Row(
        135, f"{_LOST}; there are too few samples to say why", "check the sensor's rate"
    )
    """The sensor is far too slow for max_half_cycle."""
    NOISE_ALONE = _Row(
        136,
        "no oscillation after {cycles:#whole cycle}, only noise: the measurement's standard "
        "deviation is {spread:.3g}, that of its noise at rest {noise:.3g}",
        "give a larger amplitude, or check that the actuator follows its command",
    )
    """The relay switches on noise: the response does not stand out of it."""
    GROWING = _Row(
        137,
        "the oscillation grows faster and faster, after {cycles:#whole cycle}: an unstable "
        "process that the relay cannot hold",
        "give a larger amplitude",
    )
    """Each swing is larger than the one before, in ever larger steps."""
    FAST_CYCLES = _Row(
        138,
        f"{_FAST}, each {{half:.3g}} s or sooner after {{cycles:#whole cycle}}, where a cycle "
        "took {usual:.3g} s before",
        _LOOK,
    )
    """Cycles have become far shorter: a loose contact, or an actuator that no longer moves."""
    FAST_IN_CYCLE = _Row(
        139,
        f"{_FAST}, {{switches}} times in the last of {{cycles:#whole cycle}}, and {{most}} times "
        "at most in those before",
        _LOOK,
    )
    """Noise has become larger than the hysteresis."""
    FAST_STAYS = _Row(
        140,
        f"{_FAST}, {{stays}} times with at most one stay of {{part:g}} times the {{response:.3g}} "
        "s that the process took to respond",
        _LOOK,
    )
    """No process can answer so fast: the relay switches on noise."""
    NO_CLEAR_CYCLE = _Row(
        141,
        "no clear cycle for {time:.3g} s, though the relay went on switching, after "
        "{cycles:#whole cycle}, and max_cycles, {most}, are over: its half cycles differ too much",
        "check sensor and actuator, and that the process rests at the baseline",
    )
    """Stays of very different length: an actuator that sticks, loads that come and go."""
    CLIPPED = _Row(
        142,
        "the actuator is clipped: the amplitude grew from {before:.3g} to {now:.3g}, and half the "
        "swing of the measurement from {swing_before:.3g} to {swing:.3g} only",
        "give the levels limits that it reaches, or an amplitude with which they stay between "
        "{low:.3g} and {high:.3g}",
    )
    """The actuator does not go as far as it is commanded."""
    REACH_UNKNOWN = _Row(
        143,
        f"{_REACH}[; max_cycles, {{most}}, reached][; the last {{needed}} cycles do not agree "
        "within {percent:g} %][; {which} cycles agree within {percent:g} %, allowing for noise]",
    )
    """Noise hid the oscillation at a quarter of the amplitude, so that it is not known whether
    the actuator reaches the levels."""

    # Notes of an experiment.
    NOTE_SIGN = _Row(
        160,
        "the process gain was first taken for {sign}: the measurement did not come back; give "
        "process_gain_sign to spare the process that",
    )
    NOTE_NOT_STEADY = _Row(161, "the measurement was not steady after settle_time, {motion}")
    NOTE_MOVED = _Row(
        162,
        "the measurement rested at {rest:.6g} y before the first command, and at {value:.6g} y "
        "under the baseline {baseline:g} u: look whether that is the present command",
    )
    NOTE_LOAD = _Row(
        163, "a load came during the test, and the relay's levels were shifted to compensate it"
    )
    NOTE_DISTURBED = _Row(
        164,
        "{disturbed} of {cycles} cycles disturbed: a long gap in the samples, a load step, or "
        "switches that formed no clear cycle",
    )
    NOTE_SMALL = _Row(
        165,
        "the amplitude {amplitude:g} is all that the command limits allow, and the measurement "
        "swings by {swing:.3g} only, less than {least:.3g}",
    )
    NOTE_REACH = _Row(166, _REACH)
    NOTE_REPEATED = _Row(
        167,
        "{samples} samples repeat the one before, since the sensor was silent[, at the end for "
        "{silence:.3g} s: check it first]",
    )
    NOTE_LOST = _Row(168, "{samples:#sample} lost on the way")

    # The experiment is ended from outside.
    REQUESTED = _Row(200, "aborted on request")
    """~/abort was called."""
    CANCELLED = _Row(201, "cancelled")
    """The client cancelled the action, as by Ctrl-C."""
    SIGNAL = _Row(202, "the node was stopped by {signal}")
    """Ctrl-C, a service manager, or SIGHUP: the terminal was closed or its connection lost.
    Start the node with nohup, in tmux or as a service."""
    SILENT_SENSOR = _Row(
        203, "no measurement on {topic} for {silence:.3g} s", typed="measurement_timeout SECONDS"
    )
    """The sensor is dead or its cable loose, the machine is overloaded, the sensor is slower than
    measurement_timeout, or it publishes only on change: give repeat_period then."""
    SENSOR_GONE = _Row(204, "no measurement on {topic} any more: its publisher has left")
    """The sensor's process has ended."""
    MISREAD = _Row(205, "the {what} on {topic} cannot be read: {why}")
    """A message does not have the field, joint or element that the parameters name."""
    CLOCK_STEPPED = _Row(
        206,
        "a clock has stepped: receive minus source time went from {before:.4g} s to {now:.4g} s",
        "stop what sets the clocks, or give sample_period",
    )
    """The time of the sensor's host, or of ours, was set during the tune: keep both hosts
    synchronised, and start again."""
    TIME_STANDS = _Row(
        207,
        "the time of the measurement has stood still at {time:.6g} s for {still:.3g} s",
        "check /clock, or what stamps the measurement",
    )
    """A simulation is paused, or the clock is stuck."""
    OVERTIME = _Row(
        208,
        "the tune is not over after {lasted:.4g} s, of which the measurement's clock tells "
        "{time:.4g} s",
        "check /clock, or what stamps the measurement",
    )
    """The time of the samples runs far too slowly."""
    SILENT_CONTROLLER = _Row(209, "no command on {topic} for {silence:.3g} s")
    """The present controller has stopped during the tune, so that nobody could take over."""
    SILENT_FEEDBACK = _Row(210, "no command_feedback for {silence:.3g} s")
    """The actuator no longer reports its position."""
    NOT_FOLLOWING = _Row(
        211,
        "the actuator does not follow: it is told {command:g} and says that it is at "
        "{position:g}[; it moves between {low:g} and {high:g} only: it is clipped there, give "
        "command_min and command_max within these]",
    )
    """A stuck, slow or clipped actuator, by its command_feedback."""
    FOREIGN_COMMAND = _Row(
        212,
        "another node commanded[ {command:g}] on {topic} during the tune[: {unread}][: the "
        "controller must {hold}]",
    )
    """A second publisher on the command: stop it, or connect it to controller_command."""
    OTHERS_UNKNOWN = _Row(213, "the other elements of the command are not known: {why}")
    """The message on other_commands lacks the element that is commanded."""

    # Between two nodes: at the start, and while a tune runs.
    SECOND_PUBLISHER = _Row(
        250,
        "{topic} is also published by {others}: two of them would fight for the actuator",
        "end that one, or let it command through relay_node",
    )
    """A second node commands: stop it, connect it to controller_command, or give path takeover.
    One that was killed is forgotten after about 20 s."""
    SECOND_SOURCE = _Row(
        251,
        "{topic} is published by {count} publishers, {others}, expected one: the relay would act "
        "on a mixture",
        "end the others (a killed one leaves the graph after 20 s)",
    )
    """Two sensors or simulated plants, or two controllers, on one topic, as after a launch that
    crashed."""
    NAMESAKE = _Row(
        252,
        "{count} nodes have the name {node}, expected one: a call reaches any of them",
        "end the others (a killed one leaves the graph after 20 s), or give them other names",
    )
    """Two relay_nodes, as after a crash of ros2 run."""

    # A tune cannot start.
    RUNNING = _Row(300, "tune {tune} is running", "wait for its end or call {node}/abort")
    """One relay_node runs one tune at a time."""
    NO_MEASUREMENT_YET = _Row(301, "no measurement has come yet: {why}", transient=True)
    """A best-effort sensor, another type, another topic, or no sensor: the sentence says which;
    see measurement_type and measurement_field."""
    NO_MEASUREMENT_NOW = _Row(
        316, "no measurement has come for {silence:.3g} s: {why}", transient=True
    )
    """The sensor has fallen silent."""
    NO_CLOCK = _Row(302, "use_sim_time is true, but no time has come on /clock", transient=True)
    """The simulation does not run, or publishes no clock."""
    NO_SUBSCRIBER = _Row(303, "no command would arrive: {why}", transient=True)
    """Nobody subscribes to the command, or with another type or quality of service: the
    sentence says which."""
    OTHERS_NOT_THERE = _Row(
        304,
        "the other elements of the command are not known: {why}",
        "publish there, or give command_message",
    )
    """No message on other_commands has come yet."""
    BEYOND_LIMITS = _Row(
        305,
        "the measurement is {value:.6g}, outside of its limits, measurement_min {low:g} to "
        "measurement_max {high:g}: the first sample would end the tune",
        "give a {way} {limit}",
        typed="{limit} LIMIT",
    )
    """The present measurement is outside of measurement_min to measurement_max."""
    NO_BASELINE = _Row(
        306,
        "the baseline is not known",
        "set the parameter baseline, or initial_command at the node's start, to the command of "
        "the operating point",
        typed="baseline COMMAND",
    )
    """Neither a controller's commands nor a parameter tell at which command the process rests."""
    ONE_WAY = _Row(
        307,
        "the baseline, {baseline:g}, is {where} the actuator's end, {limit} {value:g}: from there "
        "the command can go one way only",
        "at which command does the process rest at its working point? Send that, wait until it "
        "rests, and give it as the baseline",
        typed="baseline COMMAND",
    )
    """From a baseline at an end of the actuator the command can go one way only: choose one at
    which the process rests inside."""
    NO_SETPOINT = _Row(
        308,
        "relay_on is setpoint, but setpoint is not given",
        "set it to that of the present loop",
        typed="setpoint VALUE",
    )
    """A relay on the set-point switches about the set-point of the present loop."""
    NO_CONTROLLER = _Row(
        309,
        "relay_on is setpoint, but no controller_command comes",
        "connect the controller of the present loop, with path passthrough, or give "
        "controller_command_field where the messages of the measurement have it",
    )
    """A relay on the set-point needs a closed loop."""
    BUSY_COMMAND = _Row(
        310,
        "{topic} is being commanded by another node",
        "have the controller hold or track before the start",
    )
    """With path takeover the controller has to be silent before a tune."""
    UNSAFE_COMMAND = _Row(
        311,
        "{name} is {value:g}, expected from command_min {low:g} to command_max {high:g}",
        typed="{name} COMMAND",
    )
    """baseline or safe_command is outside of the command's limits."""
    NO_HOLD = _Row(
        312,
        "process_type is {kind}: at a constant command it would {drift} when a tune ends before "
        "its first cycle",
        "connect controller_command, or give hold_gain, or set start_without_hold to true",
    )
    """Nothing would hold the process."""
    TWO_CLOCKS = _Row(
        313, "{other} and sample_period {period:g} s are both given: {why}", "set {which} to 0"
    )
    """With a sample_period the number of the samples is their only clock."""
    FIXED_NOW = _Row(
        314,
        "parameters stay as they are while tune {tune} runs",
        "wait for its end or call {node}/abort",
    )
    """Parameters hold for a whole tune."""
    REST_UNKNOWN = _Row(317, "not known yet: it takes 20 samples, and 2 s of them")
    """The node has just begun to hear the sensor."""
    STILL_MOVING = _Row(
        318,
        "no: {motion} over {span:~}",
        "wait until the process rests, else the tune waits for that",
    )
    """The process moves, or is noisy, before the test."""
    NO_LIMITS = _Row(
        319,
        "{missing} not given: nothing ends a tune whose measurement goes too far that way",
        typed="{limit} LIMIT",
    )
    """measurement_min, measurement_max and max_deviation are at their defaults."""
    NO_FOLDER = _Row(
        320,
        "{folder} cannot be written to: the tune would go on without a recording",
        "give another record_directory",
        typed="record_directory FOLDER",
    )
    """The folder of the recordings belongs to another user, or is none."""
    LITTLE_SPACE = _Row(321, "in {folder}, {free:.3g} GB free", typed="record_directory FOLDER")
    """The disk of the recordings is nearly full."""
    NO_IDENTIFIER = _Row(
        315,
        "no identifier_node: a recording alone, without model and gains",
        "type: [{run}]identifier_node{where}",
    )
    """No identifier_node runs in that namespace, or it is not found yet."""

    # Model and gains.
    NO_MODEL_YET = _Row(
        400, "no model has come yet, so the step cannot be predicted", transient=True
    )
    """controller_node has no model of this loop: run a tune first."""
    QUEUE_FULL = _Row(401, "{waiting} other records wait", "ask again later", transient=True)
    """identifier_node has too much to do."""
    NOT_ANALYSED = _Row(901, "the record could not be analysed: {why}")
    """A defect of ours: report the sentence, with the recording if you can."""
    CHECK_FAILED = _Row(402, "{sentence}")
    """A check of the verdict did not pass: its name, number and limit are among the values; see
    the guide's page on the verdict."""

    # A verification.
    AS_PREDICTED = _Row(500, "{numbers}")
    """The step did what the model predicts."""
    NARROWLY = _Row(501, "narrowly: {narrow}; {numbers}")
    """The step did what the model predicts, but is near a limit."""
    NOT_AS_PREDICTED = _Row(502, "{problems}; {numbers}")
    """The numbers say what differs; the gains of before are back: tune again at this operating
    point."""
    VERIFYING = _Row(503, "a verification is running")
    """One runs at a time."""
    NONE_WAIT = _Row(504, "no gains wait to be applied[; {refused}]", transient=True)
    """No tune has given gains yet, or they were refused."""
    GAINS_AT_WORK = _Row(
        505, "gains are being put in force; wait for the end of that", transient=True
    )
    """One change of gains at a time."""
    BRINGING_BACK = _Row(506, "gains of before are being brought back[{open}]", transient=True)
    """The node of apply_to does not take them yet."""
    NODE_NOT_THERE = _Row(
        507, "the node {node} is not there, or has no parameter services[{open}]", transient=True
    )
    """Another name or namespace, or it is not running."""
    FEW_SAMPLES = _Row(
        508, "only {samples} of {needed} samples have come with a command", transient=True
    )
    """The loop has just begun to run."""
    NOBODY_SUBSCRIBES = _Row(509, "nobody subscribes to {topic}[ {since}]", transient=True)
    """The actuator is not connected to controller_node."""
    NOBODY_TAKES = _Row(
        510,
        "nobody takes a set-point from {topic}",
        "remap it to the topic of {node}",
        transient=True,
    )
    """The set-points of the step would arrive nowhere."""
    NOT_HEARD = _Row(511, "no command of {node} has been heard", transient=True)
    """The other controller's commands are not connected."""
    SILENT_OWNER = _Row(530, "no command of {node} for {silence:.3g} s")
    """The other controller has stopped."""
    OTHER_EXPERIMENT = _Row(
        512,
        "the gains are of the experiment {experiment}, and its model has not come; the newest one "
        "is of {newest}",
        "try again when the model has come, or run a tune",
    )
    """A step is predicted by the model of the same experiment."""
    DOUBTFUL_MODEL = _Row(
        513,
        "the model that would predict the step is not trusted: {doubt}",
        "set the parameter accept_doubtful to true to step all the same",
        typed="accept_doubtful true",
    )
    """A doubtful model predicts no step."""
    NOT_AUTOMATIC = _Row(515, "the controller is not in automatic, or has no gains")
    """Nothing closes the loop."""
    TUNING = _Row(516, "a tune is running")
    """A tune and a verification exclude each other."""
    NOT_AT_REST = _Row(
        520,
        "the loop is not at rest[: the measurement moved by {drift:.3g} over the last {samples} "
        "samples][ at its set-point: the measurement is {away:.3g} away from it]",
        "wait until it has settled",
    )
    """A step is seen on a loop at rest at its set-point alone."""
    STEP_SILENT = _Row(521, "no measurement for {silence:.3g} s")
    """The sensor has fallen silent."""
    STEP_TIME_STANDS = _Row(522, "the time of the samples stands still: is /clock published?")
    """A simulation is paused, or the clock is stuck."""
    STEP_TIME_BACKWARDS = _Row(523, "time went backwards, by {by:.3g} s")
    """A clock was set back."""
    STEP_GAP = _Row(524, "the samples' time went on by {by:.3g} s from one to the next")
    """Samples are missing, or a clock was set forward."""
    STEP_OVERTIME = _Row(525, "the verification took far longer than planned on the steady clock")
    """The time of the samples runs far too slowly."""
    STEP_RAN_AWAY = _Row(
        526,
        "the measurement went {away:.3g} away from where it was, more than {most:.3g}: three "
        "times what was predicted",
    )
    """The loop does not do what the model predicts."""
    STEP_OUT_OF_RANGE = _Row(527, "the measurement left its range, to {value:.6g}")
    """The measurement went beyond measurement_min to measurement_max."""
    NOT_JUDGED = _Row(528, "the step could not be judged: {why}")
    """The sensor is too coarse for the step."""
    INTERFERED = _Row(529, "{sentence}")
    """Somebody else has changed the loop during the step."""

    # Defects.
    NODE_FAILED = _Row(
        900,
        "the node failed: {error}",
        "this is a defect of relay_autotune: tune again with its newest version; if that meets "
        "it, too, report this line, with the recording if you can",
    )
    """The same command with the same version would meet it again."""


def reason_of(error: BaseException) -> Reason:
    """Return the reason that an error carries, or its sentence as one without a code.

    :param error: the error.
    """
    first = error.args[0] if error.args else None
    return first if isinstance(first, Reason) else other(str(error))


def other(sentence: str) -> Reason:
    """Return a reason that has no code, NONE for an empty sentence.

    :param sentence: for people.
    """
    return Code.OTHER(sentence=sentence) if sentence else NONE


NONE = Reason(Code.NONE)
"""Nothing has happened."""


def may_pass(sentence: str) -> bool:
    """Tell whether a sentence holds a reason that may go away by itself.

    For services whose answer is a sentence alone, such as std_srvs/Trigger: what is looked for are
    the table's own words.

    :param sentence: of another node.
    """
    patterns = (
        re.sub(r"\\{.*?\\}", ".*", re.escape(_OPTIONAL.sub("", code.row.found)))
        for code in Code
        if code.row.transient
    )
    return any(re.search(pattern, sentence) for pattern in patterns)


def joined(reasons: Sequence[Reason]) -> Reason:
    """Return several reasons as one: the first, with the others as its notes.

    :param reasons: those that say nothing are left out.
    """
    there = [reason for reason in reasons if reason]
    return there[0].plus(*there[1:]) if there else NONE
