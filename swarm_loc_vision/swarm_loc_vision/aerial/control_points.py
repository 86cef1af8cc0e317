"""Pose of a camera from ground control points: places in map whose pixels are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.ground_camera import POSE_SIZE, GroundCamera, pose_slopes, projected, rotation_of
from swarm_loc_vision.aerial.parameters import AerialSettings
from swarm_loc_vision.common.camera import Camera

MIN_POINTS = 4
MAX_POINTS = 1000
# Checked by test_control_points.py.
_MIN_SPREAD = 0.02  # Least ratio of the extents of points; below it they count as on one line
_STEPS = 200
_FAR = 1e4  # Residual of a point that a pose does not see [sigma]


class ControlPointError(ValueError):
    """Control points that do not determine a pose; the message is one sentence."""


@dataclass(frozen=True)
class ControlPoints:
    """Places and their pixels, one row each."""

    names: Sequence[str]  # (N,) for messages
    places: FloatArray  # (N, 3) in map [m]
    pixels: FloatArray  # (N, 2) in the raw image [px]

    def __len__(self) -> int:
        return len(self.names)

    def concatenate(self, other: ControlPoints) -> ControlPoints:
        """These points and others."""
        return ControlPoints(
            [*self.names, *other.names],
            np.concatenate([self.places, other.places]),
            np.concatenate([self.pixels, other.pixels]),
        )


NO_POINTS = ControlPoints((), np.zeros((0, 3)), np.zeros((0, 2)))


@dataclass(frozen=True)
class PoseFit:
    """Pose of a camera from control points."""

    ground: GroundCamera  # The camera with its pose
    residuals: FloatArray  # (N,) reprojection errors [px]
    deviations: FloatArray  # (N,) reprojection errors over their standard deviations
    names: Sequence[str]  # (N,) names of the points

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals [px]."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def check_points(points: ControlPoints) -> None:
    """Check that points can determine a pose.

    Raises:
        ControlPointError: They are too few or too many, or lie on one line in map or in the image.
    """
    if len(points) < MIN_POINTS:
        count = f"only {len(points)}" if len(points) else "no"
        raise ControlPointError(
            f"there are {count} control points, but a camera's pose needs {MIN_POINTS} or more."
        )
    if len(points) > MAX_POINTS:
        raise ControlPointError(f"there are {len(points)} control points, but {MAX_POINTS} are enough.")
    for values, where in ((points.places, "in map"), (points.pixels, "in the image")):
        if not np.isfinite(values).all():
            raise ControlPointError(f"the control points have numbers {where} that are not finite.")
        if not _determines(values):
            raise ControlPointError(
                f"the control points lie on one line {where}, or but for one do; no three of four must do so."
            )


def _determines(values: FloatArray) -> bool:
    """Whether points span a plane even without any one of them."""
    if len(np.unique(np.round(values, 9), axis=0)) < MIN_POINTS:
        return False
    return all(_spread(np.delete(values, k, axis=0)) > _MIN_SPREAD for k in range(min(len(values), 8)))


def _spread(values: FloatArray) -> float:
    """Ratio of the second to the first extent of points."""
    sizes = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
    return float(sizes[1] / sizes[0]) if sizes[0] > 0.0 else 0.0


def solve_pose(camera: Camera, points: ControlPoints, settings: AerialSettings) -> PoseFit:
    """Solve for the pose: IPPE or PnP, then least squares in raw pixels.

    The noise of a point is that of its pixel and that of its place, projected. The covariance is that of
    least squares, scaled up by residuals that exceed the noise.

    Raises:
        ControlPointError: The points do not determine a pose, or only one under the floor.
    """
    check_points(points)
    guess = _guess(camera, points)
    sigma = _sigmas(camera, guess, points, settings)

    def deviations(pose: FloatArray) -> FloatArray:
        away = (projected(camera, pose, points.places) - points.pixels) / sigma[:, None]
        return np.nan_to_num(away, nan=_FAR).ravel()

    with np.errstate(over="ignore", invalid="ignore"):
        found = least_squares(deviations, guess, method="lm", x_scale="jac", max_nfev=_STEPS * POSE_SIZE)
    pose: FloatArray = found.x
    away = deviations(pose).reshape(-1, 2)
    if not np.isfinite(pose).all() or (np.abs(away) >= _FAR).any():
        raise ControlPointError("the control points tell no pose: the camera would not see them all.")
    ground = GroundCamera(camera, pose, _covariance(camera, pose, points, sigma, away))
    if ground.centre[2] <= points.places[:, 2].max():
        raise ControlPointError(
            f"by its control points the camera is {ground.centre[2]:.3g} m above the floor:"
            " are the signs of x and y right?"
        )
    length = np.linalg.norm(away, axis=1)
    return PoseFit(ground, length * sigma, length, points.names)


def _guess(camera: Camera, points: ControlPoints) -> FloatArray:
    """An initial pose (6,)."""
    ideal = camera.to_ideal(points.pixels)
    seen = np.isfinite(ideal).all(axis=1)
    if seen.sum() < MIN_POINTS or not _determines(points.places[seen]):
        raise ControlPointError("too many control points lie where the model of the lens has no inverse.")
    tries = [cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_ITERATIVE]
    if np.ptp(points.places[seen, 2]) == 0.0:
        tries.insert(0, cv2.SOLVEPNP_IPPE)
    best, least = None, np.inf
    for method in tries:
        try:
            _, turns, shifts, errors = cv2.solvePnPGeneric(
                points.places[seen], ideal[seen], camera.matrix, None, flags=method
            )
        except cv2.error:
            continue
        for turn, shift, error in zip(turns, shifts, np.ravel(errors), strict=True):
            pose = np.concatenate([turn.ravel(), shift.ravel()]).astype(float)
            height = float(-(rotation_of(pose).T @ pose[3:])[2])
            cost = float(error) + (0.0 if height > 0.0 else 1e6)
            if np.isfinite(pose).all() and cost < least:
                best, least = pose, cost
    if best is None:
        raise ControlPointError("the control points tell no pose of the camera.")
    return best


def _sigmas(camera: Camera, pose: FloatArray, points: ControlPoints, settings: AerialSettings) -> FloatArray:
    """(N,) standard deviations of the points in the image [px]."""
    depth = (points.places @ rotation_of(pose).T + pose[3:])[:, 2]
    of_place = settings.control_sigma * camera.fx / np.maximum(depth, 1e-3)
    return np.asarray(np.hypot(settings.control_sigma_px, of_place))


def _covariance(
    camera: Camera, pose: FloatArray, points: ControlPoints, sigma: FloatArray, away: FloatArray
) -> FloatArray:
    """(6, 6) covariance of a pose by least squares."""
    slopes = (pose_slopes(camera, pose, points.places) / sigma[:, None, None]).reshape(-1, POSE_SIZE)
    information = slopes.T @ slopes
    scale = np.sqrt(np.diag(information))
    if not np.isfinite(scale).all() or (scale <= 0.0).any():
        raise ControlPointError("the control points leave the camera's pose open.")
    even = information / np.outer(scale, scale)
    if np.linalg.cond(even) > 1e12:
        raise ControlPointError("the control points leave the camera's pose open.")
    freedom = away.size - POSE_SIZE
    growth = max(1.0, float(np.sum(away**2)) / freedom) if freedom > 0 else 1.0
    return np.asarray(growth * np.linalg.inv(even) / np.outer(scale, scale))


def misfit(fit: PoseFit, points: ControlPoints, settings: AerialSettings) -> str:
    """What is wrong with the points of a fit, a sentence; empty: nothing.

    If all points but one agree, that one is named, otherwise the worst one.
    """
    worst = int(np.argmax(fit.deviations))
    if fit.deviations[worst] <= settings.max_residual:
        return ""
    for suspect in np.argsort(-fit.deviations).tolist():
        rest = ControlPoints(
            [name for k, name in enumerate(points.names) if k != suspect],
            np.delete(points.places, suspect, axis=0),
            np.delete(points.pixels, suspect, axis=0),
        )
        try:
            without = solve_pose(fit.ground.camera, rest, settings)
        except ControlPointError:
            continue
        if len(rest) > MIN_POINTS and without.deviations.max() <= settings.max_residual:
            away = projected(fit.ground.camera, without.ground.pose, points.places[suspect])
            distance = float(np.linalg.norm(away - points.pixels[suspect]))
            return (
                f"control point {points.names[suspect]} lies {distance:.3g} px from where all others put it,"
                " which is more than its noise allows."
            )
    return (
        f"the control points contradict each other: {points.names[worst]} lies {fit.residuals[worst]:.3g} px"
        f" from where the camera's pose puts it ({fit.rms_px:.3g} px rms over all)."
    )
