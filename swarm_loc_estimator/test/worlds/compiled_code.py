"""What the tests of warming up share: what has been compiled by now, in a process of its own."""

import gc
import json
import os
import subprocess
import sys
from pathlib import Path

from numba.core.dispatcher import Dispatcher


def printed_by_process(script: str, *arguments: str) -> list[str]:
    """The names that a script prints, run by itself: in this process other tests have compiled already."""
    own, worlds = Path(__file__), Path(script).parents[1] / "worlds"
    places = [str(own.parents[3]), str(own.parent), str(worlds)]  # for `bench` and worlds, as in this process
    path = os.pathsep.join([*places, *filter(None, [os.environ.get("PYTHONPATH")])])
    env = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, script, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    names: list[str] = json.loads(done.stdout)
    return names


def signatures() -> dict[str, int]:
    """Compiled function -> for how many kinds of arguments it was compiled as called by what is not."""
    found = [one for one in gc.get_objects() if isinstance(one, Dispatcher)]
    known = {f"{one.py_func.__module__}.{one.py_func.__qualname__}": len(one.signatures) for one in found}
    return {
        name: count for name, count in known.items() if ".common.bags." not in name
    }  # these only read bags


def compiled_since(before: dict[str, int]) -> list[str]:
    """What was compiled since there were these signatures."""
    return sorted(name for name, known in signatures().items() if known != before.get(name, 0))
