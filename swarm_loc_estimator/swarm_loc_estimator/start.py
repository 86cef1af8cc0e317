"""The executables of this package, each imported only when it is started; `swarm-loc` starts each by name."""

from __future__ import annotations

import sys
from pathlib import Path

from swarm_loc_estimator.common.command_line import Program

calibrate = Program("swarm_loc_estimator.cli.calibrate")
calibrate_ir = Program("swarm_loc_estimator.cli.calibrate_ir")
demo = Program("swarm_loc_estimator.cli.demo", needs_ros=True)
doctor = Program("swarm_loc_estimator.cli.doctor")
estimator_node = Program("swarm_loc_estimator.nodes.estimator_node", needs_ros=True)
graph = Program("swarm_loc_estimator.cli.graph", needs_ros=True)
import_droplets = Program("swarm_loc_estimator.cli.import_droplets")
import_mrclam = Program("swarm_loc_estimator.cli.import_mrclam")
localizer_bridge = Program("swarm_loc_estimator.nodes.localizer_bridge", needs_ros=True)
mapper_node = Program("swarm_loc_estimator.nodes.mapper_node", needs_ros=True)
markers_node = Program("swarm_loc_estimator.watch.markers_node", needs_ros=True)
new = Program("swarm_loc_estimator.cli.new")
play = Program("swarm_loc_estimator.nodes.play_node", needs_ros=True)
replay = Program("swarm_loc_estimator.cli.replay")
replay_map = Program("swarm_loc_estimator.cli.replay_map")
schema = Program("swarm_loc_estimator.cli.schema")
survey = Program("swarm_loc_estimator.cli.survey")
sweep = Program("swarm_loc_estimator.cli.sweep")
watch = Program("swarm_loc_estimator.cli.watch", needs_ros=True)
watch_node = Program("swarm_loc_estimator.watch.watch_node", needs_ros=True)


def swarm_loc() -> int:
    """`swarm-loc NAME ARGUMENTS...` does what `ros2 run swarm_loc_estimator NAME ARGUMENTS...` does."""
    programs = {name: value for name, value in globals().items() if isinstance(value, Program)}
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in programs:
        sys.argv[:2] = [f"{sys.argv[0]} {name}"]
        return programs[name]()
    if name not in ("-h", "--help"):
        print(f"swarm-loc has no command '{name}'; swarm-loc --help lists them.", file=sys.stderr)
        return 2
    print("swarm-loc COMMAND ARGUMENTS...; swarm-loc COMMAND --help shows the arguments of a command.")
    for title, needs_ros in (("Without ROS 2", False), ("With ROS 2", True)):
        print(f"\n{title}:")
        for name, program in programs.items():
            if program.needs_ros == needs_ros:  # with the first line of its docstring; nothing is imported
                path = Path(__file__).parent.joinpath(*program.module.split(".")[1:]).with_suffix(".py")
                summary = path.read_text(encoding="utf-8").partition("\n")[0].strip('"')
                print(f"  {name:16} {summary}")
    return 0
