"""Global assignment of anonymous detections to robots, and what the camera sees."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.identification.memory import IdentityMemory
from swarm_loc_estimator.identification.picture import AMBIGUOUS, UNSEEN, Picture, assign, log_ratios

SIGMA, GATE = 0.02, 18.4


def ratios(robots: FloatArray, detections: FloatArray) -> FloatArray:
    def alike(count: int) -> FloatArray:
        return np.tile(SIGMA**2 * np.eye(3), (count, 1, 1))

    picture = Picture(detections, alike(len(detections)), np.zeros(len(detections), dtype=bool))
    return log_ratios(robots, alike(len(robots)), picture, 0.0, GATE)


def poses(*places: tuple[float, float]) -> FloatArray:
    return np.array([[x, y, 0.0] for x, y in places]).reshape(-1, 3)


def test_each_robot_gets_its_own_and_strangers_nobody() -> None:
    found = assign(ratios(poses((0, 0), (1, 0), (2, 0)), poses((1.01, 0), (0, 0.02), (5, 5))), 0.95, 0.99)
    assert found.place.tolist() == [1, 0, UNSEEN]
    assert found.robot.tolist() == [1, 0, UNSEEN]
    assert found.probability[0] > 0.99


def test_two_robots_near_two_detections_between_them_are_not_told_apart() -> None:
    found = assign(ratios(poses((0, 0), (0.02, 0)), poses((0.01, 0.02), (0.01, -0.02))), 0.95, 0.99)
    assert found.place.tolist() == [AMBIGUOUS, AMBIGUOUS]
    assert found.robot.tolist() == [AMBIGUOUS, AMBIGUOUS]


def test_one_detection_between_two_robots_is_nobodys() -> None:
    found = assign(ratios(poses((0, 0), (0.05, 0)), poses((0.025, 0.0))), 0.95, 0.99)
    assert found.place.tolist() == [AMBIGUOUS, AMBIGUOUS]


def test_the_whole_counts_and_not_who_is_nearest() -> None:
    """The first robot's nearest detection is the only one that the second robot may have."""
    found = assign(ratios(poses((0, 0), (0.12, 0)), poses((0.04, 0), (-0.07, 0))), 0.95, 0.5)
    assert found.place.tolist() == [1, 0]


@given(seed=st.integers(0, 10**6), robots=st.integers(1, 4), detections=st.integers(1, 4))
def test_the_assignment_is_the_best_of_all(seed: int, robots: int, detections: int) -> None:
    rng = np.random.default_rng(seed)
    table = ratios(rng.uniform(0, 0.1, (robots, 3)), rng.uniform(0, 0.1, (detections, 3)))
    gains = np.where(np.isfinite(table), table + np.log(0.95 / 0.05), -np.inf)

    def gain(places: tuple[int, ...]) -> float:
        used = [place for place in places if place >= 0]
        if len(set(used)) < len(used):
            return -np.inf
        return sum(float(gains[i, place]) for i, place in enumerate(places) if place >= 0)

    best = max(gain(places) for places in itertools.product(range(-1, detections), repeat=robots))
    found = assign(table, 0.95, 0.5 - 1e-9)  # what is less likely than its best rival is never assigned
    clear = tuple(int(place) for place in found.place)
    if AMBIGUOUS not in clear:
        assert abs(gain(clear) - best) < 1e-9


def test_what_lies_between_things_that_were_seen_is_in_view() -> None:
    memory = IdentityMemory()
    memory.see(np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 2.0], [1.0, 0.5]]), 0)
    places = np.array([[1.0, 1.0], [1.0, 0.05], [0.0, 2.0]])
    assert memory.is_in_view(places, np.full(3, 0.1)).tolist() == [True, False, False]
    copy = memory.copy()
    for seconds in (30, 60):
        memory.see(np.array([[5.0, 5.0]]), seconds * 10**9)
    assert not memory.is_in_view(places, np.full(3, 0.1)).any()
    assert copy.is_in_view(places, np.full(3, 0.1)).any()
