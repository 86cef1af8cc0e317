"""Surveying landmarks, cameras, anchors: places and covariances against the truth; lone parts, sentences."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core_messages import detection, joined
from core_run import covariance_of_places, recording_of
from core_world import Plan, World, simulate
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.cli import survey as command
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.batch.problem import SURVEY, problem_of
from swarm_loc_estimator.offline.batch.solver import Solver
from swarm_loc_estimator.offline.batch.start import start_of
from swarm_loc_estimator.offline.calibration.recording import (
    CalibrationError,
    Recording,
    read_recording,
    rerun,
)
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.survey.survey import Placed, place_fixed, survey
from swarm_loc_estimator.sensors.camera import FROM_OPTICAL, NO_DETECTIONS, DetectionRows
from swarm_loc_estimator.sensors.imu import NO_TURN_RATES, TurnRateRows
from swarm_loc_estimator.sensors.odometry import NO_ODOMETRY
from swarm_loc_estimator.sensors.ranges import RangeRows
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival
from swarm_loc_estimator.swarm.error_models import ImuModel
from swarm_loc_estimator.swarm.swarm import (
    Anchor,
    Face,
    FixedCamera,
    Landmark,
    MapError,
    Robot,
    StartSigma,
    Swarm,
    UwbDevice,
)
from swarm_loc_estimator.swarm.swarm_file import load_swarm

PLAN = Plan(robots=3, duration_s=25.0, arena=0.8, landmarks=8, start_known=(False,))
BAGS = Path(__file__).parents[3] / "bags"


def unplaced(swarm: Swarm) -> Swarm:
    return replace(swarm, landmarks=())


def places_of(swarm: Swarm) -> Mapping[int, FloatArray]:
    return {mark.id: np.array([mark.x, mark.y, mark.yaw or 0.0]) for mark in swarm.landmarks}


def errors(found: Swarm, true: Swarm) -> FloatArray:
    poses, truth = places_of(found), places_of(true)
    a, b = (np.array([one[marker_id] for marker_id in sorted(truth)]) for one in (poses, truth))
    error: FloatArray = se2.compose(se2.rigid_fit(a[:, :2], b[:, :2]), a) - b
    error[:, 2] = se2.wrap_angle(error[:, 2])
    return error


def rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("content", [1, 2])
def test_landmarks_are_found_from_nothing(seed: int, content: int) -> None:
    """By ranges and bearings, and by poses; the robots do not know where they start."""
    world = simulate(replace(PLAN, content=content), seed)
    done = survey(recording_of(world), unplaced(world.swarm))
    assert rms(errors(done.swarm, world.swarm)) < 0.02
    assert "The origin is the first pose of one robot" in done.text
    first = done.path[np.flatnonzero(np.abs(done.path).max(axis=1) < 1e-3)]
    assert len(first)  # the pose that is the origin


def test_without_noise_they_are_exact() -> None:
    world = simulate(replace(PLAN, noise=0.0), 0)
    done = survey(recording_of(world), unplaced(world.swarm))
    assert rms(errors(done.swarm, world.swarm)) < 1e-4


def test_errors_are_within_the_covariances() -> None:
    """With one robot's start known exactly, errors are those in its frame."""
    squares = []
    for seed in range(6):
        world = simulate(PLAN, seed)
        done = survey(recording_of(world), located_start(world))
        ids = [mark.id for mark in done.problem.swarm.landmarks]
        truth = places_of(world.swarm)
        for index, marker_id in enumerate(ids):
            error = done.solution.landmark[index] - truth[marker_id]
            error[2] = se2.wrap_angle(error[2])
            squares.append(error @ np.linalg.solve(done.solution.landmark_covariance[index], error))
    # 3 is ideal; less, since cameras and odometry are exact here, which the survey does not know
    assert 0.3 < np.mean(squares) < 4.5


def test_cameras_and_odometry_are_corrected() -> None:
    world = simulate(replace(PLAN, lasting=1.0, duration_s=40.0), 2)
    exact = tuple(
        replace(
            robot,
            odometry=replace(
                robot.odometry, distance_scale_sigma=0.0, turn_scale_sigma=0.0, turn_bias_sigma=0.0
            ),
        )
        for robot in world.swarm.robots
    )
    known = world.swarm.landmarks[::4]  # two opposite ones give the scale
    done = survey(recording_of(world), replace(world.swarm, robots=exact, landmarks=known))
    assert "Corrected for robot_" in done.text
    assert rms(errors(done.swarm, world.swarm)) < 0.03


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("known", [0, 1])
def test_the_map_of_cameras_with_another_range_curve_is_right_within_its_covariance(
    seed: int, known: int
) -> None:
    """Cameras whose ranges r are .87 r + .27 m, and wheels that are all off by 2 %."""
    plan = replace(PLAN, duration_s=60.0, arena=2.0, landmarks=12, content=1, reach=5.0, speed=0.2)
    world = simulate(plan, seed)
    recording = recording_of(world)
    seen = recording.detections._replace(detection=recording.detections.detection.copy())
    distance = np.linalg.norm(seen.detection["position"], axis=1)
    seen.detection["position"] *= ((distance - 0.27) / 0.87 / distance)[:, None]
    driven = recording.odometry._replace(pose=recording.odometry.pose * [1.02, 1.02, 1.0])
    known_ones = replace(located_start(world), landmarks=world.swarm.landmarks[:known])
    far = select(seen, distance > 0.37)
    done = survey(replace(recording, detections=far, odometry=driven), known_ones)
    # errors of the scale and of all places, with the covariance that is written
    marks, truth = done.swarm.landmarks[known:], places_of(world.swarm)
    place = np.array([truth[mark.id][:2] for mark in marks])
    error = np.array([(mark.x, mark.y) for mark in marks]) - place
    covariance = covariance_of_places(replace(done.swarm, landmarks=marks))
    away = (place - place.mean(axis=0)).ravel()
    sigma = np.sqrt(away @ covariance @ away)
    assert abs(away @ error.ravel()) < 3.0 * sigma
    assert sigma / (away @ away) < (0.02, 0.006)[known]
    assert error.ravel() @ np.linalg.solve(covariance, error.ravel()) < 4.0 * len(marks)


def test_all_places_with_a_sigma_share_an_error_in_the_filter() -> None:
    """Landmarks, anchors and cameras are moved, turned and stretched as one; what is exact stays."""
    marks = (Landmark(1, 1.0, 0.0, position_sigma=0.1), Landmark(2, 2.0, 3.0, yaw_sigma=0.2))
    swarm = Swarm((Robot("a"),), marks, (FixedCamera("c", -1.0, 2.0, 2.5, position_sigma=0.1),))
    swarm = replace(swarm, anchors=(Anchor(7, 0.0, -2.0, position_sigma=0.1),))
    swarm = replace(swarm, map_error=MapError(0.5, -0.3, 0.02, 0.03, 0.05))
    away = np.array([(one.x - 0.5, one.y + 0.3) for one in swarm.surveyed])
    shift, turn, scale = np.tile(np.eye(2), (len(away), 1)), away @ [[0.0, 1.0], [-1.0, 0.0]], away
    by = np.column_stack([0.02 * shift, 0.03 * turn.ravel(), 0.05 * scale.ravel()])
    is_exact = np.repeat([one.position_sigma == 0.0 for one in swarm.surveyed], 2)
    by[is_exact] = 0.0
    own = np.diag(np.where(is_exact, 1e-8, 0.01))
    assert covariance_of_places(swarm) == pytest.approx(by @ by.T + own, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_described_places_that_share_an_error_move_as_one(seed: int) -> None:
    """All are turned by 4 deg and 2 % too far apart, known to a millimetre beside that; a start is right."""
    world = simulate(PLAN, seed)
    wrong = tuple(
        replace(one, x=1.02 * x, y=1.02 * y, yaw=(one.yaw or 0.0) + 0.07, position_sigma=1e-3, yaw_sigma=1e-3)
        for one in world.swarm.landmarks
        for x, y in [se2.transform_points(np.array([0.0, 0.0, 0.07]), np.array([[one.x, one.y]]))[0].tolist()]
    )
    off, truth = [], places_of(world.swarm)
    for error in (MapError(), MapError(yaw_sigma=0.05, scale_sigma=0.02)):
        swarm = replace(located_start(world), landmarks=wrong, map_error=error)
        found = places_of(survey(recording_of(world), swarm).swarm)
        off.append(max(np.hypot(*(found[i] - truth[i])[:2]) for i in truth))
    assert off[1] < 0.02
    assert off[0] > 2.0 * off[1]


@pytest.mark.parametrize("bag", ["eight_five_robots", "eight_five_robots_w2"])
def test_a_replay_in_a_surveyed_map_is_as_good_as_it_says(bag: str) -> None:
    """In the frame of the first pose of one robot, to whose heading all landmarks are turned alike."""
    swarm = load_swarm(BAGS / bag / "swarm.yaml")
    nobody = tuple(replace(robot, start=None) for robot in swarm.robots)
    recording = read_recording(BAGS / bag, Swarm(nobody))
    done = survey(recording, Swarm(nobody))
    # the frame
    knots = done.problem.knots
    (origin,) = np.flatnonzero(np.linalg.norm(done.path, axis=1) < 1e-4)
    first = recording.truth[swarm.robots[knots.robot[origin]].name]
    frame, known = interpolate(first, knots.stamp_ns[[origin]], DEFAULT_GAP_NS)
    assert known.all()
    # poses after the first seconds
    result, squares = rerun(recording, done.swarm, 0.5), []
    for index, robot in enumerate(swarm.robots):
        pose, known = interpolate(recording.truth[robot.name], result.stamp_ns, DEFAULT_GAP_NS)
        kept = known & (result.stamp_ns - result.stamp_ns[0] > 10_000_000_000)
        error = result.poses[kept, index] - se2.compose(se2.inverse(frame[0]), pose[kept])
        error[:, 2] = se2.wrap_angle(error[:, 2])
        squares.append(nees(error, result.covariances[kept, index]))
    assert 0.3 < np.mean(squares) < 4.0


def test_wrong_ids_change_little() -> None:
    world = simulate(replace(PLAN, duration_s=40.0), 1)
    recording = recording_of(world)
    clean = rms(errors(survey(recording, unplaced(world.swarm)).swarm, world.swarm))
    rng, rows = np.random.default_rng(0), recording.detections.detection.copy()
    wrong = rng.uniform(size=rows.size) < 0.1
    rows["id"][wrong] = rng.choice(np.unique(rows["id"]), int(wrong.sum()))
    spoilt = replace(recording, detections=recording.detections._replace(detection=rows))
    done = survey(spoilt, unplaced(world.swarm))
    assert rms(errors(done.swarm, world.swarm)) < 1.5 * clean + 0.002
    of_landmarks = done.problem.sightings.landmark >= 0
    assert 0.04 < np.mean(done.solution.weight[of_landmarks] < 0.1) < 0.16


def test_described_landmarks_give_the_frame_and_stay() -> None:
    world = simulate(PLAN, 3)
    known = world.swarm.landmarks[:2]
    done = survey(recording_of(world), replace(world.swarm, landmarks=known))
    assert done.swarm.landmarks[:2] == known
    found, truth = places_of(done.swarm), places_of(world.swarm)
    assert max(np.hypot(*(found[i] - truth[i])[:2]) for i in truth) < 0.06
    assert "The frame is that of the 2 described landmarks" in done.text


def test_what_is_rare_or_lone_is_named_with_a_remedy() -> None:
    world = simulate(replace(PLAN, robots=2), 0)
    recording = recording_of(world)
    rows = recording.detections
    ids, robot = rows.detection["id"], rows.robot
    mine, yours = (1000, 1001, 1002, 1003), (1004, 1005, 1006, 1007)
    apart = np.where(robot == 0, np.isin(ids, mine), np.isin(ids, yours))
    apart[np.flatnonzero((ids == 1007) & apart)[3:]] = False
    seen = select(rows, apart)
    done = survey(replace(recording, detections=seen), unplaced(world.swarm))
    assert "Marker 1007 was seen 3 x only and is left out; drive past it." in done.text
    assert "cannot be placed: nothing connects them with the others" in done.text
    assert len(done.swarm.landmarks) in {3, 4}


def test_a_robot_that_takes_no_part_or_stands_costs_nothing() -> None:
    """Without the odometry of the first robot, and with one that has none, those of others are used."""
    world = simulate(PLAN, 0)
    recording = recording_of(world)
    rows, seen = recording.odometry, recording.detections
    absent = replace(
        recording, odometry=select(rows, rows.robot > 0), detections=select(seen, seen.robot > 0)
    )
    first, *others = world.swarm.robots
    for robot in (first, replace(first, stands=True)):
        swarm = replace(world.swarm, robots=(robot, *others), landmarks=())
        done = survey(absent, swarm)
        assert not (done.problem.sides[done.problem.sightings.landmark < 0] < 0).any()
        assert rms(errors(done.swarm, world.swarm)) < 0.02
    standing = replace(world.swarm, robots=(replace(first, stands=True), *others), landmarks=())
    done = survey(replace(absent, detections=seen), standing)  # what it sees has no pose to start from
    assert rms(errors(done.swarm, world.swarm)) < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_wheels_that_turn_by_a_sixth_too_little_are_found(seed: int) -> None:
    """Frames of odometry then turn by radians, while each step of them is known to a thousandth."""
    world = simulate(replace(PLAN, duration_s=60.0), seed)
    robots = tuple(
        replace(robot, odometry=replace(robot.odometry, turn_scale=0.85)) for robot in world.swarm.robots
    )
    done = survey(recording_of(world), replace(world.swarm, robots=robots, landmarks=()))
    assert rms(errors(done.swarm, world.swarm)) < 0.01
    found = [robot.odometry.turn_scale for robot in done.swarm.robots]
    assert found == pytest.approx([1.0] * len(found), abs=0.02)


def test_an_inexact_landmark_that_nobody_saw_stays_as_it_is() -> None:
    world = simulate(PLAN, 3)
    unseen = Landmark(9999, 5.0, 5.0, position_sigma=0.02, yaw_sigma=0.1)
    done = survey(recording_of(world), replace(world.swarm, landmarks=(*world.swarm.landmarks[:2], unseen)))
    assert "Landmark 9999 was not seen and stays as it is described." in done.text
    kept = places_of(done.swarm)[9999]
    np.testing.assert_allclose(kept, [5.0, 5.0, 0.0], atol=1e-6)


def test_turns_of_gyroscopes_replace_those_of_wheels() -> None:
    """The wheels report no turn at all, and the gyroscopes 4 % too little."""
    world = simulate(replace(PLAN, duration_s=40.0), 2)
    recording = recording_of(world)
    rows, at_ns, robots = recording.odometry, world.stamp_ns, range(len(world.swarm.robots))
    straight = np.zeros_like(rows.pose)
    for robot in robots:
        own = rows.robot == robot
        straight[own, 0] = np.append(0.0, np.cumsum(np.hypot(*np.diff(rows.pose[own, :2], axis=0).T)))
    # constant rates between two instants of the truth, so that their integral is exact
    stamp_ns = np.tile(np.append(at_ns[:-1] + 1, at_ns[1:]), len(robots))
    true_rate = np.diff(np.unwrap(world.truth[..., 2], axis=0), axis=0) / np.diff(at_ns)[:, None] * 1e9
    rate = np.tile(true_rate, (2, 1)).T.ravel() / 1.04
    own = np.repeat(np.array(robots), 2 * len(true_rate))
    nothing = np.full((rate.size, 3), np.nan)
    turned = replace(
        recording,
        odometry=rows._replace(pose=straight),
        turn_rates=TurnRateRows(own, stamp_ns, nothing, rate, nothing, stamp_ns),
    )
    imu = ImuModel(turn_noise_density=1e-3, timeout_s=1.0)
    with_imu = tuple(replace(one, imu=imu) for one in world.swarm.robots)
    done = survey(turned, replace(world.swarm, robots=with_imu, landmarks=()))
    assert rms(errors(done.swarm, world.swarm)) < 0.02
    assert "imu.turn_scale 1.0000 -> 1.0" in done.text
    error = done.solution.parameter[:, 2] - 0.04
    assert (np.abs(error) < 3.0 * done.solution.parameter_sigma[:, 2]).all()
    assert [one.imu.turn_scale for one in done.swarm.robots] == pytest.approx([1.04] * 3, abs=0.03)
    by_gyroscopes = [replace(one.odometry, distance_scale_sigma=0.0) for one in done.swarm.robots]
    assert by_gyroscopes == [one.odometry for one in world.swarm.robots]
    by_wheels = survey(replace(turned, turn_rates=NO_TURN_RATES), replace(world.swarm, landmarks=()))
    assert rms(errors(by_wheels.swarm, world.swarm)) > 0.1


def test_what_cannot_be_surveyed_is_said_in_a_sentence() -> None:
    world = simulate(PLAN, 0)
    recording = recording_of(world)
    with pytest.raises(CalibrationError, match="no odometry"):
        survey(replace(recording, odometry=NO_ODOMETRY), world.swarm)
    with pytest.raises(CalibrationError, match="no marker that belongs to nobody"):
        survey(replace(recording, detections=NO_DETECTIONS), unplaced(world.swarm))


def test_the_gradient_is_that_of_the_cost() -> None:
    world = simulate(PLAN, 1)
    problem = problem_of(recording_of(world), unplaced(world.swarm), SURVEY)
    solver = Solver(problem, start_of(problem))
    solver.solve(lambda _share, _what: None)
    rng = np.random.default_rng(0)
    normal, _ = solver._normal(1e6)  # without weights
    solver._apply(rng.standard_normal(normal.gradient.size) / np.sqrt(normal.diagonal()))  # off the minimum
    normal, _ = solver._normal(1e6)
    step = 1e-3 * normal.gradient / normal.diagonal()
    before, cost = (solver._knot, solver._landmark, solver._parameter), []
    for sign in (1.0, -1.0):
        solver._apply(sign * step)
        cost.append(solver._normal(1e6)[1])
        solver._knot, solver._landmark, solver._parameter = before
    assert cost[0] - cost[1] == pytest.approx(-4.0 * normal.gradient @ step, rel=1e-2)


def test_the_command_surveys_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, out = BAGS / "eight_five_robots", tmp_path / "surveyed.yaml"
    assert command.main([str(bag), "--all", "--out", str(out)]) == 0
    assert f"{out} written" in capsys.readouterr().out
    assert len(load_swarm(out).landmarks) == 20
    assert out.with_suffix(".png").stat().st_size > 10_000
    true = load_swarm(bag / "swarm.yaml")
    assert rms(errors(load_swarm(out), true)) < 0.005


CEILING = FixedCamera("ceiling", 0.2, -0.1, 2.5, yaw=0.7, pitch=1.4, roll=0.1)
ANCHORS = (Anchor(0xA1, -3.0, 1.0, 2.0), Anchor(0xA2, 2.0, 3.0, 1.5))
RADIO = UwbDevice(0, x=0.02, z=0.08, range_bias=0.1, range_scale=1.01)


def located_start(world: World) -> Swarm:
    """The world without landmarks, but with a known start of the first robot, which gives the frame."""
    x, y, theta = world.truth[0, 0].tolist()
    first = replace(world.swarm.robots[0], start=(x, y, theta), start_sigma=StartSigma(1e-3, 1e-3, 1e-3))
    return replace(world.swarm, robots=(first, *world.swarm.robots[1:]), landmarks=())


def axes_of(camera: FixedCamera) -> FloatArray:
    matrix: FloatArray = Rotation.from_euler("ZYX", [camera.yaw, camera.pitch, camera.roll]).as_matrix()
    return matrix


def with_radios(swarm: Swarm) -> Swarm:
    robots = [replace(robot, uwb=replace(RADIO, address=k)) for k, robot in enumerate(swarm.robots, 1)]
    return replace(swarm, robots=tuple(robots))


def seen_from_above(world: World, rng: np.random.Generator, wrong: float = 0.0) -> DetectionRows:
    """What the camera at the ceiling sees: directions are good, distances are not."""
    turn = axes_of(CEILING) @ FROM_OPTICAL
    rows, robots = [], len(world.swarm.robots)
    for k in range(0, world.stamp_ns.size, 4):
        for robot, pose in zip(world.swarm.robots, world.truth[k], strict=True):
            face = robot.faces[0]
            place = np.append(se2.transform_points(pose, [face.x, face.y]), face.z)
            if rng.uniform() < wrong:
                place[:2] += rng.uniform(-1.0, 1.0, 2)
            optical = turn.T @ (place - [CEILING.x, CEILING.y, CEILING.z])
            optical[:2] += 0.002 * optical[2] * rng.standard_normal(2)
            one = detection(face.id, np.eye(4))
            one["position"] = optical * (1.05 + 0.02 * rng.standard_normal())
            rows.append((world.stamp_ns[k], one))
    at_ns = np.array([at for at, _ in rows])
    return DetectionRows(np.full(at_ns.size, robots), at_ns, joined([one for _, one in rows]), at_ns)


def measured_ranges(world: World, rng: np.random.Generator, wrong: float = 0.0) -> RangeRows:
    rows = []
    for k in range(0, world.stamp_ns.size, 2):
        for robot, pose in enumerate(world.truth[k]):
            antenna = np.append(se2.transform_points(pose, [RADIO.x, RADIO.y]), RADIO.z)
            for anchor in ANCHORS:
                true = float(np.linalg.norm(antenna - [anchor.x, anchor.y, anchor.z]))
                late = abs(rng.normal(0.0, 2.0)) if rng.uniform() < wrong else 0.0
                range_m = RADIO.range_scale * (true + late) + RADIO.range_bias + 0.05 * rng.standard_normal()
                rows.append((robot, world.stamp_ns[k], anchor.address, range_m))
    robots, at_ns, device, ranges = (np.array(column) for column in zip(*rows, strict=True))
    device = device.astype(np.uint64)
    return RangeRows(robots, at_ns, device, np.zeros_like(device), ranges, np.zeros(robots.size), at_ns)


@pytest.mark.parametrize("wrong", [0.0, 0.2])
@pytest.mark.parametrize("seed", range(2))
def test_a_fixed_camera_is_placed_by_the_robots_that_it_sees(seed: int, wrong: float) -> None:
    world, rng = simulate(PLAN, seed), np.random.default_rng(seed)
    recording = recording_of(world)
    above = seen_from_above(world, rng, wrong)
    recording = replace(recording, detections=in_order_of_arrival([recording.detections, above]))
    stale = FixedCamera("ceiling", 5.0, 5.0, 3.0)
    swarm = replace(located_start(world), cameras=(stale,))
    (found,) = survey(recording, swarm, cameras=True).swarm.cameras
    assert np.hypot(found.x - CEILING.x, found.y - CEILING.y) < 0.06
    assert abs(found.z - CEILING.z) < 0.06
    assert Rotation.from_matrix(axes_of(found) @ axes_of(CEILING).T).magnitude() < 0.03
    assert 1e-4 <= found.position_sigma < 0.02
    assert seed or wrong or survey(recording, swarm).swarm.cameras == (stale,)


@pytest.mark.parametrize("wrong", [0.0, 0.2])
@pytest.mark.parametrize("seed", range(2))
def test_anchors_are_placed_by_their_ranges(seed: int, wrong: float) -> None:
    world = simulate(replace(PLAN, duration_s=40.0), seed)
    ranges = measured_ranges(world, np.random.default_rng(seed), wrong)
    recording = replace(recording_of(world), ranges=ranges)
    swarm = with_radios(located_start(world))
    done = survey(recording, swarm)
    assert [one.address for one in done.swarm.anchors] == [0xA1, 0xA2]
    for one, true in zip(done.swarm.anchors, ANCHORS, strict=True):
        error = np.hypot(one.x - true.x, one.y - true.y)
        assert error < min(0.15, 5.0 * one.position_sigma + 0.02)
    assert "0xa1" in done.text
    known = replace(swarm, anchors=ANCHORS[:1])
    assert seed or wrong or survey(recording, known).swarm.anchors[0] == ANCHORS[0]


def test_what_was_measured_rarely_is_named() -> None:
    world = simulate(PLAN, 0)
    ranges = measured_ranges(world, np.random.default_rng(0))
    recording = replace(recording_of(world), ranges=select(ranges, np.arange(40)))
    swarm = replace(with_radios(world.swarm), landmarks=(), cameras=(CEILING,))
    done = survey(recording, swarm, cameras=True)
    assert "Anchor 0xa1 was measured 20 x only and is left out; drive near it." in done.text
    assert (
        "Camera ceiling stays as it is described: it has seen robots whose paths are known 0 x" in done.text
    )
    assert done.swarm.cameras == (CEILING,)
    assert not done.swarm.anchors


COUNT = 400
WALL = FixedCamera("wall", -3.0, 0.0, 1.5, pitch=0.45)
HIGH, LOW = Anchor(2**64 - 1, 2.0, 3.0, 1.5), Anchor(2**63, 1.0, 3.0, 0.08)
TAG = UwbDevice(1, z=0.08)
PLACES = {
    "line": np.column_stack([np.linspace(-2.0, 2.0, COUNT), np.zeros(COUNT)]),
    "place": np.tile([0.3, 0.2], (COUNT, 1)),
    "floor": np.random.default_rng(9).uniform(-1.5, 1.5, (COUNT, 2)),
    "corridor": np.random.default_rng(9).uniform([-5.0, -0.4], [5.0, 0.4], (COUNT, 2)),
}


def placed(
    where: str, *, camera: FixedCamera = CEILING, anchor: Anchor = HIGH, stamps: int = COUNT, seed: int = 0
) -> Placed:
    """What a robot tells that was at known places, whose path has errors of 5 mm."""
    rng = np.random.default_rng(seed)
    true = PLACES[where]
    stamp_ns = 10**18 + np.sort(np.arange(COUNT) % stamps) * 10**8
    face = Face("top", 7, z=0.08)
    found = np.column_stack([true + 0.005 * rng.standard_normal(true.shape), np.zeros(COUNT)])

    def at(_: IntArray, at_ns: IntArray) -> FloatArray:
        assert np.array_equal(at_ns, stamp_ns)
        return found

    top = np.column_stack([true, np.full(COUNT, 0.08)])
    optical = (top - [camera.x, camera.y, camera.z]) @ axes_of(camera) @ FROM_OPTICAL
    optical[:, :2] += 0.002 * optical[:, 2:] * rng.standard_normal((COUNT, 2))
    seen = joined([detection(face.id, np.eye(4)) for _ in range(COUNT)])
    seen["position"] = optical
    distance = np.linalg.norm(top - [anchor.x, anchor.y, anchor.z], axis=1)
    none = np.zeros(COUNT, dtype=np.uint64)
    recording = Recording(
        "bag",
        NO_ODOMETRY,
        DetectionRows(np.ones(COUNT, dtype=np.int64), stamp_ns, seen, stamp_ns),
        {},
        ranges=RangeRows(
            np.zeros(COUNT, dtype=np.int64),
            stamp_ns,
            none + np.uint64(anchor.address),
            none,
            distance + 0.05 * rng.standard_normal(COUNT),
            np.zeros(COUNT),
            stamp_ns,
        ),
    )
    swarm = Swarm((Robot("a", faces=(face,), uwb=TAG),), cameras=(camera,))
    return place_fixed(recording, swarm, at, cameras=True)


@pytest.mark.parametrize("where", ["line", "place"])
@pytest.mark.parametrize(("camera", "anchor"), [(CEILING, HIGH), (WALL, LOW)])
def test_robots_on_a_line_or_at_one_place_place_nothing(
    where: str, camera: FixedCamera, anchor: Anchor
) -> None:
    """All that is turned about this line fits as well."""
    found = placed(where, camera=camera, anchor=anchor)
    assert found.cameras == (camera,)
    assert not found.anchors
    assert [one.partition(", since other places fit as well")[0] for one in found.remarks] == [
        f"Camera {camera.name} stays as it is described",
        f"Anchor {anchor.address:#x} is left out",
    ]


@pytest.mark.parametrize("stamps", [1, COUNT])
def test_errors_are_within_the_sigmas_however_few_the_stamps(stamps: int) -> None:
    """An image of many robots has one stamp."""
    squares = []
    for seed in range(4):
        found = placed("floor", stamps=stamps, seed=seed)
        (one,), (seen,) = found.anchors, found.cameras
        assert np.linalg.norm([seen.x - CEILING.x, seen.y - CEILING.y, seen.z - CEILING.z]) < 0.02
        squares.append(np.hypot(one.x - HIGH.x, one.y - HIGH.y) ** 2 / one.position_sigma**2)
    assert 0.5 < np.mean(squares) < 6.0  # 2 is ideal


def test_an_anchor_beside_a_corridor_is_placed() -> None:
    """Its other side is told by less than a tenth of the length."""
    (one,) = placed("corridor").anchors
    assert np.hypot(one.x - HIGH.x, one.y - HIGH.y) < 0.1
