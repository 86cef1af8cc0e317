"""A driver's link: what breaks it is reported, whatever it is."""

import os
import pty
import termios
import threading
from collections.abc import Callable
from typing import Any

import pytest

from swarm_loc_drivers.common.link import LinkError, SerialLink
from swarm_loc_drivers.common.robot_driver import NO_CLOCK, RobotDriver, SessionError


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
