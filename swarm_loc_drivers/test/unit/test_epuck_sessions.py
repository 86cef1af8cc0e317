"""How often conversations read and take pictures, by a clock that only the test moves."""

import threading
from collections import Counter

import numpy as np
import pytest
from epuck_body import DrivenBody

from swarm_loc_drivers.core.epuck_serial_session import SerialCamera, SerialSession
from swarm_loc_drivers.core.epuck_session import Photo, Reading
from swarm_loc_drivers.core.epuck_wifi_session import WifiSession
from swarm_loc_drivers.core.link_keeper import SessionError
from swarm_loc_drivers.protocols.epuck import EPUCK1
from swarm_loc_drivers.sim.firmware.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.firmware.wifi_firmware import CYCLE_NS, WifiFirmware

MILLISECOND = 1_000_000


class Wire:
    """A link to a firmware, on which every read takes a while."""

    def __init__(self, read_ns: int) -> None:
        self.now_ns = 10**9
        self.body = DrivenBody(self.clock)
        self.firmware: SerialFirmware | WifiFirmware = WifiFirmware(self.body)
        self._read_ns = read_ns
        self._answer = b""
        self.is_cut = False

    def clock(self) -> int:
        """The time [ns]."""
        return self.now_ns

    def write(self, data: bytes) -> None:
        """See `Link`."""
        self._answer += self.firmware.receive(data) or b""

    def read(self, timeout_s: float) -> bytes:
        """See `Link`."""
        self.now_ns += self._read_ns if timeout_s > 0.0 else 0
        data, self._answer = self._answer + self.firmware.stream(), b""
        return b"" if self.is_cut else data

    def close(self) -> None:
        """Nothing is to be done."""


def stamps_ns(found: list[Reading | Photo], kind: type) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([one.stamp_ns for one in found if isinstance(one, kind)])


@pytest.mark.parametrize("period_s", [0.02, 0.05, 0.1])
def test_of_a_stream_as_many_readings_are_used_as_wanted(period_s: float) -> None:
    wire = Wire(CYCLE_NS)
    session = WifiSession(wire, False, period_s, 1.0, wire.clock, Counter())
    session.begin()
    found = [one for _ in range(400) for one in session.exchange(lambda: (0, 0))]
    gaps_ns = np.diff(stamps_ns(found, Reading))
    assert gaps_ns.size > 50
    assert abs(gaps_ns.mean() - period_s * 1e9) <= CYCLE_NS / gaps_ns.size
    assert np.abs(gaps_ns - period_s * 1e9).max() < CYCLE_NS


def test_a_silent_robot_is_found_out_although_the_clock_has_jumped_back() -> None:
    wire = Wire(CYCLE_NS)
    wire.now_ns = 1000 * 10**9
    session = WifiSession(wire, False, 0.05, 0.0, wire.clock, Counter())
    session.begin()
    assert session.exchange(lambda: (0, 0))
    wire.now_ns, wire.is_cut = 10**9, True
    assert session.exchange(lambda: (0, 0)) == []  # shows that the clock has jumped
    with pytest.raises(SessionError, match="silent"):
        session.exchange(lambda: (0, 0))


def test_over_the_serial_port_every_tick_gives_a_reading_and_pictures_keep_their_period() -> None:
    wire, tick, period_ns = Wire(2 * MILLISECOND), threading.Event(), 20 * MILLISECOND
    wire.firmware = SerialFirmware(wire.body, EPUCK1)
    wire.body.frame = (np.full((480, 640), 96, np.uint8), 1)
    camera = SerialCamera(32, 24, 8, 0.05)
    session = SerialSession(wire, 115200, camera, 60.0, tick, wire.clock, lambda: None, Counter())
    session.begin()
    begin_ns, found = wire.now_ns, []
    for step in range(100):
        wire.now_ns = begin_ns + step * period_ns
        tick.set()
        found += session.exchange(lambda: (0, 0))
    in_the_middle_ns = begin_ns + MILLISECOND + period_ns * np.arange(100)
    np.testing.assert_array_equal(stamps_ns(found, Reading), in_the_middle_ns)
    assert set(np.diff(stamps_ns(found, Photo))) == {3 * period_ns}  # the first tick at which one is due
