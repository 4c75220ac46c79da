# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""CSV files of other tools."""

from __future__ import annotations

import doctest
import math
import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from relay_autotune.bag import words
from relay_autotune.bag.csv_file import read_csv
from relay_autotune.bag.signals import Selection
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.recordings import read_experiments


def write(path, text):
    path.write_text(text)
    return path


def rows(count=20, header="time,measurement,command"):
    body = "".join(f"{k * 0.1!r},{k % 7},{k // 5 % 2}\n" for k in range(count))
    return f"{header}\n{body}"


def test_three_columns_need_no_names(tmp_path):
    (record,) = read_experiments(write(tmp_path / "a.csv", rows())).experiments
    np.testing.assert_array_equal(record.time, np.arange(20) / 10.0)
    np.testing.assert_array_equal(record.measurement, np.arange(20) % 7)
    np.testing.assert_array_equal(record.input().times, [0.5, 1.0, 1.5])
    assert record.start == 0.0
    assert record.held_input is None


def test_byte_order_mark_spaces_and_blank_lines(tmp_path):
    text = "\ufefft , y , u \n\n 0, 1.0 ,2\n 1,  2.0, 3\n\n2,1.0,2\n\n"
    (record,) = read_experiments(write(tmp_path / "a.csv", text)).experiments
    np.testing.assert_array_equal(record.command, [2.0, 3.0, 2.0])


def test_more_columns_are_named(tmp_path):
    text = "n,t,y,u,note\n" + "".join(f"{k},{k * 2},{k % 5},{k // 3 % 2},ok\n" for k in range(12))
    path = write(tmp_path / "a.csv", text)
    (record,) = read_experiments(path, Selection("y", "u", "t")).experiments
    np.testing.assert_array_equal(record.time, np.arange(12) * 2.0)
    # Names that tell it need not be given.
    (found,) = read_experiments(path).experiments
    np.testing.assert_array_equal(found.command, record.command)
    unclear = write(tmp_path / "b.csv", text.replace("y,u", "a,b", 1))
    with pytest.raises(SelectionError, match=r"5 columns: 'n', 't', 'a', 'b', 'note'; name two"):
        read_experiments(unclear)
    with pytest.raises(SelectionError, match=r"no column 'x'; its columns are 'n', 't', 'y'"):
        read_experiments(path, Selection("x", "u"))
    with pytest.raises(SelectionError, match=r"must be three columns.*'y', 'y'$"):
        read_experiments(path, Selection("y", "y"))
    two = write(tmp_path / "c.csv", "y,u\n0,1\n1,2\n")
    with pytest.raises(SelectionError, match="no time, give the sampling period with --period S"):
        read_experiments(two, Selection("y", "u"))
    with pytest.raises(BagError, match=r"line 2: 'note' is 'ok'; expected a number"):
        read_experiments(path, Selection("note", "u", "t"))


NAMED = [
    # time, set-point, measurement, command, and the units of the last two
    (("Zeit", "Sollwert (°C)", "Istwert (°C)", "Stellgröße (%)"), {"y": "°C", "u": "%"}),
    (("temps", "consigne", "mesure", "commande"), {}),
    (("tiempo", "Consigna (bar)", "Medida (bar)", "Salida (%)"), {"y": "bar", "u": "%"}),
    (("Tempo", "riferimento", "misura", "uscita"), {}),
    (("Datum", "T_soll °C", "T_ist °C", "Ventil %"), {"y": "°C", "u": "%"}),
    (("Time", "PIC7_SP_bar", "PIC7_PV_bar", "PIC7_CV_pct"), {"y": "bar", "u": "%"}),
    (("Time (min)", "Level SP (%)", "Level PV (%)", "Out (%)"), {"y": "%", "u": "%"}),
    (("Elapsed ms", "Target", "T3 degC", "Heater %"), {"y": "degC", "u": "%"}),
    # What is told in a unit of temperature or speed is measured, whatever it is of.
    (("Time", "Ref", "Heater (°C)", "Heater (%)"), {"y": "°C", "u": "%"}),
    (("Time", "Ref", "Motor rpm", "PWM"), {"y": "rpm"}),
]


@pytest.mark.parametrize(("names", "units"), NAMED, ids=lambda case: str(case)[:40])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (0, 3, 1, 2)])
def test_the_one_pair_that_names_allow_is_taken_and_said(tmp_path, names, units, order):
    cells = [line(k).split(",") for k in range(20)]
    rows = [[t, "40", y, u] for t, y, u in cells]
    text = "\n".join(";".join(row[k] for k in order) for row in [list(names), *rows])
    found = read_experiments(write(tmp_path / "a.csv", text))
    (record,) = found.experiments
    assert record.measurement.tolist() == [float(y) for _, y, _ in cells]
    assert record.units == units
    _, _, y, u = names
    assert any(f"{y!r} is taken as the measurement and {u!r} as the" in n for n in found.notes)


@pytest.mark.parametrize("names", [("T_out", "flow"), ("Ausgang", "Eingang")])
def test_what_moves_in_steps_is_the_command_where_one_name_alone_speaks(tmp_path, names):
    rows = [f"{k},{math.sin(0.1 * k):.4f},{50 + 10 * (k // 40 % 2)}" for k in range(200)]
    text = "\n".join([f"time,{','.join(names)}", *rows])
    found = read_experiments(write(tmp_path / "a.csv", text))
    assert set(found.experiments[0].command.tolist()) == {50.0, 60.0}


def test_a_gap_where_a_clock_may_have_jumped_is_told_with_its_time(tmp_path):
    rows = (f"{k + 15 * (k > 60)},{math.sin(0.1 * k):.4f},{k // 40 % 2}" for k in range(200))
    found = read_experiments(write(tmp_path / "a.csv", "\n".join(["time,y,u", *rows])))
    assert any(
        "the longest 16 s, the first after 60 s (if a clock" in note for note in found.notes
    )


def test_the_examples_of_names_are_true():
    assert doctest.testmod(words).failed == 0


def test_one_column_that_is_left_is_the_command_only_if_no_other_is(tmp_path):
    rows = (line(k).replace(",", ",40,", 1) + f",{k % 3}" for k in range(20))
    text = "t,SP,PV,A,B\n" + "\n".join(rows)
    with pytest.raises(SelectionError, match="name two of them") as refused:
        read_experiments(write(tmp_path / "a.csv", text))
    assert str(refused.value).count("--measurement PV --command") == 2


def test_names_that_say_otherwise_than_the_flags_are_told(tmp_path):
    text = "t,SP,PV,CO\n" + "\n".join(
        "{0},{2},{1},{2}".format(*line(k).split(",")) for k in range(20)
    )
    path = write(tmp_path / "a.csv", text)

    def notes(*chosen):
        return " ".join(read_experiments(path, Selection(*chosen, end=99.0)).notes)

    assert "--command 'SP' is called like a set-point" in notes("PV", "SP")
    assert "exchange them" in notes("CO", "PV")
    assert notes("PV", "CO") == ""


@pytest.mark.parametrize(("day", "told"), [("04/05", True), ("21/05", False), ("05/05", False)])
def test_a_date_that_could_be_two_is_told(tmp_path, day, told):
    rows = "".join(f"{day}/2026 06:59:{k:02},{k % 5},{k // 3 % 2}\n" for k in range(12))
    (log,) = read_csv(write(tmp_path / "a.csv", f"time,y,u\n{rows}"), Selection())
    said = [note for note in log.notes if "with the month first" in note]
    assert [note.endswith(": month 4, day 5") for note in said] == [True] * told


def test_a_column_of_dates_is_read_in_one_order_which_any_of_them_may_tell(tmp_path):
    # From the 12th of September, which could be the 9th of December, into the 13th.
    start = datetime(2026, 9, 12, 23, 59, 50, tzinfo=UTC)
    times = [start + timedelta(seconds=2 * k) for k in range(12)]
    rows = [f"{t:%d/%m/%Y %H:%M:%S},{k % 5},{k // 3 % 2}" for k, t in enumerate(times)]
    path = write(tmp_path / "a.csv", "\n".join(["time,y,u", *rows, ""]))
    (log,) = read_csv(path, Selection())
    assert log.measurement.time_ns.tolist() == [round(1e9 * t.timestamp()) for t in times]
    assert not any("with the month first" in note for note in log.notes)
    other = rows[-1].replace("13/09", "09/13")
    mixed = write(tmp_path / "b.csv", "\n".join(["time,y,u", *rows[:-1], other, ""]))
    with pytest.raises(BagError, match="day first and others with the month first"):
        read_csv(mixed, Selection())


def test_dates_in_seconds_become_the_start(tmp_path):
    text = "t,y,u\n" + "".join(f"{1.79e9 + k},{k % 5},{k // 3 % 2}\n" for k in range(12))
    (record,) = read_experiments(write(tmp_path / "a.csv", text)).experiments
    assert record.start == 1.79e9
    np.testing.assert_array_equal(record.time, np.arange(12.0))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty; expected a header line"),
        ("\n\n", "is empty; expected a header line"),
        ("t y u\n0 1 2\n", "has fewer than two rows of numbers; expected more"),
        ("t,y\n0,1\n1,2\n", r"2 columns: 't', 'y'; expected time, measurement and command"),
        # A trace of a PLC with a block for each signal, and one with a pair of columns for each.
        ("PLC.fTemp\n0;20\n1;21\n\nPLC.fOut\n0;5\n1;50\n", "put blocks of single signals side by"),
        ("Type,REAL,Type,REAL\n0,1,0,2\n1,2,1,3\n", "a name of its own for each"),
        # The log of a printer, whose numbers stand between words.
        (
            "Starting Klippy...\nStats 9.1: gcodein=0 heater_bed: target=60 temp=21.5 pwm=0.000\n",
            r"line 2 is 'Stats 9\.1: .*: write the numbers of such lines into columns",
        ),
        ("y,u,v\n1,1,2\n2,2,3\n2,3,3\n1,3,3\n1,3,4\n", "'y' does not rise.*--period S"),
        ("t,setpoint,y\n0,1,2\n1,2,3\n", "'setpoint' seems to be a set-point"),
        ("stamp,y,u\n0,1,2\n10000,2,3\n", "steps by 10000 from row to row.*--time-unit s|ms"),
        (
            "t;y;u\n0;1,5;2\n1;1.5;2\n",
            "a decimal comma and others with a point, such as '1,5' in line 2 and '1.5' in line 3",
        ),
        (
            "t;y;u\n0;1,5;2.000\n1;1,6;3.000\n",
            "a decimal comma and others with a point, .* '1,5' in line 2 and '2.000' in line 2",
        ),
        (
            "t;y;u\n0;1.000,5;2\n1;2;2\n",
            r"line 2: 'y' is '1.000,5'; expected a number; save .*thousands",
        ),
        ("t;y;u\n0;1'000.5;2\n1;2;2\n", "expected a number; save .*without separators of thous"),
        ("t,y,u\n0,1,2\n2026-01-01T00:00:00,2,1\n", "of 2 cells of 't' 1 are dates"),
        ("t,y,u\n" + "0" * (1 << 20) + ",1,2\n", "a line of more than 1048576 characters"),
        ("t,y,u\n", "has fewer than two rows of numbers"),
        ("t,y,u\n0,1,2\n1,inf,2\n", r"line 3: 'y' is inf; expected a finite number"),
        ("t,y,u\n0,1,2\n1,3,-inf\n", r"line 3: 'u' is -inf; expected a finite"),
        ("t,y,u\n0,1,2\n1,3 V,2\n", r"line 3: 'y' is '3 V'; expected a number"),
        ("t,y,u\n0,1,2\n1e18,2,3\n", "expected a time in seconds"),
        ("t,y,u\n0,1,2\n1,1,3\n", r"the measurement y is constant \(1 in all of 2 values\)"),
        ("t,y,u\n0,1,2\n1,4,2\n", r"the command u never changes \(2 in all of 2 values\)"),
        ("t,measurement,u\n0,nan,2\n1,nan,3\n", "^the measurement holds no value"),
        ("t,y,command\n0,1,2\n1,4,2\n", "^the command never changes"),
    ],
)
def test_bad_content_is_a_sentence(tmp_path, text, sentence):
    with pytest.raises((BagError, SelectionError), match=sentence) as caught:
        read_experiments(write(tmp_path / "a.csv", text))
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_or_no_text(tmp_path):
    with pytest.raises(BagError, match="does not exist"):
        read_experiments(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_bytes(b"\xff\x00\x01\x02")
    with pytest.raises(BagError, match="is not a text file"):
        read_experiments(tmp_path / "b.csv")
    (tmp_path / "c.csv").mkdir()
    with pytest.raises(BagError, match="is a folder"):
        read_experiments(tmp_path / "c.csv")


def test_a_controller_at_rest_is_refused_unless_a_part_is_named(tmp_path):
    rng = np.random.default_rng(1)
    lines = ["time,measurement,command"]
    for k, y in enumerate(0.02 * rng.standard_normal(600)):
        lines.append(f"{0.5 * k},{y},{-0.6 * y}")
    path = write(tmp_path / "a.csv", "\n".join(lines))
    with pytest.raises(BagError, match=r"stands out of the noise.*--start"):
        read_experiments(path)
    (record,) = read_experiments(path, Selection(start=0.0)).experiments
    assert len(record) == 600


def line(k, separator=",", point="."):
    cells = (f"{k * 0.5!r}", f"{k % 7 + 0.25!r}", f"{k // 5 % 2}.5")
    return separator.join(cell.replace(".", point) for cell in cells)


def same_as_plain(tmp_path, recording):
    plain = "t,y,u\n" + "\n".join(line(k) for k in range(20))
    (expected,) = read_experiments(write(tmp_path / "plain.csv", plain)).experiments
    (record,) = recording.experiments
    np.testing.assert_array_equal(record.time, expected.time)
    np.testing.assert_array_equal(record.measurement, expected.measurement)
    np.testing.assert_array_equal(record.input().times, expected.input().times)
    np.testing.assert_array_equal(record.input().values, expected.input().values)
    return record


@pytest.mark.parametrize(
    ("separator", "point", "said"),
    [
        (";", ".", ["columns are taken as separated by semicolons"]),
        ("\t", ".", ["columns are taken as separated by tabs"]),
        (
            ";",
            ",",
            [
                "columns are taken as separated by semicolons",
                "a comma within a number is taken as the decimal point",
            ],
        ),
    ],
)
def test_separators_and_decimal_commas(tmp_path, separator, point, said):
    text = separator.join("tyu") + "\n"
    text += "\n".join(line(k, separator, point) for k in range(20))
    found = read_experiments(write(tmp_path / "a.csv", text))
    same_as_plain(tmp_path, found)
    assert list(found.notes) == said


def test_each_column_has_its_own_decimal_mark(tmp_path):
    """As a program writes it that takes the mark of its times alone from the country."""
    rows = (line(k, ";", ".").split(";") for k in range(20))
    text = "t;y;u\n" + "\n".join(f"{t.replace('.', ',')};{y};{u}" for t, y, u in rows)
    same_as_plain(tmp_path, read_experiments(write(tmp_path / "a.csv", text)))


def test_a_header_may_be_missing(tmp_path):
    text = "\n".join(line(k) for k in range(20))
    found = read_experiments(write(tmp_path / "a.csv", text))
    same_as_plain(tmp_path, found)
    assert found.notes == (
        "there is no header line; the columns are called '1', '2', '3'",
        "'3' is taken as the command and '2' as the measurement, since it moves in steps; "
        "--measurement and --command name others",
    )
    chosen = read_experiments(tmp_path / "a.csv", Selection("2", "3", "1"))
    same_as_plain(tmp_path, chosen)


def test_decimal_commas_between_commas_are_no_columns(tmp_path):
    rows = "\n".join(f"{k},0000,{k % 7},5000,{k % 5},2500" for k in range(60))
    with pytest.raises(BagError, match=r"3 names and the rows have 6 cells.*decimal points"):
        read_experiments(write(tmp_path / "a.csv", f"t,u,y\n{rows}"))


def test_a_choice_of_columns_that_nothing_speaks_for_is_told(tmp_path):
    """A measurement that was taken for the command had given gains without a word on it."""
    rows = "\n".join(f"{k},{k % 7}.5,{k % 5}.25" for k in range(60))
    found = read_experiments(write(tmp_path / "a.csv", f"a,b,c\n{rows}"))
    assert found.notes[-1].startswith(
        "'c' is taken as the command and 'b' as the measurement, since it comes last; "
    )


def stamped(form):
    cells = [line(k).split(",") for k in range(20)]
    return "\n".join(",".join((form(float(t)), y, u)) for t, y, u in cells)


@pytest.mark.parametrize(
    ("header", "form", "said", "start"),
    [
        ("t [ms]", lambda t: f"{1e3 * t:g}", "the time is taken in ms, as 't [ms]' says", 0.0),
        ("t (min)", lambda t: f"{t / 60:.12f}", "the time is taken in min, as", 0.0),
        ("t", lambda t: f"{1.79e12 + 1e3 * t:.0f}", "'t' is taken as milliseconds", 1.79e9),
        ("t", lambda t: f"{1.79e15 + 1e6 * t:.0f}", "'t' is taken as microseconds", 1.79e9),
        ("time_ms", lambda t: f"{1e3 * t:g}", "the time is taken in ms, as 'time_ms' says", 0.0),
        ("micros", lambda t: f"{1e6 * t:.0f}", "the time is taken in micros, as", 0.0),
        ("t (d)", lambda t: f"{t / 86400:.15f}", "the time is taken in d", 0.0),
        (
            "t",
            lambda t: f"23:59:{55 + t:06.3f}" if t < 5.0 else f"0:00:{t - 5.0:06.3f}",
            "'t' is taken as the time of day",
            0.0,
        ),
        ("t", lambda t: f"09/21/2026 01:46:{40 + t:06.3f} PM", "taken as dates in UTC", None),
        ("t", lambda t: f"21.9.2026 13:46:{40 + t:.1f}", "taken as dates in UTC", None),
        ("t", lambda t: f"2026-09-21T13:46:{40 + t:06.3f}Z", "taken as dates in UTC", None),
        ("t", lambda t: f"2026-09-21 15:46:{40 + t:06.3f}+02:00", "taken as dates", None),
    ],
)
def test_times_in_other_units_and_dates(tmp_path, header, form, said, start):
    text = f"{header},y,u\n" + stamped(form)
    found = read_experiments(write(tmp_path / "a.csv", text))
    record = same_as_plain(tmp_path, found)
    assert said in found.notes[0]
    assert record.start == (1789998400.0 if start is None else start)


@pytest.mark.parametrize("header", ["Date", "Time", "t (d)"])
def test_the_dates_of_a_spreadsheet_are_days(tmp_path, header):
    """Of 2026-09-21, in cells that are shown as numbers."""
    text = f"{header},y,u\n" + stamped(lambda t: f"{serial(t):.11f}")
    found = read_experiments(write(tmp_path / "a.csv", text))
    assert "is taken as days since 1899-12-30" in found.notes[0]
    (record,) = found.experiments
    assert record.start == pytest.approx(1789998400.0, abs=1e-5)
    np.testing.assert_allclose(record.time, 0.5 * np.arange(20), atol=1e-5)


def serial(seconds):
    """Return a time on 2026-09-21 in the days of a spreadsheet."""
    at = datetime(2026, 9, 21, 13, 46, 40) + timedelta(seconds=seconds)
    return (at - datetime(1899, 12, 30)) / timedelta(days=1)


def test_the_uptime_of_a_fast_logger_is_no_date(tmp_path):
    rows = "\n".join(f"{25_200 + 0.001 * k:.3f},{k % 7},{k // 9 % 2}" for k in range(40))
    found = read_experiments(write(tmp_path / "a.csv", f"time,y,u\n{rows}"), Selection(end=1.0))
    assert found.experiments[0].duration == pytest.approx(0.039)


def test_a_unit_in_a_header_need_not_be_typed(tmp_path):
    text = "t,T1 [degC],T2 [degC],Q1 (%)\n" + "\n".join(
        line(k).replace(",", ",0,", 1) for k in range(20)
    )
    path = write(tmp_path / "a.csv", text)
    same_as_plain(tmp_path, read_experiments(path, Selection("T2", "Q1")))
    with pytest.raises(SelectionError, match="no column 'T'"):
        read_experiments(path, Selection("T", "Q1"))


def test_a_line_of_units_below_the_header_is_left_out_and_said(tmp_path):
    text = "t,y,u\ns,degC,%\n" + "\n".join(line(k) for k in range(20))
    found = read_experiments(write(tmp_path / "a.csv", text))
    same_as_plain(tmp_path, found)
    assert found.notes == ("line 2 holds no number and is taken for units",)


def test_empty_cells_are_a_gap_that_is_said(tmp_path):
    cells = [line(k).split(",") for k in range(20)]
    cells[6][1] = cells[7][1] = ""
    cells[8][2] = ""
    text = "t,y,u\n" + "\n".join(",".join(row) for row in cells)
    found = read_experiments(write(tmp_path / "a.csv", text))
    (record,) = found.experiments
    assert len(record) == 18
    np.testing.assert_array_equal(record.input().times, [2.5, 5.0, 7.5])
    assert found.notes == (
        "2 cells of the column 'y' are empty and left out; the longest gap is 1.5 s",
        "1 cells of the column 'u' are empty and left out; the longest gap is 1 s",
    )


def test_a_named_part_is_apart_at_a_gap_in_which_the_command_changed(tmp_path):
    """The row after the gap comes late, and one model of all would get too little dead time."""
    steps = [(k, float(k % 7), float(20 <= k < 40 or k >= 70)) for k in range(100)]
    text = "t,y,u\n" + "".join(f"{t},{y},{u}\n" for t, y, u in steps if not 33 < t < 45)
    path = write(tmp_path / "a.csv", text)
    found = read_experiments(path, Selection(start=0.0))
    assert [len(record) for record in found.experiments] == [34, 55]
    # What was commanded before acts after the gap as little as what nobody knows of it.
    after = found.experiments[1].input()
    assert (after.initial, after.times.tolist()) == (0.0, [25.0])
    assert "an experiment ends there" in found.notes[0]
    # Without a move that is known nothing is left to learn from.
    (before,) = read_experiments(path, Selection(start=0.0, end=60.0)).experiments
    assert len(before) == 34
    (still,) = read_experiments(path, Selection(start=21.0, end=60.0)).experiments
    assert np.ptp(still.command) == 0.0


def test_of_two_rows_at_one_time_the_second_has_the_step(tmp_path):
    text = "t,y,u\n0,1,0\n0,1,5\n" + "".join(f"{k},{k},5\n" for k in range(1, 20))
    found = read_experiments(write(tmp_path / "a.csv", text))
    (record,) = found.experiments
    held = record.input()
    assert (held.initial, held.times.tolist(), held.values.tolist()) == (0.0, [0.0], [5.0])
    assert "1 rows have the time of the row before" in found.notes[0]


def test_rows_are_put_into_the_order_of_their_time(tmp_path):
    order = np.random.default_rng(3).permutation(20).tolist()
    text = "t,y,u\n" + "\n".join(line(k) for k in order)
    found = read_experiments(write(tmp_path / "a.csv", text))
    same_as_plain(tmp_path, found)
    assert found.notes[0].endswith("rows are put into its order")


def test_two_recordings_in_one_file_are_not_mixed(tmp_path):
    body = "\n".join(line(k) for k in range(30))
    still = "\n".join(f"{k},{k},1" for k in range(20))
    text = f"t,y,u\n{body}\nt,y,u\n{body}\n{still}\n"
    found = read_experiments(write(tmp_path / "a.csv", text))
    first, second = found.experiments
    np.testing.assert_array_equal(first.time, second.time)
    np.testing.assert_array_equal(first.measurement, second.measurement)
    assert "the time starts anew at line 33, 63: 3 recordings are read" in " ".join(found.notes)
    assert "one of the recordings is left out: the command u never changes" in found.notes[-1]


def test_latin_1_utf_16_and_what_spreadsheets_add(tmp_path):
    body = "\n".join(line(k, ";") for k in range(20))
    text = f"sep=;\nt;T [\u00b0C];u\n{body}"
    (tmp_path / "a.csv").write_bytes(text.encode("latin-1"))
    found = read_experiments(tmp_path / "a.csv", Selection("T", "u"))
    same_as_plain(tmp_path, found)
    assert "the text is not UTF-8 and is taken as Latin-1" in found.notes
    (tmp_path / "b.csv").write_bytes(text.encode("utf-16"))
    same_as_plain(tmp_path, read_experiments(tmp_path / "b.csv", Selection("T", "u")))


def test_a_hash_begins_a_remark_or_the_header(tmp_path):
    body = "\n".join(line(k) for k in range(20))
    for k, head in enumerate(("# made by a logger\nt,y,u", "# t, y, u")):
        path = write(tmp_path / f"{k}.csv", f"{head}\n{body}")
        same_as_plain(tmp_path, read_experiments(path))


def test_a_record_that_begins_with_its_step_is_an_experiment(tmp_path):
    rng = np.random.default_rng(5)
    t = 0.5 * np.arange(300)
    y = 3.0 * (1.0 - np.exp(-t / 20.0)) + 0.01 * rng.standard_normal(300)
    text = "t,y,u\n0,0,0\n" + "\n".join(
        f"{a!r},{b!r},5" for a, b in zip(t.tolist(), y.tolist(), strict=True)
    )
    (record,) = read_experiments(write(tmp_path / "a.csv", text)).experiments
    held = record.input()
    assert (held.initial, held.values.tolist()) == (0.0, [5.0])


def test_columns_are_called_as_exports_call_the_joints(tmp_path):
    rng = np.random.default_rng(1)
    y = rng.standard_normal((20, 2)).tolist()
    head = "t,/joint_states:velocity[left],/joint_states:velocity[right],/effort:data[1]"
    rows = "".join(f"{0.1 * k:g},{a!r},{b!r},{k // 5}\n" for k, (a, b) in enumerate(y))
    path = write(tmp_path / "a.csv", f"{head}\n{rows}")
    for column, name in enumerate(("left", "right")):
        wanted = Selection(f"/joint_states:velocity[{name}]", "/effort:data[1]", start=0.0)
        (record,) = read_experiments(path, wanted).experiments
        assert record.measurement.tolist() == [row[column] for row in y]
    with pytest.raises(SelectionError, match=r"no column '/joint_states:velocity\[arm\]'"):
        read_experiments(path, Selection("/joint_states:velocity[arm]", "/effort:data[1]"))


WAYS = {
    "spaces": ("t  y u\n", lambda t, y, u: f" {t}   {y}\t{u}"),
    "spaces and commas": (
        "",
        lambda t, y, u: f"{t.replace('.', ',')} {y.replace('.', ',')} {u.replace('.', ',')}",
    ),
    "command first": ("Time,Q1,T1\n", lambda t, y, u: f"{t},{u},{y}"),
    "command first, no names": ("", lambda t, y, u: f"{t},{u},{y}"),
    "a preamble": ("Motor 3\n\nPID,1,2,3\n2 May, at noon\nt,y,u\n", "{},{},{}".format),
    "an index": (",Time,y,u\n", lambda t, y, u: f"{float(t) * 2:g},{t},{y},{u}"),
    "time last": ("y,u,Timestamp\n", lambda t, y, u: f"{y},{u},{t}"),
    "names without cells": ("# t,y,u,P,I,D\n", "{},{},{}".format),
    "units behind numbers": ("t,y,u\n", lambda t, y, u: f"{t},{y} \u00b0C,{u}%"),
    "units below names": ("t,y,u\nms,degC,%\n", lambda t, y, u: f"{float(t) * 1e3:g},{y},{u}"),
    "date and time apart": (
        "Date,Time,y,u\n",
        lambda t, y, u: f"2026.02.22, 23:20:{float(t):06.3f}, {y}, {u}",
    ),
    "date and time apart, no names": (
        "",
        lambda t, y, u: f"22/02/2026 23:20:{float(t):06.3f} {y} {u}",
    ),
    "an indent": ("\t\tt\ty\tu\n", "{}\t{}\t{}".format),
    "no number": ("t,y,u\n0.25,nan,0.5\n0.3,null,0.5\n", "{},{},{}".format),
}


@pytest.mark.parametrize("way", WAYS)
def test_tables_as_programs_write_them(tmp_path, way):
    head, form = WAYS[way]
    names = way in ("an index", "names without cells")
    text = head + "\n".join(form(*line(k).split(",")) for k in range(20))
    wanted = Selection("y", "u") if names else None
    same_as_plain(tmp_path, read_experiments(write(tmp_path / "a.txt", text), wanted))


def dated(at, k):
    """Return a row at a local time, of the plain record."""
    return f"{at:%Y-%m-%d %H:%M:%S.%f}," + line(k).split(",", 1)[1]


START = datetime(2026, 10, 25, 2, 59, 55)


def test_a_clock_that_is_set_back_by_an_hour_is_counted_on(tmp_path):
    stamps = [START + timedelta(seconds=0.5 * k) for k in range(20)]
    local = [at - timedelta(hours=at.hour >= 3) for at in stamps]
    rows = "\n".join(dated(at, k) for k, at in enumerate(local))
    found = read_experiments(write(tmp_path / "a.csv", f"time,y,u\n{rows}"))
    same_as_plain(tmp_path, found)
    assert any("set back by an hour at row 11 of numbers" in note for note in found.notes)


def test_two_recordings_of_an_hour_are_two(tmp_path):
    rows = "\n".join(f"{5 * (k % 720)},{k // 30 % 5},{k // 90 % 2}" for k in range(1440))
    first, second = read_csv(write(tmp_path / "a.csv", f"t (s),y,u\n{rows}"), Selection())
    assert len(first.measurement) == len(second.measurement) == 720


def test_a_stamp_of_a_clock_that_was_not_set_is_left_out(tmp_path):
    rows = [dated(START + timedelta(seconds=k), k % 7) for k in range(100)]
    rows[70] = "1970-01-01 00:00:00,3,3"
    (log,) = read_csv(write(tmp_path / "a.csv", "time,y,u\n" + "\n".join(rows)), Selection())
    assert len(log.measurement) == 99
    assert np.diff(log.measurement.time_ns).max() == 2 * 10**9
    assert any("before 1973 are left out" in n and "in line 72" in n for n in log.notes)


def test_rows_that_stand_twice_count_once(tmp_path):
    rows = "\n".join(line(k // 2) for k in range(40))
    found = read_experiments(write(tmp_path / "a.csv", f"t,y,u\n{rows}"))
    same_as_plain(tmp_path, found)
    assert found.notes == ("20 rows stand twice, and count once",)


@pytest.mark.parametrize("cell", ["75,5", "7,550.0", "-7,5"])
def test_a_comma_within_a_number_between_commas_is_told(tmp_path, cell):
    rows = "\n".join(f'{k},"{cell}",{k % 2}' for k in range(9))
    with pytest.raises(BagError, match=r"commas separate columns.*semicolons between"):
        read_experiments(write(tmp_path / "a.csv", f"t,y,u\n{rows}"))


def test_a_decimal_comma_that_makes_two_cells_is_told(tmp_path):
    rows = "\n".join(f"{k},75,{k},45,00" for k in range(9))
    with pytest.raises(BagError, match=r"3 names and the rows have 5 cells.*commas separate"):
        read_experiments(write(tmp_path / "a.csv", f"t,PV,CO\n{rows}"))


def test_two_columns_of_one_name_have_to_be_renamed(tmp_path):
    text = "t,PV,PV,CO\n" + "\n".join(line(k).replace(",", ",1,", 1) for k in range(20))
    with pytest.raises(SelectionError, match=r"2 columns named 'PV'.*change them in its header"):
        read_experiments(write(tmp_path / "a.csv", text))


def test_a_column_whose_name_cannot_be_typed_is_chosen_by_its_number(tmp_path):
    rows = [f"{2 * k},{k % 7 + 0.25},{k // 5 % 2}.5" for k in range(20)]
    path = write(tmp_path / "a.csv", "time,speed\\n,duty\\n\n" + "\n".join(rows))
    found = read_experiments(path, Selection("2", "3"))
    (record,) = found.experiments
    assert record.measurement.tolist() == [float(row.split(",")[1]) for row in rows]
    assert any("in seconds, 2 s from row to row; --time-unit names" in n for n in found.notes)
    with pytest.raises(SelectionError, match="no column '4'"):
        read_experiments(path, Selection("4", "3"))


def test_rows_without_times_need_their_period(tmp_path):
    cells = [line(k).split(",") for k in range(20)]
    text = "input,output\n" + "\n".join(f"{u},{y}" for _, y, u in cells)
    path = write(tmp_path / "a.csv", text)
    found = read_experiments(path, Selection(period=0.5))
    same_as_plain(tmp_path, found)
    assert "'input' is taken as the command" in found.notes[0]
    for wanted in (Selection(period=0.5, time="input"), Selection(period=0.0)):
        with pytest.raises(SelectionError, match="--period"):
            read_experiments(path, wanted)


def test_a_relay_may_be_on_or_off_and_a_few_damaged_rows_are_left_out(tmp_path):
    rows = [f"{0.1 * k:.1f},{k % 7},{'ON' if k // 5 % 2 else 'off'}" for k in range(200)]
    rows[40] = "4.0,o.3,off"
    rows[60:60] = ["time,temp,heater", "# restarted"]
    found = read_experiments(write(tmp_path / "a.csv", "time,temp,heater\n" + "\n".join(rows)))
    (record,) = found.experiments
    assert len(record) == 199
    assert set(record.command.tolist()) == {0.0, 1.0}
    assert "1 rows hold something else than numbers and are left out, the first: line 42" in (
        " ".join(found.notes)
    )
    assert "2 lines between the rows hold remarks" in " ".join(found.notes)


def test_a_step_before_the_first_row_needs_the_command_before_it(tmp_path):
    t = 0.05 * np.arange(60)
    speed = 1000.0 * (1.0 - np.exp(-t / 0.3)) + np.random.default_rng(2).normal(0.0, 5.0, 60)
    text = "t,volt,speed\n" + "".join(
        f"{a:.2f},10,{b:.2f}\n" for a, b in zip(t, speed, strict=True)
    )
    path = write(tmp_path / "a.csv", text)
    with pytest.raises(BagError, match=r"never changes \(10 in all.*--command-before"):
        read_experiments(path)
    (record,) = read_experiments(path, Selection(command_before=0.0)).experiments
    held = record.input()
    assert (held.initial, held.times.tolist(), held.values.tolist()) == (0.0, [0.0], [10.0])
    # One that it goes on with is known to have held before the first row.
    then = text + "3.00,20,1500.00\n"
    selection = Selection(command_before=10.0)
    (record,) = read_experiments(write(tmp_path / "c.csv", then), selection).experiments
    held = record.input()
    assert (held.initial, held.times[0], held.values.tolist()) == (10.0, 0.0, [10.0, 20.0])
    # Before the next one it was what it was in this one, or nobody knows.
    back = "".join(f"{a:.2f},-10,{1000.0 - b:.2f}\n" for a, b in zip(t, speed, strict=True))
    found = read_experiments(write(tmp_path / "b.csv", text + back), Selection(command_before=0.0))
    assert [r.input().values.tolist() for r in found.experiments] == [[10.0]]
    assert "used for the first recording in the file alone" in " ".join(found.notes)
    with pytest.raises(BagError, match=r"none of the 2 recordings in the file.*never changes"):
        read_experiments(tmp_path / "b.csv")


def test_rows_that_share_a_coarse_stamp_are_spread_up_to_the_next_one(tmp_path):
    times = 0.3 + 0.25 * np.arange(200)
    text = "".join(f"{t // 1:g},{50.0 + t:.3f},{40.0 if t < 20.0 else 60.0:g}\n" for t in times)
    found = read_experiments(write(tmp_path / "a.csv", f"time,y,u\n{text}"))
    (record,) = found.experiments
    assert np.diff(record.time) == pytest.approx(0.25)
    assert "about 4 rows share each time stamp" in found.notes[-1]


@pytest.mark.parametrize(("head", "tail"), [(",", ","), ("", ","), (",,", ",,"), ("", ",,")])
def test_a_separator_at_the_end_of_each_line_makes_no_column(tmp_path, head, tail):
    body = "".join(f"{k * 0.1!r},{k % 7},{k // 5 % 2}{tail}\n" for k in range(20))
    (record,) = read_experiments(write(tmp_path / "a.csv", f"t,y,u{head}\n{body}")).experiments
    np.testing.assert_array_equal(record.measurement, np.arange(20) % 7)


def test_fewer_names_than_cells_are_not_taken_and_said(tmp_path):
    body = "".join(f"{k * 0.1!r},{k % 7},{k // 5 % 2},{k}\n" for k in range(20))
    path = write(tmp_path / "a.csv", f"t,y,u\n{body}")
    found = read_experiments(path, Selection(measurement="2", command="3"))
    assert found.notes[0].startswith("line 1 has 3 names and the rows have 4 cells")


@pytest.mark.parametrize("year", [1677, 2263, 9999])
def test_a_date_beyond_nanoseconds_is_a_sentence(tmp_path, year):
    body = "".join(f"{year}-06-01 00:00:{k:02},{k % 7},{k // 5 % 2}\n" for k in range(20))
    with pytest.raises(BagError, match="before 1678 or after 2262"):
        read_experiments(write(tmp_path / "a.csv", f"time,y,u\n{body}"))


@pytest.mark.parametrize(
    ("header", "begin", "step", "range_", "unit"),
    [
        ("millis", 2**32 - 3050, 100, 2**32, 1e-3),
        ("time [ms]", 2**16 - 2010, 100, 2**16, 1e-3),
        ("time", 4294.0, 0.1, 4294.967296, 1.0),
    ],
)
def test_a_counter_that_wraps_around_is_counted_on(tmp_path, header, begin, step, range_, unit):
    ticks = [(begin + k * step) % range_ for k in range(60)]
    text = "".join(f"{t!r},{k % 7},{k // 5 % 2}\n" for k, t in enumerate(ticks))
    found = read_experiments(write(tmp_path / "a.csv", f"{header},y,u\n{text}"))
    (record,) = found.experiments
    np.testing.assert_allclose(record.time, np.arange(60) * step * unit, atol=1e-6)
    assert any("wraps around at" in note for note in found.notes)


@pytest.mark.parametrize("own_rows", [False, True])
@pytest.mark.parametrize(
    ("written", "unseen"),
    # Each 10 s, whether it moved or not; and only where it moved.
    [(lambda k, u: k % 10 == 0, 10.0), (lambda k, u: k == 0 or u(k) != u(k - 1), None)],
)
def test_a_command_that_is_read_seldom_may_have_moved_since_its_last_reading(
    tmp_path, own_rows, written, unseen
):
    def u(k):
        return (0, 10, 0, -10, 0, 10)[k // 83]

    text = "time,y,u\n"
    for k in range(480):
        of = u(k) if written(k, u) else ""
        y = 50 + u(max(k - 20, 0)) + k % 3
        text += f"{k},{y},\n" + (f"{k}.3,,{of}\n" if of != "" else "") if own_rows else ""
        text += "" if own_rows else f"{k},{y},{of}\n"
    found = read_experiments(write(tmp_path / "a.csv", text), Selection("y", "u", "time"))
    expected = unseen or (0.0 if own_rows else 1.0)
    assert [record.unseen for record in found.experiments] == [expected]


def test_a_column_that_is_constant_or_empty_is_not_proposed(tmp_path):
    text = "Time,Speed,Temp,Heater,Fan\n" + "".join(
        f"{k},,{k % 7},{k // 5 % 2},30\n" for k in range(20)
    )
    with pytest.raises(SelectionError, match="name two of them") as refused:
        read_experiments(write(tmp_path / "a.csv", text))
    assert str(refused.value).splitlines()[1:] == [
        "  --measurement Temp --command Heater  # as their names say"
    ]
    # No other column stands in for the only ones whose names tell a role.
    path = write(tmp_path / "b.csv", text.replace("Temp,Heater", "Sway,Heave"))
    with pytest.raises(SelectionError, match=r"\(constant, .*: 'Speed', 'Fan'\)$") as refused:
        read_experiments(path)
    assert "\n" not in str(refused.value)
    # Of a command that never changes it may be told what it was before.
    text = text.replace("Heater", "Ref")
    (record,) = read_experiments(
        write(tmp_path / "c.csv", text), Selection("Temp", command_before=0.0, end=99.0)
    ).experiments
    assert set(record.command.tolist()) == {30.0}


def test_of_three_columns_the_one_that_never_changes_is_the_command(tmp_path):
    text = "".join(f"{k},255,{k % 7}\n" for k in range(20))
    with pytest.raises(BagError, match=r"the command 2 never changes.*--command-before"):
        read_experiments(write(tmp_path / "a.csv", text))


def test_columns_of_two_experiments_side_by_side_are_proposed_in_pairs(tmp_path):
    slow = [f"{math.sin(0.01 * k):.4f}" for k in range(400)]
    text = "uEst,uVal,yEst,yVal,Ts,\n" + "".join(
        f"{y},{k // 50 % 2},{k // 40 % 3},{y},{'' if k else 4},\n" for k, y in enumerate(slow)
    )
    path = write(tmp_path / "a.csv", text)
    with pytest.raises(SelectionError, match=r"'uEst' does not rise from row to row, so .*--per"):
        read_experiments(path)
    with pytest.raises(SelectionError, match="name two of them") as refused:
        read_experiments(path, Selection(period=4.0))
    pairs = [line.split("--")[1:] for line in str(refused.value).splitlines()[1:]]
    assert [[flag.split()[1] for flag in pair] for pair in pairs] == [
        ["yEst", "uEst"],
        ["yVal", "uVal"],
    ]


@pytest.mark.parametrize(
    ("names", "pairs"),
    [
        ("Time,Q1,Q2,T1,T2", [("T1", "Q1"), ("T2", "Q2")]),
        ("Time,PWM_M1,PWM_M2,I_M1,I_M2", [("I_M1", "PWM_M1"), ("I_M2", "PWM_M2")]),
        # One pair may be alike by chance.
        (
            "Time,Heater,Cold Pump,Very cold level,Level",
            [(y, u) for y in ("'Very cold level'", "Level") for u in ("Heater", "'Cold Pump'")],
        ),
    ],
)
def test_a_command_is_proposed_with_the_measurement_of_its_own_suffix(tmp_path, names, pairs):
    rows = (f"{k},{k // 5 % 2},{k // 9},{k % 7},{k % 5}\n" for k in range(60))
    text = names + "\n" + "".join(rows)
    with pytest.raises(SelectionError, match="name two of them") as refused:
        read_experiments(write(tmp_path / "a.csv", text))
    lines = str(refused.value).splitlines()[1:]
    found = [re.findall(r"--\w+ ('[^']*'|\S+)", line) for line in lines]
    assert [tuple(pair) for pair in found] == pairs


def test_the_time_may_be_the_one_column_that_rises(tmp_path):
    cells = [line(k).split(",") for k in range(40)]
    text = "".join(f"4,{y},{u},{t}\n" for t, y, u in cells)
    found = read_experiments(write(tmp_path / "a.csv", text), Selection("2", "3"))
    assert found.experiments[0].time.tolist() == [0.5 * k for k in range(40)]
    assert "the time is taken from the column '4', which alone rises" in found.notes
    two = write(tmp_path / "b.csv", "".join(f"{y},{u},{t},{t}\n" for t, y, u in cells))
    with pytest.raises(SelectionError, match=r"'1' does not rise .*as '3', '4' do, so it is no"):
        read_experiments(two)


@pytest.mark.parametrize(("between", "separator"), [(",", "\t"), (", ", ";"), (";", " ")])
def test_names_may_be_separated_otherwise_than_the_rows(tmp_path, between, separator):
    head = between.join(("Time (s)", "Actual temperature (degC)", "Heater (%)"))
    body = "\n".join(line(k, separator) for k in range(20))
    found = read_experiments(write(tmp_path / "a.csv", f"{head}\n{body}"))
    assert same_as_plain(tmp_path, found).units == {"y": "degC", "u": "%"}
    assert any("the names of columns are separated by " in note for note in found.notes)


def test_the_words_of_a_title_are_no_names(tmp_path):
    body = "\n".join(line(k) for k in range(20))
    found = read_experiments(write(tmp_path / "a.csv", f"Step of today\n{body}"))
    assert found.notes[0] == "there is no header line; the columns are called '1', '2', '3'"


@pytest.mark.parametrize(
    "garbled", ["9.5,3.25,0.9.5,3.25,0.5", "3.25,0.5", "45.5,4.25,0.5,7", "7"]
)
def test_a_few_lines_with_another_number_of_cells_are_left_out(tmp_path, garbled):
    rows = [line(k) for k in range(200)]
    rows[100] = garbled
    path = tmp_path / "a.csv"
    found = read_experiments(write(path, "t,y,u\n" + "\n".join(rows)))
    assert len(found.experiments[0]) == 199
    cells = garbled.count(",") + 1
    (note,) = (note for note in found.notes if "number of cells" in note)
    assert note.startswith(
        f"1 rows have another number of cells and are left out, the first: line 102: {cells} cells"
    )
    rows[50:60] = ["1,2,3,4"] * 10
    with pytest.raises(BagError, match="line 52: 4 cells, but 3 columns have a name"):
        read_experiments(write(path, "t,y,u\n" + "\n".join(rows)))


def test_rows_without_their_last_empty_cells_are_whole(tmp_path):
    rows = (f"{k},{k % 7}" + f",{k // 20 % 2}" * (k < 2 or k % 20 == 0) for k in range(200))
    path = write(tmp_path / "a.csv", "t,y,u\n" + "\n".join(rows))
    (record,) = read_experiments(path).experiments
    assert len(record) == 200


def bursts(taken, interval=0.05, spread=0.03):
    """Return the times at which rows arrive that are taken at some times, and sent in bursts."""
    calls = np.cumsum(interval + spread * (np.random.default_rng(3).random(taken.size) - 0.5))
    sent = np.searchsorted(calls, taken)
    return calls[sent] + 0.0002 * (np.arange(taken.size) - np.searchsorted(sent, sent))


def response(t):
    """Return a measurement and a command that steps each 2 s."""
    since = np.mod(t, 4.0)
    rise = 1.0 - np.exp(-since / 0.5)
    fall = np.exp(-(since - 2.0) / 0.5)
    y = 100.0 * np.where(since < 2.0, rise, fall)
    return y + np.random.default_rng(4).normal(0.0, 1.0, t.size), (since < 2.0).astype(int)


def table(path, t, y, u):
    rows = zip(t, y, u, strict=True)
    return write(path, "time,y,u\n" + "".join(f"{a:.6f},{b:.4f},{c}\n" for a, b, c in rows))


def test_rows_that_were_stamped_in_bursts_are_spread_over_the_time_before(tmp_path):
    taken = 0.01 * np.arange(1200)
    t = bursts(taken)
    assert np.all(np.diff(t) > 0.0)
    found = read_experiments(table(tmp_path / "a.csv", t, *response(taken)))
    (record,) = found.experiments
    late = record.time - taken - np.median(record.time - taken)
    assert np.max(np.abs(late)) < 0.04
    assert np.std(late) < 0.5 * np.std(t - taken)
    assert any("rows come in bursts of about 5" in note for note in found.notes)


def sampled_at_once(taken):
    t = bursts(taken)
    return t, *response(t)


def with_pauses(taken):
    t = taken + 0.5 * (np.arange(taken.size) // 8)
    return t, *response(t)


def uneven(taken):
    t = np.cumsum(np.random.default_rng(5).exponential(0.01, taken.size))
    return t, *response(t)


def on_change(taken):
    t = np.arange(0.0, 24.0, 0.001)
    y, u = response(t)
    y = np.round(y - np.random.default_rng(4).normal(0.0, 1.0, t.size))
    kept = np.flatnonzero(np.diff(y, prepend=-1.0))
    return t[kept], y[kept], u[kept]


def signal_by_signal(taken):
    cycle, place = np.divmod(np.arange(taken.size), 5)
    t = 0.05 * cycle + 0.0002 * place
    y, u = response(0.05 * np.arange(cycle[-1] + 2))
    return t, y[cycle + (place >= 2)], u[cycle]


@pytest.mark.parametrize(
    "way", [sampled_at_once, with_pauses, uneven, on_change, signal_by_signal]
)
def test_rows_that_were_taken_when_they_are_stamped_stay_there(tmp_path, way):
    t, y, u = way(0.01 * np.arange(1200))
    found = read_csv(table(tmp_path / "a.csv", t, y, u), Selection())
    assert not any("bursts" in note for log in found for note in log.notes)
    np.testing.assert_allclose(found[0].measurement.time_ns / 1e9, t, atol=1e-6)
