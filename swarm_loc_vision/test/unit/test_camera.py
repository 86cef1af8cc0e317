"""Cameras: lenses, and calibration as messages have it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from camera_messages import camera_info
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.vision.scenes import CAMERA, FOCAL_PX, HEIGHT, WIDTH, Gray, Look, random_scene
from swarm_loc_vision.common.camera import Camera, CameraError
from swarm_loc_vision.common.images import CalibratedCamera, ImageError, camera_of, gray_image
from swarm_loc_vision.markers.detector import Detections, DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import family_named

PLUMB_BOB = (-0.28, 0.09, 1e-3, -5e-4, -0.01)
RATIONAL = (0.3, -0.1, 1e-3, 5e-4, 0.02, 0.6, -0.05, 0.01)
PRISM = (*RATIONAL, 2e-3, -1e-3, 3e-3, 5e-4)
TILTED = (*PRISM, 0.02, -0.03)
EQUIDISTANT = (-0.02, 0.01, -0.003, 0.0005)


def camera(distortion: tuple[float, ...] = (), model: str = "plumb_bob") -> Camera:
    return Camera(1280, 960, 1000.0, 990.0, 640.0, 470.0, distortion, model)


def directions() -> NDArray[np.float64]:
    u, v = np.meshgrid(np.linspace(-0.55, 0.55, 9), np.linspace(-0.4, 0.4, 7))
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)


def ideal_pixels(one: Camera) -> NDArray[np.float64]:
    return np.asarray((directions() @ one.matrix.T)[:, :2])


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), "plumb_bob"),
        (PLUMB_BOB, "plumb_bob"),
        (PLUMB_BOB[:4], "rational_polynomial"),
        (PLUMB_BOB, "rational_polynomial"),
        (RATIONAL, "rational_polynomial"),
        (RATIONAL, "plumb_bob"),
        (PRISM, "rational_polynomial"),
        (TILTED, "rational_polynomial"),
        (TILTED, "plumb_bob"),
        (EQUIDISTANT, "equidistant"),
        ((0.0,) * 4, "equidistant"),
        ((), "equidistant"),
    ],
)
def test_raw_pixels_are_opencvs(distortion: tuple[float, ...], model: str) -> None:
    one = camera(distortion, model)
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    lens = np.array(distortion or (0.0,) * 4)
    expected = project(directions()[:, None], np.zeros(3), np.zeros(3), one.matrix, lens)[0]
    raw = one.to_raw(ideal_pixels(one))
    assert raw == pytest.approx(expected.reshape(-1, 2), abs=1e-6)
    assert one.to_ideal(raw) == pytest.approx(ideal_pixels(one), abs=0.2)


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), "plumb_bob"),
        ((), ""),
        (PLUMB_BOB, "plumb_bob"),
        (PLUMB_BOB, "rational_polynomial"),
        (RATIONAL, "rational_polynomial"),
        (TILTED, "rational_polynomial"),
        (EQUIDISTANT, "equidistant"),
    ],
)
@pytest.mark.parametrize("zeros", [1, 3, 7, 9])
def test_zeros_that_follow_change_nothing(distortion: tuple[float, ...], model: str, zeros: int) -> None:
    plain, longer = camera(distortion, model), camera((*distortion, *(0.0,) * zeros), model)
    raw = plain.to_raw(ideal_pixels(plain))
    assert (longer.to_raw(ideal_pixels(plain)) == raw).all()
    assert (longer.to_ideal(raw) == plain.to_ideal(raw)).all()


@pytest.mark.parametrize("distortion", [(), (-0.02, 0.01, -0.003, 0.0005), (0.05, -0.01, 0.0, 0.0)])
def test_what_a_fisheye_sees_far_off_its_axis_has_no_ideal_pixel(distortion: tuple[float, ...]) -> None:
    one = Camera(1600, 1600, 500.0, 500.0, 800.0, 800.0, distortion, "equidistant")
    angles = np.radians([40.0, 70.0, 79.0, 81.0, 86.0, 90.0, 95.0, 105.0])
    k = np.pad(distortion, (0, 4 - len(distortion)))
    radius = angles * (1.0 + sum(k[i] * angles ** (2 * i + 2) for i in range(4)))
    ideal = one.to_ideal(np.column_stack([800.0 + 500.0 * radius, np.full(8, 800.0)]))
    assert np.arctan((ideal[:3, 0] - 800.0) / 500.0) == pytest.approx(angles[:3], abs=1e-6)
    assert np.isnan(ideal[3:]).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": 0.0}, "not calibrated: its focal lengths are 0 and 990 px"),
        ({"cx": float("nan")}, r"cx is nan, but must lie in \[-1e\+06, 1e\+06\]"),
        ({"distortion": (0.0, float("inf"), 0.0, 0.0)}, "distortion coefficient 1 is inf, but must lie in"),
        ({"fy": float("nan")}, "focal lengths are 1000 and nan px, but must lie in"),
        ({"width": 0}, "0 x 960 pixels, but must have at least 1 x 1"),
        ({"fx": 1e300}, r"focal lengths are 1e\+300 and 990 px, but must lie in \(0, 1e\+06\] px"),
        ({"distortion": (0.0, 1e5, 0.0, 0.0)}, r"coefficient 1 is 100000, but must lie in \[-10000, 10000\]"),
        ({"model": "magic"}, "is 'magic', but must be one of plumb_bob, rational_polynomial, equidistant"),
        ({"distortion": (0.1, 0.2)}, "has 2 coefficients, but must have 0 or 4 or 5 or 8 or 12 or 14"),
        ({"distortion": (0.0,) * 14 + (0.1,)}, "has 15 coefficients, but must have .* 14; only zeros may"),
        (
            {"distortion": (*EQUIDISTANT, 0.1), "model": "equidistant"},
            "has 5 coefficients, but must have 0 or 4",
        ),
        ({"distortion": PLUMB_BOB, "model": ""}, "model '' has 5 coefficients, but must have 0"),
    ],
)
def test_what_cannot_be_a_camera_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(CameraError, match=words):
        replace(camera(), **changes)


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
