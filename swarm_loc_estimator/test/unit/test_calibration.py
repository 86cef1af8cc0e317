"""Fits recover the models that a recording was made with, and refuse what holds nothing to fit to."""

import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_world import SECOND, World, record, robot

from bench.shared.bags import copy_part
from swarm_loc_estimator.cli.calibrate import main
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter, typestore
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.offline.calibration.fit import (
    NEES_AIM,
    TICK_S,
    Score,
    calibrate,
    refined,
    score,
    thinned,
)
from swarm_loc_estimator.offline.calibration.models import Options, fit_models, with_noise
from swarm_loc_estimator.offline.calibration.motion import Lateness, drive_of, fit_response
from swarm_loc_estimator.offline.calibration.recording import (
    CalibrationError,
    Recording,
    joined,
    read_recording,
    rerun,
    started_at_truth,
)
from swarm_loc_estimator.offline.calibration.sightings import ridge, sway_of
from swarm_loc_estimator.sensors.camera import CONTENT_POSE
from swarm_loc_estimator.sensors.imu import TurnRateRows
from swarm_loc_estimator.sensors.ranges import RangeRows
from swarm_loc_estimator.swarm.error_models import ImuModel, MotionResponse, OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import Anchor, CameraMount, Robot, Swarm, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.settings import Settings

BAGS = Path(__file__).parents[3] / "bags"
DROPLETS, FAST = BAGS / "droplets_twenty", BAGS / "eight_one_robot_fast"
TRUE = Robot(
    "true",
    odometry=OdometryModel(turn_bias=-0.004, course_offset=0.02, axle_offset=-0.03, delay_s=0.08, lag_s=0.2),
    response=MotionResponse((0.0,), (0.0, 0.6), ((1.02, 0.8),), ((0.95, 0.95),)),
    camera=CameraMount(x=-0.03),
    sensor=SensorModel(
        range_log_scale=-0.02,
        range_curve=0.5,
        range_offset=0.03,
        bearing_offset=0.02,
        bearing_scale=0.97,
        time_offset_s=-0.05,
    ),
)
HONEST = Robot("true")


def quiet(_share: float, _what: str) -> None:
    """Nobody watches."""


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_models_are_recovered(seed: int) -> None:
    recording, swarm = record(World((robot(1, TRUE), robot(2, TRUE)), seed))
    models = fit_models(recording, swarm, Options(), quiet)
    for found in models.swarm.robots:
        s, o = found.sensor, found.odometry
        assert s.range_curve == pytest.approx(0.5, abs=0.04)
        assert s.range_log_scale == pytest.approx(-0.02, abs=0.02)
        assert s.bearing_offset == pytest.approx(0.02, abs=0.003)
        assert s.bearing_scale == pytest.approx(0.97, abs=0.01)
        assert s.time_offset_s == pytest.approx(-0.05, abs=0.02)
        assert o.delay_s + o.lag_s == pytest.approx(0.28, abs=0.03)
        assert o.turn_bias == pytest.approx(-0.004, abs=0.001)
        assert o.course_offset == pytest.approx(0.02, abs=0.005)
        assert o.axle_offset == pytest.approx(-0.03, abs=0.005)
        response = found.response
        assert response is not None
        speed_share, turn_share = np.array(response.speed_share), np.array(response.turn_share)
        wanted = np.interp(response.turn_rates, [0.0, 0.6], [1.02, 0.8])
        np.testing.assert_allclose(speed_share[-1], wanted, atol=0.03)
        np.testing.assert_allclose(turn_share[1:, -1], 0.95, atol=0.02)


@pytest.mark.parametrize("seed", [4, 5])
def test_honest_odometry_is_left_as_it_is(seed: int) -> None:
    recording, swarm = record(World((robot(1, HONEST),), seed))
    found = fit_models(recording, swarm, Options(), quiet).swarm.robots[0]
    assert found.response is not None
    np.testing.assert_allclose(found.response.speed_share, 1.0, atol=0.02)
    np.testing.assert_allclose(found.response.turn_share, 1.0, atol=0.02)
    assert abs(found.odometry.delay_s + found.odometry.lag_s) < 0.02
    assert abs(found.odometry.course_offset) < 0.005
    assert abs(found.sensor.range_curve) < 0.03


def test_without_a_table_two_shares_are_fitted() -> None:
    recording, swarm = record(World((robot(1, TRUE),), 6))
    found = fit_models(recording, swarm, Options(response=False), quiet).swarm.robots[0]
    assert found.response is None
    assert found.odometry.turn_scale == pytest.approx(0.95, abs=0.01)
    assert 0.85 < found.odometry.distance_scale < 1.0


def test_the_yaw_of_a_camera_that_sees_headings_is_recovered() -> None:
    turned = replace(HONEST, camera=CameraMount(x=0.02, yaw=0.1))
    recording, swarm = record(World((robot(1, turned),), 7, posed=True))
    camera = fit_models(recording, swarm, Options(), quiet).swarm.robots[0].camera
    assert camera is not None
    assert camera.yaw == pytest.approx(0.1, abs=0.005)
    assert camera.x == pytest.approx(0.02, abs=0.01)


def test_a_robot_with_sparse_truth_gains_from_its_type() -> None:
    recording, swarm = record(World((robot(1, TRUE), robot(2, TRUE)), 8))
    full = recording.truth["robot2"]
    kept = np.isin(full.stamp_ns, recording.detections.stamp_ns)
    rows = np.flatnonzero(kept)[::12]
    sparse = type(full)(full.stamp_ns[rows], full.pose[rows])
    recording = replace(recording, truth={**recording.truth, "robot2": sparse})
    found = fit_models(recording, swarm, Options(), quiet).swarm.robots[1]
    assert found.response is not None
    assert found.odometry.axle_offset == pytest.approx(-0.03, abs=0.01)
    assert found.sensor.range_curve == pytest.approx(0.5, abs=0.06)


def test_the_noise_makes_the_estimator_consistent_and_better() -> None:
    recording, swarm = record(World((robot(1, TRUE),), 9, duration_s=80.0, turn_sigma=0.03))
    done = calibrate(recording, swarm, Options(evaluations=8), quiet)
    assert done.before is not None
    assert done.after is not None
    assert done.after.position_rmse < 0.5 * done.before.position_rmse
    assert 1.0 < done.after.nees < 5.0
    assert [r.start for r in done.swarm.robots] == [r.start for r in swarm.robots]


def test_a_plain_fit_changes_nothing_but_noise() -> None:
    recording, swarm = record(World((robot(1, TRUE),), 10, duration_s=60.0))
    done = calibrate(recording, swarm, Options(plain=True, evaluations=3), quiet)
    (robot_before,) = swarm.robots
    noise = {**asdict(robot_before.odometry), **asdict(robot_before.sensor)}
    assert with_noise(done.swarm, {name: noise[name] for name in done.noise}) == swarm
    assert done.noise["range_sigma_per_m"] > 0.0


def test_a_recording_that_is_too_short_to_fit_is_named() -> None:
    recording, swarm = record(World((robot(1, HONEST),), 2, duration_s=60.0, turn_sigma=0.03))
    warning = calibrate(recording, swarm, Options(evaluations=4), quiet).warning
    assert warning.startswith("The recording is too short to fit, or the description was as good before")
    fitted, described = (float(text) for text in re.findall(r"([\d.]+) mm", warning))
    assert fitted > described
    recording, swarm = record(World((robot(1, TRUE),), 2, duration_s=60.0, turn_sigma=0.03))
    assert not calibrate(recording, swarm, Options(evaluations=4), quiet).warning


def test_the_command_names_a_bag_that_is_cut_too_short(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy_part(BAGS / "eight_five_robots", tmp_path / "bag", 20.0)
    out = tmp_path / "out.yaml"
    command = [str(tmp_path / "bag"), "--swarm", str(BAGS / "eight_five_robots" / "swarm.yaml")]
    assert main([*command, "--out", str(out), "--evaluations", "2"]) == 0
    assert "The recording is too short to" in capsys.readouterr().out
    assert "The recording is too short to" in out.read_text(encoding="utf-8")


@pytest.mark.parametrize(("from_share", "to_share"), [(0.0, 0.7), (0.4, 1.0)])
def test_ground_truth_of_a_part_is_enough(from_share: float, to_share: float) -> None:
    recording, swarm = record(World((robot(1, TRUE),), 21, duration_s=200.0))
    truth = recording.truth["robot1"]
    begin, end = (int(share * truth.stamp_ns.size) for share in (from_share, to_share))
    part = Trajectory(truth.stamp_ns[begin:end], truth.pose[begin:end])
    found = fit_models(replace(recording, truth={"robot1": part}), swarm, Options(), quiet).swarm.robots[0]
    assert found.response is not None
    np.testing.assert_allclose(np.array(found.response.turn_share)[1:, -1], 0.95, atol=0.03)


def test_a_message_that_the_estimator_drops_spoils_no_run() -> None:
    recording, swarm = record(World((robot(1, HONEST),), 22, duration_s=30.0))
    swarm = started_at_truth(swarm, recording)
    odometry, detections = recording.odometry, recording.detections
    poses, bad = odometry.pose.copy(), detections.detection.copy()
    poses[0] = np.nan
    sixth = detections.stamp_ns == np.unique(detections.stamp_ns)[5]
    bad["content"][sixth], bad["covariance"][sixth] = CONTENT_POSE, -np.eye(6) * [1, 1, 1, 1, 1, -1]
    spoilt = replace(
        recording, odometry=odometry._replace(pose=poses), detections=detections._replace(detection=bad)
    )
    poses = rerun(spoilt, swarm, 0.5).poses
    assert np.isfinite(poses).all()
    apart = np.abs(poses - rerun(recording, swarm, 0.5).poses)
    assert np.max(apart) < 0.05


def test_what_cannot_be_used_is_not_read_and_said(tmp_path: Path) -> None:
    swarm = load_swarm(FAST / "swarm.yaml")
    with BagReader(FAST) as reader, BagWriter(tmp_path / "bag") as writer:
        for topic in reader.topics:
            writer.add_topic(topic.name, topic.type)
        for count, (name, kind, log_ns, data) in enumerate(reader.messages(["epuck1/odom"])):
            if count == 100:
                break
            message: Any = typestore().deserialize_cdr(data, kind)
            if count == 3:
                message.pose.pose.position.x = np.nan
            writer.write(name, log_ns, bytes(typestore().serialize_cdr(message, kind)))
    recording = read_recording(tmp_path / "bag", swarm)
    assert recording.odometry.robot.size == 99
    assert np.isfinite(recording.odometry.pose).all()
    assert "1 inputs are not used: odometry_non_finite." in recording.sentences()
    assert recording.sentences(expected=["odometry_non_finite"]) == list(recording.remarks)


def test_thinned_odometry_gives_nearly_the_same_poses() -> None:
    recording, swarm = record(World((robot(1, HONEST),), 11, duration_s=60.0))
    swarm = started_at_truth(swarm, recording)
    whole, thin = (score([rerun(one, swarm, 0.5)]) for one in (recording, thinned(recording)))
    assert thin.position_rmse == pytest.approx(whole.position_rmse, rel=0.05)


def test_without_ground_truth_there_is_one_sentence() -> None:
    recording, swarm = record(World((robot(1, TRUE),), 12, duration_s=10.0))
    with pytest.raises(CalibrationError, match=r"recording 'world' holds no <robot>/ground_truth"):
        calibrate(replace(recording, truth={}), swarm, Options(), quiet)


def test_a_clock_that_was_set_is_one_sentence() -> None:
    recording, swarm = record(World((robot(1, TRUE),), 12, duration_s=10.0))
    odometry = recording.odometry
    stamps_ns = np.where(np.arange(odometry.robot.size) < 50, odometry.stamp_ns - 10**18, odometry.stamp_ns)
    recording = replace(recording, odometry=odometry._replace(stamp_ns=stamps_ns))
    with pytest.raises(CalibrationError, match="jump of 277778 h"):
        calibrate(recording, swarm, Options(), quiet)


def test_with_too_little_there_is_one_sentence() -> None:
    recording, swarm = record(World((robot(1, TRUE),), 13, duration_s=8.0))
    with pytest.raises(CalibrationError, match="too little ground truth"):
        calibrate(recording, swarm, Options(), quiet)


def test_the_command_says_which_inputs_of_a_bag_it_does_not_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor does it need any detection."""
    out = tmp_path / "out.yaml"
    assert main([str(DROPLETS), "--out", str(out), "--plain", "--evaluations", "1"]) == 0
    shown = capsys.readouterr().out
    said = r"Not used: \d{3} messages on <robot>/brightness and \d+ messages on <robot>/fix\. Infrared"
    assert re.search(said, shown)
    assert load_swarm(out).robots[0].odometry.turn_noise > 0.0


def test_gross_errors_do_not_spoil_a_regression() -> None:
    rng = np.random.default_rng(1)
    basis = rng.standard_normal((200, 2))
    wanted = basis @ [2.0, -1.0] + 0.01 * rng.standard_normal(200)
    wanted[:20] += 5.0
    np.testing.assert_allclose(ridge(basis, wanted, 1e-9 * np.eye(2), np.zeros(2)), [2.0, -1.0], atol=0.02)


def test_how_often_poses_are_wanted_changes_nothing_in_the_filter_of_a_dense_swarm() -> None:
    """So the noise that is fitted with few poses is that of the live filter, which gives many."""
    dense = tuple(robot(k, HONEST) for k in range(72))  # their pictures of one instant are fused together
    recording, swarm = record(World(dense, 14, duration_s=8.0))
    swarm = started_at_truth(swarm, recording)
    often, seldom = (rerun(recording, swarm, tick_s) for tick_s in (0.1, TICK_S))
    rows = np.isin(often.stamp_ns, seldom.stamp_ns)
    assert rows.sum() == seldom.stamp_ns.size - 1  # the last tick is the first after the end
    np.testing.assert_allclose(often.poses[rows], seldom.poses[:-1], atol=1e-9)
    np.testing.assert_allclose(often.covariances[rows], seldom.covariances[:-1], atol=1e-9)
    for period_s in (0.0, TICK_S):  # one measurement after the other, and more of them together
        other = rerun(recording, swarm, TICK_S, Settings(fusion_period_s=period_s))
        assert np.nanmax(np.abs(other.poses - seldom.poses)) > 1e-6


@pytest.mark.parametrize("seed", [16, 17, 18])
def test_a_table_has_to_earn_its_numbers(seed: int) -> None:
    late = Lateness(0.0, 0.0)
    for true, least, most in ((HONEST, 1, 1), (TRUE, 2, 6)):
        slipping = replace(true, odometry=OdometryModel())
        recording, swarm = record(World((robot(1, slipping),), seed, duration_s=150.0, turn_sigma=0.02))
        drive = drive_of(recording.track(0), swarm.robots[0].odometry, recording.truth["robot1"])
        assert least <= len(fit_response([drive], late, table=True).speeds) <= most


def test_the_score_counts_error_consistency_and_poses_not_given() -> None:
    fair = Score(0.02, 0.01, NEES_AIM, 1.0)
    assert replace(fair, position_rmse=0.021).cost > fair.cost
    assert fair.cost < replace(fair, heading_rmse=0.0105).cost < replace(fair, position_rmse=0.021).cost
    assert replace(fair, nees=2.0 * NEES_AIM).cost == pytest.approx(replace(fair, nees=0.5 * NEES_AIM).cost)
    assert replace(fair, nees=2.0 * NEES_AIM).cost > fair.cost
    assert replace(fair, given=0.99).cost > fair.cost
    assert Score(np.nan, np.nan, np.nan, 0.0).cost > 10.0


@pytest.mark.parametrize("seed", [7, 8])
def test_recordings_are_fitted_together(seed: int) -> None:
    """Robots are elsewhere in the second, where landmarks locate them; nothing is known between the two."""
    centred = replace(TRUE, odometry=replace(TRUE.odometry, course_offset=0.0, axle_offset=0.0))
    robots = (robot(1, centred), robot(2, centred))
    (first, swarm), (second, _) = (record(World(robots, one, 150.0)) for one in (seed, seed + 10))
    both = joined([first, second])
    assert both.odometry.robot.size == first.odometry.robot.size + second.odometry.robot.size
    alone = fit_models(replace(both, truth={}), swarm, Options(alone=True), quiet)
    for found in alone.swarm.robots:
        assert found.sensor.range_curve == pytest.approx(0.5, abs=0.06)
        assert found.sensor.bearing_scale == pytest.approx(0.97, abs=0.02)
    end_ns, errors = first.range_ns[1], []
    for name, path in alone.paths.items():
        assert not ((path.stamp_ns > end_ns + SECOND) & (path.stamp_ns < end_ns + 59 * SECOND)).any()
        true, known = interpolate(both.truth[name], path.stamp_ns, DEFAULT_GAP_NS)
        assert known[path.stamp_ns > end_ns].mean() > 0.9
        errors.append(np.hypot(*(path.pose[known] - true[known])[:, :2].T))
    assert np.sqrt(np.mean(np.square(np.concatenate(errors)))) < 0.03


RADIO_BIAS, RADIO_SIGMA, GYRO_BIAS, GYRO_DENSITY = 0.3, 0.05, 0.01, 2e-3


def with_radios_and_gyroscopes(recording: Recording, swarm: Swarm, seed: int) -> tuple[Recording, Swarm]:
    """Ranges to four anchors, five a second, and turn rates of robots that know no better."""
    rng = np.random.default_rng([seed, 1])
    anchors = tuple(
        Anchor(0xA0 + k, x, y, 2.0, range_bias_sigma=0.02)
        for k, (x, y) in enumerate([(-9.0, -8.0), (8.0, -9.0), (9.0, 9.0), (-8.0, 10.0)])
    )
    ranges, turns = [], []
    for index, one in enumerate(swarm.robots):
        path = recording.truth[one.name]
        some = slice(None, None, round(0.2 * SECOND / np.diff(path.stamp_ns)[0]))
        stamps, pose = path.stamp_ns[some], path.pose[some]
        for anchor in anchors:
            distance = np.hypot(np.hypot(pose[:, 0] - anchor.x, pose[:, 1] - anchor.y), anchor.z)
            distance += RADIO_BIAS + RADIO_SIGMA * rng.standard_normal(distance.size)
            ranges.append(
                (np.full(stamps.size, index), stamps, np.full(stamps.size, anchor.address), distance)
            )
        stamps, turn = path.stamp_ns, np.unwrap(path.pose[:, 2])
        rate = np.diff(turn) / (1e-9 * np.diff(stamps)) - GYRO_BIAS
        rate += GYRO_DENSITY / np.sqrt(1e-9 * np.diff(stamps)) * rng.standard_normal(rate.size)
        turns.append((np.full(rate.size, index), stamps[1:], rate))
    robot_index, stamps, device, distance = (np.concatenate(column) for column in zip(*ranges, strict=True))
    order = np.argsort(stamps, kind="stable")
    none = np.zeros(stamps.size, dtype=np.uint64)
    arrays = (robot_index, stamps, device.astype(np.uint64), none, distance, np.zeros(stamps.size), stamps)
    columns: list[Any] = [one[order] for one in arrays]
    seen = RangeRows(*columns)
    robot_index, stamps, rate = (np.concatenate(column) for column in zip(*turns, strict=True))
    order = np.argsort(stamps, kind="stable")
    velocity = np.column_stack([np.zeros((rate.size, 2)), rate])
    columns = [one[order] for one in (robot_index, stamps, velocity, rate, velocity, stamps)]
    turned = TurnRateRows(*columns)
    robots = tuple(
        replace(one, uwb=UwbDevice(k, range_sigma=0.2), imu=ImuModel(turn_noise_density=0.02))
        for k, one in enumerate(swarm.robots, 1)
    )
    swarm = replace(swarm, robots=robots, anchors=anchors)
    return replace(recording, ranges=seen, turn_rates=turned), swarm


@pytest.mark.parametrize("seed", [7, 8])
def test_radios_and_gyroscopes_are_fitted_with_the_cameras(seed: int) -> None:
    recording, swarm = record(World((robot(1, HONEST), robot(2, HONEST)), seed, 150.0))
    recording, swarm = with_radios_and_gyroscopes(recording, swarm, seed)
    alone = fit_models(replace(recording, truth={}), swarm, Options(alone=True), quiet)
    for found in alone.swarm.robots:
        assert found.uwb is not None
        assert found.uwb.range_bias == pytest.approx(RADIO_BIAS, abs=0.05)
        assert found.uwb.range_sigma == pytest.approx(RADIO_SIGMA, rel=0.2)
        assert found.imu.turn_bias == pytest.approx(GYRO_BIAS, abs=1e-3)
        assert 0.7 < found.imu.turn_noise_density / GYRO_DENSITY < 1.6
    assert max(abs(found.range_bias) for found in alone.swarm.anchors) < 0.05


def test_a_part_of_a_recording_is_a_part_of_all_its_inputs() -> None:
    recording, swarm = record(World((robot(1, HONEST),), 1, 60.0))
    recording, _ = with_radios_and_gyroscopes(recording, swarm, 1)
    part = recording.between((21 * SECOND, 41 * SECOND))
    for name in ("odometry", "detections", "turn_rates", "ranges"):
        whole, some = getattr(recording, name).robot.size, getattr(part, name).robot.size
        assert 0.28 < some / whole < 0.4
        assert part.messages[name.replace("turn_rates", "imu")].robot.size == some


def test_a_wrong_description_with_a_start_is_mended_by_the_recording_alone(tmp_path: Path) -> None:
    """As a live estimator proposes it."""
    skewed = replace(
        HONEST,
        odometry=OdometryModel(distance_scale=0.95, turn_scale=1.05),
        camera=CameraMount(yaw=-np.radians(5.0)),
    )
    recording, swarm = record(World((robot(1, skewed),), 11, 80.0, posed=True))
    (wrong,) = started_at_truth(swarm, recording).robots
    stiff = replace(wrong, odometry=OdometryModel(wheel_noise=2e-5))
    begin = replace(swarm, robots=(stiff,))
    is_better, said = refined([recording.messages], begin, tmp_path / "swarm.yaml")
    assert is_better, said  # the half that begins where nobody has described is fitted, too
    found = load_swarm(tmp_path / "swarm.refined.yaml")
    held_out = r"which stays in use\.\nHeld-out check: .* scatter (\S+) times as much as with the old desc"
    (ratio,) = re.findall(held_out, said)
    assert 0.0 < float(ratio) < 0.5
    assert "\nCorrected for robot1: " in said
    before, after = (score([rerun(recording, one, TICK_S)]).position_rmse for one in (begin, found))
    assert after < 0.3 * before


def test_a_bag_given_twice_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = Path(__file__).parents[3] / "bags" / "eight_one_robot_fast"
    assert main([str(bag), f"{bag}/../{bag.name}", "--out", str(tmp_path / "swarm.yaml")]) == 1
    assert "a bag is given twice, which tells nothing new." in capsys.readouterr().err


def sightings(seed: int, sway: float, time_s: float, noise: float) -> tuple[FloatArray, IntArray, FloatArray]:
    """Times, markers and bearing errors of a camera that sways and sees two of five markers at a time."""
    rng = np.random.default_rng(seed)
    images = 0.2 * np.arange(3000)
    yaw, yaws = sway * rng.standard_normal(), []
    kept = np.exp(-0.2 / time_s)
    for _ in images:
        yaws.append(yaw)
        yaw = kept * yaw + np.sqrt(1.0 - kept**2) * sway * rng.standard_normal()
    marker = np.concatenate([rng.permutation(5)[:2] for _ in images])
    bearing = np.repeat(yaws, 2) + noise * rng.standard_normal(2 * images.size)
    return np.repeat(images, 2), marker, bearing


@pytest.mark.parametrize("time_s", [3.0, 10.0])
@pytest.mark.parametrize(("sway", "noise"), [(0.02, 0.01), (0.005, 0.01)])
def test_the_sway_of_a_camera_is_recovered(sway: float, noise: float, time_s: float) -> None:
    found = np.array([sway_of(*sightings(seed, sway, time_s, noise)) for seed in range(6)])
    assert np.median(found[:, 0]) == pytest.approx(sway, rel=0.15)
    assert np.median(found[:, 1]) == pytest.approx(time_s, rel=0.35)


def test_noise_of_single_sightings_is_no_sway() -> None:
    assert sway_of(*sightings(1, 0.0, 5.0, 0.01)) == (0.0, 0.0)
    time_s, marker, bearing = sightings(2, 0.02, 5.0, 0.01)
    assert sway_of(time_s, np.zeros_like(marker), bearing) == (0.0, 0.0)  # one marker tells nothing


def test_noise_that_is_scaled_keeps_its_ratios_between_robots() -> None:
    sensors = (SensorModel(bearing_sigma=0.01), SensorModel(bearing_sigma=0.04))
    swarm = Swarm(tuple(Robot(f"r{k}", sensor=sensor) for k, sensor in enumerate(sensors)))
    scaled = with_noise(swarm, {"bearing_sigma": 0.06, "turn_drift": 1e-3})
    assert [robot.sensor.bearing_sigma for robot in scaled.robots] == pytest.approx([0.03, 0.12])
    assert {robot.odometry.turn_drift for robot in scaled.robots} == {1e-3}
