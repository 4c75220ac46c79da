# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The identify command as its users meet it; one test runs the installed executable."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess

import pytest
from worked_cases import cases

from relay_autotune.cli import identify
from relay_autotune.cli.arguments import flag_of
from relay_autotune.cli.identify import CHART_METHODS, NUMBERS
from relay_autotune.identification.methods import METHODS

EXAMPLE = "--period 33.271862630047444 --amplitude 0.025968976458966186 --relay 0.04"


def run(arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command in this process: an executable takes a second to start."""
    words, out, err = arguments.split(), io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = identify.main(words)
        except SystemExit as end:
            status = int(end.code or 0)
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


def model_of(arguments: str) -> dict:
    done = run(arguments + " --json")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


@pytest.mark.long
def test_the_papers_example_as_a_table():
    words = f"--method chang {EXAMPLE} --dead-time 10 --gain 1.65".split()
    done = subprocess.run(
        ["identify", *words], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stderr == ""
    assert "1.650 e^(-10.00 s) / (1 + 20.00 s)   (fopdt, chang)" in done.stdout
    assert "2.307 u/y" in done.stdout
    assert "0.1837 rad/s" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "tau"), [("chang", 20.0), ("atv", 16.2015903238), ("li", 20.0)]
)
def test_the_same_as_a_document(method, tau):
    known = "--dead-time 10 --gain 1.65"
    if method == "li":
        # The limit cycle of 1.65 exp(-18 s)/(20 s + 1).
        second = "--period-2 54.635565559598035 --amplitude-2 0.039166402457120456"
        known = f"{second} --extra-delay 8 --dead-time 10"
    found = model_of(f"--method {method} {EXAMPLE} {known}")
    assert found["method"] == method
    assert found["structure"] == "fopdt"
    assert found["time_constants"] == pytest.approx([tau], rel=1e-5)
    assert (found["gain"], found["dead_time"]) == pytest.approx((1.65, 10.0), rel=1e-5)
    assert found["ci95"]["time_constant"] == [None, None]
    assert found["ultimate_gain"] > 0.0


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("wang.T2"))
def test_wangs_table_2(name, inputs, exact, tol):
    p = inputs
    found = model_of(
        f"--method wang --period-high {p['Tu1']!r} --period-low {p['Tu2']!r} "
        f"--peak-max {p['Au']!r} --peak-min {p['Ad']!r} --relay {p['mu']} --bias {p['mu0']} "
        f"--hysteresis {p['eps']} --gain {p['K']}"
    )
    assert found["method"] == "wang_biased"
    assert found["time_constants"][0] == pytest.approx(exact["T"], rel=tol)
    assert found["dead_time"] == pytest.approx(exact["L"], rel=tol)


def test_a_gain_from_the_means():
    found = model_of(
        "--method wang_biased --period-high 2.7877658470670195 --period-low 3.909156212273918 "
        "--peak-max 0.8585446705942692 --peak-min -4.792723352971346e-1 --relay 1 --bias 3e-1 "
        "--hysteresis 0.1 --mean-measurement -0.5 --mean-command -0.5"
    )
    assert found["gain"] == 1.0


@pytest.mark.parametrize("arguments", ["--method chang", "--method atv"])
def test_structures_and_hysteresis(arguments):
    found = model_of(f"{arguments} {EXAMPLE} --dead-time 4 --structure lag_n --order 2")
    assert len(found["time_constants"]) == 2
    found = model_of(f"{arguments} {EXAMPLE} --dead-time 10 --gain -1.65 --hysteresis 0.002")
    assert found["gain"] == -1.65
    assert found["ultimate_gain"] < 0.0
    assert found["warnings"]


WANG = "--method wang --period-high 1 --period-low 1 --peak-max 1 --peak-min -1 --relay 1"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--method chang --period 33", "chang also needs --amplitude, --relay, --dead-time"),
        (f"--method chang {EXAMPLE} --dead-time 10 --bias 1", "does not use --bias"),
        ("--method nonsense --period 3", "unknown method 'nonsense'; known: "),
        (
            "--method atv --period -3 --amplitude 1 --relay 1 --dead-time 1",
            "--period is -3, expected above 0 s",
        ),
        (
            "--method atv --period 3 --amplitude 1 --relay 1 --dead-time -1",
            "--dead-time is -1, expected at least 0 s",
        ),
        ("--method chang --period x", "'x' is not a number"),
        (f"{WANG} --bias 0.1", "also needs --gain, or --mean-measurement and --mean-command"),
        (f"{WANG} --bias 0.1 --structure sopdt", "does not use --structure"),
        (f"{WANG} --bias 0.1 --gain 0", "--gain is 0, expected any number [y/u] but 0"),
        (
            f"--method chang {EXAMPLE} --dead-time 10 --order -1",
            "order is -1, expected from 0 to 20",
        ),
    ],
)
def test_a_command_line_that_does_not_fit(arguments, message):
    done = run(arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (f"--method chang {EXAMPLE} --dead-time 17 --gain 1.65", "less than half the period"),
        (f"--method chang {EXAMPLE} --dead-time 8 --structure fopdt", "no stable FOPDT"),
        (f"--method atv {EXAMPLE} --dead-time 10 --gain 0.1", "lags of this gain can have"),
        (f"--method chang {EXAMPLE} --dead-time 10 --structure ipdt", "no structure 'ipdt'"),
    ],
)
def test_numbers_of_no_model(arguments, message):
    done = run(arguments)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert done.stdout == ""


def test_the_help_names_every_method_and_number():
    done = run("--help")
    assert done.returncode == 0
    for name in (*CHART_METHODS, *map(flag_of, NUMBERS)):
        assert name in done.stdout


def test_every_number_is_known_and_used():
    for chart in CHART_METHODS.values():
        assert set(chart.takes) <= {each.name for each in NUMBERS}
    used = {n for chart in CHART_METHODS.values() for n in chart.takes}
    assert used == {each.name for each in NUMBERS}


def test_methods_are_named_as_those_of_records():
    assert set(CHART_METHODS) - {"wang"} <= set(METHODS)


@pytest.mark.parametrize(
    ("numbers", "structure", "values"),
    [
        (f"{EXAMPLE} --time-to-peak 10", "fopdt", (1.65, 20.0, 10.0)),
        (
            "--period 1.4611314411345366 --amplitude 0.3498588075760029 --relay 1 "
            "--time-to-peak 0.3",
            "unstable_fopdt",
            (-1.0, -1.0, 0.3),
        ),
        (
            "--period 5.430275810176104 --amplitude 0.0014733080276485588 --relay 1 "
            "--structure lag_n --order 2 --dead-time 0.05",
            "lag_n",
            (1.0, 25.0, 0.05),
        ),
    ],
)
def test_the_shapes_of_thyagarajan_and_yu(numbers, structure, values):
    found = model_of(f"--method thyagarajan {numbers}")
    assert found["structure"] == structure
    model = found["gain"], found["time_constants"][0], found["dead_time"]
    assert model == pytest.approx(values, rel=1e-7)


def test_the_shape_must_be_told():
    done = run(f"--method thyagarajan {EXAMPLE}")
    assert done.returncode == 2
    assert "--time-to-peak" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("luyben.ident.eqs4-6"))
def test_luybens_step(name, inputs, exact, tol):
    found = model_of(
        f"--method luyben_step --t1 {inputs['t1']} --t2 {inputs['t2']} "
        f"--extremum {inputs['ymin']} --step {inputs['du']} --dead-time {inputs['D']}"
    )
    assert found["structure"] == "integrator_inverse"
    numbers = found["gain"], -found["zeros"][0], found["time_constants"][0]
    assert numbers == pytest.approx([exact[k] for k in ("Kp", "tau1", "tau2")], rel=tol)
    refused = run("--method luyben_step --t1 1 --t2 1.5 --extremum -1 --step 1 --dead-time 0")
    assert refused.returncode == 1
    assert "more than twice" in refused.stderr
