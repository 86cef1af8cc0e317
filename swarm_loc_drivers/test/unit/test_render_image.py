"""Rendered images against OpenCV's projection, against rays, and by what a mean over pixels must keep."""

import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from render_helpers import LANDMARK_SIZE, RayCaster, camera_matrix, pixels_of, small_arena

from bench.scenarios.eight_run import CAMERA
from swarm_loc_drivers.sim.render import scene as scenery
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.raster import Image
from swarm_loc_drivers.sim.render.renderer import Renderer, RobotCamera, Scene
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import CameraMount

SHARP = CameraModel(width=640, height=480, focus_sigma_px=0.0)
FISHY = CameraModel(width=640, height=480, focus_sigma_px=0.0, k1=-0.25, k2=0.06, p1=1e-3, p2=-5e-4)
SOFT = CameraModel(width=640, height=480, focus_sigma_px=0.6)
SHEET = LANDMARK_SIZE * 10 / 8
BEND_PX = (
    0.0014  # the renderer draws chords of at most 4 px, which leave FISHY's strongest bend by 0.00132 px
)

places = st.tuples(
    st.floats(0.15, 1.0),  # ahead [m]
    st.floats(-0.5, 0.5),  # across, as a share of that
    st.floats(-0.35, 0.35),  # below, as large
    st.floats(-1.1, 1.1),  # turned away [rad]
)
mounts = st.builds(
    CameraMount,
    x=st.floats(-0.05, 0.05),
    y=st.floats(-0.05, 0.05),
    z=st.floats(0.02, 0.2),
    yaw=st.floats(-3.0, 3.0),
    pitch=st.floats(-0.2, 0.2),
    roll=st.floats(-0.5, 0.5),
)


def black_marker(pose: tuple[float, float, float], height: float) -> Scene:
    """A marker without any white cell in an empty room."""
    hidden = scenery.level(0.0)
    hidden.rectangle(-1e-3, -1e-3, 1e-3, 1e-3, 0.0)
    board = scenery.marker(pose, height, np.zeros((8, 8), bool), LANDMARK_SIZE)
    return Scene(scenery.patches([hidden]), [board], [[]])


def square(pose: tuple[float, float, float], height: float, side: float, pieces: int = 1) -> FloatArray:
    """Corners (4 * pieces, 3) around an upright square, clockwise from its upper left, sides in pieces."""
    x, y, yaw = pose
    right = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    ends = 0.5 * side * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    around = np.concatenate([np.linspace(a, b, pieces, endpoint=False) for a, b in pairwise(ends)])
    points: FloatArray = np.array([x, y, height]) + around[:, :1] * right + around[:, 1:] * down
    return points


def in_lines(polygon: FloatArray, lines: int) -> tuple[FloatArray, FloatArray]:
    """What a polygon (n, 2) of short sides fills of each row, and how much of its outline lies there.

    Returns:
        Areas (lines,) by the integral of u dv along its sides, and lengths (lines,), where a side counts as
        a whole in every row that it comes as near as BEND_PX to [px].
    """
    a, b = polygon, np.roll(polygon, -1, axis=0)
    low, high = (f(a[:, 1], b[:, 1])[:, None] for f in (np.minimum, np.maximum))
    row = np.round(low).astype(int) - 1 + np.arange(4 + int((high - low).max()))
    level = low == high
    begin, end = (np.clip(side[:, 1:], row - 0.5, row + 0.5) for side in (a, b))
    share = (0.5 * (begin + end) - a[:, 1:]) / np.where(level, 1.0, b[:, 1:] - a[:, 1:])
    middle = a[:, :1] + share * (b - a)[:, :1]
    near = (low <= row + 0.5 + BEND_PX) & (high >= row - 0.5 - BEND_PX)
    length = near * np.linalg.norm(b - a, axis=1, keepdims=True)
    area: FloatArray = np.where(level, 0.0, middle * (end - begin))
    areas, lengths = np.zeros((2, lines + 4))  # with room for rows that no side comes into
    np.add.at(areas, row, area)
    np.add.at(lengths, row, length)
    return np.abs(areas[:lines]), lengths[:lines]


def seen_at(place: tuple[float, float, float, float], mount: CameraMount) -> tuple[FloatArray, float]:
    """A marker's pose in map and its height, from where it is in the image of a camera at the origin."""
    ahead, across, below, turned = place
    to_map = camera_matrix(RobotCamera(0, SHARP, mount), [0.0, 0.0, 0.0])
    point = to_map[:3, :3] @ (ahead * np.array([across, below, 1.0])) + to_map[:3, 3]
    towards = math.atan2(to_map[1, 3] - point[1], to_map[0, 3] - point[0])
    return np.array([point[0], point[1], towards + turned]), float(point[2])


@settings(max_examples=40, deadline=None)
@given(place=places, mount=mounts, model=st.sampled_from([SHARP, FISHY]))
@example(  # both sides' long upright edges bend within one column
    place=(0.25, 0.25, 0.0, 0.0), mount=CameraMount(x=0.0, y=0.0, z=0.125), model=FISHY
)
def test_a_marker_fills_each_row_and_column_as_its_projection_does(
    place: tuple[float, float, float, float], mount: CameraMount, model: CameraModel
) -> None:
    """Up to rounding, and to what the chords by which the renderer draws bent edges are off along them."""
    pose, height = seen_at(place, mount)
    x, y, yaw = pose.tolist()
    camera = RobotCamera(0, model, mount)
    sheet, ink = (
        pixels_of(camera, model, np.zeros(3), square((x, y, yaw), height, side, pieces=1000))
        for side in (SHEET, LANDMARK_SIZE)
    )
    assume(sheet.min() > 1.0 and (sheet.max(axis=0) < [638.0, 478.0]).all())
    light = Renderer(black_marker((x, y, yaw), height), model).light(camera, np.zeros((1, 1, 3)))
    assert light.min() > scenery.BLACK - 1e-5
    assert light.max() < scenery.WHITE + 1e-5
    above = light.astype(float) - scenery.ROOM
    for axis, lines in ((1, 480), (0, 640)):
        order = slice(None, None, 1 if axis else -1)  # u as v and v as u
        (white, white_edge), (black, black_edge) = (in_lines(side[:, order], lines) for side in (sheet, ink))
        filled = (scenery.WHITE - scenery.ROOM) * white + (scenery.BLACK - scenery.WHITE) * black
        edge = (scenery.WHITE - scenery.ROOM) * white_edge + (scenery.WHITE - scenery.BLACK) * black_edge
        wrong = np.abs(above.sum(axis=axis) - filled)
        assert (wrong <= 1e-4 + (BEND_PX * edge if model is FISHY else 0.0)).all()


@settings(max_examples=60, deadline=None)
@given(place=places, mount=mounts, model=st.sampled_from([SHARP, SOFT]))
def test_lines_through_a_markers_edges_meet_in_its_corners(
    place: tuple[float, float, float, float], mount: CameraMount, model: CameraModel
) -> None:
    pose, height = seen_at(place, mount)
    x, y, yaw = pose.tolist()
    camera = RobotCamera(0, model, mount)
    corners, sheet = (
        pixels_of(camera, model, np.zeros(3), square((x, y, yaw), height, side))
        for side in (LANDMARK_SIZE, SHEET)
    )
    assume(sheet.min() > 4.0 and (sheet.max(axis=0) < [635.0, 475.0]).all())
    assume(_narrowest(corners) > 56.0)  # seven pixels a cell leave room for the edge's profile
    light = Renderer(black_marker((x, y, yaw), height), model).light(camera, np.zeros((1, 1, 3)))
    np.testing.assert_allclose(_fitted_corners(light, corners), corners, atol=0.005)


def _narrowest(corners: FloatArray) -> float:
    """Smallest distance of a corner from the line through the opposite side [px]."""
    distances = []
    for i in range(4):
        a, b, c = corners[i], corners[(i + 1) % 4], corners[(i + 2) % 4]
        side = b - a
        distances.append(abs(side[0] * (c - a)[1] - side[1] * (c - a)[0]) / np.linalg.norm(side))
    return float(min(distances))


def _fitted_corners(light: Image, near: FloatArray) -> FloatArray:
    """Corners (4, 2) where lines fitted to the four edges between black and white meet."""
    lines = [_edge(light, near[i], near[(i + 1) % 4]) for i in range(4)]
    return np.array(
        [np.cross(lines[i - 1], lines[i])[:2] / np.cross(lines[i - 1], lines[i])[2] for i in range(4)]
    )


def _edge(light: Image, start: FloatArray, end: FloatArray) -> FloatArray:
    """The line a u + b v + c = 0 (3,) through the crossings in all rows or columns of an edge's middle."""
    upright = abs(end[1] - start[1]) > abs(end[0] - start[0])
    along, across = (1, 0) if upright else (0, 1)
    image = light.astype(float) if upright else light.T.astype(float)
    low, high = sorted((start[along], end[along]))
    margin = 0.2 * (high - low)
    lines = np.arange(math.ceil(low + margin), math.floor(high - margin) + 1)
    crossings = []
    for line in lines:
        guess = start[across] + (line - start[along]) / (end[along] - start[along]) * (
            end[across] - start[across]
        )
        first, last = round(guess) - 4, round(guess) + 4
        profile = image[line, first : last + 1]
        dark = (scenery.WHITE - profile).sum() / (scenery.WHITE - scenery.BLACK)
        dark_first = profile[0] < profile[-1]
        crossings.append(first - 0.5 + dark if dark_first else last + 0.5 - dark)
    slope, offset = np.polyfit(lines, crossings, 1)
    return np.array([1.0, -slope, -offset]) if upright else np.array([-slope, 1.0, -offset])


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), model=st.sampled_from([SHARP, FISHY]), tilt=st.floats(-0.15, 0.15))
def test_a_picture_shows_what_its_rays_meet(seed: int, model: CameraModel, tilt: float) -> None:
    """Walls, floor, markers, bodies and who hides whom, from anywhere in the arena, to all sides."""
    rng = np.random.default_rng(seed)
    poses = rng.uniform([-0.5, -0.15, -math.pi], [0.5, 0.15, math.pi], (4, 3))
    poses[1] = _beside(poses[0], rng.uniform(0.1, 0.25), rng.uniform(-0.5, 0.5), rng)
    poses[2] = _beside(poses[0], rng.uniform(0.35, 0.6), rng.uniform(-0.5, 0.5), rng)
    poses[3, :2] = rng.uniform([-1.1, 0.3], [1.1, 0.7])
    apart = np.linalg.norm(poses[:, None, :2] - poses[None, :, :2], axis=-1) + np.eye(4)
    assume(apart.min() > 0.09)
    scene = small_arena(4)
    camera = RobotCamera(0, model, CameraMount(x=0.03, z=0.08, pitch=tilt, roll=0.5 * tilt))
    light = Renderer(scene, model).light(camera, poses[None])
    pixels = rng.uniform([0, 0], [639, 479], (1500, 2)).round()
    spread = np.array([[0, 0], [-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])
    rays = _rays(camera, model, poses[0], (pixels[:, None] + spread).reshape(-1, 2))
    met = RayCaster(scene, 0, poses).brightness(camera_matrix(camera, poses[0])[:3, 3], rays).reshape(-1, 5)
    plain = np.ptp(met, axis=1) < 1e-9
    shown = light[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    wrong = plain & (np.abs(shown - met[:, 0]) > 1e-4)
    assert plain.mean() > 0.8
    assert wrong.mean() <= 0.002  # a thin thing may pass between a pixel's rays
    mixed = np.clip(shown, met.min(axis=1) - 1e-4, met.max(axis=1) + 1e-4)
    assert (np.abs(shown - mixed) < 0.1).mean() > 0.995


def _beside(pose: FloatArray, distance: float, bearing: float, rng: np.random.Generator) -> FloatArray:
    """A pose in front of another one."""
    angle = pose[2] + bearing
    return np.array(
        [
            pose[0] + distance * math.cos(angle),
            pose[1] + distance * math.sin(angle),
            rng.uniform(-math.pi, math.pi),
        ]
    )


def _rays(camera: RobotCamera, model: CameraModel, pose: FloatArray, pixels: FloatArray) -> FloatArray:
    """Directions (n, 3) in map of pixels (n, 2)."""
    plane = np.zeros_like(pixels)
    for _ in range(50):  # to the fixed point at which OpenCV projects the ray into the pixel
        points = np.column_stack([plane, np.ones(len(plane))])
        reached = cv2.projectPoints(
            points, np.zeros(3), np.zeros(3), model.camera.matrix, np.array(model.camera.distortion)
        )[0][:, 0]
        off = (pixels - reached) / model.camera.fx
        plane = plane + off
        if np.abs(off).max() < 1e-14:
            break
    rays: FloatArray = np.column_stack([plane, np.ones(len(plane))]) @ camera_matrix(camera, pose)[:3, :3].T
    return rays


def test_a_nearer_robot_hides_a_marker_and_a_farther_one_does_not() -> None:
    scene = small_arena(2)
    camera = RobotCamera(0, SHARP, CAMERA)
    sees_marker_107 = np.array([0.6, -0.2, 0.0])  # the marker stands at (1.2, -0.2)
    renderer = Renderer(scene, SHARP)

    def around(other: tuple[float, float, float]) -> FloatArray:
        poses = np.array([[sees_marker_107, other]])
        return renderer.light(camera, poses)[200:280, 280:360].astype(float)

    alone, behind, before = around((-0.5, 0.3, 0.0)), around((0.3, -0.2, 0.0)), around((0.9, -0.2, 0.3))
    np.testing.assert_allclose(alone, behind, atol=1e-6)
    assert np.abs(before - alone).mean() > 0.05
    assert alone.min() == pytest.approx(scenery.BLACK, abs=1e-4)


@pytest.mark.parametrize("shift", [0.0, 37.0, -211.0])
def test_a_part_of_a_picture_is_the_picture_of_that_part(shift: float) -> None:
    """What leaves the image at its sides does not disturb what stays."""
    across = 2.0 * math.atan(2.0 * math.tan(0.5 * SHARP.field_of_view))
    wide = CameraModel(width=1280, height=480, field_of_view=across, focus_sigma_px=0.0)
    assert wide.camera.fx == pytest.approx(SHARP.camera.fx)
    poses = np.array([[[0.0, 0.0, math.radians(shift)], [0.2, 0.06, 1.0], [0.25, -0.1, 2.0]]])
    scene = small_arena(3)
    narrow = Renderer(scene, SHARP).light(RobotCamera(0, SHARP, CAMERA), poses)
    np.testing.assert_allclose(
        Renderer(scene, wide).light(RobotCamera(0, wide, CAMERA), poses)[:, 320:960], narrow, atol=2e-5
    )
