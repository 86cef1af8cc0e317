"""Sensors of an emulated PushBot: their numbers, what they report at rest, and when they are due.

Source: sensors.c, mpu9150.c and uart.c of the board's firmware EDVSBoardOS (eDVS4337), version 0.7.1.
"""

from __future__ import annotations

from swarm_loc_drivers.pushbot.hardware import FirmwareGeneration

_NAMES = (
    *("BATTERY", *(f"ADC CHANNEL{channel}" for channel in range(6))),
    *("RAW GYRO", "RAW ACCEL", "RAW COMPASS", "CAL GYRO", "CAL ACCEL", "CAL COMPASS", "QUARTERNION"),
    *("EULER ANGLES", "ROTATION MATRIX", "HEADING", "LINEAR ACCEL", "IMU STATUS"),
    *("PWM SIGNALS", "MOTOR CURRENTS", "EVENTS RATE"),
)
"""Sensors of the second firmware by their numbers from 0; the wheels' number is apart."""
_WHEELS = "MOTOR SENSORS"
_UNIT, _G = "40000000", 16384
"""1 in Q30, and the acceleration of gravity of the raw sensor, which measures up to 2 g in 16 bits."""
_AT_REST = {
    "BATTERY": "7399",
    "RAW GYRO": "0 0 0",
    "RAW ACCEL": f"0 0 {_G}",
    "RAW COMPASS": "0 67 147",
    "CAL GYRO": "0 0 0 {ms}",
    "CAL ACCEL": "0 0 10000",
    "CAL COMPASS": "140000 0 FFD40000",
    "QUARTERNION": f"{_UNIT} 0 0 0",
    "EULER ANGLES": "0 0 0 0",
    "ROTATION MATRIX": f"{_UNIT} 0 0 0 {_UNIT} 0 0 0 {_UNIT}",
    "LINEAR ACCEL": "0 0 0",
    "IMU STATUS": "250 {ms}",
    "MOTOR CURRENTS": "0 0",
}
"""Values of a robot that stands level and looks north in a field of 20 uT ahead and 44 uT down; others are 0.

Calibrated values are hexadecimal: Q16 of deg/s, g and uT, Q30 of quaternion and matrix. The temperature has
one decimal and no point.
"""
_FIRST_NAMES = {0: "BATTERY", 14: "EVENTS RATE"}


class Sensors:
    """Which sensors a board has, and which of them are due.

    Args:
        generation: Which firmware it is.
    """

    def __init__(self, generation: FirmwareGeneration) -> None:
        self._is_first = not generation.has_decay
        names = _FIRST_NAMES if self._is_first else dict(enumerate(_NAMES))
        self._names = {**names, generation.tick_bit: _WHEELS}
        self._reloads: dict[int, int] = {}
        self._counters: dict[int, int] = {}
        self._places: dict[int, int] = {}
        self._queue: list[int] = []
        self._due: set[int] = set()

    def start(self, mask: int, period_ms: int) -> None:
        """Report sensors periodically; with a period of 0 ms a counter wraps before it reports."""
        for bit in self.bits(mask):
            self._reloads[bit] = period_ms
            if bit not in self._places:
                self._counters[bit], self._places[bit] = period_ms, len(self._queue)
                self._queue.append(bit)

    def stop(self, mask: int) -> None:
        """Stop reports.

        As on the board, the others keep their old places in the queue, by which they are taken away later:
        after that one can go on in place of another.
        """
        for bit in self.bits(mask):
            if (place := self._places.pop(bit, None)) is not None:
                del self._queue[min(place, len(self._queue) - 1)]
                self._due.discard(bit)

    def tick(self) -> None:
        """A millisecond has passed."""
        for bit in self._queue:
            self._counters[bit] = (self._counters[bit] - 1) % 2**32
            if self._counters[bit] == 0:
                self._counters[bit] = self._reloads[bit]
                self._due.add(bit)

    def take_due(self) -> list[int]:
        """Numbers of the sensors that have become due since the last call."""
        due = [bit for bit in dict.fromkeys(self._queue) if bit in self._due]
        self._due.difference_update(due)
        return due

    def bits(self, mask: int) -> list[int]:
        """The numbers in a mask of sensors that the board has."""
        return [bit for bit in self._names if mask >> bit & 1]

    def name(self, bit: int) -> str:
        """Name of a sensor, which the second firmware also lists."""
        return self._names[bit]

    def at_rest(self, bit: int, time_ms: int) -> str:
        """Values of a sensor of a robot at rest; the time [ms] is that of the last sample."""
        return _AT_REST.get(self._names[bit], "0").format(ms=time_ms)

    def listing(self) -> str:
        """Answer to `??S`; the second firmware adds a description to each row."""
        if self._is_first:
            rows = (f" {bit} {name.replace(' ', '_')} {self._size(bit)}" for bit, name in self._names.items())
            return "\n".join([" Bit Name Values", *rows, "", ""])
        rows = (f" {bit:<3} {1 << bit:<9} {name:<15} {self._size(bit)}" for bit, name in self._names.items())
        title = " Bit Dec-Value Name     # Values"
        return "\n".join(["Bitlist for available sensors:", title, *rows, "", ""])

    def _size(self, bit: int) -> int:
        """How many values a sensor has."""
        sizes = {_WHEELS: 2, "PWM SIGNALS": 4, "EVENTS RATE": 1 if self._is_first else 3, "CAL GYRO": 3}
        name = self._names[bit]
        return sizes.get(name, len(_AT_REST.get(name, "0").split()))
