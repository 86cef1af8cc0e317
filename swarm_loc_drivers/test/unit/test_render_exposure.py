"""Motion during an exposure, light and noise."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from render_helpers import LANDMARK_SIZE, pixels_of, small_arena

from bench.scenarios.eight_run import CAMERA
from swarm_loc_drivers.sim.render import scene as scenery
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.raster import Image, project
from swarm_loc_drivers.sim.render.renderer import MAX_INSTANTS, Renderer, RobotCamera
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import CameraMount

SHARP = CameraModel(width=640, height=480, focus_sigma_px=0.0)
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
    start = np.array(
        [rng.uniform([-0.8, -0.4, -3], [0.8, 0.4, 3]), rng.uniform([-0.8, -0.4, -3], [0.8, 0.4, 3])]
    )
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


def test_a_shorter_exposure_is_as_bright_and_noisier() -> None:
    eye_of = {s: replace(SHARP, exposure_s=s) for s in (0.001, 0.016)}
    frames = {
        s: Renderer(small_arena(1), model).frame(
            RobotCamera(0, model, CAMERA), turning(0.0, 1), np.random.default_rng(1)
        )
        for s, model in eye_of.items()
    }
    flat = (slice(2, 18), slice(300, 340))
    assert frames[0.001][flat].mean() == pytest.approx(frames[0.016][flat].mean(), abs=1.0)
    assert frames[0.001][flat].std() > 2.5 * frames[0.016][flat].std()


def test_light_falls_towards_the_edge_as_cos_to_the_fourth() -> None:
    full = replace(SHARP, vignetting=1.0)
    light = full.electrons() / (full.white_flux * full.exposure_s)
    assert light[239:241, 319:321].min() > 0.9999
    angle = math.atan2(math.hypot(319.5, 239.5), full.camera.fx)
    assert light[0, 0] == pytest.approx(math.cos(angle) ** 4, rel=1e-5)
    assert (replace(SHARP, vignetting=0.0).electrons() == 8000.0).all()


def test_the_same_seed_gives_the_same_frame(renderer: Renderer) -> None:
    camera = RobotCamera(0, SHARP, CAMERA)
    one, same, other = (renderer.frame(camera, turning(0.01, 5), np.random.default_rng(s)) for s in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert (one != other).mean() > 0.3


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
