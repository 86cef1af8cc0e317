"""Launch files in tests: what they start, and how they end.

As a program it does what `ros2 launch FILE NAME:=VALUE...` does.
"""

import subprocess
import sys
from pathlib import Path

from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import SetLaunchConfiguration
from node_world import module_at


def nodes_of(path: Path, **arguments: str) -> list[str]:
    """The executables that a launch file starts when all of its arguments are given."""
    context = LaunchContext()
    context.launch_configurations.update(arguments)
    return [str(action.node_executable) for action in module_at(path).start_nodes(context)]


def end_of(path: Path, **arguments: str) -> tuple[int, str]:
    """The exit status of a launch with some arguments, and what it has printed."""
    given = [f"{name}:={value}" for name, value in arguments.items()]
    command = [sys.executable, __file__, str(path), *given]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60.0)
    return done.returncode, done.stdout + done.stderr


if __name__ == "__main__":
    chosen = [SetLaunchConfiguration(*argument.split(":=", 1)) for argument in sys.argv[2:]]
    service = LaunchService(noninteractive=True)
    described = module_at(Path(sys.argv[1])).generate_launch_description()
    service.include_launch_description(LaunchDescription([*chosen, *described.entities]))
    sys.exit(service.run())
