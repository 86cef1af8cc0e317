"""Machines in networks of their own, with a router between them, on one machine.

Each is a network namespace. Multicast does not pass the router.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

PORT = 11811
LOSSY_LINK = Path(__file__).with_name("lossy_link.py")
_Ends = tuple[tuple[str, str], tuple[str, str]]  # Machine and device at either end of a link


@dataclass(frozen=True)
class Radio:
    """How the robots are linked to the router, if by radio."""

    delay_s: float  # At least [s]
    jitter_s: float  # Up to so much more [s]; packets overtake each other
    loss: float  # Share of packets, each way


class Machines:
    """Three machines: `robots`, by cable or radio, `estimator`, and between them `router`."""

    def __init__(self, stack: ExitStack, radio: Radio | None = None) -> None:
        self._tag, self._stack = f"sl{os.getpid()}", stack
        self._ends: dict[str, _Ends] = {}
        self.address = {"robots": "10.77.1.2", "estimator": "10.77.2.2"}
        self.gateway = {"robots": "10.77.1.1", "estimator": "10.77.2.1"}
        for name in ("router", *self.address):
            self._ip("netns", "add", self._of(name))
            stack.callback(self._ip, "netns", "del", self._of(name))
            self._in(name, "ip", "link", "set", "lo", "up")
        for name, address in self.address.items():
            ends = ((name, f"{self._tag}{name[0]}"), ("router", f"{self._tag}{name[0]}r"))
            if radio is not None and name == "robots":
                self._add_radio(radio, ends)
            else:
                self._add_cable(ends)
            for (machine, link), own in zip(ends, (address, self.gateway[name]), strict=True):
                self._in(machine, "ip", "addr", "add", f"{own}/24", "dev", link)
                self._in(machine, "ip", "link", "set", link, "up")
            self._ends[name] = ends
            self._in(name, "ip", "route", "add", "default", "via", self.gateway[name])
        self._in("router", "sysctl", "-qw", "net.ipv4.ip_forward=1")

    def _add_cable(self, ends: _Ends) -> None:
        (machine, link), (other, other_link) = ends
        peer = ("type", "veth", "peer", "name", other_link, "netns", self._of(other))
        self._ip("link", "add", link, "netns", self._of(machine), *peer)

    def _add_radio(self, radio: Radio, ends: _Ends) -> None:
        sockets = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        for seed, ((machine, link), one) in enumerate(zip(ends, sockets, strict=True)):
            self._in(machine, "ip", "tuntap", "add", "mode", "tun", "name", link)
            numbers = (one.fileno(), radio.delay_s, radio.jitter_s, radio.loss, seed)
            command = [sys.executable, str(LOSSY_LINK), link, *map(str, numbers)]
            with one:
                process = self._run(machine, command, os.environ, pass_fds=(one.fileno(),))
            assert process.stdout is not None
            assert process.stdout.readline() == "up\n"

    def start(self, name: str, command: list[str], server: bool) -> subprocess.Popen[str]:
        """Start a command on a machine; it ends with the test."""
        env: Mapping[str, str] = {
            **os.environ,
            # on one machine in truth, nodes would find a way past the router by shared memory
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            **({"ROS_DISCOVERY_SERVER": f"{self.gateway[name]}:{PORT}"} if server else {}),
        }
        return self._run(name, command, env)

    def switch(self, name: str, state: str) -> None:
        """Set the router's end of a machine's link `up` or `down`."""
        router, link = self._ends[name][1]
        self._in(router, "ip", "link", "set", link, state)

    def _run(
        self, name: str, command: list[str], env: Mapping[str, str], pass_fds: tuple[int, ...] = ()
    ) -> subprocess.Popen[str]:
        process = self._stack.enter_context(
            subprocess.Popen(
                ["ip", "netns", "exec", self._of(name), *command],
                env=env,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                pass_fds=pass_fds,
            )
        )
        self._stack.callback(process.kill)
        return process

    def _of(self, name: str) -> str:
        return f"{self._tag}-{name}"

    def _in(self, name: str, *command: str) -> None:
        self._ip("netns", "exec", self._of(name), *command)

    @staticmethod
    def _ip(*arguments: str) -> None:
        subprocess.run(["ip", *arguments], check=True, capture_output=True)
