"""Other robots in the scans of a lidar: what may be one, and what sightings of located ones tell."""

import math

import numpy as np
import pytest

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping.messages import ScanMessage
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.lidar import ScanRows
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.error_models import LidarModel
from swarm_loc_estimator.swarm.swarm import Robot, StartSigma, Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.robots_in_scans import Discs, discs

RADIUS, BEAMS, PERIOD_NS, SIGMA = 0.15, 360, 200_000_000, 0.01
ANGLES = 2.0 * math.pi / BEAMS * np.arange(BEAMS)
Circle = tuple[float, float, float]  # x [m], y [m], radius [m]


def ranges_to(circles: list[Circle], away: float, rng: np.random.Generator) -> FloatArray:
    """Ranges (BEAMS,) from the origin to the first of circles, or to a round wall."""
    out = np.full(BEAMS, away)
    for x, y, radius in circles:
        along, across = x * np.cos(ANGLES) + y * np.sin(ANGLES), y * np.cos(ANGLES) - x * np.sin(ANGLES)
        met = (np.abs(across) < radius) & (along > 0.0)
        out[met] = np.minimum(out[met], along[met] - np.sqrt(radius**2 - across[met] ** 2))
    return out + SIGMA * rng.standard_normal(BEAMS)


def found_in(ranges: FloatArray) -> Discs:
    ends = ranges[:, None] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
    return discs(ends, np.zeros(2), np.full(BEAMS, SIGMA**2), ANGLES.astype(np.float64), RADIUS)


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_is_found_in_a_scan_wherever_it_stands(seed: int) -> None:
    """Also across the first beam."""
    rng = np.random.default_rng(seed)
    for bearing in (0.0, *rng.uniform(-math.pi, math.pi, 8).tolist()):
        away = float(rng.uniform(0.6, 3.0))
        centre = away * np.array([math.cos(bearing), math.sin(bearing)])
        found = found_in(ranges_to([(*centre, RADIUS)], 5.0, rng))
        assert len(found.centre) == 1
        sigma = np.sqrt(found.variance[0].max() + found.variance[0, 1] * away**2)
        assert np.hypot(*(found.centre[0] - centre)) < 4.0 * sigma
        assert sigma < 0.05


@pytest.mark.parametrize(
    "circles",
    [
        [(1.5, 0.0, 0.03)],  # a pole
        [(1.5, 0.0, 0.6)],  # a column
        [(2.0, 0.0, RADIUS), (1.0, 0.12, 0.08)],  # a robot that is half hidden, by something narrower
        [],
    ],
)
def test_what_is_no_robot_is_not_found(circles: list[Circle]) -> None:
    assert not len(found_in(ranges_to(circles, 5.0, np.random.default_rng(3))).centre)


def drive(radius: float, seed: int) -> Estimate:
    """Two robots, of which one drives around the other; it starts 15 cm from where it is believed to."""
    rng, until_ns = np.random.default_rng(seed), 6_000_000_000
    lidar = LidarModel(range_sigma=SIGMA, range_sigma_per_m=0.0, robot_radius=radius)
    wide, narrow = StartSigma(0.2, 0.2, 0.05), StartSigma(0.001, 0.001, 0.001)
    b = Robot("b", start=(1.5, 0.15, 0.5 * math.pi), start_sigma=wide)
    estimator = Estimator(Swarm((Robot("a", start=(0.0, 0.0, 0.0), start_sigma=narrow, lidar=lidar), b)))
    for now_ns in range(PERIOD_NS, until_ns + 1, PERIOD_NS):
        stamps = np.arange(now_ns - PERIOD_NS, now_ns + 1, 20_000_000)
        turn = 0.1e-9 * stamps
        around = np.stack([1.5 * np.sin(turn), 1.5 * (1.0 - np.cos(turn)), turn], axis=-1)
        poses = np.concatenate([np.zeros((len(stamps), 3)), around])
        robots, both = np.repeat([0, 1], len(stamps)), np.tile(stamps, 2)
        begin_ns, scan = now_ns - PERIOD_NS, np.empty(1, dtype=object)
        bearing = 0.1e-9 * (begin_ns + 0.5 * PERIOD_NS)
        centre = 1.5 * math.cos(bearing), 1.5 * math.sin(bearing)
        ranges = ranges_to([(*centre, RADIUS)], 5.0, rng)
        step = 2.0 * math.pi / BEAMS
        scan[0] = ScanMessage(begin_ns, 0.0, 2.0 * math.pi, step, 0.0, 0.1, 12.0, ranges)
        at_ns, arrival_ns = np.array([begin_ns]), np.array([now_ns])
        rows = OdometryRows(robots, both, poses, np.full_like(poses, np.nan), both)
        scans = ScanRows(np.zeros(1, dtype=np.int64), at_ns, scan, arrival_ns)
        estimator.receive(Batch.of(begin_ns, now_ns, odometry=rows, scans=scans))
        estimate = estimator.tick(now_ns)
    return estimate


@pytest.mark.parametrize("seed", range(3))
def test_scans_tell_where_another_robot_is_without_a_map(seed: int) -> None:
    seen, unseen = drive(RADIUS, seed), drive(0.0, seed)
    truth = 1.5 * np.array([math.cos(0.6), math.sin(0.6)])
    error = seen.poses[1, :2] - truth
    assert np.hypot(*error) < 0.04
    assert np.hypot(*(unseen.poses[1, :2] - truth)) == pytest.approx(0.15, abs=0.01)
    assert error @ np.linalg.solve(seen.covariances[1, :2, :2], error) < 14.0
