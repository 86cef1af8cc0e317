"""Messages of the scenes' camera, as tests of the vision package share them."""

from types import SimpleNamespace

import numpy as np

from bench.vision.scenes import CAMERA, HEIGHT, WIDTH

FRAME = "camera_optical_frame"


def header(frame: str = FRAME) -> SimpleNamespace:
    """A std_msgs/Header."""
    return SimpleNamespace(frame_id=frame, stamp=SimpleNamespace(sec=3, nanosec=5))


def camera_info(
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
    binning: tuple[int, int] = (0, 0),
    distortion: tuple[float, ...] = (0.0,) * 5,
) -> SimpleNamespace:
    """A sensor_msgs/CameraInfo; rectified images have another focal length.

    Args:
        roi: Left and upper edge, width and height of the region [px].
        binning: Across and down.
        distortion: Of the lens.
    """
    rectified = np.hstack([np.diag([0.9, 0.9, 1.0]) @ CAMERA, np.zeros((3, 1))])
    names = ("x_offset", "y_offset", "width", "height")
    return SimpleNamespace(
        header=header(),
        width=WIDTH,
        height=HEIGHT,
        distortion_model="plumb_bob",
        d=distortion,
        k=CAMERA.ravel(),
        p=rectified.ravel(),
        roi=SimpleNamespace(**dict(zip(names, roi, strict=True))),
        binning_x=binning[0],
        binning_y=binning[1],
    )
