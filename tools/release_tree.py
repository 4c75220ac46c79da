# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Lay the two packages side by side, as ROS release tools expect them.

    python3 tools/release_tree.py FOLDER      `make release` calls it with release/

In the repository `relay_autotune_msgs` lies inside `relay_autotune`, where catkin_pkg, bloom and a
plain `colcon build` stop at the outer package. The tree holds what git tracks, as it is in the
working tree: FOLDER/relay_autotune and FOLDER/relay_autotune_msgs, each with its manifest, licence
and changelog.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUTER, INNER = "relay_autotune", "relay_autotune_msgs"
# Files that name the place of the inner package, or are only for the repository.
_LEFT_OUT = ("colcon_defaults.yaml", ".ci/", ".gitignore")


def place_of(name: str) -> Path | None:
    """Return where a file of the repository goes in the tree; None: it is left out.

    :param name: its path from the repository's root.
    """
    if name.startswith(_LEFT_OUT):
        return None
    return Path(name) if name.startswith(f"{INNER}/") else Path(OUTER, name)


def main(arguments: list[str]) -> int:
    """Write the tree.

    :param arguments: the folder, which must not hold anything yet.
    :return: the exit status.
    """
    if len(arguments) != 1:
        print(f"release_tree: expected one folder, found {len(arguments)}", file=sys.stderr)
        return 2
    target = Path(arguments[0])
    if target.exists() and any(target.iterdir()):
        print(f"release_tree: {target} is not empty: name another folder", file=sys.stderr)
        return 2
    listed = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True)
    for name in filter(None, listed.split("\0")):
        place = place_of(name)
        if place is None or not (ROOT / name).is_file():
            continue
        (target / place).parent.mkdir(parents=True, exist_ok=True)
        # The licence of the inner package is a link to that of the outer one.
        shutil.copy2(ROOT / name, target / place)
    print(f"{target / OUTER} and {target / INNER}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
