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

from swarm_loc_drivers.sim.simulation import (
    WORLD_NAMES,
    SimulationOptions,
    graph_of,
    robot_type_of,
    simulated_swarm,
)
from swarm_loc_estimator.common.command_line import exit_with_message
from swarm_loc_estimator.common.files import temporary_folder
from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.launch import parsed_options, print_line, run_graph
from swarm_loc_vision.markers.detector import precompile


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run until a node ends or Ctrl-C."""
    options = parsed_options(SimulationOptions, __doc__, arguments, {"world": WORLD_NAMES})
    swarm = simulated_swarm(options)
    detects = robot_type_of(swarm).has_markers and not options.aerial
    if detects and not is_precompiled(precompile):  # once here instead of in every detector
        print_line("compiling the marker detector for this machine: about half a minute")
        precompile()
    with temporary_folder("swarm_loc-") as links:
        return run_graph(graph_of(options, swarm, str(links)))


if __name__ == "__main__":
    sys.exit(main())
