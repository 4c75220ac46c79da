# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Identify a process from numbers read off a chart: `identify --method NAME --period P ...`."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence

from relay_autotune.cli.arguments import DONE, finite, guarded
from relay_autotune.cli.layout import labelled, width

PROGRAM = "identify"

_EPILOG = """\
Results go to standard output, everything else to standard error.
Exit status: 0 done; 1 no model has these numbers; 2 the command line is wrong.

Examples:
  identify --method wang_biased --period-high 15.4 --period-low 20.4 \\
           --peak-max 0.5 --peak-min -0.29 --relay 1 --bias 0.3 --gain 1
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: those of the command line; default: the process's own.
    :return: the exit status.
    """
    given = _joined(list(sys.argv[1:] if arguments is None else arguments))
    options = _parser().parse_args(given)
    return guarded(PROGRAM, lambda: _run(options))


def _joined(arguments: list[str]) -> list[str]:
    """Join an option and a negative number after it; argparse would take -1e-3 for an option."""
    joined: list[str] = []
    for before, argument in itertools.pairwise(["", *arguments]):
        negative = argument[:1] == "-" and argument[1:2] in tuple("0123456789.")
        if negative and before[:2] == "--" and "=" not in before:
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _parser() -> argparse.ArgumentParser:
    from relay_autotune.cli.chart import CHART_METHODS, NUMBERS, option

    methods = "\n".join(
        line
        for name, chart in CHART_METHODS.items()
        for label, text in (
            (name, chart.summary),
            (
                "",
                "   ".join(
                    [*map(option, chart.required), *(f"[{option(n)}]" for n in chart.optional)]
                ),
            ),
        )
        for line in labelled(label, text, width(), indent=17)
    )
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Identify a process from the numbers of a limit cycle, without a record.",
        epilog=f"methods and their numbers:\n{methods}\n\n{_EPILOG}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--method", required=True, metavar="NAME", help="how to identify")
    for name, number in NUMBERS.items():
        letter = number.unit.upper() if number.unit.isalpha() else "X"
        parser.add_argument(
            option(name), type=finite, metavar=letter, help=f"{number.meaning} [{number.unit}]"
        )
    parser.add_argument("--structure", default="", metavar="NAME", help="structure of the model")
    parser.add_argument(
        "--order", type=int, default=0, metavar="N", help="number of equal lags of the model"
    )
    parser.add_argument("--json", action="store_true", help="print the model as a JSON document")
    return parser


def _run(options: argparse.Namespace) -> int:
    from relay_autotune.cli.chart import NUMBERS, identify_chart
    from relay_autotune.cli.table import identification_lines
    from relay_autotune.errors import ParameterError, SelectionError
    from relay_autotune.exchange.document import to_json
    from relay_autotune.exchange.fields import to_document
    from relay_autotune.identification.known import Known

    numbers = {name: value for name in NUMBERS if (value := getattr(options, name)) is not None}
    try:
        known = Known(structure=options.structure, order=options.order)
    except ParameterError as error:
        raise SelectionError(str(error)) from error
    found = identify_chart(options.method, numbers, known)
    if options.json:
        print(to_json(to_document(found)), flush=True)
    else:
        print("\n".join(identification_lines(found, width())))
    return DONE


if __name__ == "__main__":
    sys.exit(main())
