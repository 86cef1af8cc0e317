"""Convert a folder of the MRCLAM dataset to a bag with swarm.yaml.

    import_mrclam MRCLAM_Dataset1 bags/mrclam1
    import_mrclam MRCLAM_Dataset1 bags/mrclam1_late --delay-ms 150 300 7

The bag holds <robot>/odom, <robot>/detections and <robot>/ground_truth; `swarm.yaml` lies inside its folder.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from swarm_loc_estimator.common.command_line import ProgressLine, argument, bag_to_write, command
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.offline.datasets.mrclam import Delay, convert, read_dataset

_DELAY = "detections arrive evenly between LO and HI milliseconds late (default: at once)"


@command(
    __doc__,
    argument("folder", type=Path, help="folder with Robot*_Odometry.dat and the other files"),
    argument("bag", type=bag_to_write, help="bag folder to create"),
    argument("--delay-ms", nargs=3, type=int, default=(0, 0, 0), metavar=("LO", "HI", "SEED"), help=_DELAY),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    low_ms, high_ms, seed = options.delay_ms
    if not 0 <= low_ms <= high_ms or seed < 0:
        raise UserError(f"--delay-ms {low_ms} {high_ms} {seed}: 0 <= LO <= HI and 0 <= SEED are needed.")
    began = time.monotonic()
    delay = Delay(low_ms * 1_000_000, high_ms * 1_000_000, seed)
    with ProgressLine() as progress:
        progress(0.0, "reading")
        dataset = read_dataset(options.folder)
        done = convert(dataset, options.bag, delay, progress)
    for remark in done.remarks:
        print(remark)
    names = ", ".join(f"robot{robot.subject}" for robot in dataset.robots)
    took_s = time.monotonic() - began
    print(f"{done.message_count} messages of {names} written to {options.bag} in {took_s:.1f} s")
    return 0
