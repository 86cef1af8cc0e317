"""The executables of this package, each imported only when it is started."""

from __future__ import annotations

from swarm_loc_estimator.common.command_line import Program

dotbot_node = Program("swarm_loc_drivers.dotbot.dotbot_node")
droplet_driver_node = Program("swarm_loc_drivers.droplet.droplet_nodes", "run_droplet_driver")
droplet_fleet_node = Program("swarm_loc_drivers.droplet.droplet_nodes", "run_droplet_fleet")
droplet_steering_node = Program("swarm_loc_drivers.sim.scenarios.steering_nodes", "run_droplet_steering")
droplet_world_node = Program("swarm_loc_drivers.sim.droplet.droplet_world_node")
eight_steering_node = Program("swarm_loc_drivers.sim.scenarios.steering_nodes", "run_eight_steering")
epuck_driver_node = Program("swarm_loc_drivers.epuck.epuck_driver_node")
epuck_world_node = Program("swarm_loc_drivers.sim.epuck.epuck_world_node")
exploration_node = Program("swarm_loc_drivers.pushbot.exploration_node")
pushbot_driver_node = Program("swarm_loc_drivers.pushbot.pushbot_driver_node")
pushbot_world_node = Program("swarm_loc_drivers.sim.pushbot.pushbot_world_node")
room_world_node = Program("swarm_loc_drivers.sim.room.room_world_node")
simulate = Program("swarm_loc_drivers.sim.simulate")
