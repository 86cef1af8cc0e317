"""Other robots in the scans of a lidar: what it sees of their bodies is no wall, but shows where they are.

A body is a disc that stands free: beams that end near each other, with nothing nearer beside them, as wide as
the disc is there. Discs have no identity. Located robots are assigned to them as to the detections of an
aerial image, and each becomes a range and a bearing from the lidar, at the time of its beams.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.numerics import wrap
from swarm_loc_estimator.common.se2 import between, inverse, transform_points
from swarm_loc_estimator.filter.measurements import NO_MEASUREMENTS, Measurements
from swarm_loc_estimator.filter.models import POLAR, gate_threshold
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.identification.picture import UNSEEN, Picture, assign, log_ratios
from swarm_loc_estimator.mapping.messages import LidarSweep, described_delay
from swarm_loc_estimator.sensors.fix import about_robots, take_out_headings
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import TrackedLimits, estimate_at
from swarm_loc_estimator.timeline.map_scans import MapScans, are_near_walls
from swarm_loc_estimator.timeline.settings import Settings

_MIN_BEAMS = 3  # Of a disc
_WIDTHS = (0.7, 1.2)  # Least and greatest width of what may be a disc, as a share of that of the disc
_GAP, _JUMP = 1.5, 0.7  # Steps between beams, and change of the range in radii, beyond which bodies differ
_ROUND = 0.8  # How far from the middle of a disc beams tell its distance, as a share of its radius
_SHAPE = 0.1  # Error of the shape of a body, as a share of its radius
_SIGMAS = 3.0
_MARGIN_M, _MAX_MARGIN_M = 0.05, 0.3  # Around a body, within which beams are left out
_DETECTION_PROBABILITY = 0.5  # Of a robot within the range of a lidar: others stand before it


class Discs(NamedTuple):
    """What may be discs (m,) in a scan, in the frame of its beams."""

    centre: FloatArray  # (m, 2) [m]
    variance: FloatArray  # (m, 2) of range and bearing from the lidar
    disc: IntArray  # (n,) number of the disc of each beam; -1: none

    def without(self, beams: BoolArray) -> Discs:
        """Those that do not have most of their beams among some (n,)."""
        count = len(self.centre)
        every, some = (np.bincount(self.disc[one], minlength=count) for one in (self.disc >= 0, beams))
        kept = np.append(2 * some <= every, False)  # -1 selects the last
        number = np.where(kept[self.disc], (np.cumsum(kept) - 1)[self.disc], -1)
        return Discs(self.centre[kept[:-1]], self.variance[kept[:-1]], number)


class RobotsInScans:
    """Finds located robots in scans; `scans` knows the beams of sweeps."""

    def __init__(self, swarm: Swarm, settings: Settings, scans: MapScans) -> None:
        self._scans = scans
        self._limits = TrackedLimits.of(swarm, settings)
        self._probability = settings.aerial_probability
        self._gate = float(gate_threshold(settings.aerial_gate_probability))
        discs(np.zeros((0, 2)), np.zeros(2), np.zeros(0), np.zeros(0), 1.0)  # compile

    def seen(
        self, state: SwarmState, one: Measurements, sweep: LidarSweep
    ) -> tuple[LidarSweep, Measurements]:
        """The sweep of a located robot without the beams that end at others, and sightings (k,) of these."""
        robot, stamp_ns, tracks = int(one.target), int(one.stamp_ns), self._scans.tracks
        lidar, known = sweep.lidar, state.tracked.copy()
        known[robot] = False
        others = np.flatnonzero(known)
        if not others.size:
            return sweep, NO_MEASUREMENTS
        # beams and robots, at the stamp of the scan
        delay = state.delays.get((robot, sweep.number)) or described_delay(lidar.delay_s)
        turned, best = sweep.backwards() if delay.backwards > 0.0 else sweep, int(delay.chance.argmax())
        (ends, origin, variance), now, _ = self._scans.beams(robot, stamp_ns, turned, delay.lag_s, best)
        at_ns = turned.beam_ns[turned.seen] - round(1e9 * float(delay.lag_s[best]))
        if not at_ns.size:
            return sweep, NO_MEASUREMENTS
        estimate = estimate_at(state, tracks.arrays, self._limits, stamp_ns)
        own, own_covariance = estimate.poses[robot], estimate.covariances[robot]
        poses, covariances = estimate.poses[others], estimate.covariances[others][:, :2, :2].copy()
        before = tracks.at(others, np.full(others.size, int(at_ns.min()))).pose
        after = tracks.at(others, np.full(others.size, stamp_ns)).pose
        moved = np.hypot(*(after - before)[:, :2].T)
        covariances += (moved**2)[:, None, None] * np.eye(2)
        # discs, in `map`
        found = discs(ends, origin, variance, turned.angle[turned.seen], lidar.robot_radius)
        if state.map is not None:  # pillars are no robots
            at_walls = are_near_walls(state.map.walls, transform_points(own, ends), _MARGIN_M)
            found = found.without(at_walls & (found.disc >= 0))
        picture = _picture(found, origin, own, own_covariance)
        log_density = math.log(max(len(found.centre), 1) / (math.pi * turned.reach**2))
        full = np.zeros((others.size, 3, 3))
        full[:, :2, :2] = covariances
        ratios = log_ratios(poses, full, picture, log_density, self._gate)
        place = np.full(others.size, UNSEEN)
        if len(found.centre):
            place = assign(ratios, _DETECTION_PROBABILITY, self._probability).place
        # beams at robots, by where they are estimated or seen
        spread = np.sqrt(np.trace(covariances, axis1=1, axis2=2) + np.trace(own_covariance[:2, :2]))
        reach = lidar.robot_radius + _MARGIN_M + np.minimum(_SIGMAS * spread, _MAX_MARGIN_M)
        centres = transform_points(inverse(own), poses[:, :2])
        away = np.hypot(*(ends[:, None] - centres[None]).transpose(2, 0, 1))
        at_robots: BoolArray = (away < reach).any(axis=1) | np.isin(found.disc, place[place >= 0])
        distance = sweep.distance.copy()
        distance[np.flatnonzero(sweep.seen)[at_robots]] = math.inf
        # sightings, at the time of their beams
        chosen = np.flatnonzero(place >= 0)
        stamps_ns = np.array([round(at_ns[found.disc == j].mean()) for j in place[chosen]], dtype=np.int64)
        there = tracks.at(np.full(chosen.size, robot), stamps_ns).pose
        seen = transform_points(between(there, now), found.centre[place[chosen]]) - origin
        value = np.stack([np.hypot(*seen.T), np.arctan2(seen[:, 1], seen[:, 0]), 0.0 * seen[:, 0]], axis=-1)
        noise = np.zeros((chosen.size, 3, 3))
        noise[:, [0, 1], [0, 1]] = found.variance[place[chosen]]
        sighted = about_robots(others[chosen], stamps_ns, value, noise, POLAR)
        sighted.observer[:], sighted.received_from[:], sighted.sensor[:, :2] = robot, robot, origin
        sighted.gate[:] = self._gate
        take_out_headings(sighted, np.ones(chosen.size, dtype=bool))
        shape = (_SHAPE * lidar.robot_radius) ** 2
        sighted.systematic_share[:, 0] = shape / noise[:, 0, 0]
        sighted.systematic_share[:, 1] = shape / value[:, 0] ** 2 / noise[:, 1, 1]
        return sweep._replace(distance=distance), sighted


def _picture(found: Discs, origin: FloatArray, own: FloatArray, own_covariance: FloatArray) -> Picture:
    """Discs (m,) in `map`, seen from a pose (3,) with covariance (3, 3), round."""
    away = np.hypot(*(found.centre - origin).T)
    variance = np.maximum(found.variance[:, 0], found.variance[:, 1] * away**2)
    variance += np.trace(own_covariance[:2, :2]) + own_covariance[2, 2] * away**2
    pose = np.column_stack([transform_points(own, found.centre), np.zeros(len(away))])
    covariance = variance[:, None, None] * np.eye(3)
    return Picture(pose, covariance, np.zeros(len(away), dtype=bool))


@cached_njit
def discs(
    ends: FloatArray, origin: FloatArray, variance: FloatArray, angle: FloatArray, radius: float
) -> Discs:
    """Find what may be discs of a radius [m].

    `ends` (n, 2) are of the beams that met something, in their order, from the origin (2,) of the lidar, with
    the variance (n,) of the ranges [m^2] and the directions (n,) by the lidar [rad].
    """
    count, disc = len(ends), np.full(len(ends), -1)
    centre, noise, size = np.zeros((count, 2)), np.zeros((count, 2)), 0
    arm = ends - origin
    distance = np.sqrt(arm[:, 0] ** 2 + arm[:, 1] ** 2)
    bearing = np.arctan2(arm[:, 1], arm[:, 0])
    # where one body ends and another begins; after[k]: the step of beams between k - 1 and k
    after = np.array([abs(wrap(angle[k] - angle[k - 1])) for k in range(count)])
    step = after.min() if count else 0.0
    jump = np.array([distance[k] - distance[k - 1] for k in range(count)])
    cut = (after > _GAP * step) | (np.abs(jump) > _JUMP * radius + _SIGMAS * np.sqrt(variance))
    first = np.flatnonzero(cut)[0] if cut.any() else count
    begin = first
    for n in range(first + 1, count + first + 1):
        if first == count or (n < count + first and not cut[n % count]):
            continue
        # a body from `begin` to `n`: with nothing nearer beside it
        last, here, begin = (n - 1) % count, begin, n
        beams = np.arange(here, n) % count
        is_hidden = (after[beams[0]] <= _GAP * step and jump[beams[0]] > 0.0) or (
            after[n % count] <= _GAP * step and jump[n % count] < 0.0
        )
        if is_hidden or len(beams) < _MIN_BEAMS:
            continue
        # as wide as a disc there, in the middle of its beams
        width = abs(wrap(bearing[last] - bearing[beams[0]]))
        middle = bearing[beams[0]] + 0.5 * wrap(bearing[last] - bearing[beams[0]])
        share = (width + step) / (2.0 * math.asin(min(1.0, radius / (distance[beams].min() + radius))))
        if not _WIDTHS[0] < share < _WIDTHS[1]:
            continue
        # and round: the distance of its centre is the same by all beams
        total, squares, used = 0.0, 0.0, 0
        for k in beams:
            off = distance[k] * math.sin(bearing[k] - middle)
            if abs(off) < _ROUND * radius:
                way = distance[k] * math.cos(bearing[k] - middle) + math.sqrt(radius * radius - off * off)
                total, squares, used = total + way, squares + way * way, used + 1
        mean = total / max(used, 1)
        limit = _SHAPE * radius + _SIGMAS * math.sqrt(variance[beams].max())
        if used == 0 or squares / used - mean * mean > limit * limit:
            continue
        disc[beams] = size
        centre[size, 0] = origin[0] + mean * math.cos(middle)
        centre[size, 1] = origin[1] + mean * math.sin(middle)
        shape = (_SHAPE * radius) ** 2
        noise[size, 0] = variance[beams].mean() / used + shape
        noise[size, 1] = step * step / 12.0 + shape / (mean * mean)
        size += 1
    return Discs(centre[:size], noise[:size], disc)
