"""Find the places of landmarks while robots drive around, without ground truth.

    survey recording.mcap --swarm swarm.yaml --out surveyed.yaml     a bag
    survey swarm.yaml --out surveyed.yaml                            the live graph, until Ctrl-C or for 180 s

The swarm description has the robots; that of a bag is the `swarm.yaml` inside its folder unless --swarm names
another. Every marker that belongs to no robot is a landmark, and every such radio an anchor. Described
landmarks are known places and give the frame, as starts of robots do; described anchors and fixed cameras
stay. --all surveys all of them, too. Yaw and scale of cameras and the scales of odometry are corrected where
the recording shows that they are wrong. A picture of the same name as --out
shows the arena.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from importlib import import_module

from swarm_loc_estimator.common import command_line as cli
from swarm_loc_estimator.common.command_line import argument, command
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.doctor.evidence import Evidence
from swarm_loc_estimator.offline.calibration.recording import Recording, read_recording
from swarm_loc_estimator.offline.recorded_bag import same_type
from swarm_loc_estimator.offline.survey.survey import draw, survey
from swarm_loc_estimator.sensors.inputs import kinds
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm

_LIVE_S = 180.0
_SENSORS = ("odometry", "imu", "detections", "ranges")
_SURVEYED = ("unknown_id", "uwb_unknown_address")  # Reasons for which the estimator drops what a survey needs


@command(
    __doc__,
    partial(cli.add_live_or_bag, seconds=f"how long to listen (default: {_LIVE_S:g} s, or until Ctrl-C)"),
    argument("--out", type=cli.yaml_and_picture, required=True, help="swarm description to write"),
    argument("--all", action="store_true", help="survey landmarks, anchors and cameras described, too"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    live = cli.is_live(options)
    if not live and (options.seconds or options.namespace):
        raise UserError("--seconds and --namespace are for a live graph; a bag is surveyed as a whole.")
    swarm = load_swarm(cli.described(options))
    if options.all:
        swarm = replace(swarm, landmarks=(), anchors=())
    with cli.ProgressLine() as progress:
        if live:
            listen = import_module("swarm_loc_estimator.doctor.listener").listen
            where, seconds = (options.namespace, _is_used), options.seconds or _LIVE_S
            heard: Evidence = listen(swarm, seconds, progress, *where, use_sim_time=options.use_sim_time)
            recording = Recording(
                "the live graph",
                heard.odometry,
                heard.rows("detections"),
                {},
                turn_rates=heard.turn_rates,
                ranges=heard.rows("ranges"),
                dropped=heard.converted[1].total,
            )
        else:
            recording = read_recording(options.source, swarm, progress, options.remap)
        done = survey(recording, swarm, progress, cameras=options.all)
    save_swarm(done.swarm, options.out, f"Surveyed with {recording.name}.")
    print("\n".join([done.text, *recording.sentences(_SURVEYED)]))
    print(f"{options.out} written, picture: {draw(done, options.out.with_suffix('.png'))}")
    return 0


def _is_used(message_type: str) -> bool:
    return any(same_type(message_type, one.message_type) for one in kinds().values() if one.rows in _SENSORS)
