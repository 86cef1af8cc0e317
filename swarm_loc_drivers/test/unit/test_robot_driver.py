"""A driver's link: what breaks it is told, whatever it is."""

from __future__ import annotations

import os
import pty
import termios
from typing import Any

import pytest

from swarm_loc_drivers.common.link import LinkError, SerialLink
from swarm_loc_drivers.common.robot_driver import RobotDriver


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

    def __init__(self) -> None:
        super().__init__("/dev/robot")
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


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_mistake_that_ends_the_conversation_for_ever_is_told_and_the_robot_stands() -> None:
    driver = Failing()
    driver.start()
    driver.stop()
    assert driver.trouble == "the driver has failed: ValueError('seven is no even number')"
    assert driver.sent[-1] == b"stand"
