"""The executables of this package, each imported only when it is started."""

from __future__ import annotations

from swarm_loc_estimator.common.command_line import program

calibrate = program("swarm_loc_estimator.cli.calibrate")
calibrate_ir = program("swarm_loc_estimator.cli.calibrate_ir")
demo = program("swarm_loc_estimator.cli.demo")
estimator_node = program("swarm_loc_estimator.nodes.estimator_node")
graph = program("swarm_loc_estimator.cli.graph")
import_droplets = program("swarm_loc_estimator.cli.import_droplets")
import_mrclam = program("swarm_loc_estimator.cli.import_mrclam")
mapper_node = program("swarm_loc_estimator.nodes.mapper_node")
markers_node = program("swarm_loc_estimator.watch.markers_node")
play = program("swarm_loc_estimator.nodes.play_node")
replay = program("swarm_loc_estimator.cli.replay")
replay_map = program("swarm_loc_estimator.cli.replay_map")
watch = program("swarm_loc_estimator.cli.watch")
watch_node = program("swarm_loc_estimator.watch.watch_node")
