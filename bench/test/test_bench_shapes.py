"""Figures of large swarms count the poses that are told as tracked, and say how many these are."""

import numpy as np
import pytest

from bench.peers.shapes import ShapeRuns, measure_shape, scored
from bench.shared.grid import Shape


def test_a_pose_that_is_not_tracked_is_counted_and_not_scored() -> None:
    errors = np.tile([0.003, 0.004, 0.0], (4, 5, 1))
    covariances = np.tile(1e-5 * np.eye(3), (4, 5, 1, 1))
    errors[2, 3] = np.nan
    covariances[2, 3] = np.nan
    figures = scored(errors, covariances)
    assert figures["tracked_share"] == pytest.approx(0.95)
    assert figures["position_rmse_mm"] == pytest.approx(5.0)
    assert figures["nees"] == pytest.approx(2.5)


def test_a_small_swarm_of_a_shape_is_the_exact_filter_itself() -> None:
    figures = measure_shape(Shape.CORNER, 5, ShapeRuns(duration_s=3.0, exact_s=3.0, seeds=(1, 2)))
    assert figures["position_rmse_ratio_to_exact"] == pytest.approx(1.0, abs=1e-12)
    assert figures["tracked_share"] == figures["exact_tracked_share"] == 1.0
    assert figures["nees"] == pytest.approx(figures["exact_nees"], rel=1e-12)
