"""A conversation with an emulated e-puck on one clock, a millisecond at a time: no links, no threads."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from epuck_body import GEOMETRY, DrivenBody
from numpy.typing import NDArray

from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import SessionError
from swarm_loc_drivers.epuck.driver import EpuckSession, WheelOdometry
from swarm_loc_drivers.epuck.hardware import CameraImage, EpuckModel, Reading
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.epuck.serial_session import SerialSession
from swarm_loc_drivers.epuck.wifi_session import WifiSession
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import WifiFirmware
from swarm_loc_estimator.common import se2

MS = 1_000_000
SECOND = 1000 * MS


class Wire:
    """A robot, its firmware, a session with it, and the odometry of what it reads.

    Args:
        params: Of the session; with an address over TCP the robot has the WiFi firmware.
        make: Makes the firmware, if not the usual one.
        tick_ns: Between two steps that find the session idle.

    Attributes:
        speeds: What the wheels are to do [steps/s].
        is_blocked: Whether what the robot sends does not get through; it waits with it.
        is_heard: Whether what the robot answers arrives; else it is lost.
        reconnects: Whether a session that has failed is followed by another.
        sent: What the session has sent.
        truth: Where the robot was at each millisecond.
    """

    def __init__(
        self,
        params: EpuckParameters,
        make: Callable[[DrivenBody], object] | None = None,
        tick_ns: int = 20 * MS,
    ) -> None:
        self.now_ns = SECOND
        self.clock_ns = 0  # what the session's clock is ahead
        self.body = DrivenBody(lambda: self.now_ns, steps=(32000, -32000))
        self.speeds = (0, 0)
        self.is_blocked, self.is_heard, self.reconnects = False, True, False
        self.sent = b""
        self.counts: Counter[str] = Counter()
        self.found: list[Reading | CameraImage] = []
        self.states: list[OdometryState] = []
        self.truth: dict[int, NDArray[np.float64]] = {}
        self._model: EpuckModel = params.epuck_model
        self._tick_ns = tick_ns
        self._answer = b""
        self._held: bytearray | None = None
        self.odometry = WheelOdometry(GEOMETRY, 2e-4, self.counts)
        self._params = params
        is_serial = bool(params.link_address.device)
        self.firmware: Any = (
            SerialFirmware(self.body, params.epuck_model) if is_serial else WifiFirmware(self.body)
        )
        if make is not None:
            self.firmware = make(self.body)
        self.session = self._begin()

    def _begin(self) -> EpuckSession:
        if self._params.link_address.device:
            return SerialSession(self._params, self._speeds, self._doubt, self.counts)
        return WifiSession(self._params, self._speeds, self.counts)

    def _speeds(self) -> tuple[int, int]:
        left, right = self.speeds
        self.odometry.note_rates(self.now_ns, self._model.rate(left), self._model.rate(right))
        return self.speeds

    def _doubt(self) -> None:
        self.odometry.doubt_rates(self.now_ns, self._model.max_rate)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns and not self.session.ended:
            self.step()

    def step(self) -> None:
        """A millisecond."""
        self.now_ns += MS
        self.truth[self.now_ns] = self.body.pose
        if not self.is_blocked:
            sent = self.firmware.stream()
            if self._held is None:
                self._answer += sent
            else:
                self._held += sent
        waits = self.session.is_idle and not self.session.ending and self.now_ns % self._tick_ns
        if waits or (not self._answer and self.now_ns % (5 * MS)):
            return
        answer, self._answer = self._answer, b""
        try:
            output = self.session.step(answer, self.now_ns + self.clock_ns, self.now_ns * 1e-9)
        except SessionError:
            if not self.reconnects:
                raise
            is_ending, output = self.session.ending, b""
            self.session = self._begin()
            self.session.ending = is_ending
        self.sent += output
        reply = self.firmware.receive(output) if output else None
        if self.is_heard and reply:
            self._answer += reply
        self._take()

    def stall(self, seconds: float, mode: str) -> None:
        """Let nothing get through for some time.

        Args:
            seconds: How long.
            mode: The robot "waits" with the next message, or the last one "is_under_way" and comes late, or
                what it sends "is_queued" and comes in two portions.
        """
        end_ns = self.now_ns + round(seconds * SECOND)
        held = self._held = bytearray()
        self.is_blocked = mode == "waits"
        while self.now_ns < end_ns:
            self.step()
            self.is_blocked |= mode == "is_under_way" and len(held) > 0
        self.is_blocked = False
        if mode == "is_queued":
            self._answer += bytes(held[: len(held) // 2])
            del held[: len(held) // 2]
            self.run(0.004)
        self._answer += bytes(held)
        self._held = None

    def worst_error(self) -> tuple[float, float]:
        """By how much the odometry was ever wrong at its stamps [m, rad]."""
        errors = [
            se2.between(self.truth[one.stamp_ns], one.pose)
            for one in self.states
            if one.stamp_ns in self.truth
        ]
        return max(math.hypot(*error[:2]) for error in errors), max(abs(error[2]) for error in errors)

    def drive(self, legs: Sequence[tuple[float, float, float]]) -> None:
        """Drive legs of speed [m/s], turn rate [rad/s] and amount [m or rad] by odometry, then stand."""
        for speed, turn_rate, amount in legs:
            self._until(lambda: len(self.states) > 0)
            self.speeds = self._model.wheel_commands(GEOMETRY, speed, turn_rate)
            start = self.states[-1].pose
            part = slice(2, 3) if turn_rate else slice(0, 2)
            self._until(
                lambda start=start, part=part, amount=amount: (  # type: ignore[misc]
                    np.linalg.norm(se2.between(start, self.states[-1].pose)[part]) >= amount
                )
            )
        self.speeds = (0, 0)
        self.run(0.5)
        self._until(lambda: not any(state.twist.any() for state in self.states[-3:]))

    def _until(self, condition: Callable[[], bool]) -> None:
        end_ns = self.now_ns + 60 * SECOND
        while not condition():
            self.step()
            assert self.now_ns < end_ns, self.counts

    def error(self) -> tuple[float, float]:
        """By how much the odometry is wrong at the end [m, rad]."""
        dx, dy, turn = se2.between(self.body.pose, self.states[-1].pose)
        return math.hypot(dx, dy), abs(turn)

    def _take(self) -> None:
        found, self.session.found = self.session.found, []
        self.found += found
        for one in found:
            if isinstance(one, Reading):
                state = self.odometry.update(
                    one.stamp_ns, one.left_counter, one.right_counter, doubt_ns=one.doubt_ns
                )
                self.states += [state] if state is not None else []
