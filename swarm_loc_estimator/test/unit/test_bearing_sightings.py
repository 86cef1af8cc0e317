"""Sightings of a direction alone: they turn and place robots, and errors stay as large as covariances say."""

import math

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_run import on_time, play, settled, ticks
from core_world import Plan, World, simulate
from scipy.stats import chi2

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.models import BEARING, MODELS
from swarm_loc_estimator.sensors.camera import CONTENT_BEARING
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

POSITION = 1


def errors(world: World, *, seeing: bool) -> tuple[FloatArray, FloatArray, dict[str, int]]:
    """Errors (T, N, 3) and covariances (T, N, 3, 3) at whole seconds, and verdicts on measurements."""
    estimator = Estimator(world.swarm, Settings())
    events = []
    for arrival_ns, event in on_time(world):
        if event.detections.size:
            event.detections["content"] = CONTENT_BEARING
            event.detections["position"] *= 7.0  # its length means nothing
        if seeing or not event.detections.size:
            events.append((arrival_ns, event))
    at_ns = ticks(int(world.stamp_ns[0]), int(world.stamp_ns[-1]), 1.0)[2:]
    estimates = play(estimator, events, at_ns)
    error = wrapped(np.array([one.poses - world.at(one.stamp_ns) for one in estimates]))
    return error, np.array([one.covariances for one in estimates]), settled(estimator)


def test_bearings_make_poses_better_and_the_errors_stay_as_large_as_the_covariances_say() -> None:
    squared, seeing, blind = [], [], []
    for seed in range(6):
        plan = Plan(3, 8.0, content=POSITION)
        error, covariance, verdicts = errors(simulate(plan, 300 + seed), seeing=True)
        assert verdicts["USED"] > 100
        squared.append(nees(error, covariance).mean(axis=0))
        seeing.append(np.square(error).mean(axis=(0, 1)))
        blind.append(np.square(errors(simulate(plan, 300 + seed), seeing=False)[0]).mean(axis=(0, 1)))
    better = np.sqrt(np.mean(seeing, axis=0) / np.mean(blind, axis=0))
    assert (better < 0.7).all()
    few = len(squared) * len(squared[0])  # means over a run are correlated: each counts as one pose at least
    assert chi2.ppf(0.001, 3 * few) / few < np.mean(squared) < chi2.ppf(0.999, 3 * few) / few


def test_bearings_locate_a_robot_that_moves() -> None:
    """Together with its motion, as other measurements of one degree of freedom."""
    world = simulate(Plan(2, 8.0, content=POSITION, start_known=(False,)), 5)
    error, _, verdicts = errors(world, seeing=True)
    located = error[-1][np.isfinite(error[-1]).all(axis=1)]
    assert len(located)
    assert np.abs(located[:, :2]).max() < 0.3
    assert verdicts["USED"] > 0


@pytest.mark.parametrize("quarter", range(4))
def test_a_bearing_wraps(quarter: int) -> None:
    value = np.array([0.5 * math.pi * quarter + 0.1, 0.0, 0.0])
    predicted = np.array([0.5 * math.pi * quarter - 2.0 * math.pi])
    assert MODELS[BEARING].innovation(value, predicted) == pytest.approx([0.1])
