"""Robots and estimator in different networks, with a router between them, as on several machines.

Multicast does not pass the router, so nodes find each other only through the discovery server. Left out where
there can be no namespaces.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from machines import PORT, Machines, Radio

from bench.shared.bags import copy_part
from swarm_loc_estimator.common.launch import NodeSpec, ParameterValue, node_command

BAG = Path(__file__).parents[3] / "bags" / "eight_five_robots"
INPUTS = 10  # Odometry and detections of five robots
PATIENCE_S = 120.0
SERVER = "fast-discovery-server"


@pytest.fixture
def machines(request: pytest.FixtureRequest) -> Iterator[Machines]:
    if os.geteuid() or not shutil.which("ip") or not shutil.which(SERVER):
        pytest.skip("needs root, ip and the discovery server")
    with ExitStack() as stack:
        try:
            made = Machines(stack, getattr(request, "param", None))
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


def knock(machines: Machines, name: str) -> subprocess.Popen[str]:
    """Send a packet to the router each tenth of a second, say "sent", and "answered" at its first answer."""
    code = f"""
import socket
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as knocking:
    knocking.settimeout(0.1)
    knocking.connect(("{machines.gateway[name]}", 9))
    while True:
        try:
            knocking.send(b"x")
            print("sent", flush=True)
            knocking.recv(1)
        except ConnectionRefusedError:
            break
        except TimeoutError:
            pass
print("answered", flush=True)
"""
    return machines.start(name, [sys.executable, "-c", code], server=False)


def estimator() -> list[str]:
    parameters: dict[str, ParameterValue] = {"swarm_file": str(BAG / "swarm.yaml"), "use_sim_time": True}
    return node_command(NodeSpec("swarm_loc_estimator", "estimator_node", "estimator", parameters=parameters))


def player(folder: Path) -> list[str]:
    copy_part(BAG, folder / "short", 3.0)
    parameters: dict[str, ParameterValue] = {"bag": str(folder / "short"), "wait_for_subscribers": INPUTS}
    return node_command(NodeSpec("swarm_loc_estimator", "play", "player", parameters=parameters))


@pytest.mark.timeout(300)  # what a radio loses is said again only every few seconds
@pytest.mark.parametrize("machines", [None, Radio(0.02, 0.03, 0.05)], indirect=True, ids=["cable", "radio"])
def test_a_discovery_server_joins_what_a_router_parts(machines: Machines, tmp_path: Path) -> None:
    """Also where the robots' radio loses each twentieth packet: all that is said is heard."""
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


@pytest.mark.parametrize("machines", [Radio(0.02, 0.03, 0.05)], indirect=True, ids=["radio"])
def test_a_radio_goes_on_when_its_far_end_has_been_down(machines: Machines) -> None:
    assert "answered" in said_until(knock(machines, "robots"), "answered")
    machines.switch("robots", "down")
    knocking = knock(machines, "robots")
    for _ in range(10):
        assert "answered" not in said_until(knocking, "sent")

    machines.switch("robots", "up")

    assert "answered" in said_until(knocking, "answered")


def test_without_it_they_do_not_find_each_other(machines: Machines, tmp_path: Path) -> None:
    listening = machines.start("estimator", estimator(), server=False)
    assert "ready" in said_until(listening, "ready")
    playing = machines.start("robots", player(tmp_path), server=False)

    said = said_until(playing, "waiting for subscribers", "played ")

    assert f"waiting for subscribers: 0 of {INPUTS}" in said
