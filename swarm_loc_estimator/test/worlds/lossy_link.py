"""One end of a link between two machines that delays and loses packets, as a radio does.

    python lossy_link.py DEVICE SOCKET DELAY_S JITTER_S LOSS SEED

What comes from the TUN device DEVICE goes to the other end, by a datagram socket that is open as number
SOCKET, after DELAY_S and up to JITTER_S more, but for a share LOSS of it; what comes from there goes to the
device. The kernel's own means for it, netem, is missing on many machines.
"""

import errno
import fcntl
import heapq
import os
import select
import socket
import struct
import sys
import time

import numpy as np

_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_LARGEST = 65536
_MAX_WAITING = 10_000  # Packets; what is more is lost, as in any radio's queue


def _opened(device: str) -> int:
    """The TUN device, which must be there, by number."""
    number = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(number, _TUNSETIFF, struct.pack("16sH", device.encode(), _IFF_TUN | _IFF_NO_PI))
    return number


def _put(device: int, packet: bytes) -> None:
    """Let a packet arrive; at a device that is down it is lost."""
    try:
        os.write(device, packet)
    except OSError as error:
        if error.errno != errno.EIO:
            raise


def forward(device: int, other: socket.socket, delay_s: tuple[float, float], loss: float, seed: int) -> None:
    """Hand packets on for ever; `delay_s` is the least and by how much it differs at most.

    Nothing waits for room at the other end: two ends that did so, both full, would wait for each other.
    """
    rng, far = np.random.default_rng(seed), other.fileno()
    waiting: list[tuple[float, bytes]] = []
    other.setblocking(False)
    while True:
        due_in_s = waiting[0][0] - time.monotonic() if waiting else None
        due = due_in_s is not None and due_in_s <= 0.0
        ready, room, _ = select.select((device, far), (far,) if due else (), (), None if due else due_in_s)
        if device in ready:
            packet = os.read(device, _LARGEST)
            if rng.random() >= loss and len(waiting) < _MAX_WAITING:
                due_s = time.monotonic() + delay_s[0] + delay_s[1] * rng.random()
                heapq.heappush(waiting, (due_s, packet))
        if far in ready:
            _put(device, other.recv(_LARGEST))
        if room:
            other.send(heapq.heappop(waiting)[1])


def main() -> None:
    """Be one end until killed."""
    device, number, delay_s, jitter_s, loss, seed = sys.argv[1:]
    opened, other = _opened(device), socket.socket(fileno=int(number))
    print("up", flush=True)
    forward(opened, other, (float(delay_s), float(jitter_s)), float(loss), int(seed))


if __name__ == "__main__":
    main()
