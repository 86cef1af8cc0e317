"""Which detection is me: assignment of detections to robots, chains and their probabilities."""

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.identification.chain import ChainModel, Chains, Scale
from swarm_loc_estimator.identification.memory import IdentityMemory
from swarm_loc_estimator.identification.picture import (
    AMBIGUOUS,
    UNSEEN,
    Picture,
    TrackPoint,
    assign,
    gathered_between,
    log_ratios,
)

SECOND = 10**9
SIGMA = 0.01
finite = st.floats(-3.0, 3.0)


def picture(positions: FloatArray, headings: FloatArray | None = None) -> Picture:
    pose = np.column_stack([positions, np.zeros(len(positions)) if headings is None else headings])
    covariance = np.tile(np.diag([SIGMA**2, SIGMA**2, 0.05**2]), (len(positions), 1, 1))
    return Picture(pose, covariance, np.full(len(positions), headings is not None))


def point(pose: ArrayLike) -> TrackPoint:
    return TrackPoint(np.asarray(pose, dtype=float), np.zeros((3, 3)))


@given(x=finite, y=finite, heading=finite, moved=st.tuples(finite, finite, finite))
def test_what_a_track_gathers_is_where_the_robot_is(
    x: float, y: float, heading: float, moved: tuple[float, float, float]
) -> None:
    """A small right-invariant error moves x and y of the later point so, by finite differences."""
    error, pose = 1e-7 * np.array(moved), np.array([x, y, heading])
    jacobian = gathered_between(TrackPoint(pose, np.zeros((3, 3))), TrackPoint(pose, np.outer(error, error)))
    change = se2.compose(se2.exp(error), pose) - pose
    change[2] = se2.wrap_angle(change[2])
    np.testing.assert_allclose(jacobian, np.outer(change, change), atol=1e-17)


def drive(rng: np.random.Generator, robots: int, images: int) -> tuple[FloatArray, FloatArray]:
    """True poses (images, robots, 3), and own tracks, each in a frame of its own."""
    start = np.column_stack([rng.uniform(-2, 2, (robots, 2)), rng.uniform(-3, 3, robots)])
    own = [np.zeros((robots, 3))]
    for _ in range(images - 1):
        step = np.column_stack(
            [rng.uniform(0.1, 0.6, robots), np.zeros(robots), rng.uniform(-1.5, 1.5, robots)]
        )
        own.append(se2.compose(own[-1], step))
    tracks = np.array(own)
    return se2.compose(start, tracks), tracks


class Found(NamedTuple):
    """What chains have made of five images of four robots, of which they look for the first."""

    chains: Chains  # After the newest image
    order: IntArray  # (4,) which robot each detection of it is
    pose: FloatArray  # (3,) of the robot there, by the image's scale


def found(seed: int, *, headings: bool) -> Found:
    rng = np.random.default_rng(seed)
    truth, own = drive(rng, 4, 5)
    scale = 1.0 + 0.02 * rng.standard_normal()
    chains = Chains()
    for k in range(5):
        order = rng.permutation(4)
        positions = scale * truth[k, order, :2] + SIGMA * rng.standard_normal((4, 2))
        shown = truth[k, order, 2] + 0.05 * rng.standard_normal(4) if headings else None
        chains = chains.advanced(picture(positions, shown), point(own[k, 0]), k * SECOND)
    return Found(chains, order, np.append(scale * truth[4, 0, :2], truth[4, 0, 2]))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), headings=st.booleans())
@example(seed=5661, headings=False)  # the newest detection is off by more than usual: it may be another robot
def test_chains_find_the_robot_its_heading_and_the_scale(seed: int, headings: bool) -> None:
    chains, order, pose = found(seed, headings=headings)
    answer = chains.answer()
    assert answer is not None
    assert order[answer.place] == 0
    error = answer.pose - pose
    error[2] = se2.wrap_angle(error[2])
    assert error @ np.linalg.solve(answer.covariance, error) < 30.0  # of 3 degrees of freedom: once in 10^6
    assert chains.probabilities.sum() <= 1.0 + 1e-9


@pytest.mark.parametrize("headings", [False, True])
def test_chains_are_sure_of_the_robot_unless_its_detection_is_an_outlier(headings: bool) -> None:
    """A detection far from where it is predicted may rather be of a robot that moves alike.

    A squared Mahalanobis distance of two degrees of freedom exceeds 7 three times in a hundred.
    """
    runs = [found(seed, headings=headings) for seed in range(200)]
    sure = np.array([chains.probabilities.max() > 0.9 for chains, _, _ in runs])
    assert (~sure).mean() <= 0.03


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_order_of_detections_means_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, own = drive(rng, 5, 4)
    one, other = Chains(), Chains()
    for k in range(4):
        positions = truth[k, :, :2] + SIGMA * rng.standard_normal((5, 2))
        order = rng.permutation(5)
        one = one.advanced(picture(positions), point(own[k, 0]), k * SECOND)
        other = other.advanced(picture(positions[order]), point(own[k, 0]), k * SECOND)
    np.testing.assert_allclose(one.probabilities[order], other.probabilities, atol=1e-9)


def test_robots_that_move_alike_are_not_told_apart() -> None:
    """A formation: every chain fits as well."""
    places = np.array([[0.0, 0.0], [1.0, 0.3], [-0.7, 1.1]])
    chains = Chains()
    for k in range(6):
        moved = np.array([0.5 * k, 0.0])
        chains = chains.advanced(picture(places + moved), point([0.5 * k, 0.0, 0.0]), k * SECOND)
    assert chains.probabilities.max() < 0.5


def test_a_missed_image_and_a_false_detection_do_not_end_a_chain() -> None:
    rng = np.random.default_rng(5)
    truth, own = drive(rng, 3, 7)
    chains = Chains(ChainModel(detection_probability=0.9))
    for k in range(7):
        shown = truth[k, [1, 2] if k == 3 else [0, 1, 2], :2]
        false = rng.uniform(-2, 2, (1, 2))
        chains = chains.advanced(picture(np.vstack([shown, false])), point(own[k, 0]), k * SECOND)
        if k == 3:
            assert chains.probabilities.max() < 0.99
    assert chains.probabilities[0] > 0.99


def test_a_robot_that_enters_late_finds_itself() -> None:
    rng = np.random.default_rng(6)
    truth, own = drive(rng, 3, 8)
    chains = Chains()
    for k in range(8):
        chains = chains.advanced(picture(truth[k, 1 if k < 2 else 0 :, :2]), point(own[k, 0]), k * SECOND)
        assert k >= 2 or chains.probabilities.max() < 0.9
    assert chains.probabilities[0] > 0.99


def test_a_robot_that_leaves_is_not_in_the_picture_any_more() -> None:
    rng = np.random.default_rng(7)
    truth, own = drive(rng, 3, 8)
    chains = Chains()
    for k in range(8):
        chains = chains.advanced(picture(truth[k, 1 if k > 5 else 0 :, :2]), point(own[k, 0]), k * SECOND)
    assert chains.probabilities.max() < 0.1


@pytest.mark.parametrize("scale", [0.7, 1.4])
def test_an_unknown_scale_is_found(scale: float) -> None:
    rng = np.random.default_rng(8)
    truth, own = drive(rng, 4, 6)
    chains = Chains(ChainModel(scale=Scale(1.0, 0.5)))
    for k in range(6):
        chains = chains.advanced(picture(scale * truth[k, :, :2]), point(own[k, 2]), k * SECOND)
    answer = chains.answer()
    assert answer is not None
    assert answer.place == 2
    assert answer.scale == pytest.approx(scale, rel=0.05)


def test_an_image_without_detections_leaves_less_certain() -> None:
    chains = Chains().advanced(picture(np.array([[0.0, 0.0], [1.0, 1.0]])), point([0, 0, 0]), 0)
    none = chains.advanced(picture(np.zeros((0, 2))), point([0.5, 0, 0]), SECOND)
    assert none.probabilities.size == 0
    assert none.answer() is None


def test_sure_answers_are_right_where_detections_are_missed_and_false() -> None:
    """Any number of robots and images, with an error of the scale: at most 5 % of sure answers are wrong."""
    rng, sure, right = np.random.default_rng(77), 0, 0
    for _ in range(40):
        robots, images, scale = int(rng.integers(2, 15)), int(rng.integers(3, 8)), rng.normal(1.0, 0.02)
        seen, false = rng.uniform(0.85, 1.0), rng.choice([0.0, 0.3, 1.5])
        truth, own = drive(rng, robots, images)
        chains = Chains(ChainModel(scale=Scale(1.0, 0.02)))
        for k in range(images):
            order = rng.permutation(np.flatnonzero(rng.random(robots) < seen))
            positions = scale * truth[k, order, :2] + SIGMA * rng.standard_normal((order.size, 2))
            shown = np.vstack([positions, rng.uniform(-2.0, 2.0, (rng.poisson(false), 2))])
            chains = chains.advanced(picture(shown), point(own[k, 0]), k * SECOND)
            if k and chains.probabilities.max(initial=0.0) >= 0.99:
                sure, place = sure + 1, int(np.argmax(chains.probabilities))
                right += place < order.size and order[place] == 0
    assert sure > 50
    assert right >= 0.95 * sure


SPREAD, GATE = 0.02, 18.4


def ratios(robots: FloatArray, detections: FloatArray) -> FloatArray:
    def alike(count: int) -> FloatArray:
        return np.tile(SPREAD**2 * np.eye(3), (count, 1, 1))

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
