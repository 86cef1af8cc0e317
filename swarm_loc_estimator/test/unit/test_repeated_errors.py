"""Errors of sightings that repeat are in the reported covariances, and in no pose."""

from dataclasses import replace

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import SECOND, T0, Event
from core_run import on_time, play, ticks
from core_world import Plan, World, simulate

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator

STANDING = Plan(3, 12.0, landmarks=5, standing=(0, 1, 2))
SEEDS = range(400, 412)


def same_again(world: World) -> World:
    """The world whose robots see what they saw in their first picture again and again."""
    first: dict[int, Event] = {}
    events = [
        replace(first.setdefault(event.robot, event), stamp_ns=event.stamp_ns)
        if event.pose is None
        else event
        for event in world.events
    ]
    return replace(world, events=tuple(events))


def run(world: World) -> tuple[Estimator, list[Estimate]]:
    """The estimates of each half second."""
    estimator = Estimator(world.swarm)
    return estimator, play(estimator, on_time(world), ticks(T0, int(world.stamp_ns[-1]), 0.5))


def test_pictures_that_repeat_their_errors_mislead_less() -> None:
    told, independent = [], []
    for seed in SEEDS:
        world = same_again(simulate(STANDING, seed))
        estimator, estimates = run(world)
        last = estimates[-1]
        error = wrapped(last.poses - world.at(last.stamp_ns))
        excess = se2.pose_covariance(last.poses, estimator._timeline.state.sources.excess)
        told.append(nees(error, last.covariances))
        independent.append(nees(error, last.covariances - excess))
    assert np.median(told) < 8.0  # half of each error is taken as repeated, and all of it is
    assert np.median(independent) > 3.0 * np.median(told)


def test_a_robot_that_stands_learns_little_from_more_pictures_() -> None:
    world = simulate(STANDING, 400)
    sigma = np.sqrt([np.trace(one.covariances[0][:2, :2]) for one in run(world)[1]])
    assert sigma[-1] > 0.8 * sigma[8]  # with independent errors it is half


def test_robots_that_drive_on_are_as_certain_as_the_filter_is() -> None:
    world = simulate(replace(STANDING, standing=(), speed=0.4), 401)
    state = run(world)[0]._timeline.state
    own = np.array([np.trace(state.filter.block(3 * robot + np.arange(3))) for robot in range(3)])
    assert (np.trace(state.sources.excess, axis1=1, axis2=2) < 0.3 * own).all()


@pytest.mark.parametrize("standing", [(), (0, 1, 2)])
def test_covariances_are_never_smaller_than_those_of_the_filter(standing: tuple[int, ...]) -> None:
    world = simulate(replace(STANDING, standing=standing, duration_s=6.0), 402)
    estimator = Estimator(world.swarm)
    for now_ns in ticks(T0, int(world.stamp_ns[-1]), 0.5):
        play(
            estimator,
            [(at, one) for at, one in on_time(world) if now_ns - SECOND // 2 < at <= now_ns],
            [now_ns],
        )
        least = np.linalg.eigvalsh(estimator._timeline.state.sources.excess)[:, 0]
        assert (least > -1e-11).all()
