"""An emulated e-puck as a process: `epuck_process.py serial LINK MODEL` or `epuck_process.py wifi PORT`.

It says where it answers, and for every line of its input how the robot is: pose, rates, steps.
"""

import json
import os
import sys
import time
from pathlib import Path

from emulator_process import asked
from epuck_body import DrivenBody

from swarm_loc_drivers.epuck.hardware import EPUCK_MODELS
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import WifiFirmware
from swarm_loc_drivers.sim.link_host import FirmwareHost


def main() -> None:
    """Serve until the input ends."""
    body = DrivenBody(time.monotonic_ns, steps=(32700, -32700))
    with FirmwareHost() as host:
        if sys.argv[1] == "serial":
            print(
                host.serve_pty(SerialFirmware(body, EPUCK_MODELS[sys.argv[3]]), Path(sys.argv[2])), flush=True
            )
        else:
            print(host.serve_tcp(WifiFirmware(body), port=int(sys.argv[2])), flush=True)
        os.set_blocking(sys.stdin.fileno(), False)
        while (line := asked()) != b"":
            if line is not None:
                answer = {"pose": body.pose.tolist(), "rates": body.rates, "steps": body.wheel_steps()}
                print(json.dumps(answer), flush=True)
            host.poll(0.002)


if __name__ == "__main__":
    main()
