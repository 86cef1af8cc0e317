"""Smoothing: Jacobians, errors and covariances against the truth, recordings without a solution."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core_geometry import homogeneous, marker_frame, seen, slopes_of
from core_messages import detection, joined
from core_run import recording_of
from core_world import Plan, World, simulate

from swarm_loc_estimator import replay, smooth
from swarm_loc_estimator.cli import replay as command
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.batch.normal import ChainEquations
from swarm_loc_estimator.offline.batch.problem import SURVEY, BatchProblem, opened, problem_of
from swarm_loc_estimator.offline.batch.smooth import (
    SmoothError,
    covariances_at,
    smooth_recording,
    with_lasting_errors,
)
from swarm_loc_estimator.offline.batch.solver import Solver
from swarm_loc_estimator.offline.batch.start import Start, on_paths
from swarm_loc_estimator.offline.calibration.recording import Recording, rerun
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.offline.replay import PeriodicSchedule, Runner
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.camera import NO_DETECTIONS, DetectionRows
from swarm_loc_estimator.sensors.fix import FixRows
from swarm_loc_estimator.sensors.imu import TurnRateRows
from swarm_loc_estimator.sensors.ranges import RangeRows
from swarm_loc_estimator.swarm.error_models import ImuModel
from swarm_loc_estimator.swarm.swarm import Anchor, CameraMount, FixedCamera, Swarm, UwbDevice
from swarm_loc_estimator.timeline.estimate import Status
from swarm_loc_estimator.timeline.estimator import Estimator

BAGS = Path(__file__).parents[3] / "bags"
PLAN = Plan(robots=3, duration_s=16.0, start_known=(False,))
WALL = FixedCamera("wall", -2.6, 0.0, 1.2, pitch=0.45, position_sigma=0.001, yaw_sigma=0.001)
ANCHORS = tuple(
    Anchor(100 + k, 2.0 * x, 2.0 * y, 0.5, position_sigma=0.001, range_bias_sigma=0.002)
    for k, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1)))
)
FIX_SIGMA = np.array([0.01, 0.01, 0.03])
RANGE_SIGMA = 0.03
Setup = Callable[[World, int], tuple[Recording, Swarm]]


def with_sightings(world: World, _seed: int) -> tuple[Recording, Swarm]:
    return recording_of(world), world.swarm


def with_fixes(world: World, seed: int) -> tuple[Recording, Swarm]:
    """Fixes five times a second, with headings, and nothing else."""
    rng = np.random.default_rng([seed, 7])
    recording, rows = without_cameras(world), np.arange(0, world.stamp_ns.size, 4)
    robots = np.repeat(np.arange(len(world.swarm.robots)), rows.size)
    stamps = np.tile(world.stamp_ns[rows], len(world.swarm.robots))
    pose = world.truth[rows].transpose(1, 0, 2).reshape(-1, 3)
    noisy = pose + FIX_SIGMA * rng.standard_normal(pose.shape)
    covariance = np.tile(np.diag(FIX_SIGMA**2), (len(noisy), 1, 1))
    order = np.argsort(stamps, kind="stable")
    fixes = select(FixRows(robots, stamps, noisy, covariance, stamps), order)
    return replace(recording, fixes=fixes), world.swarm


def with_ranges(world: World, seed: int) -> tuple[Recording, Swarm]:
    """Ranges to four anchors and to each other, five times a second."""
    rng = np.random.default_rng([seed, 8])
    radios = [
        UwbDevice(1 + k, x=0.05, z=0.1, range_sigma=RANGE_SIGMA) for k in range(len(world.swarm.robots))
    ]
    anchors = tuple(
        replace(
            one,
            x=one.x + one.position_sigma * float(rng.standard_normal()),
            y=one.y + one.position_sigma * float(rng.standard_normal()),
            range_bias=one.range_bias_sigma * float(rng.standard_normal()),
        )
        for one in ANCHORS
    )
    rows = []
    for k in range(0, world.stamp_ns.size, 4):
        poses = world.truth[k]
        ahead = [se2.transform_points(pose, np.array([[0.05, 0.0]]))[0].tolist() for pose in poses]
        places = [(x, y, 0.1) for x, y in ahead]
        for robot, own in enumerate(places):
            others = [(a.address, (a.x, a.y, a.z), a.range_bias) for a in anchors]
            others += [(1 + j, place, 0.0) for j, place in enumerate(places) if j != robot]
            for address, place, bias in others:
                length = float(np.linalg.norm(np.subtract(place, own))) + bias
                rows.append((robot, int(world.stamp_ns[k]), address, length))
    robots, stamps, device, value = (np.array(column) for column in zip(*rows, strict=True))
    none = np.zeros(robots.size, dtype=np.uint64)
    value = value + RANGE_SIGMA * rng.standard_normal(value.size)
    ranges = RangeRows(robots, stamps, device.astype(np.uint64), none, value, np.zeros(value.size), stamps)
    described = tuple(replace(one, uwb=radio) for one, radio in zip(world.swarm.robots, radios, strict=True))
    swarm = replace(world.swarm, robots=described, anchors=ANCHORS)
    return replace(without_cameras(world), ranges=ranges), swarm


def with_wall_camera(world: World, seed: int) -> tuple[Recording, Swarm]:
    """A fixed camera that sees the faces turned to it; it hangs a little elsewhere than described."""
    rng = np.random.default_rng([seed, 9])
    x, y, yaw = (
        np.array([WALL.x, WALL.y, WALL.yaw])
        + np.array([WALL.position_sigma] * 2 + [WALL.yaw_sigma]) * rng.standard_normal(3)
    ).tolist()
    mount = CameraMount(x=x, y=y, z=WALL.z, yaw=yaw, pitch=WALL.pitch)
    found, stamps = [], []
    for k in range(0, world.stamp_ns.size, 3):
        for robot, pose in zip(world.swarm.robots, world.truth[k], strict=True):
            for face in robot.faces:
                frame = homogeneous(pose[0], pose[1], 0.0, pose[2]) @ marker_frame(
                    face.x, face.y, face.z, face.yaw or 0.0
                )
                relative = seen(np.zeros(3), mount, frame)
                if relative[:3, 2] @ relative[:3, 3] > -0.3 * np.linalg.norm(relative[:3, 3]):
                    continue
                level = homogeneous(0, 0, 0, 0, WALL.pitch)[:3, :3] @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
                place = level @ relative[:3, 3]
                place[:2] += [0.02, 0.01] * rng.standard_normal(2)
                turn = homogeneous(0, 0, 0, 0.1 * rng.standard_normal())[:3, :3]
                relative[:3, 3] = level.T @ place
                relative[:3, :3] = level.T @ turn @ level @ relative[:3, :3]
                found.append(detection(face.id, relative))
                stamps.append(int(world.stamp_ns[k]))
    at_ns = np.array(stamps)
    camera = replace(
        WALL, sensor=replace(WALL.sensor, forward_sigma=0.02, left_sigma=0.01, heading_sigma=0.1)
    )
    rows = DetectionRows(np.full(at_ns.size, len(world.swarm.robots)), at_ns, joined(found), at_ns)
    swarm = replace(world.swarm, cameras=(camera,))
    return replace(recording_of(world), detections=rows), swarm


def without_cameras(world: World) -> Recording:
    return replace(recording_of(world), detections=NO_DETECTIONS)


ALL: dict[str, Setup] = {
    "sightings": with_sightings,
    "fixes": with_fixes,
    "ranges": with_ranges,
    "fixed camera": with_wall_camera,
}


def everything(world: World, seed: int) -> tuple[Recording, Swarm]:
    parts = {name: setup(world, seed) for name, setup in ALL.items()}
    robots = parts["ranges"][1].robots
    detections = [parts[name][0].detections for name in ("sightings", "fixed camera")]
    joint = DetectionRows(
        np.concatenate([one.robot for one in detections]),
        np.concatenate([one.stamp_ns for one in detections]),
        joined([one.detection for one in detections]),
        np.concatenate([one.arrival_ns for one in detections]),
    )
    swarm = replace(world.swarm, robots=robots, anchors=ANCHORS, cameras=parts["fixed camera"][1].cameras)
    recording = replace(parts["fixes"][0], ranges=parts["ranges"][0].ranges, detections=joint)
    return recording, swarm


def at_truth(problem: BatchProblem, world: World) -> Start:
    paths = recording_of(world).truth
    nowhere = np.full((len(problem.swarm.robots), 3), np.nan)
    marks = [(one.x, one.y, one.yaw or 0.0) for one in problem.swarm.landmarks]
    marks += [(0.0, 0.0, 0.0)] * (len(problem.swarm.surveyed) - len(marks))
    return Start(nowhere, np.array(marks).reshape(-1, 3), on_paths(problem, paths, nowhere))


class Collected(ChainEquations):
    """Equations that keep residuals and a dense Jacobian."""

    def __init__(self, size: int) -> None:
        super().__init__(size, size - 1, 0)
        self.residuals: list[FloatArray] = []
        self.rows: list[FloatArray] = []

    def add(self, jacobian: FloatArray, columns: IntArray, residual: FloatArray) -> None:
        """Keep them."""
        dense = np.zeros((*residual.shape, self.gradient.size + 1))
        for row, (by, unknowns) in enumerate(zip(jacobian, columns, strict=True)):
            np.add.at(dense[row].T, unknowns, by.T)  # -1, fixed, is the last one
        self.residuals.append(residual.ravel())
        self.rows.append(dense.reshape(-1, dense.shape[2])[:, :-1])


@pytest.mark.parametrize("off", [0.0, 0.003])
def test_jacobians_are_those_of_finite_differences(off: float) -> None:
    """Of sightings, fixes and ranges by poses, places, parameters and drifts; and of steps without slip."""
    world = simulate(replace(PLAN, robots=2, duration_s=1.0, lasting=1.0, survey=1.0, content=1), 3)
    recording, swarm = everything(world, 3)
    problem = problem_of(recording, swarm, SURVEY, is_described=True)
    assert set(np.unique(problem.sightings.model).tolist()) == {0, 1, 10}
    problem = replace(problem, slip=np.zeros_like(problem.slip))  # whitening is constant, then
    start = at_truth(problem, world)
    assert start.knot is not None
    first = np.searchsorted(problem.knots.robot, problem.knots.robot)
    solver = Solver(problem, replace(start, knot=start.knot[first]))
    solver._is_rigid = False
    size = solver._size
    solver._apply(off * np.random.default_rng(0).standard_normal(size))
    state = solver._knot, solver._landmark, solver._parameter, solver._drift

    def evaluated(step: FloatArray) -> Collected:
        solver._knot, solver._landmark, solver._parameter, solver._drift = state
        solver._apply(step)
        found = Collected(size)
        residual, jacobian, columns = solver._sightings()
        found.add(jacobian, columns, residual)
        solver._add_priors(found)
        if off == 0.0:  # else of second order, as the frame of a step's noise moves
            solver._add_odometry(found)
        return found

    here = evaluated(np.zeros(size))
    jacobian = np.concatenate(here.rows)
    slopes = slopes_of(lambda step: np.concatenate(evaluated(step).residuals), size)
    for column, slope in zip(jacobian.T, slopes.T, strict=True):
        # the growth of noise with a corrected distance is linearized, too
        np.testing.assert_allclose(column, slope, atol=0.02 * max(1.0, np.abs(slope).max()))
    assert off > 0.0 or np.abs(jacobian).max(axis=0).min() > 0.1


def test_a_drift_of_the_turn_rate_is_that_of_the_track() -> None:
    world = simulate(replace(PLAN, robots=1, lasting=1.0), 1)
    recording, swarm = with_sightings(world, 1)
    (bias,) = [one for one in SURVEY if (one.section, one.name) == ("odometry", "turn_bias")]
    problem = problem_of(recording, swarm, (bias,), is_described=True)
    assert problem.drift is not None
    by_difference = problem.by_parameter.knots[:, :, 0]
    np.testing.assert_allclose(problem.drift.turn, by_difference, atol=0.01 * np.abs(by_difference).max())


def run(recording: Recording, swarm: Swarm) -> ReplayResult:
    """The online poses by all inputs."""
    runner = Runner(Estimator(swarm), PeriodicSchedule(100_000_000))
    runner.take(
        replace(recording.messages, rows={**recording.messages.rows, "fixes": recording.fixes})
        if recording.fixes.robot.size
        else recording.messages
    )
    runner.finish(recording.range_ns[1])
    return runner.result(recording.name, recording.range_ns, recording.truth, {})


def errors_of(result: ReplayResult, world: World) -> tuple[FloatArray, FloatArray]:
    """Errors (k, 3) and their covariances, each second from the third on."""
    rows = np.flatnonzero(result.stamp_ns % 1_000_000_000 == 0)[3:-1]
    true = world.truth[np.searchsorted(world.stamp_ns, result.stamp_ns[rows])]
    error = (result.poses[rows] - true).reshape(-1, 3)
    error[:, 2] = se2.wrap_angle(error[:, 2])
    return error, result.covariances[rows].reshape(-1, 3, 3)


@pytest.mark.parametrize(
    ("sensor", "least"), [*((one, 0.8) for one in ALL if one != "ranges"), ("ranges", 0.3)]
)
def test_poses_are_better_than_online_ones_and_as_good_as_they_say(sensor: str, least: float) -> None:
    """With unknown starts; of each sensor alone. Half of the variance of ranges is taken as repeated."""
    online_squares, squares, normalized = [], [], []
    for seed in range(4):
        world = simulate(PLAN, seed)
        recording, swarm = ALL[sensor](world, seed)
        online = run(recording, swarm)
        smoothed = smooth_recording(recording, online)
        both = errors_of(online, world), errors_of(smoothed, world)
        known = np.isfinite(both[0][0]).all(axis=1)
        assert known.mean() > 0.8
        online_squares += np.sum(both[0][0][known, :2] ** 2, axis=1).tolist()
        squares += np.sum(both[1][0][known, :2] ** 2, axis=1).tolist()
        normalized += nees(*both[1]).tolist()
    assert np.mean(squares) < 0.8 * np.mean(online_squares)
    assert least < np.mean(normalized) < 4.0


def test_a_landmark_that_has_moved_and_is_opened_online_is_so_in_the_batch() -> None:
    moved = 0.06
    squares = {name: list[float]() for name in ("exact", "opened", "as it is")}
    for seed in range(2):
        world = simulate(PLAN, seed)
        recording, swarm = with_sightings(world, seed)
        first, *others = swarm.landmarks
        described = replace(swarm, landmarks=(replace(first, x=first.x + moved), *others))
        learned = replace(described, landmarks=(opened(described.landmarks[0]), *others))
        cases = ((described, None), (described, learned), (swarm, None))
        for name, (one, now) in zip(squares, cases, strict=True):
            online = replace(rerun(recording, one, 0.1), self_calibrated=now)
            error, _ = errors_of(smooth_recording(recording, online), world)
            squares[name] += np.sum(error[:, :2] ** 2, axis=1).tolist()
    exact, found, right = (float(np.mean(one)) for one in squares.values())
    assert found < 0.5 * (exact + right)
    assert found < 1.3 * right


def test_covariances_are_those_of_many_worlds() -> None:
    """Independent noise, as the batch takes it; between knots, too."""
    normalized = []
    for seed in range(10):
        world = simulate(replace(PLAN, duration_s=10.0, content=1), 100 + seed)
        recording, swarm = with_sightings(world, seed)
        problem = problem_of(recording, swarm, is_described=True)
        solution = Solver(problem, at_truth(problem, world)).solve(unwatched)
        rows = np.arange(7, world.stamp_ns.size - 3, 9)
        robots = np.repeat(np.arange(3), rows.size)
        stamps = np.tile(world.stamp_ns[rows], 3)
        poses = solution.at(robots, stamps)
        error = poses - world.truth[np.tile(rows, 3), robots]
        error[:, 2] = se2.wrap_angle(error[:, 2])
        normalized += nees(error, covariances_at(solution, robots, stamps, poses)).tolist()
    assert 2.4 < np.mean(normalized) < 3.6


def test_the_inverse_in_the_band_is_that_of_the_whole_matrix() -> None:
    rng = np.random.default_rng(1)
    normal = ChainEquations(12, 4, 3)
    for k in range(9):
        columns = np.array([[k, k + 2, k + 3, 12 + k % 3]])
        normal.add(rng.standard_normal((1, 5, 4)), columns, np.zeros((1, 5)))
    factor = normal.factored(0.0)
    whole = factor.covariance(np.arange(15))
    band = factor.inverse_band()
    for d in range(5):
        np.testing.assert_allclose(band[d, : 12 - d], np.diag(whole, -d)[: 12 - d], rtol=1e-8, atol=1e-10)


def test_looks_from_one_place_count_less() -> None:
    """A robot that stands sees the same landmarks with errors that repeat; one that drives does not."""
    world = simulate(replace(PLAN, robots=2, standing=(0,), noise=0.0), 2)
    recording, swarm = with_sightings(world, 2)
    problem = problem_of(recording, swarm, is_described=True)
    start = at_truth(problem, world)
    assert start.knot is not None
    factor = with_lasting_errors(problem, start.knot, start.landmark).sightings.covariance[:, 0, 0]
    factor = factor / problem.sightings.covariance[:, 0, 0]
    landmarks = problem.sightings.landmark >= 0
    stands, drives = (factor[landmarks & (problem.sightings.observer == robot)] for robot in range(2))
    count = np.unique(problem.sightings.stamp_ns[landmarks & (problem.sightings.observer == 0)]).size
    assert np.median(stands) == pytest.approx(1.0 + 0.5 * (count - 1), rel=0.05)
    assert np.median(drives) < 0.2 * np.median(stands)


def test_the_drift_of_a_gyroscope_is_found() -> None:
    world = simulate(replace(PLAN, robots=1, noise=0.3), 5)
    recording, swarm = with_sightings(world, 5)
    turns = np.gradient(np.unwrap(world.truth[:, 0, 2]), 1e-9 * world.stamp_ns.astype(float))
    none = np.zeros((turns.size, 3))
    rates = TurnRateRows(
        np.zeros(turns.size, dtype=np.int64), world.stamp_ns, none, turns + 0.02, none, world.stamp_ns
    )
    imu = ImuModel(turn_noise_density=0.002, turn_bias_sigma=0.02, turn_bias_time_s=100.0)
    described = replace(swarm, robots=(replace(swarm.robots[0], imu=imu),))
    recording = replace(recording, turn_rates=rates)
    problem = problem_of(recording, described, is_described=True)
    assert problem.drift is not None
    solver = Solver(problem, at_truth(problem, world))
    solver.solve(unwatched)
    assert np.median(solver._drift[:, 0]) == pytest.approx(-0.02, abs=0.004)


def test_smoothed_replays_of_real_bags() -> None:
    """Of a description that is right, and of one whose errors the replay has found."""
    for name, share in (("eight_five_robots", 0.8), ("eight_one_robot_slow", 0.6)):
        online = replay(BAGS / name)
        smoothed = smooth(BAGS / name, online)
        assert np.array_equal(smoothed.stamp_ns, online.stamp_ns)
        assert smoothed.overall.position_rmse < share * online.overall.position_rmse
        assert smoothed.overall.nees < 4.0
        assert smoothed.overall.count > 0.99 * online.overall.count
        located = np.isfinite(smoothed.poses[:, :, 0])
        assert np.array_equal(smoothed.status == Status.TRACKED, located)
        assert np.isfinite(smoothed.covariances[located]).all()
        assert (np.linalg.eigvalsh(smoothed.covariances[located]) > 0.0).all()


@pytest.mark.parametrize(
    ("bag", "sentence"),
    [
        ("droplets_twenty", "the batch does not use its brightness"),
        ("aerial_five", "the batch does not use its aerial"),
    ],
)
def test_what_cannot_be_smoothed_is_said_in_one_sentence(bag: str, sentence: str) -> None:
    with pytest.raises(SmoothError, match=re.escape(f"'{bag}' cannot be smoothed: {sentence}.")):
        smooth(BAGS / bag, replay(BAGS / bag))


def test_other_recordings_without_a_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    world = simulate(PLAN, 0)
    recording, swarm = with_sightings(world, 0)
    lost = replace(swarm, landmarks=())
    with pytest.raises(SmoothError, match="its poses are relative to a robot"):
        smooth_recording(recording, rerun(recording, lost, 0.1))
    online = rerun(recording, swarm, 0.1)
    none = replace(recording, odometry=select(recording.odometry, np.zeros(0, dtype=np.int64)))
    with pytest.raises(SmoothError, match="it has no odometry"):
        smooth_recording(none, online)
    monkeypatch.setattr("swarm_loc_estimator.offline.batch.smooth.MAX_SIZE", 100)
    with pytest.raises(SmoothError, match="it is too large; cut it, or leave robots out"):
        smooth_recording(recording, online)


def test_a_source_that_contradicts_all_others_is_named() -> None:
    world = simulate(replace(PLAN, robots=2), 1)
    recording, swarm = with_fixes(world, 1)
    fixes = recording.fixes
    wrong = (fixes.robot == 1) & (np.arange(fixes.robot.size) % 3 == 0)
    pose = fixes.pose + np.where(wrong[:, None], [0.5, 0.0, 0.0], 0.0)
    online = run(recording, swarm)
    said = r"3\d% of the measurements of robot_1 contradict the others"
    with pytest.raises(SmoothError, match=said):
        smooth_recording(replace(recording, fixes=fixes._replace(pose=pose)), online)


def test_the_command_writes_smoothed_poses_beside_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, tum = tmp_path / "out", tmp_path / "tum"
    bag = str(BAGS / "eight_five_robots")
    assert command.main([bag, "--smooth", "--out", str(out), "--tum", str(tum)]) == 0
    text = capsys.readouterr().out
    assert "all, smoothed" in text
    assert "all, smoothed" in (out / "report.html").read_text(encoding="utf-8")
    header, first, *_ = (out / "smoothed.csv").read_text(encoding="utf-8").splitlines()
    assert header == (out / "poses.csv").read_text(encoding="utf-8").splitlines()[0]
    stamp_ns, name, x, *_ = first.split(",")
    line = (tum / f"{name}.smoothed.tum").read_text(encoding="utf-8").splitlines()[0].split()
    assert line[0].replace(".", "") == stamp_ns
    assert float(line[1]) == pytest.approx(float(x))
    command.main([bag, "--out", str(out)])
    assert not (out / "smoothed.csv").exists()
