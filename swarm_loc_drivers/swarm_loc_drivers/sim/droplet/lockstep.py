"""A world of Droplets with the drivers' sessions at their consoles, in simulated time and one thread.

The bytes are those of the cable, without delay. So runs behave like live ones and are reproducible.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.velocity_command import Velocity, VelocityCommand
from swarm_loc_drivers.droplet.exchange import Brightness
from swarm_loc_drivers.droplet.odometry import CommandedMotion, MotionNoise
from swarm_loc_drivers.droplet.session import DropletMover, DropletSession, SessionSettings
from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware
from swarm_loc_drivers.sim.droplet.world import DropletWorld, SimulatedDroplet
from swarm_loc_drivers.sim.link_host import ConsoleFirmware

_TIMEOUT_S = 1.0
STRIDE_S = 2.0


class Cable:
    """A robot connected by cable: its console and the driver's session.

    Args:
        world: The world of the robot.
        robot: Its index.
        settings: Settings of the session.
        noise: The session's model of motion errors.
        publish: Called with the matrices of exchanges.

    Attributes:
        firmware: The firmware at the console.
        session: The session of the driver.
        counts: Events of the session by name.
    """

    def __init__(
        self,
        world: DropletWorld,
        robot: int,
        settings: SessionSettings,
        noise: MotionNoise,
        publish: Callable[[Brightness], None],
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._world = world
        self.firmware: ConsoleFirmware = DropletFirmware(SimulatedDroplet(world, robot))
        self._command = VelocityCommand(
            _TIMEOUT_S, lambda: world.now_ns, self.counts, lambda: 1e-9 * world.now_ns
        )
        self._motion = CommandedMotion(noise)
        mover = DropletMover(self._command, self._motion, STRIDE_S)
        self.session = DropletSession(settings, mover, (), publish, self.counts)

    def set_velocity(self, velocity: Velocity) -> None:
        """Command a velocity."""
        self._command.set(velocity)

    def odometry(self) -> OdometryState:
        """The session's odometry."""
        return self._motion.state(self._world.now_ns)

    def step(self) -> None:
        """Exchange bytes until neither end sends."""
        data = self.firmware.stream()
        while not self.session.ended:
            output = self.session.step(data, self._world.now_ns)
            if not output:
                return
            data = self.firmware.receive(output)
            if not data:
                return


def run(
    world: DropletWorld, robots: Sequence[Callable[[], object]], steps: int, control: Callable[[], None]
) -> None:
    """Advance the simulation.

    Args:
        world: The world.
        robots: Step function of each robot, such as `Cable.step`.
        steps: Number of steps of the world.
        control: Called after every step, to set velocities and record data.
    """
    for _ in range(steps):
        world.step()
        for robot in robots:
            robot()
        control()
