"""Start simulated e-pucks: ros2 launch swarm_loc_drivers simulation.launch.py swarm_file:=FILE."""

import atexit
import shutil
import tempfile
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from swarm_loc_drivers.sim.epuck_world import check_swarm
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_drivers.simulation import SimulationOptions, simulation_nodes
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.launching import node_action


def generate_launch_description() -> LaunchDescription:
    """The simulation's options as launch arguments, then its nodes."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("swarm_file", description="path of the swarm description"),
            DeclareLaunchArgument("world", default_value="w2", choices=sorted(WORLDS)),
            DeclareLaunchArgument("seed", default_value="1", description="fixes the world's errors"),
            DeclareLaunchArgument("speed", default_value="0.06", description="along the eight [m/s]"),
            DeclareLaunchArgument("rate", default_value="1.0", description="simulated seconds per second"),
            DeclareLaunchArgument("params_file", default_value="", description="ROS parameters of all nodes"),
            OpaqueFunction(function=start_nodes),
        ]
    )


def start_nodes(context: LaunchContext) -> list[Node]:
    """The actions that start the simulation's nodes."""

    def argument(name: str) -> str:
        return str(LaunchConfiguration(name).perform(context))

    swarm_file = argument("swarm_file")
    swarm = load_swarm(Path(swarm_file))
    check_swarm(swarm)  # here, and not by the world when a score of processes have started
    links = tempfile.mkdtemp(prefix="epucks-")
    atexit.register(shutil.rmtree, links, ignore_errors=True)  # when the last process has ended
    options = SimulationOptions(
        swarm_file=swarm_file,
        link_folder=links,
        world=argument("world"),
        seed=int(argument("seed")),
        speed=float(argument("speed")),
        rate=float(argument("rate")),
        parameter_file=argument("params_file") or None,
    )
    return [node_action(spec) for spec in simulation_nodes(options, [robot.name for robot in swarm.robots])]
