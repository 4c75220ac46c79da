# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Install the package relay_autotune; colcon calls this."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "relay_autotune"


def files(folder: str) -> list[str]:
    """Return the files in a folder, which are installed as they are."""
    return sorted(str(path) for path in Path(folder).iterdir() if path.is_file())


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Relay-feedback autotuner for ROS 2",
    license="Apache-2.0",
    maintainer="relay_autotune maintainers",
    maintainer_email="relay-autotune@users.noreply.github.com",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed", "report/templates/*", "web/static/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", files("launch")),
        (f"share/{PACKAGE}/config", files("config")),
        (f"share/{PACKAGE}/config/security", files("config/security")),
    ],
    python_requires=">=3.11",
    install_requires=["setuptools", "numpy>=1.26", "scipy>=1.11", "mcap"],
    extras_require={
        "bags": ["pyyaml"],
        "fleet": ["distributed", "pyarrow"],
        "report": ["jinja2", "matplotlib"],
        "web": ["tornado"],
        "test": ["control", "hypothesis", "pytest", "rosbags"],
    },
    zip_safe=True,
    entry_points={
        "console_scripts": [
            "relay_node = relay_autotune.start:relay_node",
            "identifier_node = relay_autotune.start:identifier_node",
            "plant_node = relay_autotune.start:plant_node",
            "controller_node = relay_autotune.start:controller_node",
            "simulated_loop = relay_autotune.start:simulated_loop",
            "tune_loop = relay_autotune.start:tune_loop",
            "apply_gains = relay_autotune.start:apply_gains",
            "replay = relay_autotune.start:replay",
            "identify = relay_autotune.start:identify",
            "tune = relay_autotune.start:tune",
            "csv_to_bag = relay_autotune.start:csv_to_bag",
            "report = relay_autotune.start:report",
        ],
    },
)
