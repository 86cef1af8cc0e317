"""Drivers of robots: what all share, and that of the e-puck."""

import math
import os
import pty
import socket
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from epuck_body import GEOMETRY
from epuck_rig import PATIENCE_S, SQUARE, Mute, Robots, params_of

from swarm_loc_drivers.common.link import LinkError, SerialLink
from swarm_loc_drivers.common.robot_driver import NO_CLOCK, RobotDriver, SessionError
from swarm_loc_drivers.epuck.hardware import EPUCK1
from swarm_loc_drivers.sim.link_host import FirmwareHost
from swarm_loc_estimator.common import se2


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


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    with ExitStack() as emulators, ExitStack() as benches:  # drivers end while their robots answer
        yield Robots(tmp_path, emulators, benches)


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_the_robot_stands_when_the_driver_has_ended(robots: Robots, over: str) -> None:
    emulator = robots.serial() if over == "serial" else robots.wifi()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(params_of(address))
    bench.velocity = (0.06, 0.5)
    bench.until(lambda: any(emulator.body.rates))
    bench.driver.stop()
    assert emulator.body.rates == (0.0, 0.0)


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_the_robot_stands_when_velocities_stop_coming(robots: Robots, over: str) -> None:
    emulator = robots.serial(EPUCK1) if over == "serial" else robots.wifi()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(params_of(address, "epuck1" if over == "serial" else "epuck2"))
    bench.velocity = (0.06, 0.0)
    bench.until(lambda: any(emulator.body.rates))
    bench.fall_silent()
    bench.until(lambda: not any(emulator.body.rates))
    assert bench.driver.counts["stale_cmd_vel"] >= 1  # more where the machine paused before, too


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_a_robot_switched_off_and_on_is_found_again(robots: Robots, over: str) -> None:
    start = robots.serial if over == "serial" else robots.wifi
    emulator = start()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    # the link fails when it is broken here, and not while an emulated robot waits for a processor
    bench = robots.bench(replace(params_of(address), reply_timeout_s=10.0))
    bench.drive(SQUARE[:1])
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    before = bench.states[-1]

    again = start()  # its counters and its place in the world begin at zero
    bench.until(lambda: not bench.driver.trouble)
    bench.until(lambda: bench.states[-1].stamp_ns > before.stamp_ns)
    found = bench.states[-1].pose
    origin = again.body.pose
    bench.drive(SQUARE[1:3])
    driven, true = se2.between(found, bench.states[-1].pose), se2.between(origin, again.body.pose)
    assert driven == pytest.approx(true, abs=5e-3)
    assert bench.driver.counts["connections"] == 2
    assert bench.driver.counts["link_failures"] >= 1


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_a_cut_link_costs_no_odometry_of_a_robot_that_runs_on(robots: Robots, over: str) -> None:
    start = robots.serial if over == "serial" else robots.wifi
    emulator = start()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(params_of(address))
    bench.velocity = (0.06, 0.4)
    bench.until(lambda: any(emulator.body.rates) and len(bench.states) > 10)
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    start(body=emulator.body)
    bench.until(lambda: not bench.driver.trouble)
    bench.drive(SQUARE[:1])
    error = se2.between(emulator.body.pose, bench.states[-1].pose)
    assert math.hypot(error[0], error[1]) <= 5e-3
    assert abs(error[2]) <= 2.1 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation
    assert not bench.driver.counts["counter_restarts"]


def test_a_port_that_is_not_there_is_named_and_waited_for(robots: Robots) -> None:
    bench = robots.bench(params_of(robots.serial_address, "epuck1"))
    bench.until(lambda: bench.driver.counts["link_failures"] >= 2)
    assert robots.serial_address in bench.driver.trouble
    robots.serial(EPUCK1)
    bench.until(lambda: bench.states)
    assert bench.driver.trouble == ""


def test_a_port_where_nobody_speaks_the_language_is_told(robots: Robots) -> None:
    robots.serial(EPUCK1, wrap=lambda _: Mute())
    quick = replace(params_of(robots.serial_address, "epuck1"), reply_timeout_s=0.02)
    bench = robots.bench(quick)
    bench.until(lambda: "does not answer" in bench.driver.trouble)


def test_stopping_while_the_link_is_down_still_stops_the_robot(robots: Robots) -> None:
    emulator = robots.wifi()
    bench = robots.bench(params_of(robots.tcp_address))
    bench.velocity = (0.06, 0.0)
    bench.until(lambda: any(emulator.body.rates))
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    ending = threading.Thread(target=bench.driver.stop)
    ending.start()
    robots.wifi(body=emulator.body)
    ending.join(PATIENCE_S)
    assert emulator.body.rates == (0.0, 0.0)


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
