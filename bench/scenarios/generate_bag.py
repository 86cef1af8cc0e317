"""Simulate a swarm and write its measurements as a bag, with the swarm description.

    ./run -- python -m bench generate_bag eight bags/eight_five_robots --seed 3 --duration 54 --world w0
    ./run -- python -m bench generate_bag pictures bags/eight_pictures --seed 1 --duration 9 --robots 2
    ./run -- python -m bench generate_bag droplets bags/droplets_twenty --seed 1 --duration 60
    ./run -- python -m bench generate_bag aerial bags/aerial_five --seed 1
    ./run -- python -m bench generate_bag droplets /tmp/same_boards --seed 2 --boards 1

The bag contains <robot>/odom, <robot>/detections and <robot>/ground_truth, and its folder `swarm.yaml`.
In place of detections,
    pictures writes <robot>/image_raw/compressed (JPEG) and <robot>/camera_info
    droplets writes <robot>/brightness and <robot>/fix
    aerial writes aerial/detections
The same arguments give the same bytes.
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from bench.scenarios.bags import (
    simulate_wandering,
    write_aerial_bag,
    write_bag,
    write_droplet_bag,
    write_image_bag,
)
from bench.scenarios.droplets_run import DropletRunSettings, simulate_droplets
from bench.scenarios.eight_run import EightSettings, simulate_eight, simulate_eight_images
from swarm_loc_drivers.sim.droplet.world import DROPLET_WORLDS
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_estimator.common.command_line import bag_to_write, command_parser, exit_with_message, number_in

if TYPE_CHECKING:
    from collections.abc import Sequence

_ANY_SEED = number_in(0, 2**31 - 1)


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    given = {name: value for name, value in vars(options).items() if value is not None}
    words = [f"{name}={value}" for name, value in given.items() if name not in ("bag", "write")]
    count = options.write(options, f"Simulated: {', '.join(words)}.")
    print(f"{count} messages of {options.robots} robots written to {options.bag}")
    return 0


def _eight_settings(options: argparse.Namespace) -> EightSettings:
    return EightSettings(
        seed=options.seed,
        duration_s=options.duration,
        robots=options.robots,
        speed=options.speed,
        errors=WORLDS[options.world],
        start_known=not options.start_unknown,
    )


def _eight(options: argparse.Namespace, comment: str) -> int:
    return write_bag(simulate_eight(_eight_settings(options)), options.bag, comment)


def _images(options: argparse.Namespace, comment: str) -> int:
    return write_image_bag(
        simulate_eight_images(_eight_settings(options), CameraModel()), options.bag, comment
    )


def _droplets(options: argparse.Namespace, comment: str) -> int:
    settings = DropletRunSettings(
        seed=options.seed,
        duration_s=options.duration,
        robots=options.robots,
        world=options.world,
        calibrated=options.calibrated,
        start_known=options.start_known,
        boards=options.boards,
    )
    return write_droplet_bag(simulate_droplets(settings), options.bag, comment, options.seed)


def _aerial(options: argparse.Namespace, comment: str) -> int:
    settings = EightSettings(options.seed, options.duration, options.robots, start_known=options.start_known)
    return write_aerial_bag(simulate_wandering(settings), options.bag, comment)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(__doc__)
    swarms = parser.add_subparsers(dest="swarm", required=True, metavar="SWARM")
    # e-pucks on the eight
    eight = _swarm(swarms, "eight", "e-pucks that drive along an eight among wall markers", 5, 9, 54.0)
    eight.set_defaults(write=_eight)
    images = _swarm(swarms, "pictures", "the same, with images in place of detections", 2, 9, 9.0)
    images.set_defaults(write=_images)
    for one in (eight, images):
        one.add_argument(
            "--world", choices=sorted(WORLDS), default="w0", help="error model; see sim/worlds.py"
        )
        one.add_argument("--speed", type=number_in(0.001, 0.12, "m/s"), default=0.06, help="[m/s]")
        one.add_argument("--start-unknown", action="store_true", help="leave start poses out of swarm.yaml")
    # Droplets
    droplets = _swarm(swarms, "droplets", "Droplets that measure each other by infrared", 20, 1000, 90.0)
    droplets.set_defaults(write=_droplets)
    droplets.add_argument(
        "--world", choices=sorted(DROPLET_WORLDS), default="d1", help="error model; see sim/droplet/world.py"
    )
    droplets.add_argument("--calibrated", action="store_true", help="write the elements' gains to swarm.yaml")
    droplets.add_argument("--start-known", action="store_true", help="write start poses to swarm.yaml")
    droplets.add_argument(
        "--boards", type=_ANY_SEED, help="seed of the elements' gains (default: that of --seed)"
    )
    # e-pucks seen from above
    aerial = _swarm(swarms, "aerial", "e-pucks that move at random under an overhead camera", 5, 20, 60.0)
    aerial.set_defaults(write=_aerial)
    aerial.add_argument("--start-known", action="store_true", help="write start poses to swarm.yaml")
    return parser


def _swarm(
    swarms: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    text: str,
    robots: int,
    most: int,
    seconds: float,
) -> argparse.ArgumentParser:
    """Add a sub-command with the options of all swarms, which have at most `most` robots."""
    parser = swarms.add_parser(name, help=text, description=text)
    parser.add_argument("bag", type=bag_to_write, help="bag folder to create")
    parser.add_argument("--seed", type=_ANY_SEED, default=1, help="the same seed gives the same bag")
    parser.add_argument(
        "--duration", type=number_in(2.0, 3600.0, "s"), default=seconds, help="simulated time [s]"
    )
    parser.add_argument("--robots", type=number_in(1, most), default=robots, help="number of robots")
    return parser


if __name__ == "__main__":
    sys.exit(main())
