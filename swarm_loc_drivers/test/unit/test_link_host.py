"""Whether links of emulated robots are in use."""

import socket
from pathlib import Path

from epuck_rig import Mute

from swarm_loc_drivers.common.link import SerialLink
from swarm_loc_drivers.sim.link_host import FirmwareHost


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
