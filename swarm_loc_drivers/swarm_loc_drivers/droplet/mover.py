"""Makes one Droplet follow velocities: of the few motions that it knows the nearest, in strides."""

from __future__ import annotations

import math
from collections.abc import Mapping

from swarm_loc_drivers.common.velocity_command import STILL, Velocity, VelocityCommand
from swarm_loc_drivers.droplet import console as protocol
from swarm_loc_drivers.droplet.commanded_motion import CommandedMotion
from swarm_loc_drivers.droplet.console import MoveStarted
from swarm_loc_drivers.droplet.console_session import ConsoleTalk, Talk, relay
from swarm_loc_drivers.droplet.hardware import RADIUS_M, Gait

Gaits = Mapping[int, Gait]
"""Direction -> what a step does, of the directions that a robot can move in."""

_STAND = None


def nearest_motion(wanted: Velocity, gaits: Gaits) -> int | None:
    """The direction whose velocity is nearest to the wanted one; None to stand.

    A turn counts by the speed of the robot's edge. Of velocities that are much too fast for a Droplet the
    direction decides.
    """

    def distance(direction: int | None) -> float:
        velocity = STILL if direction is _STAND else gaits[direction].velocity
        forward, left, turn = (want - have for want, have in zip(wanted, velocity, strict=True))
        return math.hypot(forward, left, RADIUS_M * turn)

    if wanted == STILL:
        return _STAND
    return min([_STAND, *gaits], key=distance)


class DropletMover:
    """Moves one Droplet.

    A stride is a command of so many steps that it lasts `stride_s`. While it lasts another command would be
    acknowledged and ignored, so every stride begins with a stop.

    Args:
        command: The velocities to follow.
        motion: Reckons where the robot goes.
        stride_s: How far ahead to command [s]; when the driver dies, the robot stops after so long.
        target: Id of a robot that is reached by infrared; None for the one at the cable.
        relay_loss: Share of the commands by infrared that are not heard.
    """

    def __init__(
        self,
        command: VelocityCommand,
        motion: CommandedMotion,
        stride_s: float,
        target: int | None = None,
        relay_loss: float = 0.0,
    ) -> None:
        self.motion = motion
        self._command = command
        self._stride_s = stride_s
        self._target = target
        self._doubt = relay_loss  # believed is all of a way, of which by this share nothing is done
        self._told: int | None = None
        self.asked: MoveStarted | None = None
        """What the robot will say that it was told, the last time."""

    def is_due(self, now_ns: int, gaits: Gaits) -> bool:
        """Whether the robot has to be told something."""
        wanted = nearest_motion(self._command.velocity(), gaits)
        if wanted != self._told:
            return True
        return wanted is not None and not self.motion.moving(now_ns)

    def tell(self, console: ConsoleTalk, gaits: Gaits) -> Talk[None]:
        """Tell the robot what to do now."""
        yield from self.stop(console)
        wanted = nearest_motion(self._command.velocity(), gaits)
        if wanted is None:
            return
        gait = gaits[wanted]
        steps = min(max(1, round(self._stride_s / gait.step_s)), protocol.MAX_STEPS)
        self.asked = MoveStarted(wanted, steps)
        begin_ns = yield from self._enter(console, protocol.move_steps(wanted, steps))
        self._told = wanted
        self.motion.begin(begin_ns, gait, steps, self._doubt)

    def stop(self, console: ConsoleTalk) -> Talk[None]:
        """Make the robot stand."""
        stamp_ns = yield from self._enter(console, protocol.STOP)
        self._told = None
        self.motion.stop(stamp_ns, self._doubt)

    def _enter(self, console: ConsoleTalk, line: str) -> Talk[int]:
        """Have the robot take a line; when it did [ns]."""
        if self._target is None:
            return (yield from console.enter(line))
        return (yield from relay(console, self._target, line))
