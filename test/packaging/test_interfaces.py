# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The interface files hold what users and old bags rely on."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2] / "relay_autotune_msgs"

# each file's sections, as separated by ---; of each the fields in any order, by type
PROMISED = {
    "msg/Reason.msg": """
        uint16 code
        string[] names values""",
    "msg/RelaySettings.msg": """
        float64 setpoint baseline amplitude bias hysteresis extra_delay sample_period
        bool reverse_acting""",
    "msg/RelayCycle.msg": """
        std_msgs/Header header
        string experiment_id
        uint32 index
        RelaySettings settings
        float64[] time measurement command
        float64 period period_high period_low peak_max peak_min time_to_peak_max time_to_peak_min
        bool converged disturbed""",
    "msg/RelayExperiment.msg": """
        std_msgs/Header header
        string experiment_id reason
        uint8 outcome
        RelaySettings settings
        float64 noise_std
        float64[] time receive_time command_time measurement command
        uint32[] cycle_start
        uint32 lost_samples""",
    "msg/TransferFunction.msg": """
        std_msgs/Header header
        string experiment_id method structure
        bool final
        float64 gain dead_time
        float64[] zeros time_constants numerator denominator std covariance ci95_low ci95_high
        uint32 order
        string[] parameters warnings undetermined combinations combination_units advice
        float64[] combination_value combination_std combination_ci95_low combination_ci95_high
        float64 support ultimate_gain ultimate_gain_std ultimate_frequency ultimate_frequency_std
        float64 residual_rms noise_std fit whiteness_p""",
    "msg/PidGains.msg": """
        std_msgs/Header header
        string experiment_id rule form reason
        bool final
        float64 kc ti td tf b p i d ms ms_95 mt gain_margin phase_margin delay_margin iae_load
        float64 gain_margin_low iae_setpoint overshoot settling_time
        float64 effort_setpoint effort_load noise_gain
        string[] warnings""",
    "srv/StartTune.srv": """
        float64 amplitude
        bool dry_run
        ---
        bool accepted
        string reason experiment_id
        string[] checks""",
    "srv/Identify.srv": """
        RelayExperiment experiment
        string method rule
        ---
        bool success
        string reason
        TransferFunction[] models
        uint32 selected recommended
        PidGains[] gains""",
    "action/Tune.action": """
        float64 amplitude
        bool dry_run
        ---
        RelayExperiment experiment
        TransferFunction transfer_function
        PidGains gains
        string bag reason
        string[] checks
        uint8 outcome
        ---
        uint8 state
        uint32 cycle
        float64 progress elapsed remaining period amplitude ultimate_gain ultimate_gain_std
        TransferFunction transfer_function
        string status""",
    "action/Verify.action": """
        float64 setpoint_step load_step
        ---
        uint8 verdict
        string reason
        Verification[] steps
        ---
        uint8 step
        float64 elapsed remaining
        string status""",
    "msg/Verification.msg": """
        std_msgs/Header header
        uint8 kind
        float64 step overshoot overshoot_predicted settling_time settling_time_predicted
        float64 iae iae_predicted fit gain_ratio ms ms_predicted
        bool passed
        string reason
        float64[] time measurement command predicted""",
}
FILES = sorted(
    str(file.relative_to(ROOT))
    for kind in ("msg", "srv", "action")
    for file in ROOT.glob(f"{kind}/*")
)


def sections(file: str) -> list[list[tuple[str, str, str]]]:
    """Return type, name (with the value of a constant) and comment of each field."""
    found: list[list[tuple[str, str, str]]] = [[]]
    for line in (ROOT / file).read_text().splitlines():
        text, _, comment = line.partition("#")
        if text.strip() == "---":
            found.append([])
        elif text.strip():
            kind, name = text.split(maxsplit=1)
            found[-1].append((kind, name.strip(), comment.strip()))
    return found


def is_constant(name: str) -> bool:
    return "=" in name


def test_every_file_is_promised():
    """A new message is added to the list above too."""
    assert sorted(PROMISED) == FILES


@pytest.mark.parametrize("file", FILES)
def test_promised_fields_are_there(file: str):
    """A field that is renamed or retyped breaks its readers."""
    promised = PROMISED[file].split("---")
    found = sections(file)
    assert len(found) == len(promised)
    for section, text in zip(found, promised, strict=True):
        fields = {(kind, name) for kind, name, _ in section}
        for line in text.strip().splitlines():
            kind, *names = line.split()
            assert {(kind, name) for name in names} <= fields


@pytest.mark.parametrize("file", FILES)
def test_every_field_says_what_it_is(file: str):
    """A bag is read by people who do not have the documentation at hand."""
    text = (ROOT / file).read_text()
    bare = [
        name
        for section in sections(file)
        for _, name, comment in section
        if not comment and not is_constant(name) and not re.search(rf"# .*\n\S+ {name}\n", text)
    ]
    assert bare == []


@pytest.mark.parametrize("file", FILES)
def test_floats_have_a_unit(file: str):
    """Each float's comment names its unit in brackets, unless it is a mere number."""
    mere = {"b", "fit", "gain_margin", "ms", "ms_95", "mt", "progress", "whiteness_p"}
    mere |= {"gain_margin_low", "effort_load", "support"}
    in_the_parameters_unit = {"std", "covariance", "ci95_low", "ci95_high"}
    in_the_parameters_unit |= {
        f"combination_{n}" for n in ("value", "std", "ci95_low", "ci95_high")
    }
    polynomials = {"numerator", "denominator"}
    compared = {"overshoot", "overshoot_predicted", "gain_ratio", "ms_predicted"}
    exempt = mere | compared | in_the_parameters_unit | polynomials
    unitless = [
        name
        for section in sections(file)
        for kind, name, comment in section
        if kind.startswith("float64") and name not in exempt and not re.search(r"\[.+\]", comment)
    ]
    assert unitless == []


def test_gains_are_never_nan():
    """A controller must not be handed a NaN; only predictions may be missing."""
    predictions = {"ms", "ms_95", "mt", "gain_margin", "phase_margin", "delay_margin", "iae_load"}
    (fields,) = sections("msg/PidGains.msg")
    names = [name for _, name, _ in fields]
    gains = names[names.index("kc") : names.index("ms")]
    assert set(gains) == {"kc", "ti", "td", "tf", "b", "p", "i", "d"}
    missing = {name for _, name, comment in fields if "NaN" in comment}
    assert missing <= predictions | set(names[names.index("iae_load") :])


def test_interfaces_are_generated():
    """A file that CMakeLists.txt forgets is never built."""
    listed = re.findall(r'"((?:msg|srv|action)/\w+\.\w+)"', (ROOT / "CMakeLists.txt").read_text())
    assert sorted(listed) == FILES


@pytest.mark.parametrize(
    ("file", "values"),
    [
        ("msg/RelayExperiment.msg", {"UNKNOWN": 0, "COMPLETED": 1, "ABORTED": 2, "FAILED": 3}),
        ("action/Tune.action", {"UNKNOWN": 0, "COMPLETED": 1, "ABORTED": 2, "FAILED": 3}),
        ("action/Verify.action", {"NONE": 0, "PASSED": 1, "FAILED": 2}),
    ],
)
def test_outcomes_keep_their_numbers(file: str, values: dict[str, int]):
    """Old bags hold the numbers, not the names."""
    constants = dict(
        re.split(r"\s*=\s*", name)
        for section in sections(file)
        for kind, name, _ in section
        if is_constant(name) and kind == "uint8" and not name.startswith(("STATE_", "VERDICT_"))
    )
    assert {name: int(value) for name, value in constants.items()} == values
