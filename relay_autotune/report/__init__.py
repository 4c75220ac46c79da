# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The report of an experiment: figures, and a page that says what they mean.

Loading this module is cheap; matplotlib and the template engine are loaded when something is
drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from relay_autotune.process.transfer_function import TransferFunction
    from relay_autotune.report.case import Case
    from relay_autotune.result import Analysis

PICTURES = (".png", ".svg", ".pdf")
# In the head of each page, before the version.
_GENERATOR = b'<meta name="generator" content="relay_autotune '


def draw(
    analysis: Analysis, path: Path | str, *, title: str, truth: TransferFunction | None = None
) -> None:
    """Draw an experiment, the fit over it and the predicted closed loop, in one picture.

    >>> from relay_autotune import analyse, draw, read_records
    >>> (record,) = read_records("bags/heater.csv")
    >>> draw(analyse(record), "heater.png", title="Heater")

    :param analysis: of the record.
    :param path: the picture; its ending says the format (.png, .svg, .pdf).
    :param title: title of the picture.
    :param truth: the true process, if it was simulated.
    """
    from relay_autotune.report.case import case_of

    write_picture(case_of(analysis, title, truth=truth), path)


def write_picture(case: Case, path: Path | str, *, title: str = "") -> None:
    """Draw the most important figures of a case into one picture.

    :param case: from :func:`~relay_autotune.report.case.case_of` or a document.
    :param path: the picture; its ending says the format (.png, .svg, .pdf).
    :param title: of the picture; default: the case's source.
    """
    from relay_autotune.report.figures import draw_picture

    draw_picture(case, Path(path), title=title or case.source)


def write_report(
    analyses: Analysis | Sequence[Analysis],
    path: Path | str,
    *,
    title: str = "",
    truth: TransferFunction | None = None,
) -> None:
    """Write the report of one or several analysed records as one HTML file.

    >>> from relay_autotune import analyse, read_records, write_report
    >>> (record,) = read_records("bags/heater.csv")
    >>> write_report(analyse(record), "heater.html", title="Heater")

    :param analyses: at least one.
    :param path: the file.
    :param title: of the page; default: the id of the first experiment.
    :param truth: the true process, if it was simulated.
    """
    from relay_autotune.report.case import case_of
    from relay_autotune.result import Analysis

    several = [analyses] if isinstance(analyses, Analysis) else list(analyses)
    default = "Relay experiment"
    cases = [case_of(a, a.record.experiment_id or title or default, truth=truth) for a in several]
    write_page(cases, path, title=title)


def write_page(cases: Sequence[Case], path: Path | str, *, title: str = "") -> None:
    """Write the report as one HTML file.

    :param cases: from :func:`~relay_autotune.report.case.case_of` or a document, at least one.
    :param path: the file.
    :param title: of the page; default: the first case's source.
    """
    from relay_autotune.report.page import page

    Path(path).write_text(page(cases, title=title), encoding="utf-8")


def is_ours(path: Path) -> bool:
    """Return whether a file is a page that :func:`write_page` wrote, of any version.

    :param path: the file.
    """
    try:
        with path.open("rb") as file:
            return _GENERATOR in file.read(2000)
    except OSError:
        return False


def write_figures(cases: Sequence[Case], folder: Path | str, kind: str = "png") -> list[Path]:
    """Write each figure of each case to a file of its own.

    :param cases: at least one.
    :param folder: created if it does not exist.
    :param kind: "png" or "svg".
    :return: the files, named after their figures; with several cases the names are numbered.
    """
    from relay_autotune.report.figures import PLATES
    from relay_autotune.report.style import save

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for number, case in enumerate(cases, start=1):
        prefix = f"{number}_" if len(cases) > 1 else ""
        for plate in PLATES:
            if not plate.missing(case):
                written.append(folder / f"{prefix}{plate.key}.{kind}")
                save(plate.figure(case), str(written[-1]))
    return written
