"""What all drivers of robots share: links, sessions that fail, defects, and robots that stand at the end."""

import os
import pty
import socket
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from epuck_rig import Mute

from bench.robustness.robots import PROTOCOLS, Run
from swarm_loc_drivers.common.link import LinkError, SerialLink
from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import NO_CLOCK, RobotDriver, SessionError, Velocity
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.sim.link_host import FirmwareHost

AHEAD = (0.02, 0.0, 0.0)
EACH = pytest.mark.parametrize("protocol", PROTOCOLS)
CUT = "the link is cut"
Story = Iterator[Callable[[], object]]


@pytest.mark.parametrize("call", ["tcsetattr", "tcflush"])
def test_a_port_that_hangs_up_while_it_is_opened_is_broken(
    monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    robot, port = pty.openpty()
    device, original = os.ttyname(port), getattr(termios, call)

    def hung_up(*arguments: Any) -> None:
        if not closed:
            closed.append(robot)
            os.close(robot)
        original(*arguments)

    closed: list[int] = []
    monkeypatch.setattr(termios, call, hung_up)
    try:
        with pytest.raises(LinkError, match=f"^{device} cannot be opened: Input/output error$"):
            SerialLink(device, 115_200, 1.0)
    finally:
        os.close(port)


class Still:
    """A session with a robot that hears at once that it shall stand."""

    def __init__(self) -> None:
        self.ending = self.connected = self.ended = False


class Failing(RobotDriver[Still]):
    """A driver that cannot cope with what its robot has measured."""

    def __init__(self, clock: Callable[[], int] = lambda: 1) -> None:
        super().__init__("/dev/robot", clock)
        self.sent: list[bytes] = []

    def _open(self) -> Any:
        return self

    def close(self) -> None:
        """See `Link`."""

    def write(self, data: bytes) -> None:
        """See `Link`."""
        self.sent.append(data)

    def _begin(self) -> Still:
        return Still()

    def _step(self, session: Still, _link: object) -> bytes:
        session.connected, session.ended = True, session.ending
        return b"stand" if session.ending else b"go"

    def _serve(self, _session: Still) -> None:
        raise ValueError("seven is no even number")


def test_a_defect_is_told_with_its_traceback_and_the_robot_stands() -> None:
    driver = Failing()
    driver.start()
    driver.stop()
    assert driver.trouble == "the driver has failed: ValueError('seven is no even number')"
    assert driver.sent[-1] == b"stand"
    assert not driver.may_run


class Recovering(Failing):
    """A driver that fails in its first two sessions, whose robot does not confirm a stop after a defect."""

    def __init__(self) -> None:
        super().__init__()
        self.healthy = threading.Event()

    def _step(self, session: Still, link: object) -> bytes:
        if session.ending and not self._stopping.is_set():
            raise SessionError("the robot does not confirm that it has stopped")
        return super()._step(session, link)

    def _serve(self, session: Still) -> None:
        if self.counts["defects"] < 2:
            super()._serve(session)
        if not self.trouble:
            self.healthy.set()


def test_a_defect_restarts_the_session_and_is_told_once_at_its_place() -> None:
    driver = Recovering()
    driver.start()
    assert driver.healthy.wait(10.0)
    driver.stop()
    assert driver.counts["defects"] == 2
    assert driver.counts["link_failures"] == 0
    (told,) = driver.defects.values()
    assert told.startswith("Traceback")
    assert told.rstrip().endswith("ValueError: seven is no even number")


def test_a_driver_connects_when_time_begins_and_not_before() -> None:
    """A simulated robot has no link before: trying would be reported as a fault."""
    asked, begun = threading.Event(), threading.Event()

    def clock() -> int:
        asked.set()
        return int(begun.is_set())

    opened = threading.Event()

    class Willing(Failing):
        def _open(self) -> Any:
            opened.set()
            return self

        def _serve(self, _session: Still) -> None:
            pass

    driver = Willing(clock)
    driver.start()
    assert asked.wait(5.0)
    asked.clear()
    assert asked.wait(5.0)  # it has asked again, so it has not gone on
    assert driver.trouble == NO_CLOCK
    assert not opened.is_set()
    begun.set()
    assert opened.wait(5.0)
    driver.stop()
    assert driver.sent[-1] == b"stand"


def test_a_driver_without_time_ends_at_once() -> None:
    driver = Failing(lambda: 0)
    driver.start()
    driver.stop()
    assert not driver.sent
    assert not driver.may_run


class Played(Run):
    """A driver and what happens to it: a generator yields what it waits for; at its end the driver stops."""

    def __init__(self, protocol: str, story: Callable[["Played"], Story]) -> None:
        self.states: list[OdometryState] = []
        self.velocity: Velocity | None = None
        self.is_cut = False
        super().__init__(protocol, self._watch)
        self._story = story(self)
        self._condition: Callable[[], object] = next(self._story)

    def _watch(self) -> None:
        assert self.now_s < 160.0, (self.driver.trouble, self.driver.counts)
        if self.velocity is not None:
            self.drive(self.velocity)
        if self._condition():
            self._condition = next(self._story, self.stop)

    def moves(self) -> bool:
        """Whether the robot moves."""
        return any(self.body.rates)

    def note(self, *received: Any) -> None:
        """Keep a state of odometry."""
        self.states.append(received[-1])

    def open(self) -> Run:
        """The link, unless it is cut."""
        if self.is_cut:
            raise LinkError(CUT)
        return self

    def read(self, timeout_s: float) -> bytes:
        """See `Link`."""
        self.open()
        return super().read(timeout_s)


@EACH
def test_the_robot_stands_when_velocities_stop_coming_and_at_the_end(protocol: str) -> None:
    def story(run: Played) -> Story:
        run.velocity = AHEAD
        yield run.moves
        run.velocity = None
        yield lambda: not run.moves()
        run.velocity = AHEAD
        yield run.moves

    run = Played(protocol, story)
    run.go()
    assert not run.moves()
    assert not run.driver.may_run
    assert run.driver.counts["stale_cmd_vel"] == 1


def cut_and_mended(run: Played) -> Story:
    """A link that is cut for a second while the robot drives."""
    run.velocity = AHEAD
    yield lambda: run.moves() and len(run.states) > 2
    run.is_cut = True
    yield lambda: run.driver.trouble == CUT
    mended_s = run.now_s + 1.0
    yield lambda: run.now_s > mended_s
    run.is_cut = False
    yield lambda: not run.driver.trouble
    count = len(run.states)
    yield lambda: len(run.states) > count + 5


@EACH
def test_a_robot_whose_link_was_cut_is_found_again(protocol: str) -> None:
    run = Played(protocol, cut_and_mended)
    run.go()
    assert run.driver.counts["connections"] == 2
    assert run.driver.counts["link_failures"] >= 1
    assert (np.diff([one.stamp_ns for one in run.states]) > 0).all()


@pytest.mark.parametrize("protocol", [name for name in PROTOCOLS if name.startswith("epuck")])
def test_a_cut_link_costs_no_odometry_of_a_robot_that_runs_on(protocol: str) -> None:
    run = Played(protocol, cut_and_mended)
    begin = run.body.wheel_steps()
    run.go()
    steps = np.subtract(run.body.wheel_steps(), begin).mean()
    way = steps * EpuckParameters("/dev/x").geometry.metres_per_step
    assert run.states[-1].pose[:2] == pytest.approx([way, 0.0], abs=2e-3)
    assert not run.driver.counts["counter_restarts"]


def test_a_droplet_behind_a_cut_cable_may_have_gone_on_or_not() -> None:
    run = Played("droplet", cut_and_mended)
    run.go()
    ways = np.diff([one.pose[0] for one in run.states])
    variances = np.diff([one.covariance[0, 0] for one in run.states])
    assert ways.max() > 2e-3
    assert variances[ways.argmax()] > ways.max() ** 2 / 4.0


@EACH
def test_stopping_while_the_link_is_down_still_stops_the_robot(protocol: str) -> None:
    def story(run: Played) -> Story:
        run.velocity = AHEAD
        yield run.moves
        run.is_cut = True
        yield lambda: run.driver.trouble == CUT
        run.stop()
        mended_s = run.now_s + 1.0
        yield lambda: run.now_s > mended_s
        run.is_cut = False
        yield lambda: False

    run = Played(protocol, story)
    run.go()
    assert not run.moves()
    assert not run.driver.may_run


def test_a_serial_port_is_used_while_a_driver_has_it_open(tmp_path: Path) -> None:
    with FirmwareHost() as host:
        host.serve_pty(Mute())
        path = host.serve_pty(Mute(), tmp_path / "robot")
        assert not host.is_used()
        link = SerialLink(str(path), 115_200, 1.0)
        assert host.is_used()
        link.close()
        assert not host.is_used()
        SerialLink(str(path), 115_200, 1.0).close()


def test_a_tcp_port_is_used_while_a_driver_is_connected() -> None:
    with FirmwareHost() as host:
        port = host.serve_tcp(Mute())
        with socket.create_connection(("127.0.0.1", port)):
            host.poll(1.0)
            assert host.is_used()
        host.poll(1.0)
        assert not host.is_used()
