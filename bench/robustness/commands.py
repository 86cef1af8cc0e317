"""The commands that write files, each with a small input, as processes."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.shared.bags import copy_part
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.offline.datasets.droplets import METRES_PER_PIXEL
from swarm_loc_estimator.swarm.ir_board import load_ir_platform

BAGS = Path(__file__).resolve().parents[2] / "bags"
READY = "SWARM_LOC_BENCH_READY"
"""Environment variable of a file that a command creates when its entry point begins."""
_START = """
import os, resource, sys
from importlib import import_module
_, package, name, full_bytes, *rest = sys.argv
if int(full_bytes) >= 0:  # the disk fills up after the command has looked for room
    from swarm_loc_estimator.common import files
    files._ROOM_BYTES = 1
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(full_bytes), resource.RLIM_INFINITY))
sys.argv = [name, *rest]
program = getattr(import_module(f"{package}.start"), name)
if ready := os.environ.pop("SWARM_LOC_BENCH_READY", ""):
    open(ready, "x").close()
sys.exit(program())
"""
_SWEEP = """bags: [{given}/eight_one_robot_fast]
settings:
  horizon_s: [0.5, 1.0]
workers: 2
"""
_PARTS = {"eight_one_robot_fast": 4.0, "eight_pictures": 1.0, "pushbot_one": 60.0, "droplets_twenty": 8.0}
_EXCHANGES = 60
_PLACES = ((300.0, 300.0, 0.3), (400.0, 310.0, 1.0))


class Command(NamedTuple):
    """A command; {out} in its arguments is an empty folder for its outputs, {given} that of the inputs."""

    program: str  # Package and executable
    arguments: str  # Its arguments with spaces between
    file: str  # One of its outputs in {out}, which it replaces; "": it makes a new folder only
    folder: str = ""  # An output folder in {out}; "": {out} itself

    @property
    def name(self) -> str:
        """A name of its own."""
        words = self.arguments.split()
        return (
            f"{self.program.partition(' ')[2]}_{words[0]}" if words[0].isalpha() else self.program.split()[1]
        )

    def line(self, given: Path, out: Path, full_bytes: int = -1) -> list[str]:
        """The command line; where no file may grow beyond `full_bytes`, -1 for any."""
        words = [word.format(given=given, out=out) for word in self.arguments.split()]
        return [
            sys.executable,
            "-c",
            f"import sys; sys.path.append({str(BAGS.parent)!r})\n{_START}",
            *self.program.split(),
            str(full_bytes),
            *words,
        ]


_ESTIMATOR, _VISION, _DRIVERS = (f"swarm_loc_{name}" for name in ("estimator", "vision", "drivers"))
_FAST = "{given}/eight_one_robot_fast"
COMMANDS = (
    Command(
        f"{_ESTIMATOR} replay",
        f"{_FAST} --swarm {{given}}/learning.yaml --out {{out}} --mcap {{out}}/a.mcap --tum {{out}}"
        " --learned {out}/a.yaml",
        "report.html",
    ),
    Command(f"{_ESTIMATOR} replay_map", "{given}/pushbot_one --out {out}", "map.pgm"),
    Command(
        f"{_ESTIMATOR} calibrate",
        f"{BAGS}/eight_one_robot_fast --plain --evaluations 1 --out {{out}}/a.yaml",
        "a.yaml",
    ),
    Command(f"{_ESTIMATOR} calibrate_ir", "{given}/droplets_twenty --out {out}/a.yaml", "a.png"),
    Command(f"{_ESTIMATOR} survey", f"{_FAST} --out {{out}}/a.yaml", "a.png"),
    Command(f"{_ESTIMATOR} sweep", "{given}/sweep.yaml --out {out}", "table.csv"),
    Command(f"{_ESTIMATOR} new", "{out}/lab/swarm.yaml --yes", "lab/swarm.schema.json"),
    Command(f"{_ESTIMATOR} import_mrclam", "{given}/mrclam {out}/bag", "", "bag"),
    Command(f"{_ESTIMATOR} import_droplets", "{given}/droplets.txt {out}/bag", "", "bag"),
    Command(f"{_VISION} print_markers", "--board 3x4 --out {out}/a.pdf", "a_board.yaml"),
    Command(f"{_VISION} detect", "{given}/eight_pictures --output {out}/bag", "", "bag"),
    Command("bench.scenarios generate_bag", "eight {out}/bag --duration 4 --robots 1", "", "bag"),
    Command("bench.scenarios generate_bag", "pictures {out}/bag --duration 2 --robots 1", "", "bag"),
    Command("bench.scenarios generate_bag", "droplets {out}/bag --duration 4 --robots 3", "", "bag"),
    Command("bench.scenarios generate_bag", "aerial {out}/bag --duration 4 --robots 2", "", "bag"),
)


def give_inputs(given: Path) -> None:
    """Write the inputs of all commands to a new folder."""
    for name, seconds in _PARTS.items():
        copy_part(BAGS / name, given / name, seconds)
        for file in (*(BAGS / name).glob("*.yaml"), *(BAGS / name).glob("*.csv")):
            if file.name != "metadata.yaml":
                shutil.copy(file, given / name)
    (given / "sweep.yaml").write_text(_SWEEP.format(given=given), encoding="utf-8")
    swarm = (given / "eight_one_robot_fast/swarm.yaml").read_text(encoding="utf-8")
    (given / "learning.yaml").write_text(
        swarm.replace("z: 0.08}", "z: 0.08, yaw_sigma: 0.05}", 1), encoding="utf-8"
    )
    _give_mrclam(given / "mrclam")
    _give_droplets(given / "droplets.txt")
    for path in (given, *given.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)


def _give_mrclam(folder: Path) -> None:
    """Robot 1 on a circle around the origin, with a landmark; files as of the dataset."""
    folder.mkdir()
    begin_s, speed, rate = 1_248_272_272.0, 0.1, 0.25
    times = np.arange(0.0, 20.0, 0.1)
    poses = se2.compose([0.0, -speed / rate, 0.0], se2.exp(np.outer(times, [speed, 0.0, rate])))
    seen = se2.transform_points(se2.inverse(poses), np.array([3.0, 1.0]))
    tables = {
        "Robot1_Odometry": [(begin_s + at_s, speed, rate) for at_s in times],
        "Robot1_Groundtruth": [(begin_s + at_s, *pose) for at_s, pose in zip(times, poses, strict=True)],
        "Robot1_Measurement": [
            (begin_s + at_s, 72, math.hypot(x, y), math.atan2(y, x))
            for at_s, (x, y) in zip(times, seen, strict=True)
        ],
        "Barcodes": [(1, 5), (6, 72)],
        "Landmark_Groundtruth": [(6, 3.0, 1.0, 0.001, 0.001)],
    }
    for name, rows in tables.items():
        lines = ["# a comment", *("\t".join(f"{value:.12g}" for value in row) for row in rows)]
        (folder / f"{name}.dat").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _give_droplets(file: Path) -> None:
    """Exchanges of two Droplets that stand, as lines of the recording."""
    (x0, y0, turn0), (x1, y1, turn1) = _PLACES
    root = np.array([METRES_PER_PIXEL * x0, METRES_PER_PIXEL * y0, turn0 + math.pi])  # its fiducial lies so
    other = np.array([METRES_PER_PIXEL * x1, METRES_PER_PIXEL * y1, turn1 + 0.5 * math.pi])
    x, y, heading = se2.between(root[None], other[None])[0]
    place = [[math.hypot(x, y), math.atan2(y, x), heading]]
    light = np.rint(expected_brightness(load_ir_platform("droplet_2016"), place)[0, 0]).astype(int)
    rows = ",".join("{" + ",".join(map(str, row)) + "}" for row in light.T.tolist())
    seen = ", ".join(
        f'"{name}"->{{{x:.0f}, {y:.0f}, {math.degrees(turn):.1f}}}'
        for name, (x, y, turn) in zip(("0029", "000A"), _PLACES, strict=True)
    )
    lines = [f'{{"000A", "0029", {{{rows}}}, {100 + k}.000, {{{seen}}}}},' for k in range(_EXCHANGES)]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


class Ended(NamedTuple):
    """A command that has ended."""

    status: int
    said: str  # On standard error


def run(line: list[str], scratch: Path) -> Ended:
    """Run a command to its end, with `scratch` for its temporary files."""
    env = {**os.environ, "TMPDIR": str(scratch), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        line, env=env, cwd=scratch, capture_output=True, text=True, errors="replace", check=False
    )
    return Ended(done.returncode, done.stderr)
