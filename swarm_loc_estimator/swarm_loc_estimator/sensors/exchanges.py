"""Brightness matrices validated, and associated with exchanges.

The matrices of all powers of an exchange share stamp, receiver and transmitter.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.sensors.messages import BrightnessRows
from swarm_loc_estimator.swarm.ir_board import RobotIr
from swarm_loc_estimator.swarm.swarm import Swarm


class Matrix(NamedTuple):
    """What was read at one power.

    Attributes:
        light: (n, n) [count], [sensor, emitter], what is read in the dark taken off.
        saturation: Light of it or more tells only that it was at least so bright.
    """

    light: FloatArray
    saturation: float


Readings = dict[int, Matrix]
"""Of an exchange, by power."""


class ExchangeKey(NamedTuple):
    """Which exchange; robots are indices into the swarm."""

    stamp_ns: int
    receiver: int
    transmitter: int


class MatrixScreening:
    """Looks through the matrices of a swarm's infrared boards.

    Args:
        swarm: Whose.

    Attributes:
        boards: Robot -> its board; robots without one are missing.
        dropped: Reason -> how many matrices could not be used.
    """

    def __init__(self, swarm: Swarm) -> None:
        self.boards: dict[int, RobotIr] = {
            k: robot.ir for k, robot in enumerate(swarm.robots) if robot.ir is not None
        }
        self.dropped: Counter[str] = Counter()
        self._robot_of = {ir.id: robot for robot, ir in self.boards.items()}

    def key_of(self, rows: BrightnessRows, k: int) -> ExchangeKey | None:
        """The exchange of matrix k; None, and counted, when the matrix cannot be used whatever else comes."""
        fault = self._fault(rows, k)
        if fault:
            self.dropped[fault] += 1
            return None
        transmitter = self._robot_of[int(rows.transmitter[k])]
        return ExchangeKey(int(rows.stamp_ns[k]), int(rows.robot[k]), transmitter)

    def add(self, rows: BrightnessRows, k: int, readings: Readings) -> None:
        """Put matrix k to others of its exchange; of two for one power the same one counts in any order."""
        platform, told = self.boards[int(rows.robot[k])].platform, float(rows.saturation[k])
        counts = rows.readings[k].reshape(platform.n, platform.n).astype(np.float64)
        limit = min(told, platform.saturation) if told > 0.0 else platform.saturation
        matrix = Matrix(counts - platform.dark_level, limit - platform.dark_level)
        power = int(rows.power[k])
        if power in readings:
            self.dropped["duplicate"] += 1
            matrix = min(matrix, readings[power], key=lambda one: (one.light.tobytes(), one.saturation))
        readings[power] = matrix

    def together(self, robot: int, exchanges: list[Readings]) -> tuple[FloatArray, FloatArray]:
        """Readings (k, modes, n, n) of exchanges of a robot's board, NaN where not measured, and saturation.

        Saturation is (k, modes).
        """
        platform = self.boards[robot].platform
        whole = np.full((len(exchanges), len(platform.amplitudes), platform.n, platform.n), np.nan)
        saturation = np.full(whole.shape[:2], platform.saturation)
        for k, exchange in enumerate(exchanges):
            for power, matrix in exchange.items():
                whole[k, power], saturation[k, power] = matrix
        return whole, saturation

    def _fault(self, rows: BrightnessRows, k: int) -> str:
        """Why matrix k cannot be used; "" if it can."""
        receiver, transmitter = (self._robot_of.get(int(ids[k])) for ids in (rows.receiver, rows.transmitter))
        ir = self.boards.get(int(rows.robot[k]))
        if ir is None:
            return "no_ir"
        if receiver is None or transmitter is None:
            return "ir_unknown_id"
        if receiver != rows.robot[k]:
            return "ir_wrong_receiver"
        if transmitter == receiver:
            return "ir_hears_itself"
        if self.boards[transmitter].platform != ir.platform:
            return "ir_other_board"
        if rows.n[k] != ir.platform.n or rows.readings[k].size != ir.platform.n**2:
            return "ir_wrong_size"
        return "" if rows.power[k] < len(ir.platform.amplitudes) else "ir_unknown_power"
