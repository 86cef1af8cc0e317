"""Conversion of brightness matrices to relative measurements, one per exchange of two robots.

The matrices of all powers of an exchange have the same stamp. Received matrices are used immediately; when
another one arrives, a measurement from all of them replaces the earlier one. So there is no delay, the order
of arrival does not matter, and a lost matrix loses only its own information.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import BRIGHTNESS as MESSAGE_TYPE
from swarm_loc_estimator.common.messages.streams import Messages
from swarm_loc_estimator.filter.measurements import NO_MEASUREMENTS, Measurements, concatenate, select
from swarm_loc_estimator.filter.models import MODELS, POLAR
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.search import IrOutcome, IrSolutions
from swarm_loc_estimator.sensors.sensor import NO_ROWS, REJECT_REASONS, Change, Sensor, reject_reasons
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains, RobotIr
from swarm_loc_estimator.swarm.swarm import Robot, Swarm


class BrightnessRows(NamedTuple):
    """Brightness matrices (b,), as `swarm_loc_msgs/BrightnessMatrix` has them."""

    robot: IntArray  #: (b,) index of the robot of the topic
    stamp_ns: IntArray  #: (b,) middle of the exchange, equal for all its power modes
    receiver: IntArray  #: (b,) id of the robot that measured
    transmitter: IntArray  #: (b,) id of the robot that lit its emitters
    n: IntArray  #: (b,) number of sensors, and of emitters
    power: IntArray  #: (b,) index of the power mode
    saturation: IntArray  #: (b,) reading at which a sensor saturates [count]; 0: that of the platform
    #: (b,) of arrays (k,) [count], row-major [sensor, emitter]; k should be n * n
    readings: NDArray[np.object_]
    arrival_ns: IntArray  #: (b,) arrival times


NO_BRIGHTNESS = BrightnessRows(*(NO_ROWS,) * 7, np.zeros(0, dtype=object), NO_ROWS)


class Matrix(NamedTuple):
    """Readings at one power."""

    light: FloatArray  # (n, n) [count], [sensor, emitter], dark readings subtracted
    saturation: float  # Light at or above this is only a lower bound [count]


Readings = dict[int, Matrix]  # Matrices of an exchange by power


class ExchangeKey(NamedTuple):
    """Identity of an exchange; robots are indices into the swarm."""

    stamp_ns: int
    receiver: int
    transmitter: int


class MatrixScreening:
    """Validates the matrices of a swarm's infrared boards."""

    def __init__(self, swarm: Swarm) -> None:
        # Board by robot, of those that have one
        self.boards: dict[int, RobotIr] = {k: r.ir for k, r in enumerate(swarm.robots) if r.ir is not None}
        self.dropped: Counter[str] = Counter()  # Number of unusable matrices by reason
        self._robot_of = {ir.id: robot for robot, ir in self.boards.items()}

    def key_of(self, rows: BrightnessRows, k: int) -> ExchangeKey | None:
        """Exchange of matrix k; None, and counted in `dropped`, if the matrix is invalid."""
        fault = self._fault(rows, k)
        if fault:
            self.dropped[fault] += 1
            return None
        transmitter = self._robot_of[int(rows.transmitter[k])]
        return ExchangeKey(int(rows.stamp_ns[k]), int(rows.robot[k]), transmitter)

    def add(self, rows: BrightnessRows, k: int, readings: Readings) -> None:
        """Add matrix k to its exchange; of two for one power, the choice does not depend on their order."""
        platform, sent = self.boards[int(rows.robot[k])].platform, float(rows.saturation[k])
        counts = rows.readings[k].reshape(platform.n, platform.n).astype(np.float64)
        limit = min(sent, platform.saturation) if sent > 0.0 else platform.saturation
        matrix = Matrix(counts - platform.dark_level, limit - platform.dark_level)
        power = int(rows.power[k])
        if power in readings:
            self.dropped["duplicate"] += 1
            matrix = min(matrix, readings[power], key=lambda one: (one.light.tobytes(), one.saturation))
        readings[power] = matrix

    def together(self, robot: int, exchanges: list[Readings]) -> tuple[FloatArray, FloatArray]:
        """Readings (k, modes, n, n) of exchanges of a board, NaN if not measured; saturation (k, modes)."""
        platform = self.boards[robot].platform
        whole = np.full((len(exchanges), len(platform.amplitudes), platform.n, platform.n), np.nan)
        saturation = np.full(whole.shape[:2], platform.saturation)
        for k, exchange in enumerate(exchanges):
            for power, matrix in exchange.items():
                whole[k, power], saturation[k, power] = matrix
        return whole, saturation

    def _fault(self, rows: BrightnessRows, k: int) -> str:
        """Reason to drop matrix k; "" if it is valid."""
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


@dataclass
class _Exchange:
    """State of an exchange."""

    readings: Readings = field(default_factory=dict)  # Received matrices
    # Current measurement (1,), or (0,) if there is none
    measurement: Measurements = NO_MEASUREMENTS
    fault: str = ""  # Reason why there is none


@lru_cache(maxsize=64)
def _estimator(platform: IrPlatform) -> MaximumLikelihood:
    """Estimator for a board; cached, because its preparation is expensive."""
    return MaximumLikelihood(platform)


class BrightnessConverter:
    """Stores recent exchanges of the boards of a swarm and converts them to measurements."""

    def __init__(self, swarm: Swarm) -> None:
        self._validator = MatrixScreening(swarm)
        self._ir = self._validator.boards
        self._gate = {robot: float(MODELS[POLAR].gate(ir.gate_probability)) for robot, ir in self._ir.items()}
        self._gains = {robot: ir.believed_gains for robot, ir in self._ir.items()}
        self._dropped: Counter[str] = Counter()
        self._measured = 0
        self._exchanges: dict[ExchangeKey, _Exchange] = {}
        for ir in self._ir.values():
            _estimator(ir.platform)  # prepare now, so that the first message is not delayed

    @property
    def drops(self) -> Counter[str]:
        """Number of unused matrices by reason; it may decrease when their exchanges are completed."""
        return self._validator.dropped + self._dropped + _faults(self._exchanges.values())

    @property
    def counters(self) -> dict[str, int]:
        """Numbers of used data by name, since the last `restart`."""
        kept = sum(exchange.measurement.size for exchange in self._exchanges.values())
        return {"infrared exchanges measured": self._measured + kept}

    def forget_before(self, oldest_ns: int) -> None:
        """Discard the exchanges before an instant."""
        self._forget([key for key in self._exchanges if key.stamp_ns < oldest_ns])

    def restart(self) -> None:
        """Discard all exchanges."""
        self._forget(list(self._exchanges))
        self._measured = 0

    def take(self, rows: BrightnessRows) -> Change:
        """Add matrices (b,); return the change of the measurements."""
        touched: dict[ExchangeKey, None] = {}
        for k in range(rows.robot.size):
            key = self._validator.key_of(rows, k)
            if key is not None:
                self._validator.add(rows, k, self._exchanges.setdefault(key, _Exchange()).readings)
                touched[key] = None
        added, withdrawn = [NO_MEASUREMENTS], [NO_MEASUREMENTS]
        groups: dict[MaximumLikelihood, list[ExchangeKey]] = {}  # By board
        for key in touched:
            groups.setdefault(_estimator(self._ir[key.receiver].platform), []).append(key)
        for keys in groups.values():
            for exchange, measurement in self._solved(keys):
                withdrawn.append(exchange.measurement)
                added.append(measurement)
                exchange.measurement = measurement
        return Change(concatenate(added), concatenate(withdrawn))

    def _forget(self, keys: Iterable[ExchangeKey]) -> None:
        """Discard exchanges and count their unused matrices."""
        gone = [self._exchanges.pop(key) for key in keys]
        self._dropped += _faults(gone)
        self._measured += sum(exchange.measurement.size for exchange in gone)

    def _solved(self, keys: list[ExchangeKey]) -> list[tuple[_Exchange, Measurements]]:
        """Exchanges of one group whose measurement changes, with the new one, (1,) or (0,)."""
        ir = self._ir[keys[0].receiver]
        exchanges = [self._exchanges[key] for key in keys]
        readings, limits = self._validator.together(keys[0].receiver, [one.readings for one in exchanges])
        sides = [[self._gains[key[side]] for key in keys] for side in (1, 2)]
        solutions = _estimator(ir.platform).solve(readings, PairGains.of(*sides), limits)
        measurements = self._measurements(keys, solutions)
        faults = reject_reasons(measurements)
        changed = []
        for k, exchange in enumerate(exchanges):
            fault = _reason(int(solutions.outcomes[k]), readings[k], limits[k])
            exchange.fault = fault or REJECT_REASONS[faults[k]]
            measurement = NO_MEASUREMENTS if exchange.fault else select(measurements, slice(k, k + 1))
            if not measurement.equals(exchange.measurement):
                changed.append((exchange, measurement))
        return changed

    def _measurements(self, keys: list[ExchangeKey], solutions: IrSolutions) -> Measurements:
        """Measurements (k,) for the filter: the transmitter's base_link in the receiver's base_link.

        The two directions between two robots are separate measurements: they use different sensors and
        emitters, so their noise and gains are independent.
        """
        out = Measurements.empty(len(keys))
        stamps_ns, receivers, transmitters = np.array(keys, dtype=np.int64).T
        out.stamp_ns[:], out.target[:] = stamps_ns, transmitters
        out.received_from[:] = out.observer[:] = receivers
        out.model[:], out.has_heading[:] = POLAR, True
        out.gate[:] = [self._gate[receiver] for receiver in receivers.tolist()]
        out.value[:], out.covariance[:] = solutions.poses, solutions.covariances
        out.systematic_share[:] = np.nan_to_num(solutions.systematic_share)
        out.has_second[:] = np.isfinite(solutions.alternatives).all(axis=1)
        out.second[out.has_second] = solutions.alternatives[out.has_second]
        return out


def _faults(exchanges: Iterable[_Exchange]) -> Counter[str]:
    """Number of unused matrices of exchanges by reason."""
    counts: Counter[str] = Counter()
    for exchange in exchanges:
        if exchange.fault:
            counts[exchange.fault] += len(exchange.readings)
    return counts


def _reason(outcome: int, readings: FloatArray, saturation: FloatArray) -> str:
    """Reason why readings (modes, n, n) with saturation (modes,) gave no pose; "" if they did."""
    if outcome == IrOutcome.FOUND:
        return ""
    if np.all(np.isnan(readings) | (readings >= saturation[:, None, None])):
        return "ir_saturated"
    return f"ir_{IrOutcome(outcome).name.lower()}"


class BrightnessSensor(Sensor):
    """Infrared boards of robots."""

    name, topic, message_type = "brightness", "brightness", MESSAGE_TYPE
    unit, keeps_units, accumulator = ("robot", "stamp_ns", "transmitter"), True, BrightnessConverter

    @classmethod
    def columns(cls, messages: Messages[Any]) -> BrightnessRows:
        """Convert decoded messages (n,)."""
        readings = np.empty(len(messages.decoded), dtype=object)
        for k, message in enumerate(messages.decoded):
            readings[k] = message.readings

        names = ("receiver", "transmitter", "n", "power", "saturation")
        numbers = [[getattr(message, name) for message in messages.decoded] for name in names]
        receiver, transmitter, n, power, saturation = np.array(numbers, dtype=np.int64).reshape(
            len(names), -1
        )
        sides = messages.robot, messages.stamp_ns, receiver, transmitter
        return BrightnessRows(*sides, n, power, saturation, readings, messages.arrival_ns)

    @classmethod
    def expected_of(cls, robot: Robot) -> bool:
        """Whether the description says that the robot has a board."""
        return robot.ir is not None
