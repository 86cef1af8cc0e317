"""Replay a bag through the estimator: poses, errors against ground truth, pictures and a page.

    replay bags/eight_five_robots
    replay recording.mcap --swarm swarm.yaml --out out/recording --set horizon_s=1.0
    replay recording.mcap --swarm swarm.yaml --learned learned.yaml

The swarm description is the `swarm.yaml` inside the bag's folder unless --swarm names another. The report
(report.txt, report.html, overview.png, paths.png, errors.png) and the poses (poses.csv) are written to --out.
--mcap writes poses, /tf, markers, and the bag's map and goals for RViz, Foxglove and other viewers.
--truth reads ground truth from files in the format of TUM in place of that of the bag.
--tum writes poses and ground truth of each robot in the format of TUM, for evo and other tools.
--smooth estimates all poses again, each from the whole recording, and compares them in the report; writes
smoothed.csv and, with --tum, <robot>.smoothed.tum.
--learned writes the description with the self-calibrated parameters of cameras, odometry and landmarks; the
parameters with a sigma in the description are estimated.
"""

from __future__ import annotations

import argparse
import csv
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common import command_line as cli
from swarm_loc_estimator.common.command_line import argument, command
from swarm_loc_estimator.common.files import replacing
from swarm_loc_estimator.offline.batch.smooth import smooth
from swarm_loc_estimator.offline.export import read_truth, write_mcap, write_tum
from swarm_loc_estimator.offline.replay import TICK_S, TICKS_S, replay
from swarm_loc_estimator.offline.report.report import REPORT_FILES, write_report
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.self_calibration import swapped_signs
from swarm_loc_estimator.timeline.settings import Settings

_REPORT = cli.folder_to_write(*REPORT_FILES, "poses.csv", "smoothed.csv")
_NOTHING_TO_LEARN = (
    "--learned: the swarm description has no sigma of a camera, of odometry or of a landmark, and nothing"
    " contradicted it, so there is nothing to learn; give for instance camera.yaw_sigma."
)
_NO_POSES = "No robot was located at any time; see what the report says of the bag and of what was dropped."
_COVARIANCE = ("xx", "xy", "xtheta", "yy", "ytheta", "thetatheta")
_COLUMNS = ("stamp_ns", "robot", "x_m", "y_m", "theta_rad", *_COVARIANCE)


@command(
    __doc__,
    cli.add_bag,
    cli.add_remap,
    cli.add_truth,
    argument("--out", type=_REPORT, default="out/replay", help="folder for the report"),
    argument("--smooth", action="store_true", help="estimate all poses again, from the whole recording"),
    argument("--learned", type=cli.yaml_to_write, metavar="FILE", help="where to write what was learned"),
    argument("--mcap", type=cli.file_to_write(".mcap"), metavar="FILE", help="poses and markers for viewers"),
    argument("--tum", type=cli.folder_to_write("*.tum"), metavar="FOLDER", help="trajectories for evo"),
    argument("--tick", type=cli.number_in(*TICKS_S, "s"), default=TICK_S, help="seconds between outputs"),
    partial(cli.add_set, what="parameter of the estimator"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    # replay, and write all files
    settings = cli.parameters_of(Settings, options.set)
    swarm = load_swarm(options.swarm or cli.swarm_beside(options.bag))
    with cli.ProgressLine() as progress:
        result = replay(
            options.bag,
            swarm,
            settings,
            tick_s=options.tick,
            remap=options.remap,
            truth=read_truth(options.truth, swarm),
            keep_sightings=True,
            progress=progress,
        )
        (options.out / "smoothed.csv").unlink(missing_ok=True)  # of an earlier run
        if options.smooth:
            smoothed = smooth(options.bag, result, remap=options.remap, progress=progress)
            result = replace(result, smoothed=smoothed)
            write_poses(smoothed, options.out / "smoothed.csv")
        progress(1.0, "writing the report")
        write_poses(result, options.out / "poses.csv")
        files = write_report(result, options.out)
        if options.mcap:
            write_mcap(result, options.mcap)
        if options.tum:
            write_tum(result, options.tum)
    # write what was learned, unless there is nothing or it cannot be right
    if options.learned:
        if not result.self_calibrated:
            print(_NOTHING_TO_LEARN, file=sys.stderr)
            return 1
        if swapped := swapped_signs(result.self_calibrated):
            print("\n".join([*swapped, f"{options.learned} was not written."]), file=sys.stderr)
            return 1
        save_swarm(result.self_calibrated, options.learned, f"Learned from {result.title}.")
    # say what was found
    print(files.text.read_text(encoding="utf-8"))
    print(f"Report:  {files.page}\nPicture: {files.overview}")
    if not np.isfinite(result.poses).all(axis=2).any():
        print(_NO_POSES, file=sys.stderr)
        return 1
    return 0


def write_poses(result: ReplayResult, path: Path) -> None:
    """Write all poses: stamp_ns, robot, x, y, theta, and the upper triangle of their covariance."""
    upper = np.triu_indices(3)
    with replacing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COLUMNS)
        for stamp_ns, poses, covariances in zip(
            result.stamp_ns.tolist(), result.poses, result.covariances, strict=True
        ):
            for robot, pose, covariance in zip(result.swarm.robots, poses, covariances, strict=True):
                if np.isfinite(pose).all():
                    writer.writerow([stamp_ns, robot.name, *pose.tolist(), *covariance[upper].tolist()])
