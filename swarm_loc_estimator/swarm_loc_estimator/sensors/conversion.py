"""Conversion of batches to measurements, with counts of dropped readings."""

from __future__ import annotations

from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.filter.measurement_model import MeasurementArray
from swarm_loc_estimator.sensors.registry import SENSORS, Batch, Measurements
from swarm_loc_estimator.sensors.sensor import (
    NO_MEASUREMENTS,
    NO_ROWS,
    Accumulator,
    Converter,
    DropCounts,
    Guard,
    Measured,
    SensorSettings,
    chosen,
)
from swarm_loc_estimator.sensors.validation import (
    BAD_MEASUREMENT,
    REJECT_REASONS,
    VALID,
    is_about_swarm,
    reject_reasons,
)
from swarm_loc_estimator.swarm.swarm import Swarm


class InputConverter:
    """Converts batches to measurements.

    Args:
        swarm: Swarm with the sensors.
        settings: Default noise of sensors, and tolerance of stamps in the future.

    Attributes:
        drops: Counts dropped readings.
        accumulators: Accumulators by sensor.
    """

    def __init__(self, swarm: Swarm, settings: SensorSettings) -> None:
        self.drops = DropCounts(len(swarm.sources))
        self.accumulators: dict[str, Accumulator] = {
            name: sensor.create_accumulator(swarm)
            for name, sensor in SENSORS.items()
            if sensor.create_accumulator is not None
        }
        self._converters: dict[str, Converter] = {
            name: sensor.create_converter(swarm, settings, self.drops)
            for name, sensor in SENSORS.items()
            if sensor.create_converter is not None
        }
        self._future_ns = round(settings.future_tolerance_s * 1e9)
        self._robots, self._landmarks = len(swarm.robots), len(swarm.surveyed)

    def convert(self, batch: Batch) -> Measurements:
        """Convert valid readings; count the others in `drops`."""
        self.drops.total.update(batch.dropped)
        parts: list[Measured] = []
        kept: dict[str, Any] = {}
        for name in SENSORS:
            rows = batch.rows.get(name)
            if rows is None or not rows.robot.size:
                continue
            late = rows.stamp_ns > rows.arrival_ns + self._future_ns
            if late.any():
                self.drops.add("future_stamp", rows.robot[late])
                rows = chosen(rows, ~late)
            with Guard(name, rows.robot.size, self.drops.total):
                found = self._converters[name](rows) if name in self._converters else rows
                if isinstance(found, Measured):
                    parts.append(self._valid(found))
                elif found.robot.size:
                    kept[name] = found
        return Measurements(batch.begin_ns, batch.end_ns, *_in_order_of_arrival(parts), kept)

    def _valid(self, found: Measured) -> Measured:
        """Select valid measurements; count the others in `drops`."""
        reasons = reject_reasons(found.measurements)
        reasons[~is_about_swarm(found.measurements, self._robots, self._landmarks)] = BAD_MEASUREMENT
        for k in set(reasons[reasons != VALID].tolist()):
            self.drops.add(REJECT_REASONS[k], found.measurements["received_from"][reasons == k])
        return chosen(found, reasons == VALID)


def _in_order_of_arrival(parts: list[Measured]) -> tuple[MeasurementArray, IntArray]:
    """Concatenate measurements and sort them by arrival; the sort is stable."""
    parts = [part for part in parts if part.measurements.size]
    if len(parts) < 2:
        return parts[0] if parts else (NO_MEASUREMENTS, NO_ROWS)
    measurements = np.concatenate([part.measurements for part in parts])
    arrival_ns = np.concatenate([part.arrival_ns for part in parts])
    order = np.argsort(arrival_ns, kind="stable")
    return measurements[order], arrival_ns[order]
