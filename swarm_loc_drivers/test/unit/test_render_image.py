"""Rendered images: geometry, light, exposure, and the camera of the simulation."""

import math
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from exact_sightings import exact_values
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from render_helpers import LANDMARK_SIZE, RayCaster, camera_matrix, pixels_of, small_arena

from bench.scenarios.eight_run import CAMERA, VIEW, EightSettings, simulate_eight, wall_markers
from bench.scenarios.lived_run import SIGHTING_DTYPE, SimulatedRun
from bench.scenarios.sightings import View, deliver, hidden, schedule_exposures
from swarm_loc_drivers.sim.render import scene as scenery
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.raster import Image, project
from swarm_loc_drivers.sim.render.renderer import MAX_INSTANTS, Renderer, RobotCamera, Scene
from swarm_loc_drivers.sim.worlds import W0, W2
from swarm_loc_estimator.common import se2
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
    x, y = pose[:2] + distance * np.array([math.cos(angle), math.sin(angle)])
    return np.array([x, y, rng.uniform(-math.pi, math.pi)])


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


IN_FRONT_OF_107 = np.array([0.9, -0.2, 0.0])  # the marker stands at (1.2, -0.2)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(small_arena(1), SHARP)


def turning(turn: float, instants: int) -> FloatArray:
    """Poses (K, 1, 3) of a camera that turns evenly by `turn` [rad] while it looks at marker 107."""
    poses = np.tile(IN_FRONT_OF_107, (instants, 1, 1))
    poses[:, 0, 2] += turn * ((np.arange(instants) + 0.5) / instants - 0.5)
    return poses


def sheets_left_edge(light: Image, camera: RobotCamera) -> tuple[float, float]:
    """Where the step from wall to sheet is against its projection, and its spread [px^2]; means over rows."""
    half = 0.5 * LANDMARK_SIZE * 10 / 8
    ends = np.array([[1.2, -0.2 + half, 0.08 + z] for z in (-0.02, 0.02)])
    below, above = pixels_of(camera, SHARP, IN_FRONT_OF_107, ends)
    shifts, spreads = [], []
    for row in range(math.ceil(above[1]), math.floor(below[1])):
        place = above[0] + (row - above[1]) / (below[1] - above[1]) * (below[0] - above[0])
        values = light[row, round(place) - 12 : round(place) + 7].astype(float)
        steps = np.diff(values) / (values[-1] - values[0])
        at = np.arange(len(steps)) + round(place) - 11.5
        middle = (steps * at).sum()
        shifts.append(middle - place)
        spreads.append((steps * (at - middle) ** 2).sum())
    return float(np.mean(shifts)), float(np.mean(spreads))


@pytest.mark.parametrize("blur_px", [0.0, 2.0, 5.0])
def test_an_edge_is_blurred_as_far_as_it_moves_and_stays_where_it_is_on_average(blur_px: float) -> None:
    renderer, camera = Renderer(small_arena(1), SHARP), RobotCamera(0, SHARP, CameraMount(z=0.08, roll=0.03))
    turn = blur_px / SHARP.camera.fx
    half = np.array([0.0, 0.0, 0.5 * turn])
    instants = renderer.instants(camera, IN_FRONT_OF_107[None] - half, IN_FRONT_OF_107[None] + half)
    assert blur_px <= instants <= 1.7 * blur_px + 1  # the image's edges move faster than its middle
    shift, spread = sheets_left_edge(renderer.light(camera, turning(turn, instants)), camera)
    still_shift, still = sheets_left_edge(renderer.light(camera, turning(0.0, 1)), camera)
    assert abs(still_shift) < 0.01
    assert abs(shift) < 0.01
    assert still == pytest.approx(1.0 / 6.0, abs=0.02)  # mean over pixels, and over places in a pixel
    drawn = blur_px**2 * (1.0 - 1.0 / instants**2) / 12.0  # of the instants
    faster = (1.0 + (0.5 * LANDMARK_SIZE * 10 / 8 / 0.3) ** 2) ** 2  # it is not in the middle of the image
    assert spread - still == pytest.approx(faster * drawn, rel=0.02, abs=0.01)


@settings(max_examples=10)
@given(turn=st.floats(-0.02, 0.02), ahead=st.floats(-0.02, 0.02), seed=st.integers(0, 100))
def test_more_instants_than_asked_for_change_nothing_that_matters(
    turn: float, ahead: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    start = rng.uniform([-0.8, -0.4, -3], [0.8, 0.4, 3], (2, 3))
    renderer, camera = Renderer(small_arena(2), SHARP), RobotCamera(0, SHARP, CAMERA)
    motion = np.array([[ahead, 0.0, turn], [0.5 * ahead, 0.0, -turn]])

    def blurred(instants: int) -> FloatArray:
        share = (np.arange(instants) + 0.5) / instants
        return renderer.light(camera, start + share[:, None, None] * motion).astype(float)

    count = renderer.instants(camera, start, start + motion)
    assert count < MAX_INSTANTS
    difference = np.abs(blurred(count) - blurred(4 * count))
    assert difference.mean() < 2e-3
    assert np.quantile(difference, 0.999) < 0.12


def test_noise_is_that_of_photons_and_read_out() -> None:
    model = replace(SHARP, exposure_s=0.002, white_flux=1e6, read_noise=20.0, white_level=200.0)
    own = Renderer(small_arena(1), model)
    camera, poses = RobotCamera(0, model, CAMERA), turning(0.0, 1)
    light = own.light(camera, poses).astype(float).copy()
    frames = np.array([own.frame(camera, poses, np.random.default_rng(k)) for k in range(60)], dtype=float)
    electrons = light * model.electrons()
    gain = 200.0 / 2000.0
    unclipped = (electrons > 400.0) & (electrons * gain < 230.0)
    np.testing.assert_allclose(frames.mean(axis=0)[unclipped], electrons[unclipped] * gain, atol=3.0)
    expected = gain**2 * (electrons + 400.0) + 1.0 / 12.0
    ratio = frames.var(axis=0, ddof=1)[unclipped] / expected[unclipped]
    assert ratio.mean() == pytest.approx(1.0, abs=0.02)
    bright = ratio[electrons[unclipped] > 1200.0]
    assert bright.mean() == pytest.approx(1.0, abs=0.03)


def test_light_falls_towards_the_edge_as_cos_to_the_fourth() -> None:
    full = replace(SHARP, vignetting=1.0)
    light = full.electrons() / (full.white_flux * full.exposure_s)
    assert light[239:241, 319:321].min() > 0.9999
    angle = math.atan2(math.hypot(319.5, 239.5), full.camera.fx)
    assert light[0, 0] == pytest.approx(math.cos(angle) ** 4, rel=1e-5)
    assert (replace(SHARP, vignetting=0.0).electrons() == 8000.0).all()


def test_a_drawn_picture_leaves_nothing_behind(renderer: Renderer) -> None:
    camera = RobotCamera(0, SHARP, CAMERA)
    first = renderer.light(camera, turning(0.0, 1)).copy()
    renderer.light(camera, turning(2.0, 7) + np.array([0.2, 0.4, 1.0]))
    np.testing.assert_array_equal(first, renderer.light(camera, turning(0.0, 1)))


def test_the_focus_spreads_light_without_losing_it() -> None:
    soft = replace(SHARP, focus_sigma_px=1.5)
    poses = turning(0.0, 1)
    sharp_light = Renderer(small_arena(1), SHARP).light(RobotCamera(0, SHARP, CAMERA), poses).astype(float)
    soft_light = Renderer(small_arena(1), soft).light(RobotCamera(0, soft, CAMERA), poses).astype(float)
    assert soft_light.mean() == pytest.approx(sharp_light.mean(), rel=1e-4)
    assert np.abs(np.diff(soft_light)).max() < 0.5 * np.abs(np.diff(sharp_light)).max()
    assert sharp_light.max() == pytest.approx(scenery.WHITE, abs=1e-5)


def test_a_wrongly_known_focal_length_scales_the_picture_about_its_middle() -> None:
    long = RobotCamera(0, SHARP, CameraMount(z=0.08), focal_scale=1.02)
    right = RobotCamera(0, SHARP, CameraMount(z=0.08))
    middle = SHARP.camera.matrix[:2, 2]
    true, believed = (np.array(project(camera.lens, 0.3, -0.2)) - middle for camera in (long, right))
    np.testing.assert_allclose(true, 1.02 * believed, rtol=1e-12)


@pytest.fixture(scope="module")
def white() -> SimulatedRun:
    return simulate_eight(EightSettings(duration_s=30.0, errors=W0))


@pytest.mark.parametrize(
    ("marker", "seen"),
    [
        ((0.5, 0.0, math.pi), True),
        ((0.5, 0.0, 0.0), False),  # its back
        ((0.11, 0.0, math.pi), False),
        ((1.51, 0.0, math.pi), False),
        ((0.5, 0.5 * math.tan(math.radians(29.0)), math.pi), True),
        ((0.5, -0.5 * math.tan(math.radians(31.0)), math.pi), False),
        ((-0.5, 0.0, 0.0), False),  # behind the camera
        ((0.5, 0.0, math.pi + math.radians(64.0)), True),
        ((0.5, 0.0, math.pi - math.radians(66.0)), False),
    ],
)
def test_view(marker: tuple[float, float, float], *, seen: bool) -> None:
    assert bool(VIEW.sees(np.array(marker))) is seen


def test_a_view_of_half_a_turn_sees_everything_in_front() -> None:
    half = View(math.pi, 0.0, 2.0, math.pi)
    assert half.sees(np.array([[0.1, 1.0, 0.0], [-0.1, 1.0, 0.0]])).tolist() == [True, False]


@pytest.mark.parametrize(
    ("disc", "is_hidden"),
    [
        ((0.5, 0.03), True),
        ((0.5, 0.04), False),
        ((1.2, 0.0), False),
        ((-0.2, 0.0), False),
        ((np.nan, np.nan), False),
    ],
)
def test_a_disc_hides_only_what_is_behind_it(disc: tuple[float, float], *, is_hidden: bool) -> None:
    assert bool(hidden(np.zeros(2), np.array([1.0, 0.0]), np.array([disc]), 0.036)) is is_hidden


def test_the_arena_has_twenty_markers_that_face_inwards() -> None:
    marks = wall_markers()
    assert len(marks) == 20
    for mark in marks:
        assert mark.yaw is not None
        assert math.cos(mark.yaw) * mark.x + math.sin(mark.yaw) * mark.y < 0.0
        assert abs(mark.x) == pytest.approx(1.2) or abs(mark.y) == pytest.approx(0.8)
    places = np.array([[mark.x, mark.y] for mark in marks])
    around = np.linalg.norm(np.diff(places, axis=0, append=places[:1]), axis=1)
    assert np.isclose(around, 0.4).sum() == 16  # all but the four corners
    np.testing.assert_allclose(around[~np.isclose(around, 0.4)], 0.2 * math.sqrt(2.0))


def test_an_eight_shows_as_many_markers_as_the_papers_geometry_gives(white: SimulatedRun) -> None:
    _, _, own = exact_values(white)
    assert (own < 0).sum() / len(white.frames) == pytest.approx(2.3, abs=0.25)
    assert (own >= 0).sum() / len(white.frames) == pytest.approx(0.85, abs=0.15)


def test_white_noise_has_the_printed_sigmas(white: SimulatedRun) -> None:
    exact, robot, own = exact_values(white)
    error = white.sightings["value"] - exact
    error[:, 2] = se2.wrap_angle(error[:, 2])
    count = len(error)
    sigma = np.array([0.026, 0.029, 0.508])
    assert (np.abs(error.mean(axis=0)) < 4.0 * sigma / math.sqrt(count)).all()
    np.testing.assert_allclose(error.std(axis=0), sigma, rtol=4.0 / math.sqrt(2 * count))
    assert (own != robot).all()  # no robot sees itself
    assert VIEW.sees(exact).all()


def test_flips_mirror_the_heading_at_the_line_of_sight() -> None:
    exactly = replace(W0, forward_sigma=0.0, left_sigma=0.0, heading_sigma=0.0, flip_probability=0.25)
    run = simulate_eight(EightSettings(duration_s=20.0, errors=exactly))
    exact, _, _ = exact_values(run)
    value = run.sightings["value"]
    np.testing.assert_allclose(value[:, :2], exact[:, :2], atol=1e-12)
    towards = np.arctan2(exact[:, 1], exact[:, 0]) + math.pi
    straight = np.isclose(se2.wrap_angle(value[:, 2] - exact[:, 2]), 0.0, atol=1e-9)
    mirrored = np.isclose(se2.wrap_angle(value[:, 2] + exact[:, 2] - 2.0 * towards), 0.0, atol=1e-9)
    assert (straight | mirrored).all()
    assert (~straight).mean() == pytest.approx(0.25, abs=0.03)


def test_gross_errors_come_at_their_rate() -> None:
    rough = replace(W0, forward_sigma=1e-4, left_sigma=1e-4, heading_sigma=1e-4, gross_probability=0.05)
    run = simulate_eight(EightSettings(duration_s=20.0, errors=rough))
    exact, _, _ = exact_values(run)
    gross = np.abs(run.sightings["value"][:, :2] - exact[:, :2]).max(axis=1) > 1e-3
    assert gross.mean() == pytest.approx(0.05, abs=0.015)


def test_a_world_of_systematic_errors_differs_by_robot() -> None:
    still = replace(W2, forward_sigma=0.0, left_sigma=0.0, flip_probability=0.0, gross_probability=0.0)
    flat = replace(
        still, map_position_sigma=0.0, face_position_sigma=0.0, turn_slip=0.0, exposure_early_s=0.0
    )
    run = simulate_eight(EightSettings(duration_s=20.0, errors=flat))
    exact, robot, _ = exact_values(run)
    value = run.sightings["value"]
    scale = np.linalg.norm(value[:, :2], axis=1) / np.linalg.norm(exact[:, :2], axis=1)
    turned = np.arctan2(value[:, 1], value[:, 0]) - np.arctan2(exact[:, 1], exact[:, 0])
    scales = [scale[robot == k] for k in range(5)]
    # the camera's offset keeps it from being exactly constant
    assert all(np.ptp(one) < 0.02 for one in scales)
    assert 0.01 < np.std([one.mean() for one in scales]) < 0.05
    yaws = [turned[robot == k].mean() for k in range(5)]
    assert math.radians(0.6) < np.std(yaws) < math.radians(4.0)


def test_pictures_are_late_lost_and_out_of_order() -> None:
    run = simulate_eight(EightSettings(duration_s=60.0))
    late_s = (run.frames["arrival_ns"] - run.frames["stamp_ns"]) * 1e-9
    assert 0.150 <= late_s.min() < 0.155
    assert 0.295 < late_s.max() <= 0.300
    assert (np.diff(run.frames["arrival_ns"]) >= 0).all()
    assert (np.diff(run.frames["stamp_ns"]) < 0).any()
    assert len(run.frames) / (5 * 7.5 * 59.6) == pytest.approx(0.95, abs=0.03)
    late_s = (run.odometry["arrival_ns"] - run.odometry["stamp_ns"]) * 1e-9
    assert 0.002 <= late_s.min() < late_s.max() <= 0.020


def test_lost_pictures_take_their_sightings_with_them() -> None:
    rng = np.random.default_rng(3)
    exposures = schedule_exposures(rng, 3, 7.5, 0, 10_000_000_000)
    count = len(exposures[0])
    frame = np.repeat(np.arange(count), 2)
    sightings = np.zeros(2 * count, SIGHTING_DTYPE)
    sightings["marker_id"] = frame
    frames, kept = deliver(rng, exposures, frame, sightings, end_ns=9_000_000_000, loss=0.3)
    assert len(kept) == 2 * len(frames) < 2 * count
    shown = [np.unique(kept["marker_id"][f["first"] : f["first"] + f["count"]]) for f in frames]
    for one, ids in zip(frames, shown, strict=True):
        assert len(ids) == 1
        assert exposures[1][ids[0]] == one["stamp_ns"]
        assert exposures[0][ids[0]] == one["robot"]


@pytest.mark.parametrize("rate_hz", [20.0, 50.0])
def test_odometry_comes_at_its_rate_from_every_robot(rate_hz: float) -> None:
    run = simulate_eight(EightSettings(duration_s=10.0, odometry_rate_hz=rate_hz))
    for robot in range(5):
        own = run.odometry[run.odometry["robot"] == robot]
        stamps = np.sort(own["stamp_ns"])
        assert stamps[0] == run.start_ns
        assert (np.diff(stamps[1:]) == round(1e9 / rate_hz)).all()
        np.testing.assert_array_equal(own["pose"][own["stamp_ns"] == run.start_ns][0], 0.0)
