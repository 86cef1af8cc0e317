"""Find the places of landmarks from a bag in which robots drove around, without ground truth.

    survey recording.mcap --swarm swarm.yaml --out surveyed.yaml

The swarm description has the robots; it is the `swarm.yaml` inside the bag's folder unless --swarm names
another. Every marker that belongs to no robot is a landmark. Described landmarks are known places and give
the frame, as starts of robots do; --all surveys them, too. Yaw and scale of cameras and the scales of
odometry are corrected where the recording shows that they are wrong. Beside --out a picture of the same name
shows the arena.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

from swarm_loc_estimator.common.command_line import (
    ProgressLine,
    add_bag,
    add_remap,
    command_parser,
    exit_with_message,
    swarm_beside,
    yaml_to_write,
)
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.survey.plots import draw
from swarm_loc_estimator.offline.survey.survey import survey
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.swarm.swarm_writer import save_swarm


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    swarm = load_swarm(options.swarm or swarm_beside(options.bag))
    if options.all:
        swarm = replace(swarm, landmarks=())
    with ProgressLine() as progress:
        recording = read_recording(options.bag, swarm, progress, options.remap)
        done = survey(recording, swarm, progress)
    save_swarm(done.swarm, options.out, f"Surveyed with {options.bag.name}.")
    print("\n".join([done.text, *recording.sentences(expected="unknown_id")]))  # those are the landmarks
    print(f"{options.out} written, picture: {draw(done, options.out.with_suffix('.png'))}")
    return 0


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser(__doc__)
    add_bag(parser)
    add_remap(parser)
    parser.add_argument("--out", type=yaml_to_write, required=True, help="swarm description to write")
    parser.add_argument("--all", action="store_true", help="survey landmarks that are described, too")
    return parser


if __name__ == "__main__":
    sys.exit(main())
