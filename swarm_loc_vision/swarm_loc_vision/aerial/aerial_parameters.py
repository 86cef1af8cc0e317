"""Parameters of `aerial_camera_node`, and what they describe. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from swarm_loc_estimator.common.parameters import choice, text
from swarm_loc_vision.aerial.aerial_camera import AerialCamera
from swarm_loc_vision.aerial.detector import POLARITIES
from swarm_loc_vision.aerial.ground.ground_control import Ground
from swarm_loc_vision.aerial.ground_file import load_ground
from swarm_loc_vision.aerial.settings import AerialSettings
from swarm_loc_vision.common.transports import TRANSPORTS


@dataclass(frozen=True)
class AerialParameters:
    """Parameters of `aerial_camera_node`; those of the detector itself are its settings."""

    image_transport: str = choice("raw", tuple(TRANSPORTS), "how images come: as they are, or as JPEG or PNG")
    control_points_file: str = text(
        "", "path of the control points, floor markers and intrinsics; empty: none, and nothing is published"
    )
    polarity: str = choice(
        "auto", tuple(POLARITIES), "whether robots are brighter or darker than the floor; auto: as clearer"
    )
    settings: AerialSettings = field(default_factory=AerialSettings, metadata={"numbers_of": AerialSettings})


def aerial_camera(parameters: AerialParameters) -> AerialCamera:
    """The camera as described.

    Raises:
        GroundFileError: The control points cannot be used.
    """
    path = parameters.control_points_file
    ground = load_ground(Path(path)) if path else Ground()
    gray_of = TRANSPORTS[parameters.image_transport].gray_of
    return AerialCamera(parameters.settings, parameters.polarity, ground, gray_of)
