"""The radio of the tests with several machines: it delays and loses, and never stands still."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

PACKETS = 400  # More than fit between both ends at once
END = "import socket, sys; from lossy_link import forward; "
END += "forward(int(sys.argv[1]), socket.socket(fileno=int(sys.argv[2])), (0.5, 0.0), 0.0, 1)"


def pair() -> tuple[socket.socket, socket.socket]:
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)


@pytest.fixture
def machines() -> Iterator[list[socket.socket]]:
    """The ends of two machines that a link of half a second joins."""
    with ExitStack() as stack:
        machines: list[socket.socket] = []
        for between in pair():
            machine, device = pair()
            machine.settimeout(30.0)
            numbers = (device.fileno(), between.fileno())
            with device, between:
                process = stack.enter_context(
                    subprocess.Popen(
                        [sys.executable, "-c", END, *map(str, numbers)],
                        cwd=Path(__file__).parents[1] / "worlds",
                        pass_fds=numbers,
                    )
                )
            stack.callback(process.kill)
            machines.append(stack.enter_context(machine))
        yield machines


def received(machine: socket.socket) -> list[int]:
    return [int.from_bytes(machine.recv(2000)[:2], "big") for _ in range(PACKETS)]


def test_ends_that_are_both_full_go_on(machines: list[socket.socket]) -> None:
    """All packets of both sides are due at once, and neither end has room for those of the other."""
    with ThreadPoolExecutor() as pool:
        receiving = [pool.submit(received, machine) for machine in machines]
        for number in range(PACKETS):
            for machine in machines:
                machine.send(number.to_bytes(2, "big") * 700)

        for one in receiving:
            assert one.result() == [*range(PACKETS)]
