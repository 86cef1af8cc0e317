"""Start simulated robots: e-pucks or Droplets and all that locates them, or PushBots that map a hall.

    simulate bags/eight_five_robots/swarm.yaml --world w2 --seed 1

One world with rendered cameras, robots that answer their drivers' bytes on serial ports, a driver and a
marker detector for each robot, the steering along the eight, and the estimator; all on simulated time. Robots
whose type is `droplet` get a table with infrared, a tracker above it and one process of drivers. Robots whose
type is `pushbot` get a hall, each a driver and an event tracker with its laser calibrated, and together a
mapper and a node that drives them to its goals.
`ros2 launch swarm_loc_drivers simulation.launch.py` starts the same.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from swarm_loc_drivers.sim.link_folder import link_folder
from swarm_loc_drivers.sim.pushbot.floor_plan import FLOOR_PLANS
from swarm_loc_drivers.sim.simulation import (
    ROBOT_TYPES,
    SimulationOptions,
    graph_of,
    robot_type_of,
    simulated_swarm,
)
from swarm_loc_estimator.common.command_line import command_parser, exit_with_message, number_in
from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.launch import print_line, run_graph
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_vision.markers.detector import precompile


def parse(arguments: Sequence[str] | None) -> SimulationOptions:
    """Read the command line."""
    parser = command_parser("simulate", __doc__)
    parser.add_argument("swarm_file", metavar="SWARM_FILE", help="the swarm description")
    defaults = SimulationOptions("")
    parser.add_argument(
        "--world",
        choices=[world for kind in ROBOT_TYPES.values() for world in kind.worlds],
        default=defaults.world,
        help="which errors robots and sensors have (default: w2 of e-pucks, d1 of Droplets)",
    )
    for name, spec in number_specs(SimulationOptions).items():
        default = getattr(defaults, name)
        kind = type(default)
        parser.add_argument(
            f"--{name}",
            type=number_in(kind(spec.low), kind(spec.high), spec.unit.strip("1")),
            default=default,
            help=f"{spec.doc} (default: {default:g})",
        )
    parser.add_argument(
        "--plan",
        choices=sorted(FLOOR_PLANS),
        default=defaults.plan,
        help=f"the hall of PushBots (default: {defaults.plan})",
    )
    parser.add_argument(
        "--aerial",
        action="store_true",
        help="an overhead camera, which cannot tell robots apart, is all that locates them",
    )
    parser.add_argument("--params-file", dest="parameter_file", help="ROS parameter file for all nodes")
    return SimulationOptions(**vars(parser.parse_args(arguments)))


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run until a node ends or Ctrl-C."""
    options = parse(arguments)
    swarm = simulated_swarm(options)
    detects = robot_type_of(swarm).has_markers and not options.aerial
    if detects and not is_precompiled(precompile):  # once, not in every robot's detector at a time
        print_line("compiling the marker detector for this machine: about half a minute")
        precompile()
    with link_folder() as links:
        return run_graph(graph_of(options, swarm, links))


if __name__ == "__main__":
    sys.exit(main())
