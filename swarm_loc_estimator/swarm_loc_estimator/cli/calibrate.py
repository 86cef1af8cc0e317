"""Fit sensors, motion and noise to a bag with ground truth, or to itself.

    calibrate bags/mrclam1 --out calibrated.yaml
    calibrate recording.mcap --swarm swarm.yaml --out calibrated.yaml --plain
    calibrate recording.mcap --self --out calibrated.yaml

Without ground truth, --self fits the recording to itself: landmarks must be where the description says, and
robots should drive straight and turn both ways past many of them for some minutes.

Several bags of one swarm are one recording with pauses, after which landmarks must locate the robots again.
The swarm description is the `swarm.yaml` inside the folder of the first unless --swarm names another. A
picture of the same name as --out shows the errors before and after.
"""

from __future__ import annotations

import argparse
from functools import partial

from swarm_loc_estimator.common import command_line as cli
from swarm_loc_estimator.common.command_line import argument, command
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.offline.batch.problem import moved
from swarm_loc_estimator.offline.calibration.fit import calibrate
from swarm_loc_estimator.offline.calibration.models import EVALUATIONS, Options
from swarm_loc_estimator.offline.calibration.plots import draw, text_of
from swarm_loc_estimator.offline.calibration.recording import joined, read_recording
from swarm_loc_estimator.offline.export import read_truth
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm

_RUNS = f"runs of the estimator to fit the noise (default {EVALUATIONS})"


@command(
    __doc__,
    partial(cli.add_bag, content="; with <robot>/ground_truth, --truth or --self", several=True),
    cli.add_remap,
    cli.add_truth,
    argument("--out", type=cli.yaml_and_picture, required=True, help="swarm description to write"),
    argument("--self", dest="alone", action="store_true", help="use no ground truth"),
    argument("--plain", action="store_true", help="fit only noise, calibrate nothing"),
    argument("--no-response", action="store_true", help="one share of speed and one of turns, no table"),
    argument("--evaluations", type=cli.number_in(1, 10_000), default=EVALUATIONS, help=_RUNS),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    kind = {"plain": options.plain, "response": not options.no_response, "alone": options.alone}
    chosen = Options(**kind, evaluations=options.evaluations)
    if options.truth and len(options.bag) > 1:
        raise UserError("--truth is for one bag.")
    if len({bag.resolve() for bag in options.bag}) < len(options.bag):
        raise UserError(f"{', '.join(map(str, options.bag))}: a bag is given twice, which tells nothing new.")
    swarm = load_swarm(options.swarm or cli.swarm_beside(options.bag[0]))
    with cli.ProgressLine() as progress:
        truth, remap = read_truth(options.truth, swarm), options.remap
        recording = joined([read_recording(bag, swarm, progress, remap, truth) for bag in options.bag])
        done = calibrate(recording, swarm, chosen, progress)
    save_swarm(done.swarm, options.out, f"Calibrated with {recording.name}. {done.warning}".rstrip())
    print("\n".join([text_of(done), *moved(swarm, done.swarm), *recording.sentences()]))
    unused = {"brightness": recording.brightness.robot.size, "fix": recording.fixes.robot.size}
    said = " and ".join(f"{count} messages on <robot>/{name}" for name, count in unused.items() if count)
    if said:
        print(f"Not used: {said}. Infrared boards are calibrated by calibrate_ir.")
    print(f"{options.out} written, picture: {draw(done, options.out.with_suffix('.png'))}")
    return 0
