"""Robots and estimator in different networks, with a router between them, as on several machines.

Each machine is a network namespace. Multicast does not pass the router, so nodes find each other only through
the discovery server. Left out where namespaces cannot be made.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

import pytest

from swarm_loc_estimator.io.bags.cut import copy_beginning
from swarm_loc_estimator.launching.graph import NodeSpec, ParameterValue
from swarm_loc_estimator.launching.processes import node_command

BAG = Path(__file__).parents[3] / "bags" / "eight_five_robots"
PORT = 11811
INPUTS = 10
"""Odometry and detections of five robots."""
PATIENCE_S = 120.0
SERVER = "fast-discovery-server"


class Machines:
    """Three machines: `robots` and `estimator`, and between them `router`."""

    def __init__(self, stack: ExitStack) -> None:
        self._tag, self._stack = f"sl{os.getpid()}", stack
        self.address = {"robots": "10.77.1.2", "estimator": "10.77.2.2"}
        self.gateway = {"robots": "10.77.1.1", "estimator": "10.77.2.1"}
        for name in ("router", *self.address):
            self._ip("netns", "add", self._of(name))
            stack.callback(self._ip, "netns", "del", self._of(name))
            self._in(name, "ip", "link", "set", "lo", "up")
        for name, address in self.address.items():
            here, there = f"{self._tag}{name[0]}", f"{self._tag}{name[0]}r"
            ends = ("netns", self._of(name), "type", "veth", "peer", "name", there, "netns")
            self._ip("link", "add", here, *ends, self._of("router"))
            for machine, link, own in ((name, here, address), ("router", there, self.gateway[name])):
                self._in(machine, "ip", "addr", "add", f"{own}/24", "dev", link)
                self._in(machine, "ip", "link", "set", link, "up")
            self._in(name, "ip", "route", "add", "default", "via", self.gateway[name])
        self._in("router", "sysctl", "-qw", "net.ipv4.ip_forward=1")

    def start(self, name: str, command: list[str], server: bool) -> subprocess.Popen[str]:
        """Start a command on a machine; it ends with the test."""
        env: Mapping[str, str] = {
            **os.environ,
            # on one machine in truth, nodes would find a way past the router by shared memory
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            **({"ROS_DISCOVERY_SERVER": f"{self.gateway[name]}:{PORT}"} if server else {}),
        }
        process = self._stack.enter_context(
            subprocess.Popen(
                ["ip", "netns", "exec", self._of(name), *command],
                env=env,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
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


@pytest.fixture
def machines() -> Iterator[Machines]:
    if os.geteuid() or not shutil.which("ip") or not shutil.which(SERVER):
        pytest.skip("needs root, ip and the discovery server")
    with ExitStack() as stack:
        try:
            made = Machines(stack)
        except subprocess.CalledProcessError as error:
            pytest.skip(f"no network namespaces here: {error.stderr.decode().strip()}")
        yield made


def said_until(process: subprocess.Popen[str], *texts: str) -> str:
    """What a process said, up to the first line with one of these texts, or to its end."""
    assert process.stdout is not None
    said = ""
    for line in process.stdout:
        said += line
        if any(text in line for text in texts):
            break
    return said


def estimator() -> list[str]:
    parameters: dict[str, ParameterValue] = {"swarm_file": str(BAG / "swarm.yaml"), "use_sim_time": True}
    return node_command(NodeSpec("swarm_loc_estimator", "estimator_node", "estimator", parameters=parameters))


def player(folder: Path) -> list[str]:
    copy_beginning(BAG, folder / "short", 3.0)
    parameters: dict[str, ParameterValue] = {"bag": str(folder / "short"), "wait_for_subscribers": INPUTS}
    return node_command(NodeSpec("swarm_loc_estimator", "play", "player", parameters=parameters))


def test_a_discovery_server_joins_what_a_router_parts(machines: Machines, tmp_path: Path) -> None:
    addresses = [word for address in machines.gateway.values() for word in ("-l", address, "-p", str(PORT))]
    server = machines.start("router", [SERVER, "-i", "0", *addresses], server=False)
    assert "running" in said_until(server, "running")
    listening = machines.start("estimator", estimator(), server=True)
    assert "ready" in said_until(listening, "ready")
    playing = machines.start("robots", player(tmp_path), server=True)

    said = said_until(playing, "played ")

    assert playing.wait(PATIENCE_S) == 0
    assert "played" in said
    assert "not everything was received" not in said  # the estimator has acknowledged each message


def test_without_it_they_do_not_find_each_other(machines: Machines, tmp_path: Path) -> None:
    listening = machines.start("estimator", estimator(), server=False)
    assert "ready" in said_until(listening, "ready")
    playing = machines.start("robots", player(tmp_path), server=False)

    said = said_until(playing, "waiting for subscribers", "played ")

    assert f"waiting for subscribers: 0 of {INPUTS}" in said
