"""The executables of this package; see the estimator's `start.py`."""

from __future__ import annotations

from swarm_loc_estimator.start import program

droplet_driver_node = program("swarm_loc_drivers.nodes.droplet.droplet_driver_node")
droplet_fleet_node = program("swarm_loc_drivers.nodes.droplet.droplet_fleet_node")
droplet_steering_node = program("swarm_loc_drivers.nodes.droplet.droplet_steering_node")
droplet_world_node = program("swarm_loc_drivers.nodes.droplet.droplet_world_node")
eight_steering_node = program("swarm_loc_drivers.nodes.epuck.eight_steering_node")
epuck_driver_node = program("swarm_loc_drivers.nodes.epuck.epuck_driver_node")
epuck_world_node = program("swarm_loc_drivers.nodes.epuck.epuck_world_node")
exploration_node = program("swarm_loc_drivers.nodes.pushbot.exploration_node")
generate_bag = program("swarm_loc_drivers.cli.generate_bag")
pushbot_driver_node = program("swarm_loc_drivers.nodes.pushbot.pushbot_driver_node")
pushbot_world_node = program("swarm_loc_drivers.nodes.pushbot.pushbot_world_node")
simulate = program("swarm_loc_drivers.cli.simulate")
