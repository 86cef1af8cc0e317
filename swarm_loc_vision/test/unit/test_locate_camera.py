"""The command that locates a fixed camera by control points, and by markers on the floor in pictures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from aerial_scenes import LENSES, floor_points, over_floor

from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, Truth, project, render
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import FixedCamera
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.aerial.ground_control import FloorMarker, Ground, GroundCamera, save_ground
from swarm_loc_vision.aerial.locate_camera import main
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.pose import square

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
