"""Draw the pictures of the page docs/report.md from a bag of the repository.

. ./env.sh && python3 tools/report_images.py
"""

from __future__ import annotations

import sys
from pathlib import Path

from relay_autotune.autotune import analyse
from relay_autotune.bag.reader import read_experiments
from relay_autotune.report.case import case_of
from relay_autotune.report.figures import PLATES
from relay_autotune.report.style import save

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / "bags/unbiased_relay_with_noise"


def main() -> int:
    """Draw each figure of the report."""
    (record,) = read_experiments(BAG).experiments
    case = case_of(analyse(record), BAG.name)
    for plate in PLATES:
        path = ROOT / f"docs/images/report_{plate.key}.png"
        save(plate.figure(case), str(path))
        print(path.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
