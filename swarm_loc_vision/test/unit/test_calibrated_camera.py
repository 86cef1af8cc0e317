"""Cameras by their camera_info: region of interest and binning, and images that do not fit them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_messages import camera_info
from scipy.spatial.transform import Rotation

from bench.vision.scenes import CAMERA, FOCAL_PX, HEIGHT, WIDTH, Gray, Look, random_scene
from swarm_loc_vision.common.camera import Camera, CameraError
from swarm_loc_vision.common.images import CalibratedCamera, ImageError, camera_of, gray_image
from swarm_loc_vision.markers.detector import Detections, DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import family_named

FAMILY = "aruco_mip_36h12"
IMAGE, TRUTHS = random_scene(np.random.default_rng(4), family_named(FAMILY), 8, Look())


class Seen(CalibratedCamera):
    """The markers that are found in the images of a camera."""

    def use(self, camera: Camera) -> None:
        """Create the detector."""
        self._detector = MarkerDetector(DetectorSettings(), {family_named(FAMILY): None}, camera)

    def found(self, message: Any) -> bytes:
        """Keep the markers of an image message."""
        self.detections = self._detector.detect(self.gray(message))
        return b""


def image_message(pixels: Gray) -> SimpleNamespace:
    """A sensor_msgs/Image."""
    height, width = pixels.shape
    fields = {"encoding": "mono8", "height": height, "width": width, "step": width, "is_bigendian": 0}
    return SimpleNamespace(**fields, data=pixels.tobytes())


def shown(roi: tuple[int, int, int, int], binning: tuple[int, int]) -> Gray:
    """What a sensor with this region and binning shows of the scene."""
    left, top, width, height = roi if any(roi) else (0, 0, WIDTH, HEIGHT)
    across, down = (max(b, 1) for b in binning)
    cut = IMAGE[top : top + height // down * down, left : left + width // across * across].astype(float)
    blocks = cut.reshape(len(cut) // down, down, -1, across)
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), np.uint8)


def detections(roi: tuple[int, int, int, int], binning: tuple[int, int]) -> Detections:
    camera = Seen(gray_image)
    camera.calibrate(camera_info(roi, binning))
    camera.detect(image_message(shown(roi, binning)))
    return camera.detections


WHOLE = (0, 0, 0, 0)
PART = (303, 93, 951, 801)  # With odd numbers, so that binning leaves a column and a row over


@pytest.mark.parametrize("roi", [WHOLE, PART])
@pytest.mark.parametrize("binning", [(0, 0), (1, 1), (2, 2), (2, 1), (1, 2)])
def test_poses_through_a_region_and_binning_are_those_of_the_whole_image(
    roi: tuple[int, int, int, int], binning: tuple[int, int]
) -> None:
    """The wrong centre of a pixel after binning would move markers by half a pixel."""
    whole, part = detections(WHOLE, (1, 1)), detections(roi, binning)
    assert whole.poses is not None
    assert part.poses is not None
    row = [int(np.flatnonzero(whole.id == marker_id)[0]) for marker_id in part.id]
    assert len(row) >= (len(TRUTHS) if roi == WHOLE else 5)
    place, expected = part.poses.position[:, 0], whole.poses.position[row, 0]
    assert place[:, 2] == pytest.approx(expected[:, 2], rel=0.005)
    bearing, wanted = (FOCAL_PX * at[:, :2] / at[:, 2:] for at in (place, expected))
    assert np.abs(bearing - wanted).max() < 0.05  # px
    turned = part.poses.rotation[:, 0] @ whole.poses.rotation[row, 0].transpose(0, 2, 1)
    assert np.degrees(Rotation.from_matrix(turned).magnitude()).max() < 0.5


@pytest.mark.parametrize(
    ("roi", "binning", "words"),
    [
        (
            (0, 0, 1281, 960),
            (0, 0),
            r"roi has 1281 x 960 pixels at \(0, 0\), but must lie within its 1280 x 960",
        ),
        ((1200, 0, 81, 960), (0, 0), r"roi has 81 x 960 pixels at \(1200, 0\), but must lie within"),
        ((0, 900, 1280, 61), (0, 0), r"roi has 1280 x 61 pixels at \(0, 900\), but must lie within"),
        ((4, 4, 0, 0), (0, 0), r"roi has 0 x 0 pixels at \(4, 4\), but must lie within"),
        (
            (0, 0, 64, 48),
            (65, 1),
            "binning_x and binning_y are 65 and 1, but must be at most the 64 x 48 pixels",
        ),
        (WHOLE, (1, 961), "binning_x and binning_y are 1 and 961, but must be at most the 1280 x 960 pixels"),
    ],
)
def test_regions_and_binning_that_cannot_be_are_refused(
    roi: tuple[int, int, int, int], binning: tuple[int, int], words: str
) -> None:
    with pytest.raises(CameraError, match=words):
        camera_of(camera_info(roi, binning))


def test_whole_images_keep_every_bit_of_the_calibration() -> None:
    expected = Camera.from_matrix((WIDTH, HEIGHT), CAMERA, (0.0,) * 5)
    assert camera_of(camera_info()) == camera_of(camera_info((0, 0, WIDTH, HEIGHT), (1, 1))) == expected


def test_images_of_another_size_than_the_region_are_dropped() -> None:
    camera = Seen(gray_image)
    camera.calibrate(camera_info(PART, (2, 2)))
    with pytest.raises(
        ImageError, match="the image has 1280 x 960 pixels, but must have 475 x 400"
    ) as caught:
        camera.detect(image_message(IMAGE))
    assert caught.value.reason == "size"
    assert (camera.images, camera.drops) == (1, {"size": 1})
