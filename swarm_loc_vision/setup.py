"""Installs modules, executables, launch files and configurations."""

import sys
from glob import glob

from setuptools import find_packages, setup

NAME = "swarm_loc_vision"

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
    description="Detectors that turn the images of a robot swarm into marker detections.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [],
    },
)
