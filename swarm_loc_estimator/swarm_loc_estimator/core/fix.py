"""Locating a robot from nothing: sightings that tie its odometry track to the map.

Each sighting between a waiting robot and something located says that one point of the robot's track (the
place where it saw the marker, or its own marker) lies at one point of the map. Two such points give the
transform in closed form (a rigid alignment); a sighting with heading gives it alone, with a mirrored
solution it gives two. The transform on which most clues agree is refined by least squares and accepted when
it is sure, and when no other one explains the clues about as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from swarm_loc_estimator.core import se2
from swarm_loc_estimator.core.measurements import NOBODY, Kind, MeasurementArray
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.state import SwarmState, robot_columns

CLUE_DTYPE = np.dtype(
    [
        ("stamp_ns", np.int64),
        ("local", np.float64, (2,)),  # point in the track's frame [m]
        ("local_covariance", np.float64, (2, 2)),
        ("track_noise", np.float64, (3, 3)),  # noise the track had gathered by then
        ("map", np.float64, (2,)),  # the same point in map [m]
        ("map_covariance", np.float64, (2, 2)),
        ("shared", np.float64, (3, 3)),  # part of it: right-invariant error of the robot on the other side
        ("turn", np.float64),  # heading of the transform that the sighting shows [rad], NaN: none
        ("other_turn", np.float64),  # of its mirrored solution, NaN: none
        ("turn_variance", np.float64),
    ]
)

_MOST_CLUES = 40
_LEAST_CLUES = 3
_AGREE = float(chi2.ppf(0.999, 2))
_LEAST_SHARE = 0.6  # of the clues must agree with a fix
_RIVAL_SHARE = 0.8  # another transform with this share of the best one's support makes the fix ambiguous
_MOST_RIVALS = 8
_APART_M, _APART_RAD = 0.1, 0.1
_HEADING_SIGMA = 0.2
_POSITION_SIGMA = 0.5
_REFINEMENTS = 5
_PRIOR = 1e-6  # so that what no clue shows is unsure instead of singular


@dataclass(frozen=True)
class Fix:
    """Where a track lies: its transform (3,) and the covariance (3, 3) of the right-invariant error."""

    transform: FloatArray
    covariance: FloatArray


class ClueBook:
    """Collects clues and lets robots enter.

    Args:
        tracks: The robots' odometry.
        window_s: Age up to which a clue is used.
    """

    def __init__(self, tracks: OdometryTracks, window_s: float) -> None:
        self._tracks = tracks
        self._window_ns = int(window_s * 1e9)

    def note(self, state: SwarmState, one: MeasurementArray) -> bool:
        """Keep a measurement (1,) that ties a waiting robot to something located; with a fix it enters.

        Returns:
            Whether the measurement was kept.
        """
        known = np.append(state.tracked, True)  # NOBODY (-1) finds the last
        observer, target = int(one["observer"][0]), int(one["target"][0])
        now_ns = int(one["stamp_ns"][0])
        robot = target if known[observer] else observer
        if known[observer] == known[target] or not self._tracks.begun(robot, now_ns):
            return False
        clue = self._clue(state, robot, one)
        old = state.clues.get(robot, clue[:0])
        clues = np.concatenate([old[old["stamp_ns"] >= now_ns - self._window_ns], clue])[-_MOST_CLUES:]
        state.clues[robot] = clues
        noise = self._tracks.at(np.array([robot]), one["stamp_ns"]).noise[0]
        fix = locate(clues, noise)
        if fix is not None:
            state.enter(robot, fix.transform, fix.covariance, noise)
        return True

    def _clue(self, state: SwarmState, robot: int, one: MeasurementArray) -> NDArray[np.void]:
        """The clue (1,) that a measurement (1,) gives about the robot."""
        sees = one["observer"][0] == robot
        other = int(one["target"][0] if sees else one["observer"][0])
        track = self._tracks.at(np.array([robot]), one["stamp_ns"])
        point, heading, covariance = _as_seen(one)
        base, spread = self._located(state, other, one)
        if sees:  # its sensor lies on the track, the marker on the map
            local_frame, map_frame = se2.compose(track.pose, one["sensor"]), se2.compose(base, one["marker"])
            local, target = se2.transform_points(local_frame, point), map_frame[:, :2]
            local_heading, map_heading = local_frame[:, 2] + heading, map_frame[:, 2]
        else:
            local_frame, map_frame = se2.compose(track.pose, one["marker"]), se2.compose(base, one["sensor"])
            local, target = local_frame[:, :2], se2.transform_points(map_frame, point)
            local_heading, map_heading = local_frame[:, 2], map_frame[:, 2] + heading
        seen = _rotated(covariance[:2, :2], (local_frame if sees else map_frame)[0, 2])
        lever = np.column_stack([np.eye(2), [-target[0, 1], target[0, 0]]])
        clue = np.zeros(1, dtype=CLUE_DTYPE)
        clue["stamp_ns"], clue["local"], clue["map"] = one["stamp_ns"], local, target
        clue["track_noise"] = track.noise
        clue["local_covariance"] = seen if sees else 0.0
        clue["map_covariance"] = lever @ spread @ lever.T + (0.0 if sees else seen)
        clue["shared"] = spread
        clue["turn"] = clue["other_turn"] = np.nan
        if one["has_heading"][0]:
            clue["turn"] = map_heading - local_heading
        if one["has_alternative"][0]:
            mirrored = one["alternative"][0, 2] - one["value"][0, 2]
            clue["other_turn"] = clue["turn"] + (-mirrored if sees else mirrored)
        clue["turn_variance"] = covariance[2, 2] + spread[2, 2]
        return clue

    def _located(self, state: SwarmState, other: int, one: MeasurementArray) -> tuple[FloatArray, FloatArray]:
        """Pose (1, 3) in map of the located side and the covariance (3, 3) of its error."""
        if other == NOBODY:
            return np.zeros((1, 3)), np.zeros((3, 3))
        robot = np.array([other])
        sample = self._tracks.at(robot, one["stamp_ns"])
        spread = state.filter.marginals(robot_columns(robot))[0] + state.map_noise(robot, sample.noise)[0]
        return se2.compose(state.transform[robot], sample.pose), spread


def locate(clues: NDArray[np.void], track_noise: FloatArray) -> Fix | None:
    """The transform that a robot's clues (k,) agree on, or None while it is not unique and sure.

    Args:
        clues: (k,) of CLUE_DTYPE.
        track_noise: (3, 3) noise the track has gathered by now; what came since a clue makes it less sure.
    """
    if clues.size < _LEAST_CLUES or np.unique(clues["stamp_ns"]).size < 2:
        return None
    spread = clues["local_covariance"] + _drift(clues, track_noise)
    hypotheses = _hypotheses(clues)
    if not hypotheses.shape[0]:
        return None
    agree = _residuals(clues, spread, hypotheses)[1] <= _AGREE
    support = agree.sum(axis=1) + (agree & _turn_agrees(clues, hypotheses)[1]).sum(axis=1)
    best = int(np.argmax(support))
    if agree[best].sum() < max(_LEAST_CLUES, _LEAST_SHARE * clues.size):
        return None
    rivals = np.flatnonzero(support >= _RIVAL_SHARE * support[best])
    rivals = rivals[np.argsort(hypotheses[rivals, 2])]
    chosen = rivals[np.unique(np.linspace(0, rivals.size - 1, _MOST_RIVALS).astype(int))]
    few = np.append(best, chosen)
    transforms, covariances = _refine(clues, spread, hypotheses[few], agree[few])
    # what clues share does not average out: the error of a robot seen, the drift of the track since
    weight = agree[best] / np.trace(spread + clues["map_covariance"], axis1=1, axis2=2)
    drift = np.average(track_noise - clues["track_noise"], axis=0, weights=weight)
    adjoint = se2.adjoint(transforms[0])
    covariances[0] += np.average(clues["shared"], axis=0, weights=weight) + adjoint @ drift @ adjoint.T
    middle = np.array([*clues["map"].mean(axis=0), 0.0])
    sigma = np.sqrt(np.diag(se2.pose_covariance(middle, covariances[0])))
    if not (sigma[2] < _HEADING_SIGMA and max(sigma[0], sigma[1]) < _POSITION_SIGMA):
        return None
    if _are_apart(transforms, sigma, clues):
        return None
    return Fix(transforms[0], covariances[0])


def _as_seen(one: MeasurementArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Point (1, 2) and heading (1,) of a measurement (1,) in the sensor's frame, with covariance (3, 3)."""
    value, covariance = one["value"], one["covariance"][0]
    if one["kind"][0] == Kind.CARTESIAN:
        return value[:, :2], value[:, 2], covariance
    distance, bearing = value[0, 0], value[0, 1]
    cos, sin = np.cos(bearing), np.sin(bearing)
    jacobian = np.array([[cos, -distance * sin, 0.0], [sin, distance * cos, 0.0], [0.0, 0.0, 1.0]])
    return np.array([[distance * cos, distance * sin]]), value[:, 2], jacobian @ covariance @ jacobian.T


def _rotated(covariance: FloatArray, angle: FloatArray) -> FloatArray:
    """Covariances (..., 2, 2) turned by angles (...)."""
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    turned: FloatArray = rotation @ covariance @ np.swapaxes(rotation, -1, -2)
    return turned


def _drift(clues: NDArray[np.void], track_noise: FloatArray) -> FloatArray:
    """Covariance (k, 2, 2) of the clues' points from what the track has drifted since."""
    lever = np.zeros((clues.size, 2, 3))
    lever[:, 0, 0] = lever[:, 1, 1] = 1.0
    lever[:, 0, 2], lever[:, 1, 2] = -clues["local"][:, 1], clues["local"][:, 0]
    drift: FloatArray = lever @ (track_noise - clues["track_noise"]) @ np.swapaxes(lever, 1, 2)
    return drift


def _hypotheses(clues: NDArray[np.void]) -> FloatArray:
    """Transforms (h, 3) from each clue with a heading and from each pair of clues far enough apart."""
    first, second = np.triu_indices(clues.size, 1)
    local = clues["local"][second] - clues["local"][first]
    target = clues["map"][second] - clues["map"][first]
    spread = np.trace(clues["local_covariance"] + clues["map_covariance"], axis1=1, axis2=2)
    sigma = np.sqrt(spread[first] + spread[second])
    length, true_length = np.hypot(*local.T), np.hypot(*target.T)
    usable = (true_length > 3.0 * sigma) & (np.abs(length - true_length) < 4.0 * sigma)
    turn = np.arctan2(target[:, 1], target[:, 0]) - np.arctan2(local[:, 1], local[:, 0])
    middle_local = 0.5 * (clues["local"][first] + clues["local"][second])
    middle_map = 0.5 * (clues["map"][first] + clues["map"][second])
    pairs = _placing(turn[usable], middle_local[usable], middle_map[usable])
    return np.concatenate([*(_shown(clues, name) for name in ("turn", "other_turn")), pairs])


def _shown(clues: NDArray[np.void], name: str) -> FloatArray:
    """Transforms (h, 3) from the clues that show a heading."""
    one = clues[~np.isnan(clues[name])]
    return _placing(one[name], one["local"], one["map"])


def _placing(turn: FloatArray, local: FloatArray, target: FloatArray) -> FloatArray:
    """Transforms (h, 3) with headings (h,) that bring points (h, 2) to their targets (h, 2)."""
    rotated = se2.transform_points(np.column_stack([np.zeros((turn.size, 2)), turn]), local)
    return np.column_stack([target - rotated, se2.wrap_angle(turn)])


def _residuals(
    clues: NDArray[np.void], spread: FloatArray, transforms: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (h, k, 2) of the clues' points under transforms (h, 3), and squared distances (h, k)."""
    residual = clues["map"] - se2.transform_points(transforms[:, None, :], clues["local"])
    covariance = clues["map_covariance"] + _rotated(spread, transforms[:, 2, None])
    weighted = np.linalg.solve(covariance, residual[..., None])[..., 0]
    return residual, np.einsum("hki,hki->hk", residual, weighted)


def _turn_agrees(clues: NDArray[np.void], transforms: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """By what turn (h, k) headings shown, or mirrored, differ from transforms (h, 3); whether by little."""
    turns = np.stack([clues["turn"], clues["other_turn"]])[:, None, :] - transforms[None, :, None, 2]
    first, other = se2.wrap_angle(turns)
    turn = np.where(np.abs(other) < np.abs(first), other, first)  # NaN is not less
    return turn, np.abs(turn) < 3.0 * np.sqrt(clues["turn_variance"])


def _refine(
    clues: NDArray[np.void], spread: FloatArray, transforms: FloatArray, agree: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton on the points and headings that agree.

    Args:
        clues: (k,).
        spread: (k, 2, 2) covariances of the clues' points on the track.
        transforms: (h, 3) where to begin.
        agree: (h, k) which clues' points each transform is to explain.

    Returns:
        Transforms (h, 3) and covariances (h, 3, 3) of their right-invariant errors.
    """
    for _ in range(_REFINEMENTS):
        residual, squared = _residuals(clues, spread, transforms)
        covariance = clues["map_covariance"] + _rotated(spread, transforms[:, 2, None])
        point = se2.transform_points(transforms[:, None, :], clues["local"])
        jacobian = np.zeros((*agree.shape, 2, 3))
        jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0
        jacobian[..., 0, 2], jacobian[..., 1, 2] = -point[..., 1], point[..., 0]
        weighted = np.linalg.solve(covariance, jacobian) * agree[..., None, None]
        information = np.einsum("hkij,hkil->hjl", jacobian, weighted)
        gradient = np.einsum("hkij,hki->hj", weighted, residual)
        turn, shown = _turn_agrees(clues, transforms)
        weight = np.where(agree & shown, 1.0 / clues["turn_variance"], 0.0)
        information[:, 2, 2] += weight.sum(axis=1)
        gradient[:, 2] += np.where(weight > 0.0, turn * weight, 0.0).sum(axis=1)
        information += _PRIOR * np.eye(3)
        step = np.linalg.solve(information, gradient[..., None])[..., 0]
        transforms = se2.compose(se2.exp(step), transforms)
    freedom = np.maximum(1, 2 * agree.sum(axis=1) - 3)
    excess = np.maximum(1.0, np.sum(squared * agree, axis=1) / freedom)
    return transforms, excess[:, None, None] * np.linalg.inv(information)


def _are_apart(transforms: FloatArray, sigma: FloatArray, clues: NDArray[np.void]) -> bool:
    """Whether a transform (h, 3) places the track clearly elsewhere than the first, known to sigma (3,)."""
    middle = clues["local"].mean(axis=0)
    places = se2.transform_points(transforms, middle)
    apart = np.hypot(*(places - places[0]).T)
    turned = np.abs(se2.wrap_angle(transforms[:, 2] - transforms[0, 2]))
    return bool(np.any((apart > _APART_M + 3.0 * sigma[:2].max()) | (turned > _APART_RAD + 3.0 * sigma[2])))
