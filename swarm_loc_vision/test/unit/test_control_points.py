"""Poses of cameras by control points and markers on the floor."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from aerial_scenes import LENSES, floor_points, over_floor

from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, Truth, project, render
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import FixedCamera
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.aerial.ground_control import (
    AerialSettings,
    ControlPointError,
    ControlPoints,
    FloorMarker,
    Ground,
    GroundCamera,
    GroundFileError,
    load_ground,
    misfit,
    save_ground,
    solve_pose,
)
from swarm_loc_vision.aerial.locate_camera import main
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.pose import square

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
    errors = np.array(away)
    ratio = np.linalg.eigvals(np.linalg.solve(told, errors.T @ errors / len(errors))).real
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


FAMILY = family_named("apriltag_36h11")
OVERHEAD = Camera.from_matrix((WIDTH, HEIGHT), CAMERA, ())
FLOOR = tuple(
    FloorMarker(k, x, y, size=0.1) for k, (x, y) in enumerate([(-0.4, 0.3), (0.4, 0.3), (0.3, -0.3)])
)


def save(ground: Ground, camera: Camera, path: Path) -> None:
    """Write control points along with the camera's intrinsics."""
    save_ground(ground, path)
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    text = ", ".join(f"{name}: {value}" for name, value in numbers.items())
    lens = f"distortion_model: {camera.model}, distortion: {[float(k) for k in camera.distortion]}"
    with path.open("a", encoding="utf-8") as file:
        file.write(f"camera: {{{text}, {lens}}}\n")


def written(folder: Path) -> tuple[Path, FloatArray]:
    """Control points of a camera, and its place."""
    rng = np.random.default_rng(2)
    truth = over_floor(LENSES["barrel"], rng)
    save(Ground(floor_points(truth, rng, 8)), truth.camera, folder / "points.yaml")
    return folder / "points.yaml", truth.centre


def photograph(truth: GroundCamera) -> FloatArray:
    """A picture of the markers on the floor without noise."""
    shown = []
    for one in FLOOR:
        position = truth.rotation @ [one.x, one.y, one.z] + truth.pose[3:]
        corners = project(truth.rotation, position, square(one.size))
        shown.append(Truth(one.id, corners, truth.rotation, position, one.size, 0.0, 0.0))
    look = Look(noise=0.0, clutter=0)
    return render(np.random.default_rng(0), FAMILY, shown, look).astype(float)


def described(section: str, folder: Path) -> FixedCamera:
    """The camera of a printed section."""
    text = f"fileversion: 1\nrobots: {{a: {{}}}}\n{section}"
    (folder / "swarm.yaml").write_text(text, encoding="utf-8")
    (camera,) = load_swarm(folder / "swarm.yaml").cameras
    return camera


def test_the_mean_of_many_pictures_is_better_than_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mean of six pictures has 0.41 times the noise of one."""
    rng, points = np.random.default_rng(5), tmp_path / "points.yaml"
    truth = over_floor(OVERHEAD, rng, tilt=0.3, height=1.5)
    save(Ground(markers=FLOOR, family=FAMILY), OVERHEAD, points)
    still, pictures = photograph(truth), [str(tmp_path / f"{k}.png") for k in range(6)]
    errors: dict[int, list[FloatArray]] = {1: [], 6: []}
    for _ in range(4):
        for path in pictures:
            cv2.imwrite(path, (still + rng.normal(0.0, 15.0, still.shape)).clip(0.0, 255.0).astype(np.uint8))
        for count, kept in errors.items():
            assert main(["up", str(points), *pictures[:count]]) == 0
            camera = described(capsys.readouterr().out, tmp_path)
            kept.append(np.array([camera.x, camera.y, camera.z]) - truth.centre)
    alone, together = (np.sqrt(np.mean(np.square(kept))) for kept in errors.values())
    assert alone < 0.01
    assert together < 0.6 * alone


def test_the_command_prints_a_section_of_the_description(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, centre = written(tmp_path)
    assert main(["ceiling1", str(path), "--height", "0.1"]) == 0
    camera = described(capsys.readouterr().out, tmp_path)
    np.testing.assert_allclose([camera.x, camera.y, camera.z], centre, atol=2e-3)
    assert 0.0 < camera.position_sigma < 0.1
    assert camera.name == "ceiling1"


def test_pictures_without_markers_are_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points, picture = tmp_path / "points.yaml", tmp_path / "empty.png"
    save(Ground(markers=FLOOR, family=FAMILY), OVERHEAD, points)
    cv2.imwrite(str(picture), np.zeros((HEIGHT, WIDTH), np.uint8))
    assert main(["up", str(points), str(picture)]) == 1
    said = f"{points}: there are no control points, but a camera's pose needs 4 or more.\n"
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(
    ("added", "arguments", "said"),
    [
        ("", ["picture.txt"], "picture.txt cannot be used: the image's format is"),
        ("", ["none.png"], "none.png cannot be read: No such file or directory."),
        ("", ["bomb.png"], "bomb.png cannot be used: the image has 30000 x 30000 pixels, but must have"),
        ("", ["small.png"], "small.png cannot be used: the image has 8 x 6 pixels, but must have"),
        ("markers: {7: {x: 0.0, y: 0.0, size: 0.1}}\n", [], "pictures of them must be given."),
        ("", ["--set", "control=1"], "'control' is no parameter"),
        ("", ["--height", "2"], "A camera 2 m above the floor does not see markers lying at 2 m."),
        ("", ["--height", "3"], "A camera 2 m above the floor does not see markers lying at 3 m."),
    ],
)
def test_what_the_command_cannot_use_is_one_sentence(
    added: str, arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = written(tmp_path)
    path.write_text(path.read_text(encoding="utf-8").replace("markers: {}\n", "") + added, encoding="utf-8")
    (tmp_path / "picture.txt").write_text("no picture", encoding="utf-8")
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((6, 8), np.uint8))
    png = (tmp_path / "small.png").read_bytes()
    (tmp_path / "bomb.png").write_bytes(png[:16] + 2 * (30_000).to_bytes(4, "big") + png[24:])
    paths = [str(tmp_path / one) if "." in one else one for one in arguments]
    assert main(["ceiling1", str(path), *paths]) != 0
    assert said in capsys.readouterr().err
