"""Pose of an overhead camera from control points and floor markers, kept while it holds.

`GroundCamera` maps pixels to places on a level plane and back, with covariances. Control points are places in
map whose pixels are known; a YAML file holds them, floor markers and intrinsics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.codec import WHOLE_FILE, Tree, TreeChecks, entry_specs, nearest, to_tree
from swarm_loc_estimator.common.parameters import (
    NumberSpec,
    UserError,
    autostart,
    choice,
    number,
    number_specs,
    text,
)
from swarm_loc_estimator.common.yaml_tree import read_tree, write_tree
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.images import TRANSPORTS, Gray
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import Family, families, family_named

BRIGHT, DARK = 1.0, -1.0  # Polarities of discs: brighter or darker than the floor
POLARITIES = {"auto": (BRIGHT, DARK), "bright": (BRIGHT,), "dark": (DARK,)}
"""The polarities that are tried, by the value of the parameter."""


@dataclass(frozen=True)
class AerialSettings:
    """Numbers of the aerial detector; the first three are of the control points."""

    control_sigma_px: float = number(
        1.0, "px", 0.01, 100.0, "standard deviation of the control points' pixels"
    )
    control_sigma: float = number(0.003, "m", 0.0, 1.0, "standard deviation of the control points' places")
    max_residual: float = number(
        4.0, "1", 1.0, 1e3, "reprojection residual beyond which control points are refused, in their sigmas"
    )
    robot_height: float = number(0.0, "m", 0.0, 10.0, "height of the robots' tops above the floor")
    robot_height_sigma: float = number(
        0.001, "m", 0.0, 1.0, "standard deviation of that height, one for all robots"
    )
    pixel_sigma: float = number(
        0.1, "px", 0.001, 10.0, "standard deviation of a robot's centre by the model of the lens"
    )
    robot_diameter: float = number(
        0.0, "m", 0.0, 10.0, "diameter of the pattern or blob on a robot; 0: estimated from the images"
    )
    min_diameter_px: float = number(6.0, "px", 4.0, 1000.0, "smallest diameter of robots in the image")
    x_min: float = number(-1e4, "m", -1e4, 1e4, "lower bound of the searched region in map")
    x_max: float = number(1e4, "m", -1e4, 1e4, "upper bound of the searched region in map")
    y_min: float = number(-1e4, "m", -1e4, 1e4, "lower bound of the searched region in map")
    y_max: float = number(1e4, "m", -1e4, 1e4, "upper bound of the searched region in map")
    min_contrast: float = number(
        0.12, "1", 0.01, 3.0, "least difference of robots and floor in the logarithm of brightness"
    )
    min_coverage: float = number(
        0.55, "1", 0.3, 1.0, "share of a robot's circle that must show an edge against the floor"
    )
    max_robots: int = number(200, "1", 1, 2000, "most detections in one image; the clearest are kept")


@dataclass(frozen=True)
class AerialParameters:
    """Parameters of `aerial_camera_node`."""

    autostart: bool = autostart()
    image_transport: str = choice("raw", tuple(TRANSPORTS), "transport: uncompressed images, or JPEG or PNG")
    control_points_file: str = text(
        "", "path of the control points, floor markers and intrinsics; without one nothing is published"
    )
    polarity: str = choice(
        "auto", tuple(POLARITIES), "whether robots are brighter or darker than the floor; auto: the clearer"
    )
    settings: AerialSettings = field(default_factory=AerialSettings, metadata={"numbers_of": AerialSettings})


POSE_SIZE = 6
_GRID = 48  # Samples along a side of the image for the reach of the lens
_PLACE_STEP = 1e-4
_POSE_STEPS = np.array([1e-6] * 3 + [1e-6] * 3)
_MIN_DEPTH = 1e-3  # Least depth of a projected place [m]


@dataclass(frozen=True)
class GroundCamera:
    """A camera with a known pose in map; the plane z = 0 of map is the floor."""

    camera: Camera  # Its intrinsics
    # (6,) from map to the optical frame (x right, y down, z forward): rotation vector, shift [m]
    pose: FloatArray
    covariance: FloatArray  # (6, 6) covariance of the pose

    def pixels(self, places: FloatArray) -> FloatArray:
        """(..., 2) raw pixels of places (..., 3) in map; NaN behind the camera and beyond its lens."""
        return projected(self.camera, self.pose, places, self.reach)

    @cached_property
    def reach(self) -> float:
        """Largest radius at distance 1 that the image shows."""
        camera = self.camera
        u, v = np.meshgrid(np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID))
        ideal = camera.to_ideal(np.stack([u, v], axis=-1))
        radius = np.linalg.norm((ideal - camera.intrinsics[2:]) / camera.intrinsics[:2], axis=-1)
        return float(np.nanmax(radius)) * 1.01

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) from map to the optical frame."""
        return rotation_of(self.pose)

    @cached_property
    def centre(self) -> FloatArray:
        """(3,) position of the camera in map [m]."""
        return np.asarray(-self.rotation.T @ self.pose[3:])

    def places(self, pixels: FloatArray, height: float) -> FloatArray:
        """(..., 2) x, y [m] on the plane z = `height` of raw pixels (..., 2); NaN where it is not seen."""
        camera = self.camera
        ideal = (camera.to_ideal(pixels) - camera.intrinsics[2:]) / camera.intrinsics[:2]
        rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (height - self.centre[2]) / rays[..., 2]
            places = self.centre[:2] + depth[..., None] * rays[..., :2]
        places[~(depth > _MIN_DEPTH)] = np.nan
        return np.asarray(places)

    def scale(self, places: FloatArray) -> FloatArray:
        """(...) pixels per metre at places (..., 3) on a level plane: the root of the scale of areas."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self._slopes(places)[..., :2]))))

    def covariances(
        self, places: FloatArray, pixel_covariance: FloatArray, height_sigma: float
    ) -> FloatArray:
        """(N, 2, 2) covariance of places (N, 3) from those of their raw pixels [px^2], pose and height [m].

        With z the pixel, p the place on a level plane, c the camera's pose and h the height, z = f(p, h, c)
        gives dp = (df/dp)^-1 (dz - df/dc dc - df/dh dh).
        """
        slopes = self._slopes(places)
        inverse = np.linalg.inv(slopes[..., :2])
        of_pose = pose_slopes(self.camera, self.pose, places)
        spread = pixel_covariance + of_pose @ self.covariance @ np.swapaxes(of_pose, -1, -2)
        of_height = slopes[..., 2:] * height_sigma
        spread = spread + of_height @ np.swapaxes(of_height, -1, -2)
        return np.asarray(inverse @ spread @ np.swapaxes(inverse, -1, -2))

    def pixel_covariances(self, places: FloatArray, covariance: FloatArray) -> FloatArray:
        """(N, 2, 2) covariance of raw pixels [px^2] from that of places (N, 3) on a level plane [m^2]."""
        slopes = self._slopes(places)[..., :2]
        return np.asarray(slopes @ covariance @ np.swapaxes(slopes, -1, -2))

    def _slopes(self, places: FloatArray) -> FloatArray:
        """(..., 2, 3) derivatives of pixels by places."""
        steps = _PLACE_STEP * np.eye(3)
        ahead, behind = (self.pixels(places[..., None, :] + s * steps) for s in (0.5, -0.5))
        return np.asarray(np.swapaxes(ahead - behind, -1, -2) / _PLACE_STEP)


def rotation_of(pose: FloatArray) -> FloatArray:
    """(3, 3) rotation of a pose (6,)."""
    return np.asarray(cv2.Rodrigues(pose[:3])[0], np.float64)


def projected(camera: Camera, pose: FloatArray, places: FloatArray, reach: float = np.inf) -> FloatArray:
    """(..., 2) raw pixels of places (..., 3) for a pose (6,); see `GroundCamera.pixels`."""
    seen = places @ rotation_of(pose).T + pose[3:POSE_SIZE]
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = seen[..., :2] / seen[..., 2:]
    outside: NDArray[np.bool_] = ~(seen[..., 2] > _MIN_DEPTH) | ~(np.linalg.norm(tangents, axis=-1) <= reach)
    tangents[outside] = 0.0
    pixels = camera.to_raw(tangents * camera.intrinsics[:2] + camera.intrinsics[2:])
    pixels[outside] = np.nan
    return pixels


def pose_slopes(camera: Camera, pose: FloatArray, places: FloatArray) -> FloatArray:
    """(..., 2, 6) derivatives of the pixels of places (..., 3) by a pose (6,)."""
    columns = [
        (projected(camera, pose + step, places) - projected(camera, pose - step, places)) / (2.0 * step.max())
        for step in np.diag(_POSE_STEPS)
    ]
    return np.stack(columns, axis=-1)


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
        places, pixels = (self.places, other.places), (self.pixels, other.pixels)
        return ControlPoints([*self.names, *other.names], np.concatenate(places), np.concatenate(pixels))


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
    for k in range(min(len(values), 8)):
        others = np.delete(values, k, axis=0)
        sizes = np.linalg.svd(others - others.mean(axis=0), compute_uv=False)
        if not sizes[1] > _MIN_SPREAD * sizes[0]:
            return False
    return True


def solve_pose(camera: Camera, points: ControlPoints, settings: AerialSettings) -> PoseFit:
    """Solve for the pose: IPPE or PnP, then least squares in raw pixels.

    The noise of a point is that of its pixel and that of its place, projected. The covariance is that of
    least squares, scaled up by residuals that exceed the noise.

    Raises:
        ControlPointError: The points do not determine a pose, or only one under the floor.
    """
    check_points(points)
    guess = _guess(camera, points)
    depth = (points.places @ rotation_of(guess).T + guess[3:])[:, 2]
    of_place = settings.control_sigma * camera.fx / np.maximum(depth, 1e-3)
    sigma: FloatArray = np.hypot(settings.control_sigma_px, of_place)  # (N,) of the points [px]

    def deviations(pose: FloatArray) -> FloatArray:
        away = (projected(camera, pose, points.places) - points.pixels) / sigma[:, None]
        return np.nan_to_num(away, nan=_FAR).ravel()

    with np.errstate(over="ignore", invalid="ignore"):
        found = least_squares(deviations, guess, method="lm", x_scale="jac", max_nfev=_STEPS * POSE_SIZE)
    pose: FloatArray = found.x
    away = deviations(pose).reshape(-1, 2)
    if not np.isfinite(pose).all() or (np.abs(away) >= _FAR).any():
        raise ControlPointError("the control points tell no pose: the camera would not see them all.")
    # the covariance of the pose by least squares
    slopes = (pose_slopes(camera, pose, points.places) / sigma[:, None, None]).reshape(-1, POSE_SIZE)
    information = slopes.T @ slopes
    scale = np.sqrt(np.diag(information))
    is_open = not np.isfinite(scale).all() or (scale <= 0.0).any()
    if is_open or np.linalg.cond(even := information / np.outer(scale, scale)) > 1e12:
        raise ControlPointError("the control points leave the camera's pose open.")
    freedom = away.size - POSE_SIZE
    growth = max(1.0, float(np.sum(away**2)) / freedom) if freedom > 0 else 1.0
    covariance: FloatArray = growth * np.linalg.inv(even) / np.outer(scale, scale)
    ground = GroundCamera(camera, pose, covariance)
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


def misfit(fit: PoseFit, points: ControlPoints, settings: AerialSettings) -> str:
    """What is wrong with the points of a fit, a sentence; empty: nothing.

    If all points but one agree, that one is named, otherwise the worst one.
    """
    worst = int(np.argmax(fit.deviations))
    if fit.deviations[worst] <= settings.max_residual:
        return ""
    for suspect in np.argsort(-fit.deviations).tolist():
        columns = (np.delete(one, suspect, axis=0) for one in (points.places, points.pixels))
        rest = ControlPoints([n for k, n in enumerate(points.names) if k != suspect], *columns)
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


_UNIT_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
"""Clockwise from the upper left of a marker, x right and y up when facing it."""
_CORNER_NAMES = ("upper left", "upper right", "lower right", "lower left")


@dataclass(frozen=True)
class FloorMarker:
    """A marker that lies on the floor, or level above it, face up."""

    id: int
    x: float = number(0.0, "m", -1e4, 1e4, "x of its centre in map")
    y: float = number(0.0, "m", -1e4, 1e4, "y of its centre in map")
    z: float = number(0.0, "m", -10.0, 10.0, "z of its centre in map")
    yaw: float = number(0.0, "rad", -6.3, 6.3, "direction to its right, from the x axis of map")
    size: float = number(0.1, "m", 0.001, 10.0, "side of its black square")

    @property
    def corners(self) -> FloatArray:
        """(4, 3) in map [m], clockwise from its own upper left."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        flat = self.size * _UNIT_CORNERS @ np.array([[cos, sin], [-sin, cos]]) + [self.x, self.y]
        return np.concatenate([flat, np.full((4, 1), self.z)], axis=1)


class FloorMarkers:
    """Finds floor markers of a family, and averages their corners over the images of a static camera."""

    def __init__(self, markers: Sequence[FloorMarker], family: Family, camera: Camera) -> None:
        self._markers = {marker.id: marker for marker in markers}
        ids = np.array(sorted(self._markers), np.int64)
        self._detector = MarkerDetector(DetectorSettings(), {family: ids}, camera)
        self._sums: dict[int, FloatArray] = {}
        self._counts: dict[int, int] = {}

    def look(self, gray: Gray) -> ControlPoints:
        """Control points from one image (height, width), which also adds to the mean."""
        found = self._detector.detect(gray)
        seen = dict(zip(found.id.tolist(), found.corners, strict=True))
        for marker_id, corners in seen.items():
            self._sums[marker_id] = self._sums.get(marker_id, np.zeros((4, 2))) + corners
            self._counts[marker_id] = self._counts.get(marker_id, 0) + 1
        return self._points(seen)

    def mean(self) -> ControlPoints:
        """Control points from all images so far."""
        return self._points({i: self._sums[i] / self._counts[i] for i in self._sums})

    def _points(self, corners: Mapping[int, FloatArray]) -> ControlPoints:
        """The corners (4, 2) of markers as control points."""
        return ControlPoints(
            [f"{corner} of marker {marker_id}" for marker_id in corners for corner in _CORNER_NAMES],
            np.array([self._markers[marker_id].corners for marker_id in corners]).reshape(-1, 3),
            np.array(list(corners.values())).reshape(-1, 2),
        )

    def forget(self) -> None:
        """Reset the mean after the camera has moved."""
        self._sums.clear()
        self._counts.clear()


NO_GROUND = "there are neither control points nor floor markers, without which nothing is published."
_SETTLING, _LATER_EVERY = 10, 10
"""Markers are searched in this many first images, then in every n-th to detect motion of the camera."""
_MOVED = 3.0  # Median displacement of markers that shows a motion of the camera, in sigmas of a point


@dataclass(frozen=True)
class Ground:
    """Known references on the floor."""

    points: ControlPoints = NO_POINTS  # Control points
    markers: tuple[FloorMarker, ...] = ()  # Floor markers
    # Family of the floor markers
    family: Family = field(default_factory=lambda: family_named("aruco_mip_36h12"))
    camera: Camera | None = None  # Intrinsics; None: those of camera_info

    @property
    def is_empty(self) -> bool:
        """Whether there is neither a point nor a marker."""
        return not self.points.names and not self.markers


class GroundControl:
    """Keeps the pose of one camera, by known references on the floor.

    The settings are the noise of the control points, and the limit of their residuals.
    """

    def __init__(self, ground: Ground, camera: Camera, settings: AerialSettings) -> None:
        self._ground, self._camera, self._settings = ground, camera, settings
        self._markers = FloorMarkers(ground.markers, ground.family, camera) if ground.markers else None
        self._images = 0
        self.moves = 0  # Number of detected motions of the camera
        self.fit: PoseFit | None = None  # The pose; None: unknown
        # Why it is unknown, a sentence; empty: it is known, or there was no image yet
        self.trouble = NO_GROUND if ground.is_empty else ""
        if len(ground.points) >= MIN_POINTS or (ground.points.names and not ground.markers):
            self._solve(ground.points)

    def look(self, gray: Gray) -> GroundCamera | None:
        """The camera with its pose at an image (height, width); None: see `trouble`."""
        markers = self._markers
        # solve for the pose with the markers of the first images, then detect motions of the camera
        if markers is not None and self._images < _SETTLING:
            markers.look(gray)
            if self.fit is None or self._images == _SETTLING - 1:
                self._solve(self._ground.points.concatenate(markers.mean()))
        elif markers is not None and (self.fit is None or self._images % _LATER_EVERY == 0):
            seen = markers.look(gray)
            has_moved = self.fit is None
            if self.fit is not None and len(seen):  # whether most markers have moved in the image
                away = np.linalg.norm(self.fit.ground.pixels(seen.places) - seen.pixels, axis=1)
                sigma = np.hypot(self._settings.control_sigma_px, self.fit.rms_px)
                has_moved = not np.median(away) <= _MOVED * sigma
            if has_moved:
                self.moves += self.fit is not None
                self._images = 0
                markers.forget()
                markers.look(gray)
                self._solve(self._ground.points.concatenate(markers.mean()))
        self._images += 1
        return self.fit.ground if self.fit else None

    def _solve(self, points: ControlPoints) -> None:
        try:
            self.fit, self.trouble = _solved(self._camera, points, self._settings), ""
        except ControlPointError as error:
            self.fit, self.trouble = None, str(error)


def located(ground: Ground, camera: Camera, pictures: Sequence[Gray], settings: AerialSettings) -> PoseFit:
    """The pose by all points and by the corners of the markers, averaged over all pictures (height, width).

    Raises:
        ControlPointError: The points do not determine a pose, or contradict each other.
    """
    points = ground.points
    if ground.markers:
        markers = FloorMarkers(ground.markers, ground.family, camera)
        for gray in pictures:
            markers.look(gray)
        points = points.concatenate(markers.mean())
    return _solved(camera, points, settings)


def _solved(camera: Camera, points: ControlPoints, settings: AerialSettings) -> PoseFit:
    """The pose with points; raises ControlPointError if they do not fit."""
    fit = solve_pose(camera, points, settings)
    if why := misfit(fit, points, settings):
        raise ControlPointError(why)
    return fit


_PLACE = NumberSpec("m", -1e4, 1e4, False, "in map")
_PIXEL = NumberSpec("px", -1e5, 1e5, False, "in the raw image")
_POINT = {"x": _PLACE, "y": _PLACE, "z": _PLACE, "u": _PIXEL, "v": _PIXEL}
_REQUIRED = ("x", "y", "u", "v")
_CAMERA = {
    "width": NumberSpec("px", 1, 1e5, False, "columns"),
    "height": NumberSpec("px", 1, 1e5, False, "rows"),
    **{name: NumberSpec("px", -1e6, 1e6, False, "intrinsics") for name in ("fx", "fy", "cx", "cy")},
}


class GroundFileError(UserError):
    """An invalid file of control points; the message is one sentence."""


def load_ground(path: Path) -> Ground:
    """Read control points.

    Raises:
        GroundFileError: It cannot be read, a value is wrong, or the points do not determine a pose.
    """
    return _Reader(path, GroundFileError).ground(read_tree(path, GroundFileError))


def save_ground(ground: Ground, path: Path, comment: str = "") -> None:
    """Write control points and floor markers for `load_ground`."""
    points = ground.points
    rows = zip(points.names, points.places.tolist(), points.pixels.tolist(), strict=True)
    tree = {
        "points": {name: dict(zip("xyzuv", [*place, *pixel], strict=True)) for name, place, pixel in rows},
        "family": ground.family.name,
        "markers": {one.id: to_tree(one, keep=number_specs(FloorMarker)) for one in ground.markers},
    }
    write_tree(tree, path, comment.splitlines())


class _Reader(TreeChecks):
    """Takes control points out of one file."""

    def ground(self, tree: Tree) -> Ground:
        sections = self.mapping(tree, WHOLE_FILE, ("points", "family", "markers", "camera"))
        points = self._points(self.mapping(sections.get("points"), "points"))
        name, known = sections.get("family", "aruco_mip_36h12"), families()
        if not isinstance(name, str) or name not in known:
            raise self.said(f"family is {name!r}, which is none{nearest(str(name), known)}")
        family = known[name]
        markers = self._markers(self.mapping(sections.get("markers"), "markers"), family)
        if not markers:
            self.made("", check_points, points=points)
        return Ground(points, markers, family, self._camera(sections.get("camera")))

    def _points(self, tree: dict[Any, Tree]) -> ControlPoints:
        rows = [self.values(entry, f"points.{name}", _POINT, _REQUIRED) for name, entry in tree.items()]
        values = np.array([[row.get(key) or 0.0 for key in _POINT] for row in rows], float).reshape(-1, 5)
        return ControlPoints([str(name) for name in tree], values[:, :3], values[:, 3:])

    def _markers(self, tree: dict[Any, Tree], family: Family) -> tuple[FloorMarker, ...]:
        markers = []
        for marker_id, entry in tree.items():
            if not isinstance(marker_id, int) or not 0 <= marker_id < len(family.words):
                raise self.said(
                    f"markers has {marker_id!r}, but ids of {family.name} are 0 to {len(family.words) - 1}"
                )
            required = ("x", "y", "size")
            values = self.values(entry, f"markers.{marker_id}", entry_specs(FloorMarker), required)
            markers.append(FloorMarker(marker_id, **values))
        return tuple(markers)

    def _camera(self, tree: Tree) -> Camera | None:
        if tree is None:
            return None
        section = self.mapping(tree, "camera", (*_CAMERA, "distortion_model", "distortion"), _CAMERA)
        values: dict[str, Any] = {
            k: self.number(section[k], f"camera.{k}", spec) for k, spec in _CAMERA.items()
        }
        values |= {key: int(values[key]) for key in ("width", "height")}
        values["distortion"] = self.list_of_numbers(section.get("distortion", []), "camera.distortion")
        return self.made("", Camera, model=str(section.get("distortion_model", "plumb_bob")), **values)
