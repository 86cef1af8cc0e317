"""What the parameters say: on the node's page, and about the detector that follows from them."""

from pathlib import Path

import numpy as np
import pytest

from bench.shared.parameter_table import markdown_table
from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, random_scene
from swarm_loc_estimator.swarm.swarm import Face, Landmark, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.detector import DetectorParameters, detector_maker
from swarm_loc_vision.markers.families import family_named

PAGE = Path(__file__).parents[2] / "doc" / "marker_detector_node.md"
FAMILY = "aruco_mip_36h12"


def test_the_page_says_what_the_table_says() -> None:
    assert markdown_table(DetectorParameters) in PAGE.read_text(encoding="utf-8")


def test_every_marker_of_the_swarm_has_its_own_size(tmp_path: Path) -> None:
    image, truths = random_scene(np.random.default_rng(4), family_named(FAMILY), 8, Look())
    first, *others = truths
    robot = Robot("a", faces=(Face("front", first.marker_id, yaw=0.0, size=first.length),))
    marks = tuple(Landmark(one.marker_id, yaw=0.0, size=one.length) for one in others)
    save_swarm(Swarm((robot,), marks), tmp_path / "swarm.yaml")
    parameters = DetectorParameters(family=FAMILY, swarm_file=str(tmp_path / "swarm.yaml"))
    detector = detector_maker(parameters)(Camera.from_matrix((WIDTH, HEIGHT), CAMERA, ()))

    detections = detector.detect(image)

    assert detections.poses is not None
    found = dict(zip(detections.id.tolist(), detections.poses.position[:, 0, 2].tolist(), strict=True))
    expected = {truth.marker_id: pytest.approx(truth.position[2], rel=0.02) for truth in truths}
    assert found == expected
