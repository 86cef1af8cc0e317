"""Start simulated e-pucks and all that locates them.

    simulate bags/eight_five_robots/swarm.yaml --world w2 --seed 1

One world with rendered cameras, robots that answer their drivers' bytes on serial ports, a driver and a
marker detector for each robot, the steering along the eight, and the estimator; all on simulated time.
`ros2 launch swarm_loc_drivers simulation.launch.py` starts the same.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from swarm_loc_drivers.sim.epuck_world import check_swarm
from swarm_loc_drivers.sim.world_error import WorldError
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_drivers.simulation import SimulationOptions, simulation_nodes
from swarm_loc_estimator.cli.arguments import number_in
from swarm_loc_estimator.cli.ending import told_in_a_sentence
from swarm_loc_estimator.cli.graph import say
from swarm_loc_estimator.core.compiled import is_warm
from swarm_loc_estimator.io.swarm_file import SwarmFileError, load_swarm
from swarm_loc_estimator.processes import GraphError, run_graph
from swarm_loc_vision.core.warm_up import CORE, warm_up


def parse(arguments: Sequence[str] | None) -> SimulationOptions:
    """Read the command line; links have no folder yet."""
    parser = argparse.ArgumentParser(
        prog="simulate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    defaults = SimulationOptions("", "")
    parser.add_argument("swarm_file", metavar="SWARM_FILE", help="the swarm description")
    parser.add_argument(
        "--world",
        choices=sorted(WORLDS),
        default=defaults.world,
        help=f"which errors robots and cameras have (default: {defaults.world})",
    )
    parser.add_argument(
        "--seed", type=number_in(0, 2**31 - 1), default=defaults.seed, help="fixes them (default: 1)"
    )
    parser.add_argument(
        "--speed",
        type=number_in(0.001, 0.12, "m/s"),
        default=defaults.speed,
        help=f"along the eight (default: {defaults.speed} m/s)",
    )
    parser.add_argument(
        "--rate",
        type=number_in(0.01, 100.0),
        default=defaults.rate,
        help="simulated seconds per second, as far as the machine keeps up (default: 1)",
    )
    parser.add_argument("--params-file", dest="parameter_file", help="ROS parameter file for all nodes")
    return SimulationOptions(link_folder="", **vars(parser.parse_args(arguments)))


@told_in_a_sentence(GraphError, SwarmFileError, WorldError)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run until a node ends or Ctrl-C."""
    options = parse(arguments)
    swarm = load_swarm(Path(options.swarm_file))
    check_swarm(swarm)  # here, and not by the world when a score of processes have started
    if not is_warm(CORE):  # once, not in every robot's detector at a time
        say("compiling the marker detector for this machine: about half a minute")
        warm_up()
    with tempfile.TemporaryDirectory(prefix="epucks-") as links:
        chosen = replace(options, link_folder=links)
        return run_graph(simulation_nodes(chosen, [robot.name for robot in swarm.robots]), say)


if __name__ == "__main__":
    sys.exit(main())
