"""Brightness matrices to relative measurements, one per exchange of two robots.

The matrices of all powers of one exchange share their stamp. Those received so far are used at once; when
another one arrives, a measurement from all of them replaces the earlier one. So nothing waits, the order of
arrival does not matter, and a lost matrix costs only its own information.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.gating import gate_threshold
from swarm_loc_estimator.filter.measurement_model import MEASUREMENT_DTYPE, Kind, MeasurementArray
from swarm_loc_estimator.infrared.closed_form import ClosedForm
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.solution import IrEstimator, IrOutcome, IrSolutions
from swarm_loc_estimator.sensors.exchanges import ExchangeKey, MatrixScreening, Readings
from swarm_loc_estimator.sensors.messages import NO_MEASUREMENTS, BrightnessRows
from swarm_loc_estimator.sensors.validation import REJECT_REASONS, reject_reasons
from swarm_loc_estimator.swarm.ir_board import IrMethod, IrPlatform, PairGains
from swarm_loc_estimator.swarm.swarm import Swarm

_METHODS: dict[IrMethod, Callable[[IrPlatform], IrEstimator]] = {
    IrMethod.LIKELIHOOD: MaximumLikelihood,
    IrMethod.CLOSED_FORM: ClosedForm,
}


class Change(NamedTuple):
    """What new matrices change.

    Attributes:
        added: (m,) measurements to use from now on.
        withdrawn: (w,) measurements given before that no longer hold.
    """

    added: MeasurementArray
    withdrawn: MeasurementArray


@dataclass
class _Exchange:
    """What has come of an exchange.

    Attributes:
        readings: Its matrices.
        measurement: (1,) as it is used, (0,) when there is none.
        fate: Why there is none.
    """

    readings: Readings = field(default_factory=dict)
    measurement: MeasurementArray = field(default_factory=NO_MEASUREMENTS.copy)
    fate: str = ""


@lru_cache(maxsize=64)
def _estimator(platform: IrPlatform, method: IrMethod) -> IrEstimator:
    """The estimator of a kind for a board; what it prepares is worth keeping."""
    return _METHODS[method](platform)


class BrightnessConverter:
    """Keeps the exchanges of the last while, and makes measurements of them.

    Args:
        swarm: Whose.
    """

    def __init__(self, swarm: Swarm) -> None:
        self._validator = MatrixScreening(swarm)
        self._ir = self._validator.boards
        self._gate = {robot: float(gate_threshold(ir.gate_probability)) for robot, ir in self._ir.items()}
        self._dropped: Counter[str] = Counter()
        self._measured = 0
        self._exchanges: dict[ExchangeKey, _Exchange] = {}
        for ir in self._ir.values():
            _estimator(ir.platform, ir.estimator)  # now, and not when the first message is waiting

    @property
    def drops(self) -> Counter[str]:
        """Matrices not used, by reason; what still comes of their exchanges may make them useful."""
        return self._validator.dropped + self._dropped + _fates(self._exchanges.values())

    @property
    def measured(self) -> int:
        """Exchanges that gave a measurement, since the last `restart`."""
        return self._measured + sum(exchange.measurement.size for exchange in self._exchanges.values())

    def forget_before(self, oldest_ns: int) -> None:
        """Let go of the exchanges before an instant: nothing more comes of them."""
        self._forget([key for key in self._exchanges if key.stamp_ns < oldest_ns])

    def restart(self) -> None:
        """Let go of all exchanges."""
        self._forget(list(self._exchanges))
        self._measured = 0

    def take(self, rows: BrightnessRows) -> Change:
        """Take matrices (b,) in."""
        touched: dict[ExchangeKey, None] = {}
        for k in range(rows.robot.size):
            key = self._validator.key_of(rows, k)
            if key is not None:
                self._validator.add(rows, k, self._exchanges.setdefault(key, _Exchange()).readings)
                touched[key] = None
        added, withdrawn = [NO_MEASUREMENTS], [NO_MEASUREMENTS]
        for keys in self._alike(touched):
            for exchange, measurement in self._solved(keys):
                withdrawn.append(exchange.measurement)
                added.append(measurement)
                exchange.measurement = measurement
        return Change(np.concatenate(added), np.concatenate(withdrawn))

    def _forget(self, keys: Iterable[ExchangeKey]) -> None:
        """Let go of exchanges."""
        gone = [self._exchanges.pop(key) for key in keys]
        self._dropped += _fates(gone)
        self._measured += sum(exchange.measurement.size for exchange in gone)

    def _alike(self, keys: Iterable[ExchangeKey]) -> Iterable[list[ExchangeKey]]:
        """Exchanges of one kind of board and estimator together."""
        groups: dict[IrEstimator, list[ExchangeKey]] = {}
        for key in keys:
            ir = self._ir[key.receiver]
            groups.setdefault(_estimator(ir.platform, ir.estimator), []).append(key)
        return groups.values()

    def _solved(self, keys: list[ExchangeKey]) -> list[tuple[_Exchange, MeasurementArray]]:
        """Exchanges of one kind whose measurement changes, with what it becomes, (1,) or (0,)."""
        ir = self._ir[keys[0].receiver]
        exchanges = [self._exchanges[key] for key in keys]
        readings, limits = self._validator.together(keys[0].receiver, [one.readings for one in exchanges])
        sides = [[self._ir[key[side]].believed_gains for key in keys] for side in (1, 2)]
        solutions = _estimator(ir.platform, ir.estimator).solve(readings, PairGains.of(*sides), limits)
        measurements = self._measurements(keys, solutions)
        faults = reject_reasons(measurements)
        changed = []
        for k, exchange in enumerate(exchanges):
            exchange.fate = (
                _reason(int(solutions.outcomes[k]), readings[k], limits[k]) or REJECT_REASONS[faults[k]]
            )
            measurement = NO_MEASUREMENTS if exchange.fate else measurements[k : k + 1]
            if measurement.tobytes() != exchange.measurement.tobytes():
                changed.append((exchange, measurement))
        return changed

    def _measurements(self, keys: list[ExchangeKey], solutions: IrSolutions) -> MeasurementArray:
        """Measurements (k,) as the filter knows them: the transmitter's base_link in the receiver's.

        That one robot hears another and is heard by it are two measurements: other sensors read the light of
        other emitters, so neither noise nor gains have anything in common.
        """
        measurements = np.zeros(len(keys), dtype=MEASUREMENT_DTYPE)
        stamps_ns, receivers, transmitters = np.array(keys, dtype=np.int64).T
        measurements["stamp_ns"], measurements["target"] = stamps_ns, transmitters
        measurements["received_from"] = measurements["observer"] = receivers
        measurements["kind"], measurements["has_heading"] = Kind.POLAR, 1
        measurements["gate"] = [self._gate[receiver] for receiver in receivers.tolist()]
        measurements["value"], measurements["covariance"] = solutions.poses, solutions.covariances
        measurements["systematic_share"] = np.nan_to_num(solutions.systematic_share)
        ambiguous = np.isfinite(solutions.alternatives).all(axis=1)
        measurements["has_alternative"] = ambiguous
        measurements["alternative"][ambiguous] = solutions.alternatives[ambiguous]
        return measurements


def _fates(exchanges: Iterable[_Exchange]) -> Counter[str]:
    """How many matrices of exchanges were not used, by reason."""
    counts: Counter[str] = Counter()
    for exchange in exchanges:
        if exchange.fate:
            counts[exchange.fate] += len(exchange.readings)
    return counts


def _reason(outcome: int, readings: FloatArray, saturation: FloatArray) -> str:
    """Why readings (modes, n, n), of saturation (modes,), gave no pose, "" if they did."""
    if outcome == IrOutcome.FOUND:
        return ""
    if np.all(np.isnan(readings) | (readings >= saturation[:, None, None])):
        return "ir_saturated"
    return f"ir_{IrOutcome(outcome).name.lower()}"
