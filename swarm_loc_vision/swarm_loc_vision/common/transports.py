"""Ways that images come, and how their messages are read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_vision.common.gray import decoded_image, gray_image

Gray = NDArray[np.uint8]


def gray_of_image(message: Any) -> Gray:
    """The image of a sensor_msgs/Image.

    Raises:
        ImageError: It cannot be read.
    """
    return gray_image(
        message.encoding,
        message.width,
        message.height,
        message.step,
        message.data,
        is_bigendian=bool(message.is_bigendian),
    )


def gray_of_compressed(message: Any) -> Gray:
    """The image of a sensor_msgs/CompressedImage.

    Raises:
        ImageError: It cannot be read.
    """
    return decoded_image(message.format, message.data)


@dataclass(frozen=True)
class Transport:
    """A way that images come, as image_transport has it.

    Attributes:
        suffix: Of the topic, behind that of the images as they are.
        message_type: Of its messages.
        gray_of: Reads one of them.
    """

    suffix: str
    message_type: str
    gray_of: Callable[[Any], Gray]


TRANSPORTS = {
    "raw": Transport("", "sensor_msgs/msg/Image", gray_of_image),
    "compressed": Transport("/compressed", "sensor_msgs/msg/CompressedImage", gray_of_compressed),
}
"""By the names of image_transport."""
