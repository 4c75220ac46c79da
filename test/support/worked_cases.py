# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The worked cases of the papers with their exact values, as the tests use them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from relay_autotune.process.structures import INTEGRATOR_INVERSE
from relay_autotune.process.transfer_function import TransferFunction

_CASES = json.loads((Path(__file__).parent / "data" / "worked_cases.json").read_text())

PROCESSES = {
    "ex1 e-10s/(s+1)^3": TransferFunction.lag_n(1.0, 1.0, 3, 10.0),
    "ex2 e-15s/(s+1)^15": TransferFunction.lag_n(1.0, 1.0, 15, 15.0),
    "ex3 e-10s/(s+1)^2": TransferFunction.lag_n(1.0, 1.0, 2, 10.0),
    "ex4 e-.05s/(25s+1)^2": TransferFunction.lag_n(1.0, 25.0, 2, 0.05),
    "ex5 e-.6s/(6s+1)^8": TransferFunction.lag_n(1.0, 6.0, 8, 0.6),
    "ex6 e-.001s/(s+1)^20": TransferFunction.lag_n(1.0, 1.0, 20, 0.001),
    "eq42 e-.01s/(2s+1)^2": TransferFunction.lag_n(1.0, 2.0, 2, 0.01),
    "fopdt .1": TransferFunction.fopdt(1.0, 1.0, 0.1),
    "fopdt 1": TransferFunction.fopdt(1.0, 1.0, 1.0),
    "fopdt 10": TransferFunction.fopdt(1.0, 1.0, 10.0),
    "Chang 1.65e-10s/(20s+1)": TransferFunction.fopdt(1.65, 20.0, 10.0),
    "Luyben int+inv": INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
}


def cases(*prefixes: str) -> list[Any]:
    """Return the cases whose id begins with one of the prefixes, as (id, inputs, exact, tol)."""
    found = [
        (c["id"], c["inputs"], c["exact"], c["tol_rel"])
        for c in _CASES
        if c["id"].startswith(prefixes)
    ]
    assert found, f"no worked case begins with {prefixes}"
    return found
