"""Poses of overhead cameras by control points: exact, as unsure as they are, refused where they must be."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from aerial_scenes import LENSES, floor_points, over_floor, spread

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.ground_control import (
    AerialSettings,
    ControlPointError,
    ControlPoints,
    FloorMarker,
    Ground,
    GroundFileError,
    load_ground,
    misfit,
    save_ground,
    solve_pose,
)
from swarm_loc_vision.markers.families import family_named

NOISE = AerialSettings(control_sigma_px=0.5, control_sigma=0.0)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("seed", range(5))
def test_exact_points_give_the_exact_pose(lens: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = over_floor(LENSES[lens], rng)
    points = floor_points(truth, rng, 4 + seed)
    fit = solve_pose(truth.camera, points, NOISE)
    assert fit.residuals.max() < 1e-3
    np.testing.assert_allclose(fit.ground.rotation, truth.rotation, atol=1e-5)
    np.testing.assert_allclose(fit.ground.centre, truth.centre, atol=1e-4)


@pytest.mark.parametrize("lens", LENSES)
def test_places_and_pixels_are_each_other_s_inverse(lens: str) -> None:
    rng = np.random.default_rng(3)
    ground = over_floor(LENSES[lens], rng)
    pixels = rng.uniform([20, 20], [620, 460], (200, 2))
    flat = ground.places(pixels, 0.1)
    seen = np.isfinite(flat).all(axis=1)
    assert seen.sum() > 150
    places = np.concatenate([flat[seen], np.full((seen.sum(), 1), 0.1)], axis=1)
    np.testing.assert_allclose(ground.pixels(places), pixels[seen], atol=0.02)


@pytest.mark.parametrize("lens", ["barrel", "fisheye"])
def test_places_are_as_unsure_as_told(lens: str) -> None:
    """Covariance by pose and pixels against what noise really does."""
    rng = np.random.default_rng(8)
    truth = over_floor(LENSES[lens], rng)
    points = floor_points(truth, rng, 8)
    place = np.array([[0.3, -0.2, 0.0]])
    pixel = truth.pixels(place)
    away = []
    for _ in range(300):
        noisy = replace(points, pixels=points.pixels + NOISE.control_sigma_px * rng.standard_normal((8, 2)))
        ground = solve_pose(truth.camera, noisy, NOISE).ground
        away.append((ground.places(pixel + 0.3 * rng.standard_normal((1, 2)), 0.0) - place[:, :2])[0])
    fit = solve_pose(truth.camera, points, NOISE)
    told = fit.ground.covariances(place, 0.3**2 * np.eye(2)[None], 0.0)[0]
    # of 300 samples a variance is within a fourth (3 sigma)
    ratio = np.linalg.eigvals(np.linalg.solve(told, spread(np.array(away)))).real
    assert ratio.min() > 0.7
    assert ratio.max() < 1.4


def test_heights_shift_places_away_from_the_camera() -> None:
    ground = over_floor(LENSES["straight"], np.random.default_rng(1), tilt=0.3)
    place = np.array([[0.5, 0.3, 0.1]])
    pixel = ground.pixels(place)
    np.testing.assert_allclose(ground.places(pixel, 0.1), place[:, :2], atol=1e-6)
    farther = ground.places(pixel, 0.0) - ground.centre[:2]
    assert np.linalg.norm(farther) > np.linalg.norm(place[0, :2] - ground.centre[:2])
    told = ground.covariances(place, np.zeros((1, 2, 2)), 0.01)[0]
    step = (ground.places(pixel, 0.09) - ground.places(pixel, 0.11))[0] / 2.0
    np.testing.assert_allclose(told, np.outer(step, step), rtol=0.05, atol=1e-9)


def test_a_wrong_point_is_named() -> None:
    rng = np.random.default_rng(5)
    truth = over_floor(LENSES["barrel"], rng)
    points = floor_points(truth, rng, 8)
    points.pixels[3] += [25.0, -10.0]
    fit = solve_pose(truth.camera, points, NOISE)
    assert "control point p3 lies 26.9 px from where all others put it" in misfit(fit, points, NOISE)


def test_points_that_fit_are_fine() -> None:
    rng = np.random.default_rng(6)
    truth = over_floor(LENSES["straight"], rng)
    points = floor_points(truth, rng, 12)
    points.pixels[:] += NOISE.control_sigma_px * rng.standard_normal((12, 2))
    assert not misfit(solve_pose(truth.camera, points, NOISE), points, NOISE)


SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
PIXELS = np.array([[100.0, 400.0], [500.0, 410.0], [480.0, 100.0], [120.0, 90.0]])


@pytest.mark.parametrize(
    ("places", "pixels", "words"),
    [
        (SQUARE[:3], PIXELS[:3], "there are only 3 control points, but a camera's pose needs 4 or more"),
        (SQUARE * [1.0, 0.0, 0.0], PIXELS, "lie on one line in map"),
        (np.array([*SQUARE[:3], [2.0, 0.0, 0.0]]), PIXELS, "lie on one line in map"),
        (SQUARE, PIXELS * [1.0, 0.0], "lie on one line in the image"),
        (SQUARE * np.nan, PIXELS, "numbers in map that are not finite"),
        (SQUARE * [1.0, -1.0, 1.0], PIXELS, "are the signs of x and y right"),
    ],
)
def test_points_that_tell_no_pose_are_refused(places: FloatArray, pixels: FloatArray, words: str) -> None:
    points = ControlPoints([f"p{k}" for k in range(len(places))], places, pixels)
    with pytest.raises(ControlPointError, match=words):
        solve_pose(LENSES["straight"], points, NOISE)


def test_files_are_read_back(tmp_path: Path) -> None:
    points = ControlPoints(["a", "b", "c", "d"], SQUARE, PIXELS)
    family = family_named("apriltag_36h11")
    ground = Ground(points, (FloorMarker(7, 0.5, -0.25, yaw=1.0, size=0.2),), family)
    save_ground(ground, tmp_path / "ground.yaml", "where it is from")
    again = load_ground(tmp_path / "ground.yaml")
    assert again.markers == ground.markers
    assert again.family is family
    assert list(again.points.names) == list(points.names)
    np.testing.assert_array_equal(again.points.places, SQUARE)
    np.testing.assert_array_equal(again.points.pixels, PIXELS)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("points: {a: {x: 1, y: 2, u: 3}}", "points.a lacks v"),
        ("points: {a: {x: 1, y: 2, u: 3, v: 4, w: 5}}", "'points.a.w' is not a known key"),
        ("points: {a: {x: 1, y: 2, u: 3, v: 4}}", "there are only 1 control points"),
        ("{}", "there are no control points"),
        ("family: qr\n", "family is 'qr', which is none"),
        ("markers: {99999: {x: 0, y: 0, size: 0.1}}", "markers has 99999, but ids of"),
        ("markers: {1: {x: 0, y: 0, size: -0.1}}", "markers.1.size is -0.1 but must lie in"),
        ("markers: {1: {x: 0, y: 0, size: 0.1}}\ncamera: {width: 9}", "camera lacks height"),
    ],
)
def test_wrong_files_are_told_in_one_sentence(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "ground.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(GroundFileError, match=words):
        load_ground(tmp_path / "ground.yaml")
