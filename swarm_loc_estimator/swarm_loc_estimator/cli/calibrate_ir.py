"""Estimate the gains of infrared sensors and emitters from exchanges between robots.

    calibrate_ir bags/droplets_twenty
    calibrate_ir recording.mcap --swarm swarm.yaml --out calibrated.yaml --without-truth
    calibrate_ir bags/droplets_real --board out/board.yaml --out out/swarm.yaml

The bag holds <robot>/brightness. <robot>/ground_truth is used if present; without it
the poses are estimated together with the gains. The description is the `swarm.yaml` inside the bag's folder
unless --swarm names another. Robots are calibrated with those of the same platform. A picture of
the same name as --out shows the residuals before and after, and the gains.
"""

from __future__ import annotations

import argparse
from functools import partial

from swarm_loc_estimator.common import command_line as cli
from swarm_loc_estimator.common.command_line import argument, command
from swarm_loc_estimator.offline.calibration.infrared.board import calibrate_from, with_board
from swarm_loc_estimator.offline.calibration.infrared.gains import calibrate_infrared
from swarm_loc_estimator.offline.calibration.plots import board_text, draw_board, draw_gains, gains_text
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.swarm.ir_board import save_ir_platform
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm

_OUT = "out/calibrated_ir.yaml"


@command(
    __doc__,
    partial(cli.add_bag, content=" with <robot>/brightness"),
    cli.add_remap,
    argument("--out", type=cli.yaml_and_picture, default=_OUT, help=f"description to write (default {_OUT})"),
    argument("--board", type=cli.yaml_and_picture, help="where to write the board, found by ground truth"),
    argument("--without-truth", action="store_true", help="do as if there were no ground truth"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    swarm = load_swarm(options.swarm or cli.swarm_beside(options.bag))
    if options.board is None:
        with cli.ProgressLine() as progress:
            recording = read_recording(options.bag, swarm, progress, options.remap)
            gains = calibrate_infrared(recording, swarm, progress, with_truth=not options.without_truth)
        save_swarm(gains.swarm, options.out, f"Infrared gains calibrated with {options.bag.name}.")
        print("\n".join([gains_text(gains), *recording.sentences()]))
        print(f"{options.out} written, picture: {draw_gains(gains, options.out.with_suffix('.png'))}")
        return 0
    # fit the parameters of the board, and write it and a swarm description that uses it
    with cli.ProgressLine() as progress:
        recording = read_recording(options.bag, swarm, progress, options.remap)
        board, done = calibrate_from(recording, swarm, progress)
    said = f"Infrared board calibrated with {options.bag.name}."
    save_ir_platform(done.model.platform, options.board, said)
    save_swarm(with_board(swarm, board, done, options.board), options.out, said)
    print(board_text(board, done, swarm))
    picture = draw_board(board, done, options.board.with_suffix(".png"))
    print(f"{options.board} and {options.out} written, picture: {picture}")
    return 0
