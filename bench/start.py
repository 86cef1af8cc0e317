"""What a user waits for: the first import, a replay with its report, an estimator node that is ready.

With `--other`, the folder of another version that is set up, both are measured in turns, and compared:

    make bench-start
    make bench-start ARGS="--other ../earlier"
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.shared.common import ProgressLine, options_of, table, write_figures

_ROOT = Path(__file__).parents[1]
_BAG = Path("bags/eight_five_robots")
_READY = b"ready"


def _ran(folder: Path, *command: str) -> tuple[float, float]:
    """Wall and CPU time of a command to its end [s]."""
    begun = time.monotonic()
    process = subprocess.Popen([folder / "run", *command], cwd=folder, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"'{' '.join(command)}' in {folder} ended with {os.waitstatus_to_exitcode(status)}.")
    return time.monotonic() - begun, used.ru_utime + used.ru_stime


def _replayed(folder: Path) -> tuple[float, float]:
    with tempfile.TemporaryDirectory() as out:
        return _ran(folder, "swarm_loc_estimator", "replay", str(_BAG), "--out", f"{out}/replay")


def _ready(folder: Path) -> tuple[float, float]:
    """Until a node says that it is ready."""
    begun = time.monotonic()
    node = [str(folder / "run"), "swarm_loc_estimator", "estimator_node", "--ros-args"]
    node += ["-p", f"swarm_file:={_BAG / 'swarm.yaml'}"]
    with subprocess.Popen(node, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        is_ready = any(_READY in line for line in process.stdout or ())
        wall_s = time.monotonic() - begun
        process.terminate()
        _, _, used = os.wait4(process.pid, 0)
        process.returncode = 0
    if not is_ready:
        raise SystemExit(f"the estimator of {folder} ended before it was ready.")
    return wall_s, used.ru_utime + used.ru_stime


def _imported(folder: Path) -> tuple[float, float]:
    return _ran(folder, "--", "python", "-c", "import swarm_loc_estimator as core; core.Estimator")


MEASURED = {"import": _imported, "replay": _replayed, "node": _ready}
"""Name -> measurement in a folder."""


def main() -> None:
    """Measure in turns, print the table, write the figures."""
    options = options_of(
        __doc__, repeats=(3, "times that all is measured"), other=("", "folder of another version")
    )
    folders = {"": _ROOT} | ({"other.": Path(options.other).resolve()} if options.other else {})
    found: dict[str, list[tuple[float, float]]] = {}
    say = ProgressLine("start")
    for turn in range(options.repeats):
        for what, measure in MEASURED.items():
            for prefix, folder in folders.items():
                say(f"{turn + 1} of {options.repeats}: {prefix}{what}")
                found.setdefault(prefix + what, []).append(measure(folder))
    figures = {
        f"{name}.{unit}": value
        for name, times in found.items()
        for unit, value in zip(("wall_s", "cpu_s"), np.median(times, axis=0).tolist(), strict=True)
    }
    if options.other:
        names = [f"{what}.{unit}" for what in MEASURED for unit in ("wall_s", "cpu_s")]
        figures |= {f"{name}_ratio": figures[name] / figures[f"other.{name}"] for name in names}
    print(table(("figure", "value"), list(figures.items())))
    print(write_figures("start", figures))


if __name__ == "__main__":
    main()
