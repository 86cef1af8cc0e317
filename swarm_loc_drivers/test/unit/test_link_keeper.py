"""A driver's link: what breaks it is told, whatever it is."""

from __future__ import annotations

import os
import pty
import termios
from collections import Counter
from typing import Any

import pytest

from swarm_loc_drivers.core.link_keeper import LinkKeeper
from swarm_loc_drivers.transports.link import LinkError
from swarm_loc_drivers.transports.serial_link import SerialLink


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


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_mistake_that_ends_the_conversation_for_ever_is_told() -> None:
    def converse() -> None:
        keeper.note_connection()
        raise ValueError("seven is no even number")

    keeper = LinkKeeper("/dev/robot", converse, Counter())
    keeper.start()
    keeper.stop()
    assert keeper.trouble == "the driver has failed: ValueError('seven is no even number')"
