"""The whole detector on rendered images and, where they are at hand, on photographs."""

import json
import math
import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.vision.negatives import black_squares
from bench.vision.peers import own_detector
from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, Truth, random_scene
from swarm_loc_estimator.sensors.camera import CONTENT_POSE, CONTENT_POSE_TWO
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.detector import Detections, DetectorSettings, MarkerDetector, detection_rows
from swarm_loc_vision.markers.families import Family, draw_marker, family_named

PHOTOS = Path(__file__).resolve().parents[4] / "shared" / "data" / "photos"
Gray = NDArray[np.uint8]


def match(detections: Detections, truths: list[Truth]) -> list[tuple[int, Truth]]:
    """Rows of detections and the markers that they are of."""
    pairs = []
    for truth in truths:
        for row in np.flatnonzero(detections.id == truth.marker_id):
            if np.abs(detections.corners[row] - truth.corners).max() < 3.0:
                pairs.append((int(row), truth))
                break
    return pairs


@pytest.mark.parametrize(
    "name",
    [
        "artoolkit_bch_thin",
        "artoolkit_bch_thick",
        "aruco_mip_36h12",
        "apriltag_36h11",
        "apriltag_36h11_thick",
    ],
)
def test_markers_of_all_families_are_found_where_they_are(name: str) -> None:
    family = family_named(name)
    image, truths = random_scene(np.random.default_rng(5), family, 15, Look())
    detections = own_detector(family).detect(image)
    truths = [truth for truth in truths if truth.side_px > 3.0 * family.side and truth.incidence < 1.0]
    pairs = match(detections, truths)
    assert len(pairs) == len(truths) >= 6
    errors = [detections.corners[row] - truth.corners for row, truth in pairs]
    assert math.sqrt(np.mean(np.sum(np.square(errors), axis=2))) < 0.06
    assert (detections.family == family.code).all()


CELL_PX = 10
GAP_PX = 3 * CELL_PX


def grid_of(family: Family, rows: int, columns: int) -> Gray:
    """A grid as Kalibr prints it, whose tags have a border of two cells: dark squares at their corners."""
    tag = family.side * CELL_PX
    grid = np.full((rows * (tag + GAP_PX) + 5 * GAP_PX, columns * (tag + GAP_PX) + 5 * GAP_PX), 255, np.uint8)
    for row, column in np.ndindex(rows + 1, columns + 1):
        y, x = (2 * GAP_PX + place * (tag + GAP_PX) for place in (row, column))
        grid[y : y + GAP_PX, x : x + GAP_PX] = 0
        if row < rows and column < columns:
            inside = np.s_[y + GAP_PX : y + GAP_PX + tag, x + GAP_PX : x + GAP_PX + tag]
            grid[inside] = draw_marker(family, row * columns + column, CELL_PX, margin=0)
    return grid


def view_of(grid: Gray, width: int, rng: np.random.Generator) -> tuple[Gray, NDArray[np.float64]]:
    """A grid seen aslant, about `width` pixels wide, and the homography from its pixels to the view's."""
    scale = width / grid.shape[1]
    outline = np.array([[0, 0], [grid.shape[1], 0], [grid.shape[1], grid.shape[0]], [0, grid.shape[0]]])
    seen = outline * scale + 40.0 + rng.uniform(-0.2, 0.2, (4, 2)) * scale * grid.shape[0]
    to_image = cv2.getPerspectiveTransform(outline.astype(np.float32), seen.astype(np.float32))
    size = (width + 80, round(grid.shape[0] * scale) + 80)
    # a pixel of the image is the mean of 4 x 4; pixels have their origin in their middle
    middle = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    finer = np.linalg.inv(middle) @ np.diag([4, 4, 1]) @ to_image @ middle
    drawn = cv2.warpPerspective(grid, finer, (4 * size[0], 4 * size[1]), borderValue=255)
    image = cv2.GaussianBlur(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    noisy = np.clip(30 + 0.7 * image + rng.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)
    return noisy, np.asarray(to_image)


def errors_in_grid(
    found: Detections, family: Family, columns: int, to_image: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Errors (N, 4, 2) of corners of a grid's tags [px]."""
    tag = family.side * CELL_PX
    corner = np.array([[0, 0], [tag, 0], [tag, tag], [0, tag]])
    place = np.stack([found.id % columns, found.id // columns], axis=1) * (tag + GAP_PX) + 3 * GAP_PX
    return found.corners - cv2.perspectiveTransform((corner + place[:, None]).astype(float), to_image) + 0.5


@pytest.mark.parametrize("width", [300, 480, 960])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_all_tags_of_a_grid_of_kalibr_are_found_where_they_are(width: int, seed: int) -> None:
    family = family_named("apriltag_36h11_thick")
    noisy, to_image = view_of(grid_of(family, 2, 4), width, np.random.default_rng(seed))
    found = MarkerDetector(DetectorSettings(), {family: None}).detect(noisy)
    assert sorted(found.id.tolist()) == [*range(8)]
    error = errors_in_grid(found, family, 4, to_image)
    assert math.sqrt(np.mean(np.sum(np.square(error), axis=2))) < 0.12
    assert np.abs(error).max() < 0.5


@pytest.mark.parametrize(
    ("drawn", "expected"),
    [("apriltag_36h11_thick", "apriltag_36h11"), ("apriltag_36h11", "apriltag_36h11_thick")],
)
@pytest.mark.parametrize("ids", [None, [*range(36)], [1, 17, 300]])
def test_a_grid_with_another_border_shows_no_wrong_tag(
    drawn: str, expected: str, ids: list[int] | None
) -> None:
    """Cells of another width differ in some bits, as many as few ids allow; what is read is in its place."""
    family = family_named(drawn)
    used = None if ids is None else np.array(ids)
    detector = MarkerDetector(DetectorSettings(), {family_named(expected): used})
    for seed, width in enumerate((200, 300, 480, 960)):
        noisy, to_image = view_of(grid_of(family, 6, 6), width, np.random.default_rng(seed))
        found = detector.detect(noisy)
        assert (found.id < 36).all()
        assert (np.abs(errors_in_grid(found, family, 6, to_image)) < 1.5).all()


def test_corners_and_poses_are_as_sure_as_they_say() -> None:
    family, nees = family_named("aruco_mip_36h12"), []
    for seed in range(6):
        image, truths = random_scene(np.random.default_rng(seed), family, 15, Look())
        lengths = {truth.marker_id: truth.length for truth in truths}
        camera = Camera.from_matrix((WIDTH, HEIGHT), CAMERA, ())
        detections = MarkerDetector(DetectorSettings(), {family: None}, camera, lengths=lengths).detect(image)
        poses = detections.poses
        assert poses is not None
        for row, truth in match(detections, truths):
            if truth.side_px < 24.0 or lengths[truth.marker_id] != truth.length:
                continue
            turn = Rotation.from_matrix(poses.rotation[row, 0] @ truth.rotation.T).as_rotvec()
            error = np.concatenate([poses.position[row, 0] - truth.position, turn])
            nees.append(error @ np.linalg.solve(poses.covariance[row, 0], error))
            assert np.linalg.eigvalsh(poses.covariance[row, 0])[0] > 0.0
    assert len(nees) > 50
    assert 0.8 < np.median(nees) < 9.0  # 5.35 were the corners' noise all that there is, and white


def test_a_distorting_lens_does_not_matter() -> None:
    family = family_named("aruco_mip_36h12")
    ideal, truths = random_scene(np.random.default_rng(3), family, 12, Look(noise=0.5))
    camera = Camera.from_matrix((WIDTH, HEIGHT), CAMERA, (-0.25, 0.08, 5e-4, -5e-4, 0.0))
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    source = camera.to_ideal(np.stack([u, v], axis=2)).astype(np.float32)
    raw = np.asarray(cv2.remap(ideal, source[..., 0], source[..., 1], cv2.INTER_CUBIC), np.uint8)
    lengths = {truth.marker_id: truth.length for truth in truths}
    detections = MarkerDetector(DetectorSettings(), {family: None}, camera, lengths=lengths).detect(raw)
    assert detections.poses is not None
    checked = 0
    for truth in truths:
        rows = np.flatnonzero(detections.id == truth.marker_id)
        if truth.side_px < 30.0 or len(rows) != 1:
            continue
        assert camera.to_ideal(detections.corners[rows[0]]) == pytest.approx(truth.corners, abs=0.3)
        assert detections.poses.position[rows[0], 0] == pytest.approx(truth.position, rel=0.01, abs=0.003)
        # no lens is calibrated to less than about a tenth of a pixel
        sideways = math.sqrt(detections.poses.covariance[rows[0], 0, 0, 0])
        assert sideways > 0.1 * truth.position[2] / CAMERA[0, 0]
        checked += 1
    assert checked >= 6


def half_in_shadow(image: Gray) -> Gray:
    """Stripes of shadow, as of blinds, each as wide as three markers or so."""
    u = np.arange(WIDTH)
    return np.asarray(image * np.where(np.sin(u / 45.0) > 0.0, 1.0, 0.45), np.uint8)


def as_jpeg(image: Gray) -> Gray:
    """At a quality of 60."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.parametrize(
    ("change", "share"),
    [
        (half_in_shadow, 0.85),
        (as_jpeg, 0.95),
        (lambda image: (image * 0.12).astype(np.uint8), 0.95),
        (lambda image: np.clip(image * 1.6, 0, 255).astype(np.uint8), 0.95),
        (lambda image: cv2.GaussianBlur(image, (0, 0), 1.5), 0.85),
    ],
    ids=["shadows", "jpeg", "dark", "bright", "out of focus"],
)
def test_bad_light_and_bad_cameras_hide_few_markers(change: Callable[[Gray], Gray], share: float) -> None:
    family, found, shown = family_named("apriltag_36h11"), 0, 0
    for seed in range(3):
        image, truths = random_scene(np.random.default_rng(seed), family, 15, Look())
        truths = [truth for truth in truths if truth.side_px > 24.0]
        detections = own_detector(family).detect(change(image))
        found += len(match(detections, truths))
        shown += len(truths)
    assert shown > 30
    assert found >= share * shown


def test_crowded_markers_and_those_with_part_of_the_border_covered_are_found() -> None:
    family = family_named("apriltag_36h11")
    ids = np.arange(0, 560, 4)
    tiles = [np.pad(draw_marker(family, int(i), 5, 0), (0, 5), constant_values=255) for i in ids]
    rows = [np.hstack(tiles[i : i + 14]) for i in range(0, len(tiles), 14)]
    sheet = np.pad(np.vstack(rows), 20, constant_values=255)
    sheet = np.clip(cv2.GaussianBlur(sheet, (0, 0), 0.7) * 0.7 + 30.0, 0, 255).astype(np.uint8)
    detector = own_detector(family)
    assert sorted(detector.detect(sheet).id.tolist()) == ids.tolist()
    pitch = tiles[0].shape[0]
    for row in range(10):
        for column in range(14):  # a light strip across the border, as of a reflection or a straw
            v, u = 20 + row * pitch, 20 + column * pitch
            sheet[v - 2 : v + 5, u + 14 : u + 20] = 200
    assert len(np.intersect1d(detector.detect(sheet).id, ids)) > 0.95 * len(ids)


def test_black_squares_with_a_speck_of_light_are_none() -> None:
    assert not any(black_squares(60).values())


def test_an_image_full_of_squares_takes_little_memory_and_counts_what_it_drops() -> None:
    tile = np.full((14, 14), 225, np.uint8)
    tile[2:11, 2:11] = 25
    detector = own_detector(family_named("apriltag_36h11"))
    tracemalloc.start()
    detections = detector.detect(np.tile(tile, (77, 137)))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(detections) == 0
    assert detections.dropped["too_many_candidates"] > 10_000
    assert most < 100_000_000


def test_inverted_markers_are_none() -> None:
    family = family_named("apriltag_36h11")
    image, _ = random_scene(np.random.default_rng(1), family, 15, Look(clutter=0))
    assert len(own_detector(family).detect(255 - image)) == 0


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (33, 41), (960, 1277)])
def test_empty_images_of_any_size_show_nothing(shape: tuple[int, int]) -> None:
    detector = own_detector(family_named("artoolkit_bch_thin"))
    noise = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    for image in (np.zeros(shape, np.uint8), np.full(shape, 255, np.uint8), noise):
        detections = detector.detect(image)
        assert len(detections) == 0
        assert len(detection_rows(detections, 16.0)) == 0


def test_rows_hold_what_was_found() -> None:
    family = family_named("aruco_mip_36h12")
    image, _ = random_scene(np.random.default_rng(2), family, 15, Look())
    detections = own_detector(family).detect(image)
    assert detections.poses is not None
    have_two = np.isfinite(detections.poses.chi2[:, 1])
    assert have_two.any()
    for ambiguity in (0.0, 1e9):
        rows = detection_rows(detections, ambiguity)
        contents = np.where(have_two & (ambiguity > 0.0), CONTENT_POSE_TWO, CONTENT_POSE)
        assert (rows["content"] == contents).all()
        assert (rows["id"] == detections.id).all()
        assert np.linalg.norm(rows["orientation"], axis=1) == pytest.approx(np.ones(len(rows)))
        two = rows["content"] == CONTENT_POSE_TWO
        assert (rows["alternative_ratio"][two] >= 1.0).all()
        assert np.isnan(rows["alternative_ratio"][~two]).all()


PHOTO_FAMILIES = {"DICT_APRILTAG_36h11": "apriltag_36h11", "DICT_6X6_250": "aruco_6x6_250"}


@pytest.mark.skipif(not PHOTOS.exists(), reason="the photographs are not at hand")
@pytest.mark.parametrize(
    "file",
    [
        "opencv/singlemarkersoriginal.jpg",
        "opencv/choriginal.jpg",
        "opencv/chocclusion_original.jpg",
        "apriltag/33369213973_9d9bb4cc96_c.jpg",
        "apriltag/34085369442_304b6bafd9_c.jpg",
        "apriltag/34139872896_defdb2f8d9_c.jpg",
    ],
)
def test_photographs(file: str) -> None:
    manifest = json.loads((PHOTOS / "manifest.json").read_text(encoding="utf-8"))
    (entry,) = [entry for entry in manifest if entry["file"] == file]
    image = np.asarray(cv2.imread(str(PHOTOS / file), cv2.IMREAD_GRAYSCALE), np.uint8)
    detections = MarkerDetector(
        DetectorSettings(), {family_named(PHOTO_FAMILIES[entry["dict"]]): None}
    ).detect(image)
    assert not Counter(entry["ids"]) - Counter(detections.id.tolist())
    assert set(detections.id.tolist()) <= set(entry["ids"])
    for marker_id, corners in entry.get("corners", {}).items():
        (row,) = np.flatnonzero(detections.id == int(marker_id))
        assert detections.corners[row].ravel() == pytest.approx(np.ravel(corners), abs=1.6)
