#!/usr/bin/env python3
"""Make this clone ready to run: a virtual environment, ROS 2 in it where none is sourced, the built packages.

Doing it again costs next to nothing, and after an interruption is all there is to do.
"""

from __future__ import annotations

import argparse
import sys

from workspace import build, host, install
from workspace.layout import WorkspaceError
from workspace.stamps import only_one


def ensure(*, bench: bool = False, compiled: bool = False) -> None:
    """Do what is not done yet.

    Args:
        bench: Whether the benchmarks' requirements belong to it.
        compiled: Whether the estimator's inner loops are compiled, too.

    Raises:
        WorkspaceError: Something is missing, or a step failed.
    """
    host.check_python_age()
    with only_one():
        install.ensure(bench=bench)
        build.ensure()
        if compiled:
            build.compile_estimator()


def main() -> int:
    """Run from the command line: 0 when all is ready, 1 with one sentence when something is missing."""
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
