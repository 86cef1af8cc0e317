"""Three emulated Droplets as a process, the first on a serial port: `droplet_process.py LINK`.

For every line of its input it says how they are: poses, and whether any moves.
"""

import json
import os
import sys
import time
from pathlib import Path

from droplet_rig import SECOND, world_of
from emulator_process import asked

from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware
from swarm_loc_drivers.sim.droplet.world import STEP_NS, SimulatedDroplet
from swarm_loc_drivers.sim.link_host import FirmwareHost


def main() -> None:
    """Serve in real time until the input ends."""
    world = world_of()
    robots = [DropletFirmware(SimulatedDroplet(world, robot)) for robot in range(len(world.ids))]
    with FirmwareHost() as host:
        print(host.serve_pty(robots[0], Path(sys.argv[1])), flush=True)
        os.set_blocking(sys.stdin.fileno(), False)
        due_s = time.monotonic()
        while (line := asked()) != b"":
            if line is not None:
                print(json.dumps(world.poses.tolist()), flush=True)
            world.step()
            for robot in robots[1:]:
                robot.stream()
            due_s += STEP_NS / SECOND
            host.poll(max(0.0, due_s - time.monotonic()))


if __name__ == "__main__":
    main()
