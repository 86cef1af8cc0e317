"""A bag with images: what it holds, and that a detector finds in it the markers where they are."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from render_helpers import pixels_of

from bench.scenarios.bags import CAMERA_INFO, COMPRESSED_IMAGE
from bench.scenarios.eight_run import CAMERA, EightSettings, simulate_eight_images
from bench.scenarios.generate_bag import main
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.renderer import RobotCamera
from swarm_loc_drivers.sim.scenarios.eight import FAMILY
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.swarm.swarm import Landmark
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import family_named

ARGUMENTS = ["--seed", "2", "--duration", "2.5", "--robots", "2", "--world", "w2"]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "pictures"
    assert main(["pictures", str(path), *ARGUMENTS]) == 0
    return path


def test_every_picture_comes_with_its_calibration_and_late(bag: Path) -> None:
    store: Any = typestore()
    with BagReader(bag) as reader:
        messages = list(reader.messages())
    assert {topic.removeprefix("epuck1/").removeprefix("epuck2/") for topic, _, _, _ in messages} == {
        "odom",
        "ground_truth",
        "image_raw/compressed",
        "camera_info",
    }
    images, infos = (
        [
            (log_ns, store.deserialize_cdr(data, kind))
            for topic, _, log_ns, data in messages
            if topic == f"epuck2/{name}"
        ]
        for name, kind in (("image_raw/compressed", COMPRESSED_IMAGE), ("camera_info", CAMERA_INFO))
    )
    assert [one.header for _, one in images] == [one.header for _, one in infos]
    late_s = [
        log_ns * 1e-9 - one.header.stamp.sec - 1e-9 * one.header.stamp.nanosec for log_ns, one in images
    ]
    assert 0.15 <= min(late_s) < max(late_s) <= 0.3
    assert len(images) > 10
    assert {one.header.frame_id for _, one in images} == {"epuck2/camera_optical_frame"}
    image = cv2.imdecode(images[0][1].data, cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape == (960, 1280)
    np.testing.assert_allclose(infos[0][1].k.reshape(3, 3), CameraModel().camera.matrix)


def test_the_same_arguments_give_the_same_bytes(bag: Path, tmp_path: Path) -> None:
    again = tmp_path / bag.name
    assert main(["pictures", str(again), *ARGUMENTS]) == 0
    assert (bag / "pictures.mcap").read_bytes() == (again / "pictures.mcap").read_bytes()


def test_a_detector_finds_the_landmarks_where_they_are() -> None:
    """Rendered without hidden errors, every landmark's corners are found where OpenCV projects them."""
    camera = CameraModel(exposure_s=1e-4, white_flux=1e8)  # no time to turn, the light of an ordinary image
    recorded = simulate_eight_images(EightSettings(seed=4, duration_s=2.0, robots=3, errors=W0), camera)
    run, family = recorded.run, family_named(FAMILY)
    detector = MarkerDetector(DetectorSettings(), {family: None})
    marks = {mark.id: mark for mark in run.swarm.landmarks}
    errors: list[float] = []
    for frame, image in zip(run.frames, recorded.images(), strict=True):
        robot = int(frame["robot"])
        pose = run.truth.at(robot, frame["stamp_ns"])
        found = detector.detect(image)
        assert set(found.id.tolist()) <= set(run.swarm.owner_of)
        for marker_id, corners in zip(found.id.tolist(), found.corners, strict=True):
            if marker_id in marks:
                mark = marks[marker_id]
                expected = pixels_of(RobotCamera(robot, camera, CAMERA), camera, pose, square_of(mark))
                errors += np.linalg.norm(corners - expected, axis=1).tolist()
    assert len(errors) > 4 * len(run.frames)
    assert np.median(errors) < 0.12
    assert np.quantile(errors, 0.95) < 0.3


def square_of(mark: Landmark) -> FloatArray:
    """Corners (4, 3) of a landmark, clockwise from the upper left of one who faces it."""
    yaw = mark.yaw or 0.0
    right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    sides = 0.5 * mark.size * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    corners: FloatArray = np.array([mark.x, mark.y, mark.z]) + sides[:, :1] * right + sides[:, 1:] * up
    return corners
