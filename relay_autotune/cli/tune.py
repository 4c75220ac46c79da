# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""From a transfer function to gains: `tune --gain K --time-constants T --dead-time D`.

The process comes from flags or from a JSON document. One rule is shown in full, or all rules side
by side.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.arguments import (
    DONE,
    NOTHING_FOUND,
    Parser,
    add_web,
    check_web,
    finite,
    run_command,
    say,
)
from relay_autotune.cli.jobs import (
    add_design,
    add_design_details,
    add_export,
    design_options,
    export_target,
    show,
)
from relay_autotune.cli.table import gains_lines
from relay_autotune.cli.terminal import in_columns, labelled, width, write
from relay_autotune.errors import ModelError, SelectionError, TuningError
from relay_autotune.exchange.export import exported
from relay_autotune.exchange.fields import to_document
from relay_autotune.exchange.models import model_fields, to_json
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.loop.gains import FORMS, Gains, Performance, series_form
from relay_autotune.process.structures import (
    GENERAL,
    STRUCTURES,
    TABLE,
    recognised,
    structure_named,
)
from relay_autotune.process.transfer_function import TransferFunction, process_text
from relay_autotune.quantities import Quantity
from relay_autotune.result import Shaping
from relay_autotune.text import digits
from relay_autotune.tuning import DEFAULT_RULE, RULES, design, task_of_model
from relay_autotune.tuning.compensators import COMPENSATORS, Compensator
from relay_autotune.tuning.task import DesignTask

if TYPE_CHECKING:
    from relay_autotune.report.case import Case


_FLAGS = (
    *("gain", "time_constants", "zeros", "dead_time", "integrators", "order", "structure"),
    *("natural_frequency", "damping", "numerator", "denominator"),
)
_NUMBERS_OF_MODEL = ("gain", "dead_time", "natural_frequency", "damping")
# Equal lags that a model may have: with more a design would take minutes.
_MOST_LAGS = 1000


def model_of(options: argparse.Namespace) -> TransferFunction:
    """Return the process that the command line gives.

    :param options: with ``document`` and the flags of the model, None where not given.
    :raises SelectionError: if they give no model, two, or an invalid one.
    """
    given = {name: getattr(options, name) for name in _FLAGS if getattr(options, name) is not None}
    if options.document is not None and given:
        raise SelectionError(
            f"the model is given twice, by {options.document} and by "
            f"{', '.join('--' + name.replace('_', '-') for name in given)}: give one of them"
        )
    if options.document is None and not given:
        raise SelectionError(
            "no model: give --gain, --time-constants and --dead-time, or a JSON document; "
            "tune --help has examples"
        )
    if options.document is None and options.experiment is not None:
        raise SelectionError("--experiment is of a document, and the model is given by flags")
    if options.document is not None:
        given = _from_document(options.document, options.experiment)
    try:
        model = _built(given)
        return recognised(model) if model.structure == GENERAL else model
    except ModelError as error:
        raise SelectionError(f"this is not a model: {error}") from error


def _built(given: dict[str, Any]) -> TransferFunction:
    """Return the transfer function of a model's fields.

    A document has all of them, and its gain is that of the time-constant form. Flags, and
    objects that people write, have some, and their gain is that of the structure's formula.
    """
    numbers: dict[str, Any] = {n: _number(n, given.get(n, 0.0)) for n in _NUMBERS_OF_MODEL}
    gain, dead_time = numbers["gain"], numbers["dead_time"]
    zeros, lags = (_constants(name, given.get(name)) for name in ("zeros", "time_constants"))
    order, integrators = (_count(name, given.get(name) or 0) for name in ("order", "integrators"))
    numerator, denominator = (
        _coefficients(name, given[name]) if given.get(name) is not None else None
        for name in ("numerator", "denominator")
    )
    structure = given.get("structure") or ""
    if structure and structure not in STRUCTURES:
        raise SelectionError(f"unknown structure {structure!r}; known: {', '.join(TABLE)}")
    if denominator is not None and "time_constants" in given and "gain" in given:
        integrators = len(denominator) - 1 - len(lags)
        return TransferFunction(gain, zeros, lags, integrators, dead_time, structure or GENERAL)
    if unknown := [repr(name) for name in given if name not in _FLAGS]:
        raise SelectionError(f"unknown {', '.join(unknown)}; known: {', '.join(_FLAGS)}")
    for name, values in {"dead_time": [dead_time], "time_constants": lags, "zeros": zeros}.items():
        for value in values:
            if problem := Quantity(name, 0.0, "s").problem(abs(value)):
                raise SelectionError(problem)
    if numerator is not None or denominator is not None:
        if numerator is None or denominator is None:
            raise SelectionError("numerator and denominator belong together: give both")
        return TransferFunction.from_polynomials(numerator, denominator, dead_time)
    if "gain" not in given:
        raise SelectionError("the model lacks its gain: give --gain")
    for lag in lags:
        if lag.real <= 0.0 and lag.imag == 0.0:
            raise SelectionError(
                f"a time constant must be > 0 s, found {lag.real:g} s; an unstable process has "
                "--structure unstable_fopdt and a positive one"
            )
    if structure and structure != GENERAL:
        return structure_named(structure).of_fields(
            **numbers, order=order, time_constants=_real("time_constants", lags),
            zeros=_real("zeros", zeros),
        )  # fmt: skip
    if order and len(lags) == 1:
        lags = lags * order
    elif order and order != len(lags):
        raise SelectionError(
            f"--order {order} is the number of equal lags and goes with one time constant, found "
            f"{len(lags)}"
        )
    if "natural_frequency" in given or "damping" in given:
        pair = numbers["natural_frequency"], numbers["damping"]
        lags = (*lags, *TransferFunction.oscillator(1.0, *pair, 0.0).time_constants)
    if not lags and not integrators:
        raise SelectionError("the model has no dynamics: give --time-constants or --integrators")
    return TransferFunction(gain, zeros, lags, integrators, dead_time)


def _from_document(name: str, experiment: int | None) -> dict[str, Any]:
    """Return the fields of the model in a JSON document."""
    try:
        text = sys.stdin.read() if name == "-" else Path(name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is not text"
        raise SelectionError(f"{name} cannot be read: {why}") from error
    try:
        found = json.loads(text, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        raise SelectionError(
            f"{name} is not a JSON document ({error.msg} in line {error.lineno}); if it is a "
            "replay of several bags, give one of its lines"
        ) from error
    except SelectionError:
        raise
    except (ValueError, RecursionError):
        raise SelectionError(
            f"{name} holds numbers of too many digits, or too many brackets within one another"
        ) from None
    if not isinstance(found, dict):
        raise SelectionError(f"{name} holds a JSON {type(found).__name__}, expected an object")
    if "experiments" in found:
        return _selected(name, found, experiment)
    if experiment is not None:
        raise SelectionError(f"{name} holds no experiments: leave out --experiment")
    if isinstance(found.get("model"), dict):
        found = found["model"]
    if not {"gain", "denominator"} & found.keys():
        raise SelectionError(
            f"{name} holds no model: expected a document of replay --json or identify --json, or "
            "an object with gain, time_constants and dead_time, or with numerator and denominator"
        )
    return found


def _no_constant(text: str) -> float:
    raise SelectionError(f"every number of a model must be finite, found {text}")


def _selected(name: str, document: dict[str, Any], which: int | None) -> dict[str, Any]:
    experiments = document["experiments"]
    if not isinstance(experiments, list):
        raise SelectionError(f"{name}: 'experiments' must be a list, as replay --json writes it")
    if which is not None and not 1 <= which <= len(experiments):
        raise SelectionError(
            f"{name} has {len(experiments)} experiments, found --experiment {which}"
        )
    tried = experiments if which is None else [experiments[which - 1]]
    with_model = [e for e in tried if isinstance(e, dict) and e.get("selected") is not None]
    if not with_model:
        raise SelectionError(f"{name} has no experiment with a model")
    if len(with_model) > 1:
        raise SelectionError(
            f"{name} has {len(with_model)} experiments with a model: choose one by --experiment"
        )
    try:
        model = with_model[0]["models"][with_model[0]["selected"]]
    except (KeyError, IndexError, TypeError):
        model = None
    if not isinstance(model, dict):
        raise SelectionError(f"{name}: 'selected' names no entry of 'models'")
    return model


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SelectionError(f"{name} must be a number, found {value!r}")
    try:
        return float(value)
    except OverflowError:
        raise SelectionError(f"{name} is beyond the numbers of a computer") from None


def _count(name: str, value: Any) -> int:
    if problem := Quantity(name, 0, lower=0, upper=_MOST_LAGS).problem(value):
        raise SelectionError(problem)
    return int(value)


def _constants(name: str, values: Any) -> tuple[complex, ...]:
    if values is None:
        return ()
    found = []
    for value in values if isinstance(values, list | tuple) else [values]:
        if isinstance(value, list) and len(value) == 2:
            found.append(complex(_number(name, value[0]), _number(name, value[1])))
        else:
            found.append(complex(_number(name, value)))
    return tuple(found)


def _real(name: str, values: tuple[complex, ...]) -> tuple[float, ...]:
    if any(value.imag for value in values):
        raise SelectionError(
            f"{name} of a structure are real; a complex pair has natural_frequency and damping"
        )
    return tuple(value.real for value in values)


def _coefficients(name: str, values: Any) -> list[float]:
    if not isinstance(values, list | tuple):
        raise SelectionError(f"{name} must be a list of coefficients, found {values!r}")
    return [_number(name, value) for value in values]


_HEADINGS = ("Ms", "Mt", "GM", "PM", "IAE")
# The numbers of gains in each form, with their units.
_ISA = {"kc": "u/y", "ti": "s", "td": "s"}
_NUMBERS = {"isa": _ISA, "series": _ISA, "parallel": {"p": "u/y", "i": "u/(y s)", "d": "u s/y"}}
_UNITS_JUDGED = ("", "", "", "deg", "y s/u")


@dataclass
class _Designs:
    """The gains that some rules give for a process.

    :param task: what is designed.
    :param rule: the rule that was asked for.
    :param form: in which gains are shown: "isa", "parallel" or "series".
    :param every: whether all rules are asked, besides that one.
    :param known: what that one gives, if it was asked before.
    :raises TuningError: if that one is asked alone, and gives none.
    """

    task: DesignTask
    rule: str
    form: str
    every: bool
    known: Sequence[Gains] = ()

    def __post_init__(self) -> None:
        # Those of the rules that apply, the chosen one's first; by name, why a rule gives none.
        self.gains, self.refused = list(self.known), dict[str, str]()
        names = sorted(RULES, key=lambda n: n != self.rule) if self.every else [self.rule]
        for name in names[len(self.known) :]:
            with self._refusing(name):
                self.gains.append(design(self.task, name))

    @contextmanager
    def _refusing(self, name: str) -> Iterator[None]:
        """Note that a rule gives no gains, where others are asked, too."""
        try:
            yield
        except TuningError as error:
            if not self.every:
                raise
            self.refused[name] = str(error)

    @property
    def recommended(self) -> int | None:
        """Index of the gains of the rule that was asked for; None: it gives none."""
        return 0 if self.gains and self.gains[0].rule == self.rule else None

    @cached_property
    def inside(self) -> list[tuple[Compensator, Performance]]:
        """Controllers with a model inside, each with what it does; others are noted as refused."""
        found, task = [], self.task
        for name, make in COMPENSATORS.items() if self.every else ():
            with self._refusing(name):
                made = make(task)
                found.append((made, analyse_loop(made.law, task.process)))
        return found

    def lines(self) -> list[str]:
        """Return the process with the only gains in full, or with all rules side by side.

        :raises TuningError: if the only gains do not have the form.
        """
        model, options = self.task.model, self.task.options
        lines = labelled("process", f"{process_text(model)}   ({model.structure})", width())
        if options.law:
            lines += labelled("law", f"{options.law} every {options.sample_period:g} s", width())
        if not self.every:
            return [*lines, "", *gains_lines(self.gains[0], width=width(), form=self.form)]
        return [*lines, "", *self._side_by_side()]

    def _side_by_side(self) -> list[str]:
        """Return a line for each rule and each controller with a model inside, and why not."""
        rows: list[tuple[str, ...]] = []
        if self.gains:
            rows.append(("", *_NUMBERS[self.form], *_HEADINGS))
            for k, each in enumerate(self.gains):
                mark = "* " if k == self.recommended else "  "
                bare = each.bare if self.form == "parallel" else None
                rows.append((mark + each.rule, *self._in_form(each), *_judged(bare or each)))
            rows.append(("", *_NUMBERS[self.form].values(), *_UNITS_JUDGED))
        if self.inside:
            rows.append(("",) * 9)
            rows.append(("with a model inside", *("",) * 8))
            rows.append(("", "lambda", "DM", "", *_HEADINGS))
            for compensator, found in self.inside:
                numbers = digits(compensator.closed_loop_time), digits(found.delay_margin, 3), ""
                rows.append((f"  {compensator.name}", *numbers, *_judged(found)))
            rows.append(("", "s", "s", "", *_UNITS_JUDGED))
        lines = in_columns(rows, width())
        if self.refused:
            lines += ["", "  no gains by"]
        indent = max(map(len, self.refused), default=0) + 6
        for name, why in self.refused.items():
            lines += labelled(f"  {name}", why, width(), indent=indent)
        return lines

    def document(self) -> dict[str, Any]:
        """Return the gains as a document.

        :raises TuningError: if the only gains do not have the form.
        """
        inside = self.inside
        found: dict[str, Any] = {
            "model": model_fields(self.task.model),
            "gains": [self._fields(each) for each in self.gains],
            "recommended": self.recommended,
            "refused": self.refused,
        }
        if inside:
            found["compensators"] = [
                {
                    "name": each.name,
                    "closed_loop_time": each.closed_loop_time,
                    **to_document(performance),
                    "reason": each.reason,
                }
                for each, performance in inside
            ]
        return found

    def case(self) -> Case:
        """Return the model as a page shows it."""
        from relay_autotune.report.case import Case, given_model

        given = given_model(self.task.model)
        return Case(
            source=process_text(self.task.model),
            models=(given,),
            model=given,
            gains=tuple(self.gains),
            best_gains=None if self.recommended is None else self.gains[0],
            added_delay=self.task.options.added_delay,
        )

    def _in_form(self, gains: Gains) -> tuple[str, ...]:
        try:
            found = series_form(gains) if self.form == "series" else gains
        except TuningError:
            return "no", "series", "form"
        return tuple(digits(getattr(found, name)) for name in _NUMBERS[self.form])

    def _fields(self, gains: Gains) -> dict[str, Any]:
        fields = to_document(gains)
        if self.form == "series":
            try:
                fields["series"] = dict(vars(series_form(gains)))
            except TuningError as error:
                if not self.every:
                    raise
                fields["series"] = {"reason": str(error)}
        return fields


def _judged(found: Gains | Performance) -> tuple[str, ...]:
    return (
        *(digits(x, 3) for x in (found.ms, found.mt, found.gain_margin)),
        digits(math.degrees(found.phase_margin), 3),
        digits(found.iae_load, 3),
    )


PROGRAM = "tune"

_EPILOG = """\
The model is given by flags or by a JSON document, of `replay --json` or
`identify --json`, or such as
  {"gain": 1.65, "time_constants": [20], "dead_time": 10}
A document - is read from standard input.
Units: y of the measurement, u of the command, s.

Results go to standard output, everything else to standard error.

Exit status: 0 done; 1 the rule gives no gains; 2 the command line is wrong.

Examples:
  tune --gain 1.65 --time-constants 20 --dead-time 10
  tune --gain 1.65 --time-constants 20 --dead-time 10 --table
  tune --gain 0.8 --time-constants 25 3 --dead-time 1 --rule simc --lambda 5
  tune --structure integrator_inverse --gain 0.547 --zeros -0.418 \\
       --time-constants 1.06 --dead-time 0.1 --rule luyben2003 --form series
  tune --numerator 1 --denominator 10 7 1 --dead-time 2 --ms 1.6
  replay --json bag | tune - --export pid_controller --dof heater > gains.yaml
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: those of the command line; default: the process's own.
    :return: the exit status.
    """
    options = _parser().parse_args(arguments)
    return run_command(PROGRAM, lambda: _run(options))


def _parser() -> Parser:
    parser = Parser(
        PROGRAM,
        usage="%(prog)s [MODEL | flags of the model] [options]",
        description="Compute controller gains from a model of the process.",
        epilog=_EPILOG,
    )
    parser.add_argument(
        "document", nargs="?", metavar="MODEL", help="JSON document with the model; -: from stdin"
    )
    parser.add_argument(
        "--experiment", type=int, metavar="N", help="which experiment of a document, from 1"
    )
    model = parser.add_argument_group("the model, where no document is given")
    number: dict[str, Any] = {"type": finite}
    several: dict[str, Any] = {"type": finite, "nargs": "+"}
    model.add_argument(
        "--gain", **number, metavar="K", help="gain [y/u; y/(u s) if it integrates]"
    )
    model.add_argument("--time-constants", **several, metavar="T", help="T of (T s + 1) [s]")
    model.add_argument("--dead-time", **number, metavar="S", help="dead time [s]")
    model.add_argument(
        "--zeros", **several, metavar="Z", help="Z of (Z s + 1) above; < 0: inverse response [s]"
    )
    model.add_argument("--integrators", type=int, metavar="N", help="number of poles at s = 0")
    model.add_argument("--order", type=int, metavar="N", help="number of equal lags")
    model.add_argument("--natural-frequency", **number, metavar="W", help="of a pair [rad/s]")
    model.add_argument("--damping", **number, metavar="ZETA", help="of a pair")
    model.add_argument("--structure", metavar="NAME", help="structure, such as unstable_fopdt")
    model.add_argument("--numerator", **several, metavar="B", help="powers of s, highest first")
    model.add_argument("--denominator", **several, metavar="A", help="powers of s, highest first")

    asked = parser.add_argument_group("the rule")
    asked.add_argument("--rule", metavar="NAME", help="the rule; --table shows them all")
    asked.add_argument("--table", action="store_true", help="every rule, side by side")
    add_design(parser)

    shown = parser.add_argument_group("how it is shown")
    shown.add_argument("--form", choices=FORMS, default="isa", help="form of the gains (isa)")
    shown.add_argument("--json", action="store_true", help="print a JSON document")
    add_export(parser).add_argument(
        "--output", metavar="FILE", help="write the file there, not to standard output"
    )
    add_web(parser)
    add_design_details(parser)
    return parser


def _run(options: argparse.Namespace) -> int:
    if options.output is not None and options.export is None:
        raise SelectionError("--output is for --export: say what to write")
    if options.table and options.export is not None:
        raise SelectionError("--export writes the gains of one rule: leave out --table")
    rule = options.rule or DEFAULT_RULE
    if rule not in RULES:
        raise SelectionError(f"unknown rule {rule!r}; known: {', '.join(RULES)}")
    check_web(options)
    asked, target = design_options(options), export_target(options)
    if asked.law and not asked.sample_period:
        raise SelectionError(
            f"{asked.law} runs at a sampling period: give it with --sample-period S"
        )
    task = task_of_model(model_of(options), asked)
    found = _Designs(task, rule, options.form, options.table)
    if options.export is not None:
        (gains,) = found.gains
        write(exported(gains, options.export, target), options.output)
        for warning in gains.warnings:
            say(PROGRAM, warning)
    elif options.json:
        print(to_json(found.document()), flush=True)
    else:
        print("\n".join(found.lines()))
    if not found.gains:
        say(PROGRAM, "no rule gives gains for this model")
    if options.web:
        every = found if options.table else replace(found, every=True, known=found.gains)
        show(options, [(every.case(), Shaping(task))])
    return DONE if found.gains else NOTHING_FOUND
