# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Damage bags where it opens new paths of the reader: `python3 benchmarks/fuzz_coverage.py`.

Guided by coverage with atheris, which is not among the requirements: `pip install atheris`. An
error that is not one of ours, more than 5 s or more than 1 GB for one bag ends the run, and that
bag is kept in the working directory as `crash-...`, `timeout-...` or `oom-...`.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
from pathlib import Path

SECONDS, QUICK_SECONDS = 600, 5


def main() -> int:
    """Fuzz until the time is up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few seconds: does it run?")
    parser.add_argument("--seconds", type=int, default=SECONDS, help="(%(default)s)")
    options = parser.parse_args()
    try:
        import atheris
    except ImportError:
        print("fuzz_coverage: not run: atheris is not installed: pip install atheris")
        return 0
    with atheris.instrument_imports(include=["relay_autotune"]):
        from relay_autotune.bag.signals import Selection
        from relay_autotune.errors import RelayAutotuneError
        from relay_autotune.recordings import read_experiments
    from made_recordings import seeds

    folder = Path(tempfile.mkdtemp(prefix="fuzz_"))
    corpus = folder / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(seeds()):
        if len(seed) < 40_000:
            (corpus / str(number)).write_bytes(b"\0" + seed)
    bag = folder / "bag.mcap"
    selections = (
        Selection(),
        Selection("/measurement", "/command", start=0.0),
        Selection("/joints:position[1]", "/command", clock="header"),
        Selection("/imu:linear_acceleration.y", "/command", clock="log"),
    )

    def read(data: bytes) -> None:
        bag.write_bytes(data[1:])
        with contextlib.suppress(RelayAutotuneError):
            read_experiments(bag, selections[data[0] % 4 if data else 0])

    limit = QUICK_SECONDS if options.quick else options.seconds
    rules = [f"-max_total_time={limit}", "-timeout=5", "-rss_limit_mb=1000", "-max_len=40000"]
    atheris.Setup([sys.argv[0], *rules, str(corpus)], read)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
