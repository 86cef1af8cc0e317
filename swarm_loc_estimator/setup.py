"""Installs modules, executables, launch files and configurations."""

import sys
from glob import glob

from setuptools import find_packages, setup

NAME = "swarm_loc_estimator"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*", "bench", "bench.*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", sorted(glob("config/*.yaml"))),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    install_requires=["setuptools"],
    # A first line of a script cannot hold a path with a space; `ros2 run` then needs python3 on the PATH.
    options={"build_scripts": {"executable": "/usr/bin/env python3"}} if " " in sys.executable else {},
    zip_safe=False,
    maintainer="Swarm localization maintainers",
    maintainer_email="swarm-localization@example.org",
    description="The central estimator of a robot swarm, its replay, its player and its reports.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "calibrate = swarm_loc_estimator.cli.calibrate:main",
            "demo = swarm_loc_estimator.cli.demo:main",
            "estimator_node = swarm_loc_estimator.nodes.estimator_node:main",
            "graph = swarm_loc_estimator.cli.graph:main",
            "import_mrclam = swarm_loc_estimator.cli.import_mrclam:main",
            "play = swarm_loc_estimator.nodes.play_node:main",
            "replay = swarm_loc_estimator.cli.replay:main",
        ],
    },
)
