"""Odometry: rates, tracks, and one that is constant."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from core_geometry import wrapped
from core_messages import SECOND, T0
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.odometry.track_arrays import OdometrySample, look_up_pose
from swarm_loc_estimator.odometry.tracks import OdometryTracks, TrackChange
from swarm_loc_estimator.swarm.calibration_states import DISTANCE_SCALE, TURN_BIAS, TURN_SCALE
from swarm_loc_estimator.swarm.error_models import OdometryModel, RandomWalk
from swarm_loc_estimator.swarm.swarm import Robot
from swarm_loc_estimator.timeline.estimate import ConstantOdometry, Estimate, Status

PLAIN = OdometryModel(wheel_separation=0.1, wheel_noise=1e-4)
WALK = RandomWalk(position=2e-4, heading=0.05)
STEP_NS = SECOND // 20


def tracks(*models: OdometryModel) -> OdometryTracks:
    return OdometryTracks([Robot(f"r{i}", odometry=model) for i, model in enumerate(models or (PLAIN,))])


def arc(speed: float, turn_rate: float, seconds: NDArray[np.floating[Any]]) -> FloatArray:
    """Poses (k, 3) on a circle, in closed form."""
    heading = turn_rate * seconds
    x = speed * seconds if turn_rate == 0.0 else speed / turn_rate * np.sin(heading)
    y = 0.0 * seconds if turn_rate == 0.0 else speed / turn_rate * (1.0 - np.cos(heading))
    return np.column_stack([x, y, heading])


def feed(track: OdometryTracks, stamps: NDArray[np.int64], raw: FloatArray, robot: int = 0) -> TrackChange:
    return track.extend(np.full(stamps.size, robot), stamps, raw)


def stamps_until(seconds: float) -> NDArray[np.int64]:
    return T0 + STEP_NS * np.arange(round(seconds * 20) + 1, dtype=np.int64)


def look(track: OdometryTracks, stamp_ns: int, robot: int = 0) -> OdometrySample:
    return track.at(np.array([robot]), np.array([stamp_ns]))


@pytest.mark.parametrize(("speed", "turn_rate"), [(0.1, 0.0), (0.1, 0.7), (-0.05, -2.0), (0.0, 1.0)])
def test_a_track_follows_closed_form_arcs_between_the_rows_too(speed: float, turn_rate: float) -> None:
    track, stamps = tracks(), stamps_until(3.0)
    feed(track, stamps, arc(speed, turn_rate, (stamps - T0) * 1e-9))
    for seconds in (0.0, 0.31, 1.0, 2.987):
        expected = arc(speed, turn_rate, np.array([seconds]))
        sample = look(track, T0 + round(seconds * 1e9))
        np.testing.assert_allclose(sample.pose, expected, atol=1e-6)
        np.testing.assert_allclose(sample.raw, expected, atol=1e-6)


def test_headings_across_a_half_turn_are_followed() -> None:
    track, stamps = tracks(), stamps_until(8.0)
    raw = arc(0.1, 1.0, (stamps - T0) * 1e-9)
    raw = wrapped(raw)
    feed(track, stamps, raw)
    assert look(track, T0 + 8 * SECOND).pose[0, 2] == pytest.approx(8.0, abs=1e-9)


def sampled_covariance(pose: FloatArray, mean: FloatArray) -> FloatArray:
    """That of errors exp(xi) = sample times mean^-1 of poses (k, 3), to first order the entries of xi."""
    turned = pose[:, 2] - mean[2]
    cos, sin = np.cos(turned), np.sin(turned)
    x = pose[:, 0] - (cos * mean[0] - sin * mean[1])
    y = pose[:, 1] - (sin * mean[0] + cos * mean[1])
    return np.cov(np.stack([x, y, turned]))


@pytest.mark.parametrize(("speed", "turn_rate"), [(0.2, 0.0), (0.2, 1.5), (0.0, 2.0)])
def test_preintegrated_noise_is_that_of_sampled_wheels(speed: float, turn_rate: float) -> None:
    """Wheels with covar(ds_r, ds_l) = diag(k |ds_r|, k |ds_l|); the error is taken in the track's frame."""
    track, stamps = tracks(), stamps_until(1.0)
    raw = arc(speed, turn_rate, (stamps - T0) * 1e-9)
    feed(track, stamps, raw)
    rng, samples = np.random.default_rng(0), 20_000
    pose, dt, width = np.zeros((samples, 3)), 0.05, PLAIN.wheel_separation
    for _ in range(20):
        wheels = speed * dt + 0.5 * width * turn_rate * dt * np.array([1.0, -1.0])
        wheels = wheels + np.sqrt(PLAIN.wheel_noise * np.abs(wheels)) * rng.standard_normal((samples, 2))
        path, turn = wheels.mean(axis=1), (wheels[:, 0] - wheels[:, 1]) / width
        middle = pose[:, 2] + 0.5 * turn
        pose += np.column_stack([path * np.cos(middle), path * np.sin(middle), turn])
    sampled = sampled_covariance(pose, raw[-1])
    covariance = look(track, int(stamps[-1])).covariance[0]
    np.testing.assert_allclose(covariance, sampled, atol=0.05 * np.abs(covariance).max())
    np.testing.assert_allclose(np.diag(covariance), np.diag(sampled), rtol=0.08, atol=2e-6)


@pytest.mark.parametrize("heading", [0.0, 0.7])
@pytest.mark.parametrize("course", [0.0, math.pi / 3, math.pi / 2, -2.0, math.pi])
def test_preintegrated_noise_is_that_of_sampled_steps_in_any_direction(course: float, heading: float) -> None:
    """A robot that walks without turning: noise along and across its way and in heading."""
    model = replace(PLAIN, distance_noise=4e-4, lateral_noise=1e-4, distance_drift=2e-5, lateral_drift=1e-5)
    track, stamps, step = tracks(model), stamps_until(1.0), 0.01
    way = step * np.arange(stamps.size)[:, None] * [math.cos(heading + course), math.sin(heading + course)]
    feed(track, stamps, np.column_stack([way, np.full(stamps.size, heading)]))
    rng, samples, dt = np.random.default_rng(1), 20_000, 0.05
    pose = np.tile([0.0, 0.0, heading], (samples, 1))
    wheel, width = model.wheel_noise, model.wheel_separation
    for _ in range(stamps.size - 1):
        along = step + math.sqrt((0.5 * wheel + model.distance_noise) * step + model.distance_drift * dt) * (
            rng.standard_normal(samples)
        )
        across = math.sqrt(model.lateral_noise * step + model.lateral_drift * dt) * rng.standard_normal(
            samples
        )
        turn = math.sqrt(2.0 * wheel * step) / width * rng.standard_normal(samples)
        middle = pose[:, 2] + 0.5 * turn + course
        cos, sin = np.cos(middle), np.sin(middle)
        pose += np.column_stack([cos * along - sin * across, sin * along + cos * across, turn])
    sampled = sampled_covariance(pose, np.array([*way[-1], heading]))
    covariance = look(track, int(stamps[-1])).covariance[0]
    np.testing.assert_allclose(covariance[:2, :2], sampled[:2, :2], atol=0.05 * np.abs(sampled[:2, :2]).max())
    np.testing.assert_allclose(covariance, sampled, atol=0.05 * np.abs(sampled).max())


@pytest.mark.parametrize("course", [0.0, math.pi / 3, -math.pi / 2])
def test_a_step_sideways_is_calibrated_like_one_ahead(course: float) -> None:
    model = replace(PLAIN, distance_scale=0.8, course_offset=0.1, lag_s=0.3)
    ahead, aside = tracks(model), tracks(model)
    stamps, path = stamps_until(2.0), 0.02 * np.arange(41)
    feed(ahead, stamps, np.column_stack([path, 0.0 * path, 0.0 * path]))
    feed(aside, stamps, np.column_stack([path * math.cos(course), path * math.sin(course), 0.0 * path]))
    when = int(stamps[-1]) + STEP_NS // 2  # past the newest message
    one, other = look(ahead, when), look(aside, when)
    cos, sin = math.cos(course), math.sin(course)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(other.pose[0], turn @ one.pose[0], atol=1e-12)
    noise = turn @ one.covariance[0] @ turn.T
    np.testing.assert_allclose(other.covariance[0], noise, atol=1e-12)
    np.testing.assert_allclose(other.jacobian[0, :, 1], turn @ one.jacobian[0, :, 1], atol=1e-12)


def test_a_robot_without_odometry_stands_for_ever() -> None:
    track = OdometryTracks([Robot("still", stands=True), Robot("silent")])
    assert track.has_started(0, T0)
    assert not track.has_started(1, T0)
    sample = track.at(np.array([0, 1]), np.array([T0, T0]))
    assert not sample.pose[0].any()
    assert not sample.covariance[0].any()
    assert not sample.jacobian[0].any()
    assert sample.silence_s.tolist() == [0.0, math.inf]


def test_a_robot_without_odometry_may_walk_at_random() -> None:
    track = OdometryTracks([Robot("still", stands=True), Robot("odd", stands=True, random_walk=WALK)])
    assert track.has_started(1, T0)
    assert [track.is_random_walk(robot) for robot in (0, 1)] == [False, True]
    stamps = np.array([T0, T0 + 3_000_000_000])
    sample = track.at(np.array([1, 1]), stamps)
    assert not sample.pose.any()
    assert sample.silence_s.tolist() == [0.0, 0.0]
    gained = sample.covariance[1] - sample.covariance[0]
    expected = 3.0 * np.diag([WALK.position, WALK.position, WALK.heading])
    np.testing.assert_allclose(gained, expected, rtol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_any_order_and_batching_of_rows_gives_the_same_track(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lagging = replace(PLAIN, lag_s=0.2, distance_scale=1.1, turn_noise=0.01)
    orderly, shuffled = tracks(PLAIN, lagging), tracks(PLAIN, lagging)
    stamps = np.sort(rng.choice(np.arange(60), 50, replace=False)) * STEP_NS + T0
    raw = arc(0.1, 0.8, (stamps - T0) * 1e-9)
    raw[20] += 3.0  # no robot can drive so far
    raw = wrapped(raw)
    robots, rows = np.repeat([0, 1], 50), np.tile(raw, (2, 1))
    all_stamps = np.tile(stamps, 2)
    orderly.extend(robots, all_stamps, rows)
    conflicting = np.concatenate([rng.permutation(100), rng.integers(0, 100, 10)])  # and ten twice
    for batch in np.array_split(conflicting, rng.integers(1, 30)):
        shuffled.extend(robots[batch], all_stamps[batch], rows[batch])
    who, when = np.repeat([0, 1], 80), np.tile(T0 + np.arange(80) * STEP_NS // 2 * 2 + 7_000_000, 2)
    for found, expected in zip(shuffled.at(who, when), orderly.at(who, when), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_two_rows_with_one_stamp_the_same_one_counts_in_any_order(order: tuple[int, int]) -> None:
    track, rows = tracks(), np.array([[0.02, 0.0, 0.0], [0.01, 0.0, 0.0]])
    feed(track, np.array([T0]), np.zeros((1, 3)))
    dropped = [feed(track, np.array([T0 + STEP_NS]), rows[[k]]).duplicates for k in order]
    assert sum(dropped) == 1
    assert look(track, T0 + STEP_NS).pose[0, 0] == pytest.approx(0.01)


def test_a_late_row_says_from_where_on_look_ups_change() -> None:
    track, stamps = tracks(PLAIN, PLAIN), stamps_until(1.0)
    raw = arc(0.1, 0.5, (stamps - T0) * 1e-9)
    kept = np.arange(stamps.size) != 10
    feed(track, stamps[kept], raw[kept])
    before = track.at(np.zeros(21, dtype=np.int64), stamps)
    change = feed(track, stamps[[10]], raw[[10]] + [0.003, 0.0, 0.0])
    assert change.changed_from_ns[0] == stamps[9]
    assert change.changed_from_ns[1] > stamps[-1]
    after = track.at(np.zeros(21, dtype=np.int64), stamps)
    np.testing.assert_array_equal(after.pose[:10], before.pose[:10])
    assert np.abs(after.pose[10] - before.pose[10]).max() > 1e-3


@pytest.mark.parametrize("turn_rate", [0.0, 1.5])
@pytest.mark.parametrize("timeout_s", [0.3, 1.0])
@pytest.mark.parametrize("then", ["silence", "a row", "a jump"])
def test_what_noise_is_preintegrated_between_any_two_instants_is_a_covariance(
    timeout_s: float, turn_rate: float, then: str
) -> None:
    track, stamps = tracks(replace(PLAIN, timeout_s=timeout_s)), stamps_until(0.5)
    feed(track, stamps, arc(0.3, turn_rate, (stamps - T0) * 1e-9))
    if then != "silence":
        late = T0 + round(2.0 * SECOND)
        feed(
            track, np.array([late]), arc(0.3, turn_rate, np.array([2.0])) + (5.0 if then == "a jump" else 0.0)
        )
    instants = T0 + np.arange(0, 3 * SECOND, 30_000_000)
    sample = track.at(np.zeros(instants.size, dtype=np.int64), instants)
    least = np.linalg.eigvalsh(np.diff(sample.covariance, axis=0)).min()
    assert least > -1e-3 * PLAIN.wheel_noise  # the motion of a silent robot is not known better than a step's


@pytest.mark.parametrize("early", [0.3, 0.6, 0.9, 0.99])
@pytest.mark.parametrize(("speed", "turn_rate"), [(0.2, 0.0), (0.2, 1.5)])
def test_a_stamp_that_is_too_early_or_late_makes_no_rate(
    speed: float, turn_rate: float, early: float
) -> None:
    """Past the newest row a robot is off by no more than the stamp's error and .4 of its motion since."""
    stamps = stamps_until(1.0)
    raw = arc(speed, turn_rate, (stamps - T0) * 1e-9)
    for wrong, sign in ((-1, -1), (-2, 1)):  # the last stamp is early, or the one before it late
        moved, track = stamps.copy(), tracks()
        moved[wrong] += sign * round(early * STEP_NS)
        feed(track, moved, raw)
        for ahead_s in (0.0, 0.05, 0.1):
            at_ns = max(int(moved[-1]), int(stamps[-1])) + round(ahead_s * 1e9)
            truth = arc(speed, turn_rate, np.array([(at_ns - T0) * 1e-9]))[0]
            error = look(track, at_ns).pose[0] - truth
            elapsed_s = (at_ns - moved[-1]) * 1e-9
            allowed_s = early * STEP_NS * 1e-9 + 0.4 * elapsed_s
            assert math.hypot(*error[:2]) <= speed * allowed_s
            assert abs(error[2]) <= turn_rate * allowed_s + 1e-9


@pytest.mark.parametrize("short", [0.1, 0.5, 0.9])
def test_steps_of_different_length_give_the_same_rate(short: float) -> None:
    """A reading in between, with a right stamp, changes nothing; nor does a silence before it."""
    track = tracks()
    stamps = np.append(stamps_until(1.0), T0 + SECOND + round(short * STEP_NS))
    stamps = np.delete(stamps, slice(14, 17))
    feed(track, stamps, arc(0.2, 0.7, (stamps - T0) * 1e-9))
    at_ns = int(stamps[-1]) + STEP_NS
    np.testing.assert_allclose(
        look(track, at_ns).pose[0], arc(0.2, 0.7, np.array([(at_ns - T0) * 1e-9]))[0], atol=1e-4
    )


def test_a_silent_robot_runs_on_for_its_timeout_and_then_may_be_anywhere() -> None:
    track, stamps = tracks(), stamps_until(1.0)
    feed(track, stamps, arc(0.1, 0.0, (stamps - T0) * 1e-9))
    soon, late = look(track, T0 + SECOND + STEP_NS), look(track, T0 + 11 * SECOND)
    assert soon.pose[0, 0] == pytest.approx(0.105, abs=1e-9)
    assert soon.silence_s[0] == pytest.approx(0.05)
    assert late.silence_s[0] == pytest.approx(10.0)
    reach = PLAIN.max_speed * 10.0
    np.testing.assert_allclose(np.diag(late.covariance[0])[:2], reach**2 / 3, rtol=0.2)
    assert late.covariance[0, 2, 2] > 1.0


@pytest.mark.parametrize("rows", [0, 1, 20])
def test_a_pose_alone_is_that_of_the_whole_look_up(rows: int) -> None:
    track, stamps = tracks(replace(PLAIN, timeout_s=0.3)), stamps_until(1.0)[:rows]
    feed(track, stamps, arc(0.1, 1.3, (stamps - T0) * 1e-9))
    if rows:  # behind a gap
        feed(track, stamps[-1:] + SECOND, np.array([[0.2, 0.1, 0.4]]))
    pose = np.empty(3)
    for stamp_ns in range(T0 - SECOND // 2, T0 + 4 * SECOND, 17_000_000):
        look_up_pose(track.arrays, 0, stamp_ns, pose)
        np.testing.assert_array_equal(pose, look(track, stamp_ns).pose[0])


def test_a_row_after_a_silence_changes_nothing_more_than_a_timeout_before_it() -> None:
    track, stamps = tracks(), stamps_until(1.0)
    feed(track, stamps, arc(0.1, 0.3, (stamps - T0) * 1e-9))
    instants = T0 + np.arange(0, 6 * SECOND, STEP_NS)
    who = np.zeros(instants.size, dtype=np.int64)
    before = track.at(who, instants)
    feed(track, np.array([T0 + 6 * SECOND]), np.array([[0.4, 0.2, 0.5]]))
    after = track.at(who, instants)
    np.testing.assert_array_equal(after.pose, before.pose)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    np.testing.assert_array_equal(after.jacobian, before.jacobian)


def test_a_jump_is_no_motion_but_makes_the_robot_unsure() -> None:
    track, stamps = tracks(), stamps_until(1.0)
    raw = arc(0.1, 0.0, (stamps - T0) * 1e-9)
    raw[10:, 0] += 4.0  # the driver was restarted
    assert feed(track, stamps, raw).jumps == 1
    assert look(track, int(stamps[-1])).pose[0, 0] == pytest.approx(0.1 - 0.005)
    assert look(track, int(stamps[-1])).raw[0, 0] == pytest.approx(4.1)
    grown = look(track, int(stamps[10])).covariance[0] - look(track, int(stamps[9])).covariance[0]
    assert math.sqrt(grown[0, 0]) > 0.02
    assert feed(track, stamps[[15]] + 1, raw[[15]]).jumps == 0  # one that comes late counts none again


def test_trimming_and_growing_keep_look_ups() -> None:
    kept, trimmed = tracks(PLAIN, PLAIN), tracks(PLAIN, PLAIN)
    capacity = trimmed.arrays.stamp_ns.shape[1]
    for second in range(120):
        stamps = T0 + second * SECOND + STEP_NS * np.arange(20, dtype=np.int64)
        raw = arc(0.1, 0.3, (stamps - T0) * 1e-9)
        for track in (kept, trimmed):
            feed(track, stamps, raw)
        now_ns = int(stamps[-1])
        trimmed.trim(now_ns - 2 * SECOND, now_ns - 4 * SECOND)
        when = now_ns - np.arange(0, 4 * SECOND, 230_000_000)
        who = np.zeros(when.size, dtype=np.int64)
        for found, expected in zip(trimmed.at(who, when), kept.at(who, when), strict=True):
            np.testing.assert_array_equal(found, expected)
    assert trimmed.arrays.stamp_ns.shape[1] == capacity
    assert kept.arrays.stamp_ns.shape[1] > capacity
    assert feed(trimmed, np.array([T0 + 100 * SECOND]), np.zeros((1, 3))).too_old.size == 1


def test_calibration_scales_and_delays_the_motion() -> None:
    model = replace(PLAIN, distance_scale=0.9, turn_scale=1.2, delay_s=0.25)
    track, stamps = tracks(model), stamps_until(2.0)
    feed(track, stamps, arc(0.1, 0.5, (stamps - T0) * 1e-9))
    expected = arc(0.09, 0.6, np.array([1.0]))
    np.testing.assert_allclose(look(track, T0 + SECOND + SECOND // 4).pose, expected, atol=1e-5)


def test_a_track_begins_with_its_earliest_row_even_when_that_comes_late() -> None:
    track = tracks()
    assert not track.has_started(0, T0 + SECOND)
    feed(track, np.array([T0 + STEP_NS]), np.array([[0.01, 0.0, 0.0]]))
    assert not track.has_started(0, T0)
    feed(track, np.array([T0]), np.array([[0.004, 0.0, 0.0]]))
    assert track.has_started(0, T0)
    np.testing.assert_allclose(track.arrays.begin_pose[0], [0.004, 0.0, 0.0])
    np.testing.assert_allclose(look(track, T0 - SECOND).pose[0], [0.004, 0.0, 0.0])


def test_preintegrated_drift_is_how_the_pose_moves_with_scales_and_bias() -> None:
    """Against tracks of robots whose motion is calibrated differently, by finite differences."""
    stamps, step = stamps_until(3.0), 1e-5
    model = replace(PLAIN, course_offset=0.1, axle_offset=-0.03)
    models = [
        replace(model, **{name: 1.0 + way * step})
        for name in ("distance_scale", "turn_scale")
        for way in (1.0, -1.0)
    ]
    track, raw = tracks(model, *models, model, model), arc(0.2, 0.9, (stamps - T0) * 1e-9)
    for robot, bias in enumerate([0.0, 0.0, 0.0, 0.0, 0.0, step, -step]):
        # a bias is turned into the report, whose path does not change
        rate = 0.9 + bias
        feed(track, stamps, arc(0.2, rate, (stamps - T0) * 1e-9) if bias else raw, robot)
    for seconds in (0.5, 1.77, 3.0):
        at_ns = T0 + round(seconds * 1e9)
        here = look(track, at_ns)
        poses = [look(track, at_ns, robot).pose[0] for robot in range(1, 7)]
        for k, parameter in enumerate((DISTANCE_SCALE, TURN_SCALE, TURN_BIAS)):
            moved = se2.log(se2.compose(poses[2 * k], se2.inverse(poses[2 * k + 1]))) / (2 * step)
            np.testing.assert_allclose(here.jacobian[0, :, parameter], moved, atol=2e-4)


SIGMA = 0.01
TENTH = SECOND // 10


def contradicted(
    poses: FloatArray, *, constant: BoolArray | bool = True, sigma: FloatArray | float = SIGMA
) -> list[bool]:
    """Whether a robot with poses (T, 3), ten a second, and their sigmas (T,) is contradicted at each."""
    odometry, found = ConstantOdometry(1), []
    stands = np.broadcast_to(constant, len(poses))
    for k, (pose, one) in enumerate(zip(poses, np.broadcast_to(sigma, len(poses)), strict=True)):
        covariance = np.diag([one**2, one**2, 0.01])[None]
        status = np.array([Status.WAITING if np.isnan(pose[0]) else Status.TRACKED], np.uint8)
        now_ns = T0 + k * TENTH
        estimate = Estimate(now_ns, pose[None], covariance, pose[None], status, np.zeros(1), status > 0)
        odometry.add(stands[k : k + 1], estimate)
        found.append(bool(odometry.contradicted(now_ns)[0]))
    return found


def drive(speed: float, seconds: float) -> FloatArray:
    return np.outer(0.1 * speed * np.arange(round(10 * seconds)), [1.0, 0.0, 0.0])


def test_a_robot_that_moves_is_found_unless_its_odometry_does() -> None:
    found = contradicted(drive(0.1, 10.0))
    assert 1.5 <= 0.1 * found.index(True) <= 2.0, "after three moves of five centimetres"
    assert all(found[found.index(True) :])
    assert not any(contradicted(drive(0.1, 10.0), constant=False))


@pytest.mark.parametrize("seed", range(20))
def test_a_pose_that_becomes_surer_is_no_move(seed: int) -> None:
    """The mean of all measurements of a robot that stands."""
    count = np.arange(1, 601)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (600, 3))
    means = np.cumsum(noise, axis=0) / count[:, None]
    assert not any(contradicted(means, sigma=1.0 / np.sqrt(count)))


def test_moves_must_be_clear() -> None:
    found = contradicted(drive(0.1, 30.0), sigma=0.1)
    assert 12.0 <= 0.1 * found.index(True) <= 14.0, "three moves of three standard deviations"


@pytest.mark.parametrize("moves", [1, 2])
def test_a_robot_that_was_carried_or_started_wrong_is_believed_to_stand(moves: int) -> None:
    places = np.repeat(np.outer(np.arange(moves + 1), [1.0, 0.5, 0.2]), 50, axis=0)
    assert not any(contradicted(places))


def test_a_robot_that_was_lost_in_between_has_not_moved_by_that() -> None:
    places = np.repeat(np.outer(np.arange(6.0), [1.0, 0.5, 0.2]), 20, axis=0)
    places[::20] = np.nan
    assert not any(contradicted(places))


def test_it_is_forgotten_a_while_after_the_last_moves() -> None:
    found = contradicted(np.concatenate([drive(0.1, 2.0), np.tile([0.2, 0.0, 0.0], (400, 1))]))
    assert found[20 + 250]
    assert not found[20 + 310]


def test_a_robot_that_was_carried_and_then_drives_is_no_longer_accused() -> None:
    found = contradicted(drive(0.1, 10.0), constant=np.arange(100) < 50)
    assert found[49]
    assert not any(found[50:])


def test_poses_that_were_set_are_no_moves() -> None:
    odometry = ConstantOdometry(1)
    for k in range(6):
        odometry.forget(0)
        for now_ns in (T0 + k * SECOND, T0 + k * SECOND + TENTH):
            pose = np.full((1, 3), float(k))
            status = np.array([Status.TRACKED], np.uint8)
            odometry.add(
                np.ones(1, bool),
                Estimate(now_ns, pose, 1e-6 * np.eye(3)[None], pose, status, pose[:, 0], status > 0),
            )
            assert not odometry.contradicted(now_ns).any()
