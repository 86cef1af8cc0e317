"""Driver of one Droplet at a cable and of those that it reaches by infrared, without ROS."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from swarm_loc_drivers.common.link import Link, SerialLink
from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import (
    MAX_NONSENSE_S,
    NONSENSE,
    STILL,
    RobotDriver,
    SessionError,
    Velocity,
    VelocityCommand,
)
from swarm_loc_drivers.droplet import protocol
from swarm_loc_drivers.droplet.exchange import (
    Brightness,
    PollingExchange,
    Publish,
    SessionSettings,
    TdmaExchange,
    TdmaSettings,
)
from swarm_loc_drivers.droplet.hardware import BAUD_RATE, DIRECTIONS, RADIUS_M, Gait, gait
from swarm_loc_drivers.droplet.odometry import CommandedMotion, MotionNoise
from swarm_loc_drivers.droplet.parameters import DropletParameters
from swarm_loc_drivers.droplet.protocol import (
    BROKEN,
    UNKNOWN,
    ConsoleTalk,
    Echo,
    Identity,
    MotorTrims,
    MoveStarted,
    Noted,
    Said,
    StepLength,
    Talk,
    relay,
)

_TRIES = 3
_IDLE_NS = 20_000_000  # Period of checks for new work while the console is silent [ns]
_SILENCE_NS = 1_000_000_000  # A robot that has said nothing for so long is asked for its id [ns]


class DropletSession:
    """A `Session` with one Droplet at a cable, and movers for those without, which it stops, too.

    It is connected when the robot has sent its id and its gaits. `publish` receives the matrices of
    exchanges.
    """

    def __init__(
        self,
        settings: SessionSettings,
        mover: DropletMover,
        relayed: Sequence[DropletMover],
        publish: Publish,
        counts: Counter[str],
    ) -> None:
        self.ending = self.connected = self.ended = False
        self._settings = settings
        self._mover = mover
        self._movers = (mover, *relayed)
        self._counts = counts
        self._console = ConsoleTalk(
            settings.elements, round(settings.reply_timeout_s * 1e9), self._on_said, counts
        )
        shared = self._interlude, publish, counts
        self._exchanging: PollingExchange | TdmaExchange = (
            TdmaExchange(self._console, settings.exchanges, *shared)
            if isinstance(settings.exchanges, TdmaSettings)
            else PollingExchange(self._console, settings.exchanges, *shared)
        )
        self._trims: dict[int, tuple[int, int, int]] = {}
        self._lengths: dict[int, int] = {}
        self._gaits: dict[int, Gait] = {}
        self._talk = self._run()
        self._due_ns = 0
        self._sense_ns = 0  # When the robot last said what makes sense
        self._patience_ns = round(1e9 * max(MAX_NONSENSE_S, 2.0 * settings.reply_timeout_s))

    @property
    def robot(self) -> int:
        """Id of the robot; 0 until it is known."""
        return self._exchanging.validator.robot or 0

    def request_exchanges(self) -> None:
        """Request one exchange with every partner."""
        self._exchanging.request()

    def step(self, data: bytes, now_ns: int) -> bytes:
        """Continue with what the console has said; the bytes to send. See `TalkSession.step`.

        Raises:
            SessionError: The robot does not answer as it must.
        """
        jumped_back = now_ns < self._console.now_ns
        self._sense_ns = min(self._sense_ns, now_ns)
        self._console.hear(data, now_ns)
        if data or jumped_back or now_ns >= self._due_ns:
            try:
                self._due_ns = next(self._talk)
            except StopIteration:
                self.ended = True
        if self.connected and now_ns > self._sense_ns + self._patience_ns:
            raise SessionError(NONSENSE)
        return self._console.take_output()

    def abandon(self, now_ns: int) -> None:
        """The link is broken: the motion of the robots is unknown."""
        if not self.ended:
            for mover in self._movers:
                mover.motion.lose(now_ns)

    def _run(self) -> Talk[None]:
        yield from self._identify()
        self.connected = True
        while (yield from self._interlude()):
            now_ns = self._console.now_ns
            if self._exchanging.is_due(now_ns):
                yield from self._exchanging.talk()
            elif now_ns > self._sense_ns + _SILENCE_NS and self._exchanging.is_quiet(now_ns):
                yield from self._console.enter(protocol.GET_ID)
            else:
                yield now_ns + _IDLE_NS
        for mover in self._movers:
            yield from mover.stop(self._console)

    def _identify(self) -> Talk[None]:
        """Stop the robot and read its id and its gaits."""
        yield from self._console.forget_line()
        yield from self._mover.stop(self._console)
        yield from self._answered(protocol.GET_ID, lambda: self.robot != 0)
        yield from self._answered(
            protocol.MOTOR_SETTINGS, lambda: len(self._trims) == len(self._lengths) == len(DIRECTIONS)
        )
        gaits = {
            direction: gait(direction, self._trims[direction], self._lengths[direction])
            for direction in self._settings.model.directions
        }
        self._gaits = {direction: one for direction, one in gaits.items() if one is not None}

    def _answered(self, line: str, condition: Callable[[], bool]) -> Talk[None]:
        """Send a request until its answer has arrived."""
        for _ in range(_TRIES):
            yield from self._console.enter(line)
            if (yield from self._console.until(condition)):
                return
        raise SessionError(f"the robot does not answer '{line}'")

    def _interlude(self) -> Talk[bool]:
        """Send due motion commands; whether to continue."""
        for mover in self._movers:
            now_ns = self._console.now_ns
            waits = self.ending or not self._exchanging.is_quiet(now_ns)
            if not waits and mover.is_due(now_ns, self._gaits):
                yield from mover.send(self._console, self._gaits)
        return not self.ending

    def _on_said(self, said: Said) -> None:
        event = said.event
        if not isinstance(event, Echo) and not (
            isinstance(event, Noted) and event.reason in (BROKEN, UNKNOWN)
        ):
            self._sense_ns = self._console.now_ns
        if isinstance(event, Identity):
            self._exchanging.validator.robot = event.robot
        elif isinstance(event, MotorTrims):
            self._trims[event.direction] = event.trims
        elif isinstance(event, StepLength):
            self._lengths[event.direction] = event.per_kilostep
        elif isinstance(event, MoveStarted):
            # a command to move, from here or by infrared
            if event != self._mover.asked and event.direction in self._gaits:
                self._counts["foreign_moves"] += 1
                self._mover.motion.begin(self._console.now_ns, self._gaits[event.direction], event.steps)
        else:
            self._exchanging.observe(said)


Gaits = Mapping[int, Gait]  # Gaits of the directions in which a robot can move


def nearest_motion(wanted: Velocity, gaits: Gaits) -> int | None:
    """The direction whose velocity is nearest to the wanted one; None to stand.

    A turn is weighted by the speed of the robot's edge. For velocities beyond a Droplet's speed the direction
    decides.
    """

    def distance(direction: int | None) -> float:
        velocity = STILL if direction is None else gaits[direction].velocity
        forward, left, turn = (want - have for want, have in zip(wanted, velocity, strict=True))
        return math.hypot(forward, left, RADIUS_M * turn)

    return None if wanted == STILL else min([None, *gaits], key=distance)


class DropletMover:
    """Moves one Droplet by velocities: that at the cable, or one with the id `target`, by infrared.

    A stride is a command of steps that lasts `stride_s`. A command during it would be acknowledged and
    ignored, so every stride begins with a stop. If the driver dies, the robot stops after a stride. A share
    of the commands by infrared is lost.
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
        self._doubt = relay_loss  # probability that a command was lost
        self._sent: int | None = None
        self.asked: MoveStarted | None = None  # The last command to move, which the robot will print

    def is_due(self, now_ns: int, gaits: Gaits) -> bool:
        """Whether a command is due."""
        wanted = nearest_motion(self._command.velocity(), gaits)
        return wanted != self._sent or (wanted is not None and not self.motion.moving(now_ns))

    def send(self, console: ConsoleTalk, gaits: Gaits) -> Talk[None]:
        """Send the current motion."""
        yield from self.stop(console)
        wanted = nearest_motion(self._command.velocity(), gaits)
        if wanted is None:
            return
        gait = gaits[wanted]
        steps = min(max(1, round(self._stride_s / gait.step_s)), protocol.MAX_STEPS)
        self.asked = MoveStarted(wanted, steps)
        begin_ns = yield from self._enter(console, protocol.move_steps(wanted, steps))
        self._sent = wanted
        self.motion.begin(begin_ns, gait, steps, self._doubt)

    def stop(self, console: ConsoleTalk) -> Talk[None]:
        """Stop the robot."""
        stamp_ns = yield from self._enter(console, protocol.STOP)
        self._sent = None
        self.motion.stop(stamp_ns, self._doubt)

    def _enter(self, console: ConsoleTalk, line: str) -> Talk[int]:
        """Send a line to the robot; the time at which it accepts the line [ns]."""
        if self._target is None:
            return (yield from console.enter(line))
        return (yield from relay(console, self._target, line))


OWN = ""  # Name of the robot at the cable
_READ_S, _STOP_READ_S = 0.05, 0.01  # Longest wait for bytes in a step, and while robots are stopped [s]


@dataclass(frozen=True)
class DropletListeners:
    """Receivers of the robots' data, called in the driver's thread."""

    # Receives names, `OWN` for the robot at the cable, and states
    odometry: Callable[[str, OdometryState], None]
    # Receives the id of the robot at the cable and its matrices
    brightness: Callable[[int, Brightness], None]


class DropletDriver(RobotDriver[DropletSession]):
    """Drives Droplets in its own thread, see `RobotDriver`."""

    def __init__(
        self, params: DropletParameters, listeners: DropletListeners, clock: Callable[[], int]
    ) -> None:
        super().__init__(params.address, clock)
        self._params = params
        self._listeners = listeners
        self._requested = threading.Event()
        self._odometry_due_ns = 0
        self._commands: dict[str, VelocityCommand] = {}
        self._movers: dict[str, DropletMover] = {}
        noise = MotionNoise(params.walk_noise, params.veer_noise, params.turn_noise)
        for name, target in {OWN: None, **params.relayed_ids}.items():
            command = self._commands[name] = VelocityCommand(params.cmd_vel_timeout_s, clock, self.counts)
            motion, loss = CommandedMotion(noise), params.relay_loss if name != OWN else 0.0
            self._movers[name] = DropletMover(command, motion, params.stride_s, target, loss)

    def set_velocity(self, name: str, velocity: Velocity) -> None:
        """Set the velocity of a robot."""
        self._commands[name].set(velocity)

    def request_exchanges(self) -> None:
        """Measure once with every partner."""
        self._requested.set()

    def _open(self) -> Link:
        return SerialLink(self._params.address, BAUD_RATE, self._params.reply_timeout_s)

    def _begin(self) -> DropletSession:
        relayed = [mover for name, mover in self._movers.items() if name != OWN]

        def publish(one: Brightness) -> None:
            self._listeners.brightness(session.robot, one)

        session = DropletSession(self._params.session, self._movers[OWN], relayed, publish, self.counts)
        return session

    def _step(self, session: DropletSession, link: Link) -> bytes:
        return session.step(link.read(_STOP_READ_S if session.ending else _READ_S), self._clock())

    def _lose(self, session: DropletSession) -> None:
        session.abandon(self._clock())

    def _serve(self, session: DropletSession) -> None:
        if not session.connected:
            return
        if self._requested.is_set():
            self._requested.clear()
            session.request_exchanges()
        now_ns = self._clock()
        period_ns = round(1e9 / self._params.odom_rate)
        if now_ns and not 0 < self._odometry_due_ns - now_ns <= period_ns:
            self._odometry_due_ns = now_ns + period_ns - now_ns % period_ns
            for name, mover in self._movers.items():
                self._listeners.odometry(name, mover.motion.state(now_ns))
