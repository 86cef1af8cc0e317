"""Simulated sightings survive the way through published detections and the estimator's conversion."""

import numpy as np

from bench.scenarios.bags import as_detections
from bench.scenarios.eight_run import EightSettings, simulate_eight
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.sensors.camera import DetectionRows, SightingConverter
from swarm_loc_estimator.sensors.sensor import DropCounts


def test_the_estimator_reads_what_was_simulated() -> None:
    run = simulate_eight(EightSettings(duration_s=5.0))
    robots = np.repeat(run.frames["robot"], run.frames["count"]).astype(np.int64)
    stamps_ns = np.repeat(run.frames["stamp_ns"], run.frames["count"])
    drops = DropCounts(len(run.swarm.robots))
    rows = DetectionRows(robots, stamps_ns, as_detections(run), stamps_ns)
    measured = SightingConverter(run.swarm, drops).convert(rows)
    assert not drops.total
    assert measured.size == len(run.sightings) > 0
    order = np.lexsort((measured.reading, measured.observer, measured.stamp_ns))
    expected = np.lexsort((run.sightings["marker_id"], robots, stamps_ns))
    value = measured.value[order]
    np.testing.assert_allclose(value[:, :2], run.sightings["value"][expected, :2], atol=1e-12)
    np.testing.assert_allclose(
        se2.wrap_angle(value[:, 2] - run.sightings["value"][expected, 2]), 0.0, atol=1e-12
    )
