# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Many bags: in processes, on a cluster, into files, and again after a run that was cut short."""

from __future__ import annotations

import csv
import functools
import importlib.util
import json
import multiprocessing.forkserver
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from fleet_work import die, die_of_bag_3, die_once, mark, wait_for_ever
from made_bags import REPOSITORY

from relay_autotune.analysis import Task
from relay_autotune.bag.reader import recordings_in
from relay_autotune.bag.signals import Selection
from relay_autotune.cli import fleet, replay
from relay_autotune.cli.fleet import COLUMNS, ResultsFile, in_processes, on_cluster, rows
from relay_autotune.cli.jobs import Job
from relay_autotune.errors import BagError

STEP = REPOSITORY / "bags" / "step_test"
# A method that finds nothing in a step test leaves the time to what is tested here.
QUICK = ("--method", "thyagarajan")


@pytest.fixture(autouse=True)
def deadline():
    """Fail where a process that is missed would be waited for forever."""

    def end(*_):
        pytest.fail("still waiting after 240 s")

    before = signal.signal(signal.SIGALRM, end)
    # again, if what is left waits, too
    signal.setitimer(signal.ITIMER_REAL, 240.0, 20.0)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


def run(capsys, *arguments):
    status = replay.main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return status, out, err


def jobs(count, folder=None):
    return [
        Job(f"bag{k}", (str(folder),), Selection(), Task("waveform", "imc")) for k in range(count)
    ]


def links(folder, count):
    """Lay out one bag under many names."""
    paths = [folder / f"bag_{k}" for k in range(count)]
    for path in paths:
        path.symlink_to(STEP)
    return paths


@pytest.mark.long
@pytest.mark.parametrize("more", [(), ("--jobs", "2")], ids=["one", "two"])
def test_a_folder_of_bags_is_a_table_with_a_line_each(tmp_path, capsys, more):
    links(tmp_path, 2)
    (tmp_path / "broken.mcap").write_bytes(b"junk")
    (tmp_path / "notes.txt").write_text("to be passed over")
    (tmp_path / "launch.log").write_text("1790000000.1 [INFO] started\n1790000000.2 [INFO] done\n")
    names = [f"a column called {k}" for k in "abcd"]
    (tmp_path / "unclear.csv").write_text(",".join(names) + "\n1,2,3,4\n2,3,4,5\n")
    status, out, err = run(capsys, "--rule", "imc", *more, tmp_path)
    head, units, *rows = out.splitlines()
    # What of a column's name says that it may be chosen is not cut off.
    rows, unclear = rows[:3], rows[3:]
    assert unclear[0].split()[:2] == ["unclear.csv", "-"] and max(map(len, unclear[:-6])) < 100
    told = " ".join(" ".join(unclear).split())
    assert "'a column called d'; name two of them with --measurement NAME" in told
    assert "--command 'a column called c'" in unclear[-6]
    names = ["K_u", "w_u", "kc", "ti", "td", "tf", "b", "every", "Ms"]
    assert head.split() == ["verdict", *names]
    # Each unit ends where its name does.
    ends = [head.index(f" {name}") + 1 + len(name) for name in ("K_u", "w_u", "kc", "ti", "every")]
    assert [units[:end].split()[-1] for end in ends] == ["u/y", "rad/s", "u/y", "s", "s"]
    assert [row.split()[0] for row in rows] == ["bag_0", "bag_1", "broken.mcap"]
    _, json_out, _ = run(capsys, "--json", "--rule", "imc", STEP)
    (found,) = json.loads(json_out)["experiments"]
    gains = found["gains"][found["recommended"]]
    for row in rows[:2]:
        verdict, *numbers = row.split()[1:]
        assert verdict == found["verdict"]
        told = dict(zip(head.split()[1:], map(float, numbers), strict=True))
        for name in ("kc", "ti", "td", "tf", "b"):
            assert told[name] == pytest.approx(gains[name], rel=1e-3)
        assert f"a controller that runs every {told['every']:g} s" in gains["reason"]
    assert "broken.mcap  -" in rows[2] and len(rows[2]) < 100
    # The choice of columns counts as a matter of the command line.
    assert status == 2
    # Where the machine is slow, it is said how long a model will take.
    assert all(line.startswith("computing the model") for line in err.splitlines())


@pytest.mark.parametrize(
    ("files", "count"),
    [
        (("metadata.yaml", "a_0.mcap", "b_0.mcap"), 0),
        (("a_0.mcap", "a_1.mcap", "a_10.mcap.zstd"), 0),
        (("a_0.mcap", "b_0.mcap", "notes.txt"), 2),
        (("a_0.mcap", "heater.csv"), 2),
        (("notes.txt",), 0),
    ],
)
def test_a_folder_that_is_one_recording_is_told_from_a_folder_of_them(tmp_path, files, count):
    for name in files:
        (tmp_path / name).touch()
    assert len(recordings_in(tmp_path)) == count


@pytest.mark.parametrize("ending", [".csv", ".txt", ".dat", ".tsv", ".log", ".TXT"])
def test_every_table_that_is_read_alone_is_read_in_a_folder(tmp_path, capsys, ending):
    for name in ("a", "b"):
        (tmp_path / f"{name}{ending}").write_text("t,y,u\n0,1,0\n1,1,1\n2,2,1\n")
    (tmp_path / "notes.txt").write_text("The oven of 2026.\n12 runs, 3 of them good.\n")
    found = [path.name for path in recordings_in(tmp_path)]
    assert found == [f"a{ending}", f"b{ending}"]
    _, out, err = run(capsys, "--json", *sorted(tmp_path.iterdir()))
    assert [json.loads(line)["bag"] for line in out.splitlines()] == [
        str(tmp_path / name) for name in found
    ]
    (left_out,) = [line for line in err.splitlines() if "is left out" in line]
    assert "notes.txt is left out" in left_out and ".tsv" in left_out


def test_processes_do_each_bag_once(tmp_path):
    found = dict(in_processes(jobs(20, tmp_path), 2, mark))
    assert {number: done.name for number, done in found.items()} == {
        k: f"bag{k}" for k in range(20)
    }
    assert all((tmp_path / f"bag{k}").read_text() == "x" for k in range(20))


def test_a_bag_that_takes_its_process_down_is_reported_and_the_others_are_done(tmp_path):
    found = list(in_processes(jobs(10, tmp_path), 2, die_of_bag_3))
    assert sorted(number for number, _ in found) == list(range(10))
    for number, done in found:
        assert done.status == (1 if number == 3 else 0)
    assert "ended from outside" in dict(found)[3].said[0]


def test_processes_that_die_while_bags_are_still_handed_out_do_not_end_the_command(tmp_path):
    """A pool of the standard library refused the next bag then, or waited for it forever."""
    found = dict(in_processes(jobs(20, tmp_path), 6, die))
    assert sorted(found) == list(range(20))
    assert all("ended from outside" in done.said[0] for done in found.values())


def test_a_bag_whose_process_died_for_another_reason_is_done_in_the_end(tmp_path):
    do = functools.partial(die_once, number=2)
    found = list(in_processes(jobs(6, tmp_path), 2, do))
    assert (tmp_path / "died").exists()
    assert sorted(number for number, _ in found) == list(range(6))
    assert found[-1][0] == 2 and all(done.status == 0 for _, done in found)


@pytest.mark.nightly
def test_a_process_that_forks_others_is_started_again_when_it_is_killed(tmp_path):
    found = in_processes(jobs(3, tmp_path), 1, mark)
    assert next(found)[1].status == 0
    number = multiprocessing.forkserver._forkserver._forkserver_pid
    os.kill(number, signal.SIGKILL)
    os.waitid(os.P_PID, number, os.WEXITED | os.WNOWAIT)
    assert len(list(found)) == 2
    assert len(list(in_processes(jobs(3, tmp_path), 2, mark))) == 3


@pytest.mark.nightly
def test_a_cluster_of_which_a_worker_is_killed_loses_nothing_and_does_nothing_twice(
    tmp_path, monkeypatch
):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY / "test" / "support"), prepend=os.pathsep)
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster:
        do = functools.partial(die_once, number=10)
        found = list(on_cluster(jobs(30, tmp_path), cluster.scheduler_address, do))
    assert (tmp_path / "died").exists()
    assert sorted(number for number, _ in found) == list(range(30))
    assert all(done.name == f"bag{number}" and done.status == 0 for number, done in found)


def until(condition, what):
    deadline = time.monotonic() + 120.0
    while not (value := condition()):
        assert time.monotonic() < deadline, what
        time.sleep(0.05)
    return value


def is_running(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.nightly
def test_the_bags_of_a_scheduler_that_dies_are_not_done(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("relay_autotune.cli.fleet._CONNECT_S", 5.0)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY / "test" / "support"), prepend=os.pathsep)
    where, flag = tmp_path / "scheduler.json", tmp_path / "bag1.pid"
    begin = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
    begin += ["--host", "tcp://127.0.0.1", "--port", "0", "--scheduler-file", str(where)]
    join = [sys.executable, "-m", "distributed.cli.dask_worker", "--no-nanny", "--no-dashboard"]
    join += ["--nthreads", "1", "--scheduler-file", str(where), "--death-timeout", "60"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    processes = [subprocess.Popen(begin, **quiet)]
    try:
        until(lambda: where.exists() and where.read_text().endswith("}"), "the scheduler")
        address = json.loads(where.read_text())["address"]
        processes.append(subprocess.Popen(join, **quiet))
        found = []

        def kill():
            until(lambda: found and flag.exists(), "a job")
            processes[0].kill()

        threading.Thread(target=kill, daemon=True).start()
        with pytest.raises(BagError, match="is gone: 2 of 3 bags are not done"):
            found.extend(on_cluster(jobs(3, tmp_path), address, wait_for_ever))
        assert [done.name for _, done in found] == ["bag0"]
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_no_worker_is_left_when_the_command_is_ended(tmp_path, number):
    code = (
        "import sys\n"
        f"sys.path[:0] = {[str(REPOSITORY / 'test' / 'support'), str(Path(__file__).parent)]}\n"
        "from test_fleet import jobs\n"
        "from fleet_work import wait_for_ever\n"
        "from relay_autotune.cli.fleet import in_processes\n"
        f"list(in_processes(jobs(3, {str(tmp_path)!r}), 2, wait_for_ever))\n"
    )
    command = subprocess.Popen([sys.executable, "-c", code])
    try:
        flags = [tmp_path / f"bag{k}.pid" for k in (1, 2)]
        numbers = [
            until(lambda flag=flag: flag.exists() and flag.read_text(), "a job") for flag in flags
        ]
        assert all(map(is_running, numbers))
        command.send_signal(number)
        command.wait()
        until(lambda: not any(map(is_running, numbers)), "the end of the workers")
    finally:
        command.kill()
        command.wait()


def test_no_scheduler_is_said_in_one_line(capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("relay_autotune.cli.fleet._CONNECT_S", 0.3)
    status, out, err = run(capsys, STEP, "--scheduler", "tcp://127.0.0.1:9", *QUICK)
    assert (status, out) == (1, "")
    assert "cannot reach the scheduler tcp://127.0.0.1:9" in err.splitlines()[-1]


def test_results_come_in_the_order_of_the_command_line(tmp_path, capsys):
    paths = [*links(tmp_path, 3), tmp_path / "none"]
    status, out, err = run(capsys, "--json", "--jobs", 2, *paths, *QUICK)
    assert [json.loads(line)["bag"] for line in out.splitlines()] == list(map(str, paths))
    assert status == 1
    assert "none does not exist" in err


def test_a_run_that_was_cut_short_goes_on(tmp_path, capsys):
    paths, output = links(tmp_path, 4), tmp_path / "out.jsonl"
    run(capsys, *paths[:2], "--output", output, *QUICK)
    whole = output.read_bytes()
    # The third was being written when the machine went down.
    output.write_bytes(whole + whole[:100])
    status, out, err = run(capsys, *paths, paths[0], "--output", output, *QUICK)
    assert (status, out) == (1, "")
    assert "2 of 4 bags are in" in err
    documents = [json.loads(line) for line in output.read_text().splitlines()]
    assert [document["bag"] for document in documents] == list(map(str, paths))
    assert output.read_bytes().startswith(whole)


@pytest.mark.long
def test_a_bad_bag_leaves_a_row_with_its_reason(tmp_path, capsys):
    output = tmp_path / "out.csv"
    run(capsys, STEP, tmp_path / "none", "--output", output)
    with output.open() as file:
        good, bad = csv.DictReader(file)
    assert float(good["gain"]) == pytest.approx(0.8, rel=0.01)
    assert float(good["kc"]) > 0.0
    assert good["error"] == ""
    assert "does not exist" in bad["error"]
    assert bad["gain"] == ""


def test_a_table_in_parquet(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    output = tmp_path / "out.parquet"
    document = {"bag": "b", "experiments": [], "error": "is empty"}
    with ResultsFile(str(output)) as results:
        results.add("b", json.dumps(document))
    table = parquet.read_table(output)
    assert tuple(table.column_names) == COLUMNS
    (row,) = table.to_pylist()
    assert (row["bag"], row["error"], row["kc"]) == ("b", "is empty", None)
    assert list(rows(document)) == [row]


def test_files_that_cannot_be_results(tmp_path, capsys):
    status, _, err = run(capsys, STEP, "--output", tmp_path / "out.txt", *QUICK)
    assert status == 2
    assert "expected an ending .jsonl, .csv, .parquet" in err
    other = tmp_path / "other.jsonl"
    other.write_text("precious\n")
    status, _, err = run(capsys, STEP, "--output", other, *QUICK)
    assert status == 1
    assert "holds something else than results of replay" in err
    assert other.read_text() == "precious\n"
    with (
        ResultsFile(str(tmp_path / "used.jsonl")),
        pytest.raises(BagError, match="being written by"),
    ):
        ResultsFile(str(tmp_path / "used.jsonl"))


def test_a_defect_in_one_bag_does_not_stop_the_others(tmp_path, capsys, monkeypatch):
    def fail(path, *rest):
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr("relay_autotune.cli.jobs.read_experiments", fail)
    status, out, err = run(capsys, "--json", "a", "b", *QUICK)
    assert status == 1
    errors = [json.loads(line)["error"] for line in out.splitlines()]
    for name, error in zip("ab", errors, strict=True):
        assert error.startswith(f"{name} could not be analysed: a defect")
        assert "ZeroDivisionError" in error
    assert err.count("\n") == 2


@pytest.mark.parametrize(
    "options",
    [
        ["--jobs", "0"],
        ["--jobs", "many"],
        ["--max-chunk", "0"],
        ["--max-chunk", "4T"],
        ["--clock", "sun"],
    ],
)
def test_wrong_options_have_status_2(options, capsys):
    with pytest.raises(SystemExit) as caught:
        replay.main(["bag", *options])
    assert caught.value.code == 2


def test_a_chunk_beyond_the_limit_is_left_out_and_said(capsys):
    arguments = (STEP, "--measurement", "/reactor/temperature", "--command", "/reactor/heater")
    status, _, err = run(capsys, *arguments, "--max-chunk", "1k")
    assert status == 1
    assert "declares 53012 bytes, more than the 1024 that --max-chunk allows" in err


def test_two_bags_on_one_timeline(tmp_path, capsys):
    status, out, _ = run(capsys, "--json", "--join", STEP, STEP / "step_test_0.mcap", *QUICK)
    assert status == 1
    (document,) = map(json.loads, out.splitlines())
    assert document["bag"] == f"{STEP}, {STEP / 'step_test_0.mcap'}"
    assert len(document["experiments"]) == 1


def test_what_is_no_recording_is_passed_over_with_a_line(tmp_path, capsys):
    (bag,) = links(tmp_path, 1)
    (tmp_path / "README.md").write_text("Bags of the tank.\n")
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "tank.png").write_bytes(b"\x89PNG")
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    output = tmp_path / "fleet.csv"
    given = sorted(tmp_path.iterdir())
    status, _, err = run(capsys, *QUICK, "--jobs", 2, "--output", output, *given)
    passed_over = [line for line in err.splitlines() if "is left out" in line]
    assert [line.split()[1] for line in passed_over] == [
        str(tmp_path / "README.md"),
        str(tmp_path / "pictures"),
    ]
    with output.open(newline="") as file:
        found = {row["bag"]: row["error"] for row in csv.DictReader(file)}
    # a bag of ROS 1 is a recording, of which its reader says what to do
    assert set(found) == {str(bag), str(tmp_path / "old.bag")}
    assert "convert it" in found[str(tmp_path / "old.bag")]
    assert status == 1


def test_a_table_of_somebody_else_is_not_overwritten(tmp_path, capsys):
    output = tmp_path / "fleet.csv"
    output.write_text("my,own,table\n")
    status, _, err = run(capsys, *QUICK, "--output", output, STEP)
    assert status == 1
    assert "name another file" in err
    assert output.read_text() == "my,own,table\n"
    assert not Path(f"{output}.jsonl").exists()


def test_what_is_loaded_before_the_first_job_exists():
    # The standard library passes over a name that cannot be imported.
    assert all(importlib.util.find_spec(name) for name in fleet._PRELOADED)
