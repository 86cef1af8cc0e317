"""E-pucks that wander at random, seen by a camera above that cannot tell them apart.

They drive and turn at speeds of their own, which change every now and then, turn back at the arena's edge,
and stop and turn before others. The camera sees all of it; it misses some robots, and takes other things
for robots.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from swarm_loc_drivers.sim.differential_drive import Controller
from swarm_loc_drivers.sim.run import CAMERA_LATENESS, START_NS, LivedRun, arrival_ns
from swarm_loc_drivers.sim.scenarios.eight import ARENA, STEP_NS, EightSettings, drive_robots
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.detections import ANONYMOUS_DTYPE
from swarm_loc_estimator.swarm.swarm import Swarm

PERIOD_NS = 500_000_000
_SIGMA = 0.008
_DETECTED = 0.95
_FALSE = 0.1  # Mean number of false detections of an image
_SPEEDS, _TURN_RATE = (0.03, 0.10), 0.8
_CHANGES_S = (0.5, 3.0)
_EDGE, _NEAR = 0.2, 0.13
_HOMING_GAIN = 3.0


@dataclass(frozen=True)
class AerialRun(LivedRun):
    """A simulated swarm with an overhead camera that cannot tell robots apart."""

    stamp_ns: IntArray  # (k,) exposure of each image, in order of arrival
    arrival_ns: IntArray  # (k,)
    images: tuple[np.typing.NDArray[np.void], ...]  # (k) of each the detections (n,) of ANONYMOUS_DTYPE


def simulate_wandering(settings: EightSettings) -> AerialRun:
    """Drive robots about at random and look at them from above; each robot has a speed of its own."""
    rng = np.random.default_rng(settings.seed)
    start = places(rng, settings.robots, ARENA)
    swarm, truth, odometry = drive_robots(rng, settings, start, wander(rng, settings.robots, ARENA))
    blind = Swarm(tuple(replace(robot, camera=None, faces=()) for robot in swarm.robots))
    stamp_ns = np.arange(START_NS + PERIOD_NS, int(truth.stamp_ns[-1]), PERIOD_NS)
    poses = truth.all_at(stamp_ns)
    images = [_image(rng, poses[k]) for k in range(stamp_ns.size)]
    arrivals_ns = arrival_ns(rng, stamp_ns, CAMERA_LATENESS)
    come = rng.random(stamp_ns.size) >= W0.frame_loss
    order = [
        int(k)
        for k in np.argsort(arrivals_ns, kind="stable")
        if come[k] and arrivals_ns[k] < truth.stamp_ns[-1]
    ]
    return AerialRun(
        blind, truth, odometry, stamp_ns[order], arrivals_ns[order], tuple(images[k] for k in order)
    )


def places(rng: np.random.Generator, robots: int, arena: tuple[float, float]) -> FloatArray:
    """Start poses (N, 3) in an arena [m] that are not too near to each other."""
    half = 0.5 * np.array(arena) - _EDGE
    chosen: list[FloatArray] = []
    while len(chosen) < robots:
        place = rng.uniform(-half, half)
        if all(np.hypot(*(place - other)) > 2.0 * _NEAR for other in chosen):
            chosen.append(place)
    return np.column_stack([np.array(chosen), rng.uniform(-np.pi, np.pi, robots)])


def wander(rng: np.random.Generator, robots: int, arena: tuple[float, float]) -> Controller:
    """Commands in an arena [m] that change at random, each robot's at times of its own."""
    speed, rate, left_s = np.zeros(robots), np.zeros(robots), np.zeros(robots)
    half = 0.5 * np.array(arena) - _EDGE

    def control(_step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        new = left_s <= 0.0
        speed[new] = rng.uniform(*_SPEEDS, int(new.sum()))
        rate[new] = rng.uniform(-_TURN_RATE, _TURN_RATE, int(new.sum()))
        left_s[new] = rng.uniform(*_CHANGES_S, int(new.sum()))
        left_s[:] -= STEP_NS * 1e-9
        home = se2.wrap_angle(np.arctan2(-pose[:, 1], -pose[:, 0]) - pose[:, 2])
        out = (np.abs(pose[:, :2]) > half).any(axis=1)
        turn = np.where(out, np.clip(_HOMING_GAIN * home, -2.0, 2.0), rate)
        away = pose[None, :, :2] - pose[:, None, :2]
        ahead = away[..., 0] * np.cos(pose[:, 2])[:, None] + away[..., 1] * np.sin(pose[:, 2])[:, None]
        blocked = ((np.hypot(away[..., 0], away[..., 1]) < _NEAR) & (ahead > 0.0)).any(axis=1)
        return np.where(blocked, 0.0, speed), np.where(blocked, _TURN_RATE, turn)

    return control


def _image(rng: np.random.Generator, poses: FloatArray) -> np.typing.NDArray[np.void]:
    """Detections in an image of robots at poses (N, 3): positions in random order."""
    seen = poses[rng.random(len(poses)) < _DETECTED, :2]
    half = 0.5 * np.array(ARENA)
    false = rng.uniform(-half, half, (rng.poisson(_FALSE), 2))
    places = np.concatenate([seen + rng.normal(0.0, _SIGMA, seen.shape), false])
    image = np.zeros(len(places), dtype=ANONYMOUS_DTYPE)
    order = rng.permutation(len(places))
    image["x"], image["y"] = places[order].T
    image["theta"] = image["u_px"] = image["v_px"] = np.nan
    image["covariance"] = np.diag([_SIGMA**2, _SIGMA**2, np.pi**2])
    return image
