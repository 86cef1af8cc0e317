"""Message types for bags without ROS: Jazzy's own, and this workspace's from its `.msg` files."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from swarm_loc_estimator.common.parameters import UserError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

MESSAGE_PACKAGE = "swarm_loc_msgs"

ODOMETRY = "nav_msgs/msg/Odometry"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
DETECTIONS = f"{MESSAGE_PACKAGE}/msg/MarkerDetectionArray"
DETECTION = f"{MESSAGE_PACKAGE}/msg/MarkerDetection"
BRIGHTNESS = f"{MESSAGE_PACKAGE}/msg/BrightnessMatrix"
ANONYMOUS_DETECTIONS = f"{MESSAGE_PACKAGE}/msg/AnonymousDetectionArray"
ROBOT_IDENTITIES = f"{MESSAGE_PACKAGE}/msg/RobotIdentities"
SWARM_ODOMETRY = f"{MESSAGE_PACKAGE}/msg/SwarmOdometry"
SWARM_DETECTIONS = f"{MESSAGE_PACKAGE}/msg/SwarmDetections"
SWARM_FIXES = f"{MESSAGE_PACKAGE}/msg/SwarmFixes"
SWARM_POSES = f"{MESSAGE_PACKAGE}/msg/SwarmPoses"
MARKERS = "visualization_msgs/msg/MarkerArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"


class DefinitionsNotFoundError(UserError):
    """The `.msg` files of this workspace are neither beside the package nor installed."""


def message_folder() -> Path:
    """The folder with this workspace's `.msg` files.

    In a source tree it lies beside this package; installed it is found as ROS does, on AMENT_PREFIX_PATH.

    Raises:
        DefinitionsNotFoundError: Neither is there.
    """
    beside = Path(__file__).resolve().parents[4] / MESSAGE_PACKAGE / "msg"
    prefixes = [
        Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix
    ]
    for folder in (beside, *(prefix / "share" / MESSAGE_PACKAGE / "msg" for prefix in prefixes)):
        if any(folder.glob("*.msg")):
            return folder
    raise DefinitionsNotFoundError(
        f"The message definitions of {MESSAGE_PACKAGE} are neither in '{beside}' nor under a prefix on"
        " AMENT_PREFIX_PATH; build the workspace and source its set-up first."
    )


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Jazzy's types and this workspace's, read once.

    Raises:
        DefinitionsNotFoundError: The workspace's `.msg` files are not there.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for path in sorted(message_folder().glob("*.msg")):
        types.update(
            get_types_from_msg(path.read_text(encoding="utf-8"), f"{MESSAGE_PACKAGE}/msg/{path.stem}")
        )
    store.register(types)
    return store


def encode(message: Any, message_type: str) -> bytes:
    """Serialize a message object of the type store to little-endian CDR."""
    return bytes(typestore().serialize_cdr(message, message_type))
