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


def ensure(*, extra: str | None = None, compiled: bool = False) -> None:
    """Run the steps of the set-up that are not done yet.

    Args:
        extra: Requirements to add, one of `install.EXTRAS`.
        compiled: Whether to compile the inner loops of the estimator of a small swarm.

    Raises:
        WorkspaceError: Something is missing, or a step failed.
    """
    host.check_python_age()
    with only_one():
        install.ensure(extra=extra)
        with build.compiling() if compiled else nullcontext():
            build.ensure()


def main() -> int:
    """Run from the command line; returns 0, or 1 after one sentence about a failure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--extra", choices=install.EXTRAS, help="requirements to add")
    arguments = parser.parse_args()
    try:
        ensure(extra=arguments.extra, compiled=arguments.extra != "docs")
    except WorkspaceError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Interrupted: the next run starts where this one stopped.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
