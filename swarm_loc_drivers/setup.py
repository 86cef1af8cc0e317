"""Installs what setup.cfg says."""

import sys

from setuptools import setup

# A first line of a script cannot hold a path with a space; `ros2 run` then needs python3 on the PATH.
setup(options={"build_scripts": {"executable": "/usr/bin/env python3"}} if " " in sys.executable else {})
