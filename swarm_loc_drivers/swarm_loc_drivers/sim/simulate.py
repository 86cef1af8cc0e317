"""Start a complete simulation of e-pucks, Droplets or PushBots.

    simulate bags/eight_five_robots/swarm.yaml --world w2 --seed 1

All nodes use simulated time. The robots' type in the swarm description selects the world:
    e-pucks (any other type): rendered cameras; a driver and a marker detector per robot; steering along an
        eight; the estimator
    droplet: a table with infrared and a tracker; all drivers in one process; steering; the estimator
    pushbot: a hall; a driver and an event tracker per robot; mapper, exploration and estimator
See doc/simulate.md. With ROS 2: `ros2 launch swarm_loc_drivers simulation.launch.py`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from swarm_loc_drivers.sim.pushbot.floor_plan import FLOOR_PLANS
from swarm_loc_drivers.sim.simulation import (
    ROBOT_TYPES,
    SimulationOptions,
    graph_of,
    robot_type_of,
    simulated_swarm,
)
from swarm_loc_estimator.common.command_line import command_parser, exit_with_message, number_in
from swarm_loc_estimator.common.files import temporary_folder
from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.launch import print_line, run_graph
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_vision.markers.detector import precompile


def parse(arguments: Sequence[str] | None) -> SimulationOptions:
    """Read the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("swarm_file", metavar="SWARM_FILE", help="the swarm description")
    defaults = SimulationOptions("")
    parser.add_argument(
        "--world",
        choices=[world for kind in ROBOT_TYPES.values() for world in kind.worlds],
        default=defaults.world,
        help="error model of robots and sensors (default: w2 for e-pucks, d1 for Droplets)",
    )
    # one option for each number of SimulationOptions
    for name, spec in number_specs(SimulationOptions).items():
        default = getattr(defaults, name)
        kind = type(default)
        parser.add_argument(
            f"--{name}",
            type=number_in(kind(spec.low), kind(spec.high), spec.unit.strip("1")),
            default=default,
            help=f"{spec.doc} (default: {default:g})",
        )
    # the environment, and how robots are seen
    parser.add_argument(
        "--plan",
        default=defaults.plan,
        help=f"the hall of PushBots: {', '.join(FLOOR_PLANS)}, or the path of a floor plan"
        f" (default: {defaults.plan})",
    )
    parser.add_argument(
        "--aerial",
        action="store_true",
        help="locate e-pucks only by an overhead camera, which cannot tell them apart",
    )
    parser.add_argument("--params-file", dest="parameter_file", help="ROS parameter file for all nodes")
    return SimulationOptions(**vars(parser.parse_args(arguments)))


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run until a node ends or Ctrl-C."""
    options = parse(arguments)
    swarm = simulated_swarm(options)
    detects = robot_type_of(swarm).has_markers and not options.aerial
    if detects and not is_precompiled(precompile):  # once here instead of in every detector
        print_line("compiling the marker detector for this machine: about half a minute")
        precompile()
    with temporary_folder("swarm_loc-") as links:
        return run_graph(graph_of(options, swarm, str(links)))


if __name__ == "__main__":
    sys.exit(main())
