#!/usr/bin/env python3
"""Set up this clone: a virtual environment, ROS 2 in it unless one is sourced, the built packages.

A repeated set-up takes little time; run it again after an interruption.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext

from workspace import build, host, install
from workspace.layout import WorkspaceError
from workspace.stamps import only_one


def ensure(*, bench: bool = False, compiled: bool = False) -> None:
    """Run the steps of the set-up that are not done yet.

    Args:
        bench: Whether to install the benchmarks' requirements.
        compiled: Whether to compile the inner loops of the estimator of a small swarm.

    Raises:
        WorkspaceError: Something is missing, or a step failed.
    """
    host.check_python_age()
    with only_one():
        install.ensure(bench=bench)
        with build.compiling() if compiled else nullcontext():
            build.ensure()


def main() -> int:
    """Run from the command line; returns 0, or 1 after one sentence about a failure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bench", action="store_true", help="add what the benchmarks compare with")
    arguments = parser.parse_args()
    try:
        ensure(bench=arguments.bench, compiled=True)
    except WorkspaceError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Interrupted: the next run starts where this one stopped.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
