"""Turns by a gyroscope: any order of arrival, gaps, mount, standing robots, messages."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from core_messages import T0
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import IMU, CdrError, encode
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.odometry.track_arrays import OdometrySample
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.imu import TurnRateRows, TurnRateSensor
from swarm_loc_estimator.sensors.inputs import Ingest
from swarm_loc_estimator.sensors.sensor import DropCounts
from swarm_loc_estimator.swarm.calibration_states import DISTANCE_SCALE, TURN_BIAS, TURN_SCALE
from swarm_loc_estimator.swarm.error_models import ImuModel, OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.settings import Settings

NOISE = 0.002
GYRO = ImuModel(turn_noise_density=NOISE, turn_bias_sigma=0.01)
WHEELS = OdometryModel(wheel_separation=0.1, wheel_noise=1e-4)
SPEED, TURN_RATE = 0.1, 0.5
Stamps = NDArray[np.int64]


def tracks(imu: ImuModel = GYRO) -> OdometryTracks:
    return OdometryTracks([Robot("r0", odometry=WHEELS, imu=imu)])


def stamps(rate_hz: float, begin_s: float, end_s: float) -> Stamps:
    return T0 + np.rint(1e9 * np.arange(begin_s, end_s + 1e-9, 1.0 / rate_hz)).astype(np.int64)


def seconds(stamp_ns: Stamps) -> FloatArray:
    return np.asarray((stamp_ns - T0) * 1e-9)


def straight(stamp_ns: Stamps) -> FloatArray:
    """Odometry of wheels that report no turn, while the robot turns."""
    return np.column_stack([SPEED * seconds(stamp_ns), np.zeros(stamp_ns.size), np.zeros(stamp_ns.size)])


def feed(track: OdometryTracks, stamp_ns: Stamps, raw: FloatArray) -> None:
    track.extend(np.zeros(stamp_ns.size, dtype=np.int64), stamp_ns, raw)


def turn(track: OdometryTracks, stamp_ns: Stamps, rates: FloatArray) -> int:
    change = track.extend_turns(np.zeros(stamp_ns.size, dtype=np.int64), stamp_ns, rates)
    return int(change.changed_from_ns[0])


def look(track: OdometryTracks, *at_s: float) -> OdometrySample:
    at_ns = T0 + np.rint(1e9 * np.array(at_s)).astype(np.int64)
    return track.at(np.zeros(at_ns.size, dtype=np.int64), at_ns)


def test_turns_are_those_of_the_gyroscope_and_paths_those_of_the_wheels() -> None:
    track, odometry, gyro = tracks(), stamps(20, 0.0, 4.0), stamps(100, -0.1, 4.1)
    turn(track, gyro, np.full(gyro.size, TURN_RATE))
    feed(track, odometry, straight(odometry))
    at_s = np.array([0.0, 0.31, 1.0, 3.987])
    sample = look(track, *at_s.tolist())
    angle, radius = TURN_RATE * at_s, SPEED / TURN_RATE
    arc = np.column_stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])
    np.testing.assert_allclose(sample.pose, arc, atol=1e-5)  # wheels report the chord as the path
    np.testing.assert_allclose(sample.covariance[:, 2, 2], NOISE**2 * at_s, atol=1e-12)
    np.testing.assert_allclose(sample.jacobian[:, 2, TURN_BIAS], at_s, atol=1e-9)
    np.testing.assert_allclose(sample.jacobian[:, 2, TURN_SCALE], angle, atol=1e-9)
    np.testing.assert_allclose(sample.jacobian[1:, 0, DISTANCE_SCALE], arc[1:, 0], atol=1e-4)


def test_scale_bias_and_a_varying_rate_are_integrated_exactly() -> None:
    imu = replace(GYRO, turn_scale=1.02, turn_bias=0.03)
    track, odometry, gyro = tracks(imu), stamps(7, 0.0, 3.0), stamps(50, -0.1, 3.1)
    turn(track, gyro, 0.4 * seconds(gyro))  # linear, which the trapezoidal rule integrates exactly
    feed(track, odometry, straight(odometry))
    end_s = float(seconds(odometry)[-1])
    expected = 1.02 * 0.2 * end_s**2 + 0.03 * end_s
    assert look(track, end_s).pose[0, 2] == pytest.approx(expected, abs=1e-9)


def test_turns_of_the_wheels_bridge_gaps_and_are_not_calibrated_by_the_gyroscope() -> None:
    track, odometry = tracks(), stamps(20, 0.0, 3.0)
    gyro = np.concatenate([stamps(100, -0.1, 1.0), stamps(100, 2.0, 3.1)])
    turn(track, gyro, np.full(gyro.size, TURN_RATE))
    raw = straight(odometry)
    raw[:, 2] = 0.8 * TURN_RATE * seconds(odometry)
    feed(track, odometry, raw)
    headings = look(track, 1.0, 2.0, 3.0)
    np.testing.assert_allclose(np.diff(headings.pose[:, 2]), [0.8 * TURN_RATE, TURN_RATE], atol=1e-6)
    np.testing.assert_allclose(headings.jacobian[:, 2, TURN_BIAS], [1.0, 1.0, 2.0], atol=1e-9)


@pytest.mark.parametrize(("rate", "turned"), [(0.02, 0.0), (0.5, 1.0)])
def test_bias_and_noise_do_not_turn_a_standing_robot_but_a_hand_does(rate: float, turned: float) -> None:
    track, odometry, gyro = tracks(), stamps(20, 0.0, 2.0), stamps(100, -0.1, 2.1)
    rng = np.random.default_rng(0)
    turn(track, gyro, rate + NOISE * math.sqrt(100.0) * rng.standard_normal(gyro.size))
    feed(track, odometry, np.zeros((odometry.size, 3)))
    sample = look(track, 2.0)
    assert sample.pose[0, 2] == pytest.approx(turned, abs=4.0 * NOISE * math.sqrt(2.0))
    assert (sample.covariance[0, 2, 2] > 0.0) == (turned > 0.0)


def test_old_rates_are_dropped_from_long_runs_and_do_not_change_poses() -> None:
    track, whole = tracks(), tracks()
    for begin_s in np.arange(0.0, 60.0, 0.5).tolist():
        for one in (track, whole):
            gyro, odometry = stamps(100, begin_s, begin_s + 0.49), stamps(20, begin_s, begin_s + 0.49)
            turn(one, gyro, np.sin(seconds(gyro)))
            feed(one, odometry, straight(odometry))
        track.trim(T0 + round(1e9 * (begin_s - 1.0)), T0 + round(1e9 * (begin_s - 2.0)))
    assert track.arrays.gyro_ns.size < 2000 < whole.arrays.gyro_filled[0]
    at_s = np.linspace(58.5, 59.9, 30).tolist()
    np.testing.assert_allclose(look(track, *at_s).pose, look(whole, *at_s).pose, atol=1e-9)
    old = track.extend_turns(np.zeros(1, dtype=np.int64), np.array([T0]), np.ones(1))
    assert old.too_old.tolist() == [0]
    newest = stamps(100, 59.5, 59.6)
    assert track.extend_turns(np.zeros(11, dtype=np.int64), newest, np.ones(11)).duplicates == 11


def message(velocity: tuple[float, float, float], stamp_ns: int = T0, known: bool = True) -> bytes:
    names = ("x", "y", "z")
    covariance = np.full(9, 0.0 if known else -1.0)
    fields = {"header": {"stamp": stamp_ns, "frame_id": "imu"}, "angular_velocity_covariance": covariance}
    return encode({**fields, "angular_velocity": dict(zip(names, velocity, strict=True))}, IMU)


def test_messages_are_read_and_bad_ones_counted() -> None:
    swarm = Swarm((Robot("r0", imu=GYRO), Robot("r1")))
    ingest = Ingest(swarm)
    sent = [
        ("r0/imu", message((0.1, 0.2, 0.3))),
        ("r0/imu", message((0.1, 0.2, 0.3))[:-9]),
        ("r0/imu", message((0.1, math.nan, 0.3), T0 + 1)),
        ("r0/imu", message((0.1, 0.2, 0.3), T0 + 2, known=False)),
        ("r0/imu", message((0.0, 0.0, 1e9), T0 + 3)),
    ]
    assert "r1/imu" not in ingest.handle_of
    messages = [
        SerializedMessage(ingest.handle_of[topic], data, T0 + k) for k, (topic, data) in enumerate(sent)
    ]
    batch = MessageBatch.of(messages)
    (part,) = ingest.read(batch)
    assert part.dropped == {"bad_message": 1}
    drops = DropCounts(2)
    rows = TurnRateSensor(swarm, Settings(), drops).measure(part["imu"])
    assert rows.rate.tolist() == [0.3]
    assert drops.total == Counter(imu_no_rate=1, imu_non_finite=1, imu_absurd=1)
    with pytest.raises(CdrError):
        TurnRateSensor.decode(message((0.0, 0.0, 0.0))[:40])


@pytest.mark.parametrize("mounted", [0.0, math.pi])
@pytest.mark.parametrize(("lean", "knows"), [(0.3, True), (0.3, False), (-0.4, True)])
def test_a_robot_that_leans_turns_about_the_vertical(mounted: float, lean: float, knows: bool) -> None:
    """By the orientation of its IMU, if it has one; one of another mount is none."""
    mount, yaw_rate = Rotation.from_euler("X", mounted), 0.7
    turned = Rotation.from_euler("ZY", [1.0, lean]) * mount
    velocity = turned.inv().apply([0.0, 0.0, yaw_rate])
    fields = {"header": {"stamp": T0}, "angular_velocity": dict(zip("xyz", velocity, strict=True))}
    covariance = [0.0 if knows else -1.0] + [0.0] * 8
    seen = dict(zip("xyzw", turned.as_quat(), strict=True))
    data = encode({**fields, "orientation": seen, "orientation_covariance": covariance}, IMU)
    for described, uses in ((mounted, knows), (mounted + 0.5 * math.pi, False)):
        swarm = Swarm((Robot("r0", imu=replace(GYRO, roll=math.remainder(described, 2.0 * math.pi))),))
        ingest = Ingest(swarm)
        batch = MessageBatch.of([SerializedMessage(ingest.handle_of["r0/imu"], data, T0)])
        (part,) = ingest.read(batch)
        rate = TurnRateSensor(swarm, Settings(), DropCounts(1)).measure(part["imu"]).rate[0]
        assert (abs(rate - yaw_rate) < 1e-9) == uses


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_the_mount_is_taken_into_account(roll: float, pitch: float, rate: float) -> None:
    """The IMU measures the robot's turn about the vertical in its own frame."""
    imu = replace(GYRO, roll=roll, pitch=pitch)
    mount = Rotation.from_euler("YX", [pitch, roll]).as_matrix()
    velocity = mount.T @ [0.0, 0.0, rate]
    one = np.zeros(1, dtype=np.int64)
    unknown = np.full((1, 3), np.nan)
    rows = TurnRateRows(one, one + T0, velocity[None], unknown[:, 0], unknown, one + T0)
    sensor = TurnRateSensor(Swarm((Robot("r0", imu=imu),)), Settings(), DropCounts(1))
    converted = sensor.measure(rows)
    assert converted.rate[0] == pytest.approx(rate, abs=1e-9)
