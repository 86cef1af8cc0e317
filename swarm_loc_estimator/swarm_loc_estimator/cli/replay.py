"""Replay a bag through the estimator: poses, errors against ground truth, pictures and a page.

    replay bags/eight_five_robots
    replay recording.mcap --swarm swarm.yaml --out out/recording --set horizon_s=1.0
    replay recording.mcap --swarm swarm.yaml --learned learned.yaml

The swarm description is the `swarm.yaml` inside the bag's folder unless --swarm names another. The report
(report.txt, report.html, overview.png, paths.png, errors.png) and the poses (poses.csv) are written to --out.
--learned writes the description for the next run, with what the filter has learned of cameras, odometry and
landmarks; it learns of what the description gives a sigma.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_estimator.cli.arguments import folder_to_write, number_in, yaml_to_write
from swarm_loc_estimator.cli.ending import told_in_a_sentence
from swarm_loc_estimator.cli.progress import ProgressLine
from swarm_loc_estimator.core.learned import learns
from swarm_loc_estimator.core.settings import EstimatorSettings, SettingsError
from swarm_loc_estimator.io.bag_file import BagError
from swarm_loc_estimator.io.report import write_report
from swarm_loc_estimator.io.swarm_file import SwarmFileError, load_swarm
from swarm_loc_estimator.io.swarm_writer import save_swarm
from swarm_loc_estimator.io.typestore import DefinitionsNotFoundError
from swarm_loc_estimator.replay import TICK_S, replay
from swarm_loc_estimator.replay_result import ReplayResult

_NOTHING_TO_LEARN = (
    "--learned: the swarm description has no sigma of a camera, of odometry or of a landmark,"
    " so there is nothing to learn; give for instance camera.yaw_sigma."
)
_COVARIANCE = ("xx", "xy", "xtheta", "yy", "ytheta", "thetatheta")
_COLUMNS = ("stamp_ns", "robot", "x_m", "y_m", "theta_rad", *_COVARIANCE)


@told_in_a_sentence(BagError, SwarmFileError, SettingsError, DefinitionsNotFoundError)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    settings = read_settings(options.set)
    swarm = load_swarm(options.swarm or swarm_beside(options.bag))
    with ProgressLine() as progress:
        if options.learned and not learns(swarm):
            print(_NOTHING_TO_LEARN, file=sys.stderr)
            return 1
        result = replay(options.bag, swarm, settings, tick_s=options.tick, progress=progress)
        progress(1.0, "writing the report")
        files = write_report(result, options.out)
        write_poses(result, options.out / "poses.csv")
        if options.learned and result.learned:
            save_swarm(result.learned, options.learned, f"Learned from {result.title}.")
    print(files.text.read_text(encoding="utf-8"))
    print(f"Report:  {files.page}\nPicture: {files.overview}")
    return 0


def swarm_beside(bag: Path) -> Path:
    """The swarm description that belongs to a bag; raises BagError where there is none."""
    if not bag.exists():
        raise BagError(f"There is no bag '{bag}'.")
    return (bag if bag.is_dir() else bag.parent) / "swarm.yaml"


def read_settings(pairs: Sequence[str]) -> EstimatorSettings:
    """Settings from texts such as `horizon_s=1.0`; raises SettingsError."""
    kind_of = {name: type(value) for name, value in asdict(EstimatorSettings()).items()}
    values: dict[str, Any] = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        if name not in kind_of:
            raise SettingsError(f"--set {pair}: '{name}' is no setting; there are {', '.join(kind_of)}.")
        try:
            values[name] = kind_of[name](text)
        except ValueError:
            wanted = "whole number" if kind_of[name] is int else "number"
            raise SettingsError(f"--set {pair}: '{text}' is not a {wanted}.") from None
    return EstimatorSettings(**values)


def write_poses(result: ReplayResult, path: Path) -> None:
    """Write all poses: stamp_ns, robot, x, y, theta, and the upper triangle of their covariance."""
    upper = np.triu_indices(3)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COLUMNS)
        for stamp_ns, poses, covariances in zip(
            result.stamp_ns.tolist(), result.pose, result.covariance, strict=True
        ):
            for robot, pose, covariance in zip(result.swarm.robots, poses, covariances, strict=True):
                if np.isfinite(pose).all():
                    writer.writerow([stamp_ns, robot.name, *pose.tolist(), *covariance[upper].tolist()])


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="replay", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path, help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("--swarm", type=Path, help="swarm description (default: swarm.yaml beside the bag)")
    parser.add_argument("--out", type=folder_to_write, default="out/replay", help="folder for the report")
    parser.add_argument(
        "--learned", type=yaml_to_write, metavar="FILE", help="where to write what was learned"
    )
    parser.add_argument(
        "--tick", type=number_in(1e-3, 3600.0, "s"), default=TICK_S, help="seconds between outputs"
    )
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="estimator setting")
    return parser


if __name__ == "__main__":
    sys.exit(main())
