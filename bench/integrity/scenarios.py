"""Scenarios: each injects a fault into a run, mostly of five e-pucks on the eight for sixty seconds, by seed.

Those of other sensors than odometry and cameras on robots are in `sensors.py`.
"""

import math
from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np

from bench.integrity import faults
from bench.integrity.faults import CLEAN, FAULT_S, SYSTEMATIC, Fault, settings_of
from bench.integrity.sensors import SENSOR_SCENARIOS
from bench.scenarios.eight_run import simulate_eight
from bench.scenarios.lived_run import SimulatedRun
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_drivers.sim.worlds import W0, W2
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray

_FACE = 20  # A marker of the second robot


def _clean_w0(seed: int) -> Fault:
    return Fault(simulate_eight(settings_of(seed, W0)))


@lru_cache(maxsize=1)  # scenarios of one seed share it
def _clean(seed: int) -> SimulatedRun:
    return simulate_eight(settings_of(seed, CLEAN))


def _w2_on_w0_file(seed: int) -> Fault:
    return Fault(simulate_eight(settings_of(seed, SYSTEMATIC)))


def _hidden_in_noise(seed: int) -> Fault:
    return Fault(simulate_eight(settings_of(seed, W2)))


def _driver_gap(seed: int) -> Fault:
    begin_s = 17.3 + 2.7 * seed % 20.0
    end_s = begin_s + (1.2, 1.6, 2.0, 3.0, 6.0)[seed % 5]
    return Fault(faults.restarted_driver(_clean(seed), 0, begin_s, end_s), end_s)


def _wrong_starts(seed: int) -> Fault:
    return Fault(faults.wrong_starts(_clean(seed), np.random.default_rng([seed, 1])), 0.0)


def _kidnapped(seed: int) -> Fault:
    at_s = 20.0 + 3.1 * seed % 15.0
    run = simulate_eight(settings_of(seed, CLEAN), moved=faults.kidnapped(0, at_s))
    seen_s = faults.next_sighting_s(run, 0, at_s)
    return Fault(run, seen_s, (at_s, seen_s))


def _false_sightings(seed: int) -> Fault:
    value = np.random.default_rng([seed, 2]).uniform([0.2, -0.15, -3.0], [0.5, 0.15, 3.0])
    run = faults.false_sightings(
        _clean(seed), (0, _FACE), FAULT_S, lambda stamps, _: np.tile(value, (stamps.size, 1))
    )
    return Fault(run, FAULT_S[1])


def _moved_landmark(seed: int) -> Fault:
    angle = np.random.default_rng([seed, 3]).uniform(0.0, 2.0 * math.pi)
    which, step = faults.busiest_landmark(_clean(seed)), (0.2 * math.cos(angle), 0.2 * math.sin(angle))
    moved = simulate_eight(settings_of(seed, CLEAN), lambda swarm: faults.moved_landmark(swarm, which, step))
    return Fault(moved, about=f"landmark {which}")


def _wrong_scale(seed: int) -> Fault:
    return Fault(faults.rescaled_odometry(_clean(seed), 0, 1.1))


def _turned_camera(seed: int) -> Fault:
    turned = simulate_eight(
        settings_of(seed, CLEAN), lambda swarm: faults.turned_camera(swarm, 0, math.radians(10.0))
    )
    return Fault(faults.changed_cameras(_clean(seed), turned, 0, FAULT_S[0]))


def _two_odometry_sources(seed: int) -> Fault:
    return Fault(faults.second_odometry(_clean(seed), 0, FAULT_S[0], 20.0))


_BLIND_S = 10.0  # Time without sightings of and by a robot whose odometry is reset


def _reset_blind(seed: int, *, at_origin: bool) -> Fault:
    """The odometry of an unseen robot is reset: near its origin, or its heading only."""
    rng = np.random.default_rng([seed, 6])
    at_s = float(rng.uniform(18.0, 30.0))
    begin_s, end_s = at_s - 0.5, at_s + _BLIND_S
    run = faults.with_twists(_clean(seed))
    pose = faults.odometry_pose(run, 0, at_s)
    if at_origin:
        near = np.append(rng.normal(0.0, 0.02, 2), rng.uniform(-0.5, 0.5))
        begin = faults.odometry_pose(run, 0, 0.0)
        run = faults.reset_odometry(run, 0, 0.0, se2.compose(near, se2.between(pose, begin)))
        run = faults.reset_odometry(run, 0, at_s, np.zeros(3))
    else:
        pose[2] += rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 3.0)
        run = faults.reset_odometry(run, 0, at_s, pose)
    hidden = faults.hide(run, 0, begin_s, end_s)
    return Fault(hidden, faults.next_sighting_s(hidden, 0, end_s))


def _twist_only(seed: int) -> Fault:
    run = faults.with_twists(_clean(seed))
    return Fault(faults.twist_only(run, 0))


def _odometry_flood(seed: int) -> Fault:
    return Fault(faults.second_odometry(_clean(seed), 0, FAULT_S[0], 1000.0))


def _creeping_spoof(seed: int, observers: int = 1) -> Fault:
    rng, run = np.random.default_rng([seed, 4]), _clean(seed)
    for k, (observer, target) in enumerate(((0, 1), (2, 3))[:observers]):
        sight = (observer, _FACE + 10 * (target - 1))
        source = _creeping(run, rng, observer, target)
        run = faults.false_sightings(run, sight, (FAULT_S[0] + k, FAULT_S[1]), source)
    return Fault(run, FAULT_S[1])


def _creeping(
    run: SimulatedRun, rng: np.random.Generator, observer: int, target: int
) -> faults.SightingSource:
    """Sightings that are true at first and then drift at 2 cm/s."""
    camera, face = run.swarm.robots[observer].camera, run.swarm.robots[target].faces[0]
    assert camera is not None  # noqa: S101
    angle = rng.uniform(0.0, 2.0 * math.pi)

    def source(stamps_ns: IntArray, truth: Trajectories) -> FloatArray:
        poses = truth.all_at(stamps_ns)
        sensor = se2.compose(poses[:, observer], np.array([camera.x, camera.y, camera.yaw]))
        marker = se2.compose(poses[:, target], np.array([face.x, face.y, face.yaw]))
        way = 0.02 * (faults.seconds(run, stamps_ns) - FAULT_S[0])
        marker[:, 0] += way * math.cos(angle)
        marker[:, 1] += way * math.sin(angle)
        noise = rng.standard_normal(marker.shape) * [0.005, 0.002, 0.06]
        return se2.between(sensor, marker) + noise

    return source


SCENARIOS: Mapping[str, Callable[[int], Fault]] = {
    "clean_w0": _clean_w0,
    "w2_on_w0_file": _w2_on_w0_file,
    "driver_gap": _driver_gap,
    "wrong_starts": _wrong_starts,
    "kidnapped": _kidnapped,
    "false_sightings": _false_sightings,
    "moved_landmark": _moved_landmark,
    "wrong_scale": _wrong_scale,
    "turned_camera": _turned_camera,
    "two_odometry_sources": _two_odometry_sources,
    "odometry_flood": _odometry_flood,
    "odometry_reset_origin_blind": lambda seed: _reset_blind(seed, at_origin=True),
    "heading_reset_blind": lambda seed: _reset_blind(seed, at_origin=False),
    "twist_only": _twist_only,
    "creeping_spoof": _creeping_spoof,
    "creeping_spoof_two": lambda seed: _creeping_spoof(seed, 2),
    "hidden_in_noise": _hidden_in_noise,
    **SENSOR_SCENARIOS,
}
