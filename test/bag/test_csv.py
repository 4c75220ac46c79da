"""CSV files of other tools."""

from __future__ import annotations

import numpy as np
import pytest

from relay_autotune.bag.reader import Selection, read_experiments
from relay_autotune.errors import BagError, SelectionError


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
    with pytest.raises(SelectionError, match=r"5 columns: 'n', 't', 'y', 'u', 'note'; name two"):
        read_experiments(path)
    with pytest.raises(SelectionError, match=r"no column 'x'; its columns are 'n', 't', 'y'"):
        read_experiments(path, Selection("x", "u"))
    with pytest.raises(SelectionError, match="must be three columns"):
        read_experiments(path, Selection("y", "y"))
    with pytest.raises(BagError, match=r"line 2: 'note' is 'ok'; expected a number"):
        read_experiments(path, Selection("note", "u", "t"))


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
        ("0,1,2\n1,2,3\n", "has no header line: its first line is 0, 1, 2"),
        ("t;y;u\n0;1;2\n", r"has the columns 't;y;u'; expected at least three"),
        ("t,y,u\n", "has 0 rows of numbers"),
        ("t,y,u\n0,1,2\n1,,2\n", r"line 3: the column 'y' is missing"),
        ("t,y,u\n0,1,2\n1,5\n", r"line 3: the column 'u' is missing"),
        ("t,y,u\n0,1,2\n1,nan,2\n", r"line 3: 'y' is nan; expected a finite number"),
        ("t,y,u\n0,1,2\n1,3,-inf\n", r"line 3: 'u' is -inf; expected a finite"),
        ("t,y,u\n0,1,2\n1,3 V,2\n", r"line 3: 'y' is '3 V'; expected a number"),
        ("t,y,u\n0,1,2\n5,2,2\n4,1,3\n", r"line 4: the time goes back from 5 s to 4 s"),
        ("t,y,u\n0,1,2\n1e18,2,3\n", "expected a time in seconds"),
        ("t,y,u\n0,1,2\n1,1,3\n", r"the measurement y is constant \(1 in all of 2 values\)"),
        ("t,y,u\n0,1,2\n1,4,2\n", r"the command u never changes \(2 in all of 2 values\)"),
    ],
)
def test_bad_content_is_a_sentence(tmp_path, text, sentence):
    with pytest.raises(BagError, match=sentence) as caught:
        read_experiments(write(tmp_path / "a.csv", text))
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_or_no_text(tmp_path):
    with pytest.raises(BagError, match="does not exist"):
        read_experiments(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x01")
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
