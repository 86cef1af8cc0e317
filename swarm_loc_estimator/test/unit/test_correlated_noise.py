"""Noise that is correlated in time or repeated, and what stamps add to it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from core_geometry import marker_frame, nees, wrapped
from core_messages import POSITION, SECOND, T0, Event, detection, joined
from core_run import errors, on_time, play, ticks
from core_world import Plan, World, simulate
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.correlated_noise import record_constraint, record_pair, use_mean
from swarm_loc_estimator.filter.measurements import NOBODY, LossReason, Measurements, concatenate
from swarm_loc_estimator.filter.models import POLAR, predict
from swarm_loc_estimator.filter.state import PAIR_ROWS, SwarmState
from swarm_loc_estimator.filter.update import relative_motion
from swarm_loc_estimator.odometry.track_arrays import new_sample
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.camera import DetectionRows, SightingConverter
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.ir_board import RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, StartSigma, Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

VARIANCES = np.array([1e-4, 2e-3, 5e-3])
VALUE = (0.15, 0.4, -2.0)
UNSURE, SURE = 4.0 * VARIANCES, 1e-6 * VARIANCES
TOLD = slice(3, 6)


class Exchange(NamedTuple):
    """What robot 0 has heard."""

    systematic_share: float
    value: tuple[float, float, float] = VALUE
    transmitter: int = 1
    stamp_ns: int = 0
    size: float = 1.0  # of its variances

    def columns(self) -> Measurements:
        """As the filter gets it."""
        one = Measurements.empty(1)
        one.stamp_ns[:], one.observer[:], one.target[:] = self.stamp_ns, 0, self.transmitter
        one.model[:], one.has_heading[:], one.value[:] = POLAR, True, self.value
        one.systematic_share[:], one.covariance[:] = self.systematic_share, np.diag(VARIANCES * self.size)
        return one


def pairs(places: int = 4) -> SwarmState:
    return SwarmState(ParameterTable.of([Robot(name) for name in "abcd"]), places)


def standing(value: tuple[float, float, float]) -> FloatArray:
    """Poses (2, 3) in map of an observer and of a target that it has at so much."""
    distance, bearing, heading = value
    observer = np.array([0.3, -0.2, 0.7])
    seen = np.array([distance * np.cos(bearing), distance * np.sin(bearing), heading])
    return np.array([observer, se2.compose(observer, seen)])


class Use(NamedTuple):
    """What becomes of an exchange."""

    innovation: FloatArray
    noise: FloatArray
    pair: FloatArray


def use_of(
    state: SwarmState,
    exchange: Exchange,
    variances: FloatArray,
    predicted: FloatArray | None = None,
    poses: FloatArray | None = None,
) -> Use:
    """How an exchange is used where robots are at `poses`, by default at what it measured."""
    value = np.array(exchange.value)
    poses = standing(exchange.value) if poses is None else poses
    predicted = value if predicted is None else predicted
    innovation = value - predicted
    innovation[1:] = se2.wrap_angle(innovation[1:])
    use = Use(innovation, np.diag(VARIANCES * exchange.size), np.zeros((PAIR_ROWS, 3)))
    use_mean(exchange.columns(), 0, state.arrays(), poses, predicted, variances, *use)
    return use


def noise_of(state: SwarmState, exchange: Exchange, variances: FloatArray) -> FloatArray:
    noise: FloatArray = np.diag(use_of(state, exchange, variances).noise).copy()
    return noise


class Belief:
    """A Kalman filter of one pair's relative pose, which stands."""

    def __init__(self, state: SwarmState, variances: FloatArray) -> None:
        self.state, self.value, self.variances = state, np.array(VALUE), variances

    def use(self, exchange: Exchange) -> None:
        """Let an exchange correct it."""
        use = use_of(self.state, exchange, self.variances, self.value, standing(VALUE))
        record_pair(exchange.columns(), 0, self.state.arrays(), use.pair)
        noise = np.diag(use.noise)
        self.value = self.value + self.variances / (self.variances + noise) * use.innovation
        self.variances = self.variances * noise / (self.variances + noise)

    @property
    def told(self) -> FloatArray:
        """The information (3,) of the pair."""
        told: FloatArray = np.diag(self.state.pair_history[0, 0, TOLD]).copy()
        return told


def used(state: SwarmState, exchange: Exchange, variances: FloatArray) -> FloatArray:
    """Use it where it measured; returns the variances (3,) left."""
    use = use_of(state, exchange, variances)
    record_pair(exchange.columns(), 0, state.arrays(), use.pair)
    left: FloatArray = variances * np.diag(use.noise) / (variances + np.diag(use.noise))
    return left


@given(share=st.floats(0.01, 0.999) | st.just(1.0), count=st.integers(1, 30), seed=st.integers(0, 10**6))
def test_robots_that_stand_are_believed_to_be_where_the_mean_of_their_exchanges_says(
    share: float, count: int, seed: int
) -> None:
    """Whatever was told first; and no surer than the mean is."""
    belief = Belief(pairs(), UNSURE)
    values = VALUE + 0.5 * np.sqrt(VARIANCES) * np.random.default_rng(seed).standard_normal((count, 3))
    for value in values.tolist():
        belief.use(Exchange(share, tuple(value)))
    own = 1.0 - share
    mean = values.mean(axis=0) if own > 0.0 else values[0]
    expected = (belief.told * mean + VALUE / UNSURE) / (belief.told + 1.0 / UNSURE)
    np.testing.assert_allclose(belief.value, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(belief.variances, 1.0 / (belief.told + 1.0 / UNSURE), rtol=1e-6)
    assert (belief.told * VARIANCES * (share + own / count) <= 1.0 + 1e-6).all()


@pytest.mark.parametrize("share", [0.05, 0.3, 0.9])
def test_after_many_exchanges_nearly_all_is_told_that_their_mean_tells(share: float) -> None:
    belief = Belief(pairs(), UNSURE)
    for _ in range(60):
        belief.use(Exchange(share))
    most = 1.0 / (VARIANCES * (share + (1.0 - share) / 60))
    assert (belief.told > 0.75 * most).all()
    assert (belief.told < most).all()


@given(
    exchanges=st.lists(st.tuples(st.floats(0.01, 1.0), st.floats(0.2, 5.0)), min_size=2, max_size=20),
    seed=st.integers(0, 10**6),
)
def test_robots_that_stand_are_never_surer_than_the_least_error_that_comes_again(
    exchanges: list[tuple[float, float]], seed: int
) -> None:
    """However unlike exchanges are; and however values scatter, that is no turn of the robots."""
    rng = np.random.default_rng(seed)
    belief = Belief(pairs(), 1e6 * VARIANCES)
    for share, size in exchanges:
        bearing, heading = rng.uniform(-3.0, 3.0, 2).tolist()
        belief.use(Exchange(share, (VALUE[0], bearing, heading), size=size))
    least = min(share * size for share, size in exchanges) * VARIANCES
    assert (belief.variances >= (1.0 - 1e-5) * least).all()


def test_an_exchange_that_seems_better_does_not_take_what_came_again_before_for_less() -> None:
    """The mean still contains the errors of those before it, by their weight."""
    belief = Belief(pairs(), UNSURE)
    for _ in range(9):
        belief.use(Exchange(0.8))
    before = belief.told
    belief.use(Exchange(0.8, size=0.5))
    better = 0.8 * (0.5**0.5 * 0.2 + 0.8) ** 2  # a tenth and somewhat more of the mean is the new one
    assert (belief.told < 1.0 / (better * VARIANCES)).all()
    assert (belief.told > before).all()


@given(share=st.floats(0.0, 1.0), turn=st.floats(0.0, 3.0), more=st.floats(1.0, 4.0))
def test_what_is_told_again_never_counts_more_than_the_first_time(
    share: float, turn: float, more: float
) -> None:
    state = pairs()
    left = more * used(state, Exchange(share), SURE)
    distance, bearing, heading = VALUE
    turned = Exchange(share, (distance, bearing + turn, heading))
    again = noise_of(state, turned, left)
    assert (again >= VARIANCES * (1.0 - 1e-9)).all()
    assert (again <= noise_of(state, Exchange(share), left) * (1.0 + 1e-6)).all()


@given(
    move=st.just((0.0, 0.0, 0.0))
    | st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-3.0, 3.0)),
    sigma=st.floats(0.001, 0.1),
    side=st.integers(0, 1),
    share=st.floats(0.05, 0.95),
)
def test_where_robots_may_have_moved_a_new_mean_begins(
    move: tuple[float, float, float], sigma: float, side: int, share: float
) -> None:
    """What was measured elsewhere is no value to come back to; without odometry nobody knows of a move."""
    state, belief = pairs(), standing(VALUE)
    first = use_of(state, Exchange(share), UNSURE)
    record_pair(Exchange(share).columns(), 0, state.arrays(), first.pair)
    belief[side] = se2.compose(belief[side], np.array(move))
    state.preintegrated_covariance[side] += sigma**2 * np.eye(3)
    value = np.array([0.16, 0.3, -1.9])
    use = use_of(state, Exchange(share, (0.17, 0.2, -1.8)), UNSURE, value, belief)
    np.testing.assert_allclose(use.innovation, (0.01, -0.1, 0.1), atol=1e-12)


@pytest.mark.parametrize(
    ("receiver_turns", "transmitter_turns", "new"),
    [(1.5, 0.0, [False, True, False]), (0.0, 1.5, [False, False, False]), (1.5, 1.5, [True, True, True])],
)
def test_robots_that_have_turned_tell_something_new(
    receiver_turns: float, transmitter_turns: float, new: list[bool]
) -> None:
    """A bearing errs by the gains of sensors, range and heading by those of emitters besides."""
    state = pairs()
    left = used(state, Exchange(0.9), 1e-3 * VARIANCES)
    distance, bearing, heading = VALUE
    turned = Exchange(0.9, (distance, bearing - receiver_turns, heading - receiver_turns + transmitter_turns))
    poses = standing(VALUE)
    poses[:, 2] += receiver_turns, transmitter_turns
    noise = np.diag(use_of(state, turned, left, poses=poses).noise)
    np.testing.assert_array_equal(noise < 1.1 * noise_of(pairs(), turned, left), new)


def test_what_others_tell_makes_room_for_what_a_pair_tells_again() -> None:
    state = pairs()
    left = used(state, Exchange(1.0), 9.0 * SURE)
    lowered = noise_of(state, Exchange(1.0), 0.1 * left)
    moved = used(state, Exchange(1.0), 0.1 * left) + left
    assert (lowered > 1e6 * VARIANCES).all()
    assert (noise_of(state, Exchange(1.0), moved) < 2.0 * VARIANCES).all()


def test_a_pair_is_forgotten_when_either_robot_is_lost_or_others_take_its_place() -> None:
    new = noise_of(pairs(), Exchange(1.0), SURE)
    for lost in (0, 1):
        state = pairs()
        used(state, Exchange(1.0), SURE)
        state.deinitialize(lost, LossReason.COMMAND, 0)
        np.testing.assert_allclose(noise_of(state, Exchange(1.0), SURE), new)
    state = pairs(places=2)
    for transmitter, stamp_ns in ((1, 1), (2, 2), (3, 3)):
        left = used(state, Exchange(1.0, transmitter=transmitter, stamp_ns=stamp_ns), SURE)
    again = [noise_of(state, Exchange(1.0, transmitter=k), left) for k in (1, 2, 3)]
    assert [bool((noise > 1e6 * VARIANCES).all()) for noise in again] == [False, True, True]


def test_what_has_located_a_robot_counts_as_told() -> None:
    state = pairs()
    exchange = Exchange(1.0).columns().row(0)
    record_constraint(exchange, state.arrays(), new_sample(2)._replace(pose=standing(VALUE)))
    told = np.diag(state.pair_history[0, 0, TOLD])
    assert (told > 0.4 / VARIANCES).all()  # not all of it
    assert (noise_of(state, Exchange(1.0), VARIANCES) > noise_of(pairs(), Exchange(1.0), VARIANCES)).all()
    np.testing.assert_allclose(noise_of(state, Exchange(0.0), VARIANCES), VARIANCES)


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_pair_whose_relative_pose_is_known_exactly_tells_nothing(share: float) -> None:
    """Neither where rounding leaves nothing of its variances, or less."""
    state = pairs()
    for variances in (np.zeros(3), np.zeros(3), np.full(3, -1e-20), np.full(3, 1e-20)):
        use = use_of(state, Exchange(share), variances)
        assert np.isfinite(use.innovation).all()
        assert (np.diag(use.noise) >= share * VARIANCES * (1.0 - 1e-6)).all()
        record_pair(Exchange(share).columns(), 0, state.arrays(), use.pair)
        assert np.isfinite(state.pair_history).all()


class StandingPair:
    """An estimator of two robots that stand where `VALUE` says, their starts known so well."""

    def __init__(self, sigma: float, settings: Settings) -> None:
        robots = [
            Robot(
                f"r{k}",
                camera=None,
                start=(float(pose[0]), float(pose[1]), float(pose[2])),
                start_sigma=StartSigma(sigma, sigma, sigma),
                stands=True,
                ir=RobotIr(k + 1, load_ir_platform("droplet"), "droplet"),
            )
            for k, pose in enumerate(standing(VALUE))
        ]
        self.estimator = Estimator(Swarm(tuple(robots)), settings)

    def hear(self, stamps_ns: Sequence[int], share: float) -> Estimate:
        """Fuse exchanges at instants, together; return the estimate at the last one."""
        rows = concatenate([Exchange(share, stamp_ns=stamp_ns).columns() for stamp_ns in stamps_ns])
        rows.gate[:] = 9.0
        self.estimator._timeline.add(rows)
        return self.estimator.tick(stamps_ns[-1])

    @property
    def told(self) -> FloatArray:
        """The information (3,) of the pair."""
        told: FloatArray = np.diag(self.estimator._timeline.state.pair_history[0, 0, TOLD]).copy()
        return told


@pytest.mark.parametrize("sigma", [1e-6, 1e-12])
@pytest.mark.parametrize("sparse_from", [2, 250])
def test_robots_whose_starts_are_as_good_as_exact_stay_there(sparse_from: int, sigma: float) -> None:
    pair = StandingPair(sigma, Settings(sparse_from=sparse_from))
    for second in range(1, 6):
        estimate = pair.hear([second * 10**9], 0.9)
    np.testing.assert_allclose(estimate.poses, standing(VALUE), atol=1e-9)
    assert pair.estimator.used == 5


def test_exchanges_that_are_fused_together_tell_no_more_than_their_mean() -> None:
    """Those of one pair in one period, too: as much as one after the other."""
    share, stamps_ns = 0.9, [10**9 + k * 10**8 for k in range(1, 10)]
    one_by_one = StandingPair(0.1, Settings(fusion_period_s=0.0))
    together = StandingPair(0.1, Settings(fusion_period_s=1.0, sparse_from=2))
    covariances = []
    for pair in (one_by_one, together):
        covariances.append(pair.hear(stamps_ns, share).covariances)
        assert pair.estimator.used == len(stamps_ns)
        assert (pair.told * VARIANCES < 1.0 / share).all()
    np.testing.assert_allclose(together.told, one_by_one.told, rtol=1e-6)
    np.testing.assert_allclose(covariances[1], covariances[0], atol=1e-9)


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


TIME_SIGMA_S = 0.04
SEER = Robot("seer", camera=CameraMount(x=0.04))
FACES = (Face("left", 3, 0.01, 0.03, 0.0, 1.5, position_sigma=0.003), Face("back", 4, -0.03, yaw=3.1))
SWARM = Swarm((SEER, Robot("other", faces=FACES)), (Landmark(7, 1.0, 0.2, 0.0, 3.0),))


def with_time_sigma(swarm: Swarm, sigma_s: float) -> Swarm:
    robots = (replace(one, sensor=replace(one.sensor, time_sigma_s=sigma_s)) for one in swarm.robots)
    return replace(swarm, robots=tuple(robots))


def measured_of(swarm: Swarm, stamps: IntArray, seen: NDArray[np.void]) -> Measurements:
    rows = DetectionRows(np.zeros(stamps.size, np.int64), stamps, seen, stamps)
    return SightingConverter(swarm).convert(rows)


def test_what_a_picture_shows_shares_the_error_of_its_stamp() -> None:
    seen = joined([detection(marker, marker_frame(1.0, 0.0, 0.0, 3.0)) for marker in (7, 3, 99, 7)])
    stamps = np.array([T0, T0, T0, T0 + SECOND])
    measured = measured_of(with_time_sigma(SWARM, 0.1), stamps, seen)
    np.testing.assert_allclose(measured.stamp_variance, [0.02, 0.02, 0.01])
    measured = measured_of(SWARM, stamps, seen)
    assert (measured.stamp_variance == 0.0).all()


def test_how_unsure_a_face_sits_adds_to_the_noise_of_its_sightings() -> None:
    for content, distance in ((2, 1.0), (POSITION, 0.8)):
        seen = joined(
            [detection(marker, marker_frame(distance, 0.0, 0.0, 3.0), content) for marker in (3, 4, 7)]
        )
        measured = measured_of(SWARM, np.full(3, T0), seen)
        sure, unsure = measured.covariance[1], measured.covariance[0]
        away = 1.0 if content != POSITION else float(measured.value[0, 0])
        np.testing.assert_allclose(unsure - sure, np.diag([9e-6, 9e-6 / away**2, 0.0]), atol=1e-15)
        np.testing.assert_allclose(measured.covariance[2], sure)


def test_what_is_left_of_systematic_errors_adds_to_the_noise_that_a_detection_tells() -> None:
    known, unknown = (detection(7, marker_frame(1.0, 0.0, 0.0, 3.0)) for _ in range(2))
    known["covariance"] = np.diag([1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6])
    sensor = replace(SEER.sensor, residual_position_sigma=0.01, residual_heading_sigma=0.02)
    seers = SWARM, replace(SWARM, robots=(replace(SEER, sensor=sensor), SWARM.robots[1]))
    plain, more = (measured_of(swarm, np.full(2, T0), joined([known, unknown])).covariance for swarm in seers)
    np.testing.assert_allclose(more[0] - plain[0], np.diag([1e-4, 1e-4, 4e-4]), atol=1e-15)
    np.testing.assert_array_equal(more[1], plain[1])


@pytest.mark.parametrize("target", [-1, 1])
def test_relative_motion_is_the_rate_of_what_is_predicted(target: int) -> None:
    """Robots drive arcs, with base_link ahead of the axle; rates against differences of predictions."""
    models = (OdometryModel(axle_offset=0.02, course_offset=0.1), OdometryModel(turn_scale=1.1))
    tracks = OdometryTracks([Robot(f"r{i}", odometry=model) for i, model in enumerate(models)])
    stamps = T0 + 10_000_000 * np.arange(300)
    for robot, (path, turn) in enumerate([(0.002, 0.011), (-0.001, -0.02)]):
        heading = turn * np.arange(300) + robot
        steps = path * np.column_stack([np.cos(heading + 0.5 * turn), np.sin(heading + 0.5 * turn)])
        place = np.cumsum(np.vstack([[[0.3, -0.8]], steps[:-1]]), axis=0)
        tracks.extend(np.full(300, robot), stamps, np.column_stack([place, heading]))
    one = Measurements.empty(1)
    one.observer[:], one.target[:], one.has_heading[:] = 0, target, True
    one.sensor[:], one.marker[:] = [0.04, 0.01, 0.2], [0.5, 0.3, -1.0]
    one.stamp_ns[:], one.stamp_variance[:] = T0 + 1_504_000_000, 1.0

    def predicted(shift_ns: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        now = one.stamp_ns + shift_ns
        poses = np.vstack([tracks.at(np.array([robot]), now).pose for robot in (0, 1)])
        value, jacobian = predict(one, poses[:1], poses[1:])
        return value[0], jacobian[0], poses

    motion = np.empty(3)
    _, jacobian, poses = predicted(0)
    relative_motion(one, 0, tracks.arrays, poses, motion)
    rate = wrapped((predicted(2_000_000)[0] - predicted(-2_000_000)[0])[None])[0] / 0.004
    np.testing.assert_allclose(jacobian[:, :3] @ motion, rate, rtol=0.01, atol=2e-3)
    one.stamp_variance[:] = 0.0
    relative_motion(one, 0, tracks.arrays, poses, motion)
    assert (motion == 0.0).all()


def test_a_robot_whose_motion_is_unknown_gives_no_rate() -> None:
    tracks = OdometryTracks([SEER])
    one = Measurements.empty(1)
    one.observer[:], one.target[:], one.stamp_variance[:], one.stamp_ns[:] = 0, NOBODY, 1.0, T0
    motion = np.full(3, np.nan)
    relative_motion(one, 0, tracks.arrays, np.zeros((2, 3)), motion)
    assert (motion == 0.0).all()  # nothing has come
    tracks.extend(
        np.zeros(2, np.int64), np.array([T0, T0 + SECOND // 10]), np.array([[0.0] * 3, [0.1, 0, 0]])
    )
    for after_s, expected in ((-1.0, 0.0), (0.05, -1.0), (0.3, -1.0), (5.0, 0.0)):
        one.stamp_ns[:] = T0 + round(after_s * SECOND)
        relative_motion(one, 0, tracks.arrays, np.zeros((2, 3)), motion)
        np.testing.assert_allclose(motion, [expected, 0.0, 0.0], atol=1e-9)


def mean_errors(world: World, swarm: Swarm, settings: Settings) -> tuple[FloatArray, float]:
    """NEES (N,) of each robot over time, and the mean squared error of positions [m^2]."""
    end_ns = int(world.stamp_ns[-1])
    estimates = play(Estimator(swarm, settings), on_time(world), ticks(T0, end_ns, 1.0))
    error = errors(world, estimates)[2:]
    squared: FloatArray = nees(error, np.array([one.covariances for one in estimates])[2:]).mean(axis=0)
    return squared, float(np.nanmean(error[..., :2] ** 2))


@pytest.mark.parametrize("many", [5, 1000])
def test_errors_are_admitted_where_stamps_err_and_who_trusts_them_errs_more(many: int) -> None:
    """Who trusts them doubts the whole description at last, which makes for large covariances."""
    settings = Settings(policy=Policy(large_from=1, batch_from=many))
    knowing, trusting = [], []
    for seed in range(12):
        rng = np.random.default_rng([seed, 7])
        world = simulate(Plan(3, 8.0, speed=0.4, turn_rate=1.5, reach=1.5), 400 + seed)
        events = [
            one
            if one.pose is not None
            else replace(one, stamp_ns=one.stamp_ns + round(rng.normal(0.0, TIME_SIGMA_S) * SECOND))
            for one in world.events
        ]
        world = replace(world, events=tuple(events))
        knowing.append(mean_errors(world, with_time_sigma(world.swarm, TIME_SIGMA_S), settings))
        trusting.append(mean_errors(world, world.swarm, settings))
    squared = np.array([one for one, _ in knowing])
    assert np.mean(squared) < chi2.ppf(1.0 - 1e-4, 3 * squared.size) / squared.size
    assert np.mean([error for _, error in trusting]) > 1.5 * np.mean([error for _, error in knowing])
