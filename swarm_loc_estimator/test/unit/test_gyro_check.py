"""Gyroscopes against wheels: wrong ones are named and left out, what lasts short or skids is not."""

from collections.abc import Callable

import numpy as np
import pytest
from core_messages import T0
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from wrong_setups import ROBOT, good, with_gyroscope

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.error_models import ImuModel, OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot
from swarm_loc_estimator.timeline.estimate import Contradicted, Status

GYRO = ImuModel(turn_noise_density=3e-4, turn_bias_sigma=0.01)
WHEELS = OdometryModel(wheel_separation=0.053, wheel_noise=2e-5)
SPEED, SLIP = 0.06, 0.03  # [m/s], and random walk of the turns of wheels [rad/s^0.5]
STEP_NS, GYRO_STEP_NS = 50_000_000, 20_000_000
Stamps = NDArray[np.int64]


def seconds(stamp_ns: Stamps) -> FloatArray:
    return np.asarray((stamp_ns - T0) * 1e-9)


def rate(at_s: FloatArray) -> FloatArray:
    """True turn rates, both to the left and to the right."""
    return np.asarray(0.4 * np.sin(0.3 * at_s + 0.8))


class Drive:
    """Odometry and turn rates of a robot that turns to both sides; its wheels report a share of each turn."""

    def __init__(self, seed: int, end_s: float = 40.0, share: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        self.stamp_ns = T0 + np.arange(0, round(end_s * 1e9), STEP_NS)
        self.gyro_ns = T0 + np.arange(-GYRO_STEP_NS, round(end_s * 1e9) + STEP_NS, GYRO_STEP_NS)
        turn = 0.05 * rate(seconds(self.stamp_ns)) + SLIP * np.sqrt(0.05) * rng.standard_normal(
            self.stamp_ns.size
        )
        self.turn = share * turn
        self.rate = rate(seconds(self.gyro_ns)) + 2e-3 * rng.standard_normal(self.gyro_ns.size)

    def raw(self) -> FloatArray:
        """Odometry (k, 3)."""
        heading = np.cumsum(self.turn)
        way = SPEED * 0.05 * np.column_stack([np.cos(heading), np.sin(heading)])
        return np.column_stack([np.cumsum(way, axis=0), heading])

    def tracks(self) -> OdometryTracks:
        """The track of all data."""
        tracks = OdometryTracks([Robot("r0", odometry=WHEELS, imu=GYRO)])
        tracks.extend_turns(np.zeros_like(self.gyro_ns), self.gyro_ns, self.rate)
        tracks.extend(np.zeros_like(self.stamp_ns), self.stamp_ns, self.raw())
        return tracks

    def doubted(self) -> NDArray[np.bool_]:
        """Whether the gyroscope is contradicted, as each row of odometry arrives."""
        tracks = OdometryTracks([Robot("r0", odometry=WHEELS, imu=GYRO)])
        tracks.extend_turns(np.zeros_like(self.gyro_ns), self.gyro_ns, self.rate)
        one, raw, found = np.zeros(1, dtype=np.int64), self.raw(), []
        for k in range(self.stamp_ns.size):
            tracks.extend(one, self.stamp_ns[k : k + 1], raw[k : k + 1])
            found.append(bool(tracks.contradicts_gyroscope()[0]))
        return np.array(found)


FAULTS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "zero": lambda values: 0.0 * values,
    "other axis": lambda values: 2e-3 * np.random.default_rng(9).standard_normal(values.size),
    "upside down": lambda values: -values,
    "degrees": np.degrees,
}


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("at_s", [0.0, 11.0])
@pytest.mark.parametrize("seed", range(5))
def test_wrong_gyroscopes_are_named_within_five_seconds_and_come_back(
    name: str, at_s: float, seed: int
) -> None:
    drive = Drive(seed)
    time_s, end_s = seconds(drive.gyro_ns), at_s + 10.0
    wrong = (time_s >= at_s) & (time_s < end_s)
    drive.rate[wrong] = FAULTS[name](drive.rate[wrong])
    doubted, time_s = drive.doubted(), seconds(drive.stamp_ns)
    assert not doubted[time_s < at_s].any()
    assert doubted[(time_s > at_s + 5.0) & (time_s < end_s)].all()
    assert not doubted[time_s > end_s + 10.0].any()


@pytest.mark.parametrize("seed", range(5))
def test_a_frozen_gyroscope_is_named_when_the_turn_changes(seed: int) -> None:
    drive = Drive(seed)
    frozen = seconds(drive.gyro_ns) >= 15.0
    drive.rate[frozen] = drive.rate[frozen][0]
    doubted, time_s = drive.doubted(), seconds(drive.stamp_ns)
    assert not doubted[time_s < 15.0].any()
    assert doubted[time_s > 20.0].all()


@pytest.mark.parametrize("share", [1.0, 2.0, 0.6])
@pytest.mark.parametrize("seed", range(5))
def test_right_gyroscopes_are_neither_named_nor_less_certain(share: float, seed: int) -> None:
    """From the first turn on; skid-steered robots report twice their turns, which is learned in seconds."""
    drive = Drive(seed, share=share)
    assert not drive.doubted().any()
    from_s = 1.0 if share == 1.0 else 5.0
    end_ns = T0 + np.array([round(from_s * 1e9), round(39e9)])
    begin, end = drive.tracks().at(np.zeros(2, dtype=np.int64), end_ns).covariance[:, 2, 2]
    assert end - begin == pytest.approx(GYRO.turn_noise_density**2 * (39.0 - from_s), rel=1e-6)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("blocked", [True, False])
def test_what_lasts_short_is_uncertain_but_the_gyroscope_is_used(seed: int, blocked: bool) -> None:
    """Wheels turn while the robot is blocked; or the robot is pushed around while they roll on."""
    drive = Drive(seed)
    time_s, gyro_s = seconds(drive.stamp_ns), seconds(drive.gyro_ns)
    if blocked:
        drive.rate[(gyro_s > 15.0) & (gyro_s < 17.5)] -= rate(np.array(16.0))
        drive.turn[(time_s > 15.0) & (time_s < 17.5)] *= 1.5
    else:
        drive.rate[(gyro_s > 15.0) & (gyro_s < 16.0)] += 1.0
    assert not drive.doubted().any()
    at = drive.tracks().at(np.zeros(2, dtype=np.int64), T0 + np.array([14_000_000_000, 18_000_000_000]))
    turned = drive.rate[(gyro_s >= 14.0) & (gyro_s < 18.0)].sum() * 0.02
    assert np.diff(at.pose[:, 2])[0] == pytest.approx(turned, abs=0.01)
    apart = turned - drive.turn[(time_s > 14.0) & (time_s <= 18.0)].sum()
    assert abs(apart) < 3.0 * np.sqrt(np.diff(at.covariance[:, 2, 2])[0])


def test_the_turn_is_uncertain_from_the_begin_of_the_fault_on() -> None:
    drive = Drive(0)
    drive.rate[seconds(drive.gyro_ns) >= 16.0] = 0.0
    at_s = np.arange(16.0, 24.0, 0.25)
    sample = drive.tracks().at(np.zeros(at_s.size, dtype=np.int64), T0 + np.rint(at_s * 1e9).astype(np.int64))
    true = np.cumsum(rate(np.arange(16.0, 24.0, 0.001))) * 0.001
    error = sample.pose[:, 2] - sample.pose[0, 2] - true[np.rint((at_s - 16.0) * 1e3).astype(int)]
    sigma = np.sqrt(sample.covariance[:, 2, 2] - sample.covariance[0, 2, 2] + GYRO.turn_noise_density**2)
    assert np.all(np.abs(error[1:]) < 3.0 * sigma[1:])


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32), parts=st.integers(1, 6))
def test_the_order_of_arrival_does_not_matter(seed: int, parts: int) -> None:
    rng = np.random.default_rng(seed)
    drive = Drive(seed, 20.0)
    begin_s = rng.uniform(0.0, 15.0)
    time_s = seconds(drive.gyro_ns)
    wrong = (time_s > begin_s) & (time_s < begin_s + rng.uniform(1.0, 10.0))
    drive.rate[wrong] = rng.choice([0.0, -1.0]) * drive.rate[wrong]
    heard = rng.uniform(size=time_s.size) > rng.choice([0.0, 0.6])  # with gaps, some longer than the time-out
    drive.gyro_ns, drive.rate = drive.gyro_ns[heard], drive.rate[heard]
    other, raw = OdometryTracks([Robot("r0", odometry=WHEELS, imu=GYRO)]), drive.raw()
    places = [*((True, part) for part in np.array_split(rng.permutation(drive.gyro_ns.size), parts))]
    places += [(False, part) for part in np.array_split(rng.permutation(drive.stamp_ns.size), parts)]
    at_ns = T0 + np.arange(0, 20_000_000_000, 250_000_000)
    robots, last = np.zeros_like(at_ns), np.zeros((2, at_ns.size))
    for k in rng.permutation(len(places)).tolist():
        is_gyro, rows = places[k]
        if is_gyro:
            change = other.extend_turns(np.zeros_like(rows), drive.gyro_ns[rows], drive.rate[rows])
        else:
            change = other.extend(np.zeros_like(rows), drive.stamp_ns[rows], raw[rows])
        sample = other.at(robots, at_ns)
        now = np.stack([sample.pose[:, 2], sample.covariance[:, 2, 2]])
        before = at_ns <= change.changed_from_ns[0]
        np.testing.assert_array_equal(now[:, before], last[:, before])  # what had not changed is as it was
        last = now
    expected, found = drive.tracks().at(robots, at_ns), other.at(robots, at_ns)
    for name in ("pose", "covariance", "jacobian"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)


@pytest.mark.parametrize("factor", [0.0, -1.0])
def test_nobody_else_is_named(factor: float) -> None:
    estimated = with_gyroscope(factor)(good()).estimated
    (one,) = estimated.contradictions
    assert (one.about, one.kind) == (f"gyroscope of {ROBOT}", Contradicted.GYROSCOPE)
    assert (estimated.status == Status.TRACKED).all()
