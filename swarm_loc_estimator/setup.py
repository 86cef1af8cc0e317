"""Installs what setup.cfg says; a wheel has only one program, `swarm-loc`."""

import sys

from setuptools import setup

# A first line of a script cannot hold a path with a space; `ros2 run` then needs python3 on the PATH.
options = {"build_scripts": {"executable": "/usr/bin/env python3"}} if " " in sys.executable else {}

# colcon installs the programs of setup.cfg where only `ros2 run` finds them. pip would install them on the
# PATH, where some hide others, such as watch. python_requires is here because colcon cannot read it.
in_wheel = {
    "entry_points": {"console_scripts": ["swarm-loc = swarm_loc_estimator.start:swarm_loc"]},
    "python_requires": ">=3.10",
}
is_wheel = {"bdist_wheel", "dist_info", "editable_wheel"} & set(sys.argv)

setup(options=options, **(in_wheel if is_wheel else {}))
