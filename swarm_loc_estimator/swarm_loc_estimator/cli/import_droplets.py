"""Convert a recording of Droplets under an overhead camera to a bag with swarm.yaml.

    import_droplets rnbCalibData.txt bags/droplets
    import_droplets rnbCalibData.txt bags/droplets --platform droplet --metres-per-pixel 0.00105

One line per exchange: {"TX", "RX", 6 x 6 counts, camera time [s], {"id"->{x, y, orientation}, ...}},. The bag
holds <robot>/brightness, <robot>/ground_truth of stationary robots, and <robot>/fix of receivers. Errors of
the camera are corrected: misread ids, orientations wrong by quarter turns, robots in two places.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from swarm_loc_estimator.common.command_line import ProgressLine, argument, bag_to_write, command, number_in
from swarm_loc_estimator.offline.datasets import droplets

_SCALE = "of the camera's image (default: robots of 44 mm that touch are 42 pixels apart)"


@command(
    __doc__,
    argument("recording", type=Path, help="text file, one exchange a line"),
    argument("bag", type=bag_to_write, help="bag folder to create"),
    argument("--platform", default="droplet_2016", help="board of the robots (default droplet_2016)"),
    argument(
        "--metres-per-pixel", type=number_in(1e-6, 1.0, "m"), default=droplets.METRES_PER_PIXEL, help=_SCALE
    ),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    settings = droplets.ImportSettings(options.platform, options.metres_per_pixel)
    with ProgressLine() as progress:
        done = droplets.import_recording(options.recording, options.bag, settings, progress)
    for remark in done.remarks:
        print(remark)
    turns = sorted(done.fiducials.turn_of.items())
    turned = ", ".join(f"{droplets.name_of(robot)} {turn * 57.29578:+.0f}" for robot, turn in turns)
    mirrored = "" if done.fiducials.handedness == 1 else "; the image is mirrored"
    print(f"fiducials sit turned by [deg]: {turned}{mirrored}")
    print(f"{done.exchanges} exchanges, {done.with_truth} with ground truth, written to {options.bag}")
    return 0
