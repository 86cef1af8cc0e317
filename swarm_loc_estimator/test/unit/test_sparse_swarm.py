"""Small swarms in the sparse filter: who joins, is lost, found, contradicted, named, as in the dense one."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import POSE, POSITION, SECOND, T0
from core_run import on_time, play, settled, ticks
from core_world import Plan, World, simulate
from scipy.stats import chi2

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.sparse.sparse_filter import SparseFilter
from swarm_loc_estimator.swarm.calibration_states import CAMERA_OFFSET
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

SPARSE = Settings(sparse_from=2, fusion_period_s=0.2)

world_of = lru_cache(maxsize=16)(simulate)  # For tests that change nothing in it


def run(world: World, settings: Settings = SPARSE, period_s: float = 0.2) -> tuple[Estimator, list[Estimate]]:
    """A world through an estimator of its own, all in time."""
    estimator = Estimator(world.swarm, settings)
    end_ns = int(world.stamp_ns[-1])
    return estimator, play(estimator, on_time(world), ticks(T0, end_ns, period_s))


def is_sparse(estimator: Estimator) -> bool:
    return isinstance(estimator._timeline.state.filter, SparseFilter)


def distances(world: World, estimates: list[Estimate]) -> FloatArray:
    """(T, N) between estimates and truth [m]; NaN where not located."""
    return np.array([np.hypot(*(e.poses - world.at(e.stamp_ns))[:, :2].T) for e in estimates])


def assert_chi_square(worlds: list[World]) -> None:
    """The mean of normalised errors, one of each run and robot, is what three degrees of freedom give."""
    squared = []
    for world in worlds:
        estimator, estimates = run(world, period_s=1.0)
        assert is_sparse(estimator)
        error = wrapped(np.array([e.poses - world.at(e.stamp_ns) for e in estimates]))
        squared.append(nees(error, np.array([e.covariances for e in estimates]))[5:].mean(axis=0))
    samples = np.concatenate(squared)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * samples.size) / samples.size
    assert low < samples.mean() < high


@pytest.mark.parametrize("content", [POSE, POSITION])
def test_the_normalised_error_is_chi_square_distributed(content: int) -> None:
    plan = Plan(12, 10.0, content=content, landmarks=6)
    assert_chi_square([simulate(plan, 400 + seed) for seed in range(4)])


@pytest.mark.parametrize("content", [POSE, POSITION])
def test_landmarks_badly_surveyed_are_estimated(content: int) -> None:
    plan = Plan(3, 20.0, content=content, survey=1.0, speed=0.15)
    worlds = [world_of(plan, 500 + seed) for seed in range(4)]
    assert_chi_square(worlds)
    own, others = [], []
    for world in worlds:
        trusted = tuple(replace(mark, position_sigma=0.0, yaw_sigma=0.0) for mark in world.swarm.landmarks)
        trusting = replace(world, swarm=replace(world.swarm, landmarks=trusted))
        own.append(np.square(distances(world, run(world)[1])[25:]).mean())
        others.append(np.square(distances(world, run(trusting)[1])[25:]).mean())
    assert np.mean(own) < 0.7 * np.nanmean(others)  # not a number where it got lost


@pytest.mark.parametrize("content", [POSE, POSITION])
def test_robots_described_with_sigmas_are_calibrated(content: int) -> None:
    plan = Plan(3, 20.0, content=content, lasting=1.0, speed=0.15)
    assert_chi_square([simulate(plan, 600 + seed) for seed in range(4)])


def misled(world: World, liar: int, from_ns: int, by: tuple[float, float]) -> World:
    """The world where one robot sees all that it sees off by so much, in its camera's frame [m]."""
    events = []
    for event in world.events:
        detections = event.detections
        if event.robot == liar and detections.size and event.stamp_ns >= from_ns:
            detections = detections.copy()
            detections["position"][:, 0] += by[0]
            detections["position"][:, 2] += by[1]
        events.append(replace(event, detections=detections))
    return replace(world, events=tuple(events))


@pytest.mark.parametrize("seed", range(3))
def test_false_sightings_of_one_robot_are_gated_and_the_robot_is_named(seed: int) -> None:
    as_in_a_large_swarm = replace(SPARSE, policy=Policy(reopen_all_up_to=2))
    plan = Plan(5, 14.0, landmarks=6)
    world = misled(simulate(plan, 700 + seed), 2, T0 + 6 * SECOND, (0.5, 0.3))
    estimator, estimates = run(world, as_in_a_large_swarm)
    named = set()
    for estimate in estimates[-5:]:
        named |= {one.about for one in estimator.contradictions(estimate.stamp_ns)}
    assert settled(estimator)["GATED"] > 10
    honest = [k for k in range(5) if k != 2]
    assert world.swarm.robots[2].name in named
    assert not named & {world.swarm.robots[k].name for k in honest}
    assert distances(world, estimates)[:, honest].max() < 0.1


def test_where_descriptions_contradict_everything_is_estimated_anew() -> None:
    world = misled(simulate(Plan(5, 14.0, landmarks=6), 701), 2, T0 + 6 * SECOND, (0.5, 0.3))
    estimator, estimates = run(world)
    state = estimator._timeline.state
    assert state.is_doubted
    assert (state.arrays().table.column[:, 1:CAMERA_OFFSET] >= 0).all()
    assert all(state.landmark_column(k) >= 0 for k in range(6))
    assert distances(world, estimates)[:, [0, 1, 3, 4]].max() < 0.1


@pytest.mark.parametrize(("others", "ago_s", "is_doubted"), [(1, 30, False), (2, 30, True), (2, 61, False)])
def test_a_survey_is_doubted_as_a_whole_where_a_third_landmark_contradicts_it_within_a_minute(
    others: int, ago_s: int, is_doubted: bool
) -> None:
    world = simulate(Plan(3, 4.0, landmarks=8), 720)
    estimator, _ = run(world)
    state, now_ns = estimator._timeline.state.copy(), int(world.stamp_ns[-1])
    state.contradicted_ns[3 : 3 + others] = now_ns - ago_s * SECOND
    estimator._fusion._augment(state, 3 + others, now_ns)
    assert state.is_doubted == is_doubted
    opened = [state.landmark_column(k) >= 0 for k in range(8)]
    assert opened == [is_doubted or k == others for k in range(8)]
