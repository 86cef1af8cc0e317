"""What benchmarks share: readings cut at ticks, errors after a rigid fit, parts of equal size."""

from __future__ import annotations

import math

import numpy as np

from bench.shared.common import equal_parts, rms
from bench.shared.simulated_run import detection_rows, fitted_errors, inputs_between, odometry_rows, ticks
from swarm_loc_drivers.sim.scenarios.eight import EightSettings, simulate_eight
from swarm_loc_estimator.common import se2


def test_each_reading_is_given_once_in_the_tick_in_which_it_arrives() -> None:
    run = simulate_eight(EightSettings(seed=2, duration_s=3.0))
    odometry, detections, tick_ns = odometry_rows(run), detection_rows(run), ticks(run)
    parts = inputs_between(tick_ns, odometry=odometry, detections=detections)
    for name, arrivals_ns in (("odometry", odometry.arrival_ns), ("detections", detections.arrival_ns)):
        assert arrivals_ns.size > 50
        cut = [part[name].arrival_ns for part in parts]
        np.testing.assert_array_equal(np.concatenate(cut), arrivals_ns)
        begins_ns = [0, *tick_ns[:-1]]
        for begin_ns, end_ns, arrival_ns in zip(begins_ns, tick_ns, cut, strict=True):
            assert ((arrival_ns > begin_ns) & (arrival_ns <= end_ns)).all()


def test_a_moved_frame_costs_nothing_and_unknown_places_stay_unknown() -> None:
    truth = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [3.0, 1.0]])
    places = se2.transform_points([0.3, -0.2, 1.1], truth)
    places[1] = math.nan
    errors = fitted_errors(places, truth)
    assert np.isnan(errors[1]).all()
    np.testing.assert_allclose(np.delete(errors, 1, axis=0), 0.0, atol=1e-12)


def test_parts_have_all_values_by_size() -> None:
    parts = equal_parts(np.array([3.0, 1.0, 2.0, 5.0, 4.0]), 2)
    assert [part.tolist() for part in parts] == [[1, 2, 0], [4, 3]]


def test_the_root_mean_square_is_that_of_all_numbers() -> None:
    assert rms([[3.0, 4.0], [0.0, 0.0]]) == 2.5
