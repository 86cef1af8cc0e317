"""Simulated sightings as messages of detections, as detectors publish them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from swarm_loc_drivers.sim.common.record import Records, SimulatedRun
from swarm_loc_estimator.common.messages.cdr import DETECTION_DTYPE
from swarm_loc_estimator.sensors.camera import CONTENT_POSE

FAMILY = 0
"""MarkerDetection.FAMILY_ARTOOLKIT_BCH."""


def as_detections(run: SimulatedRun) -> Records:
    """All sightings (S,) of a run, of DETECTION_DTYPE; markers stand upright at their described heights."""
    markers = run.swarm.owner_of
    camera_height = np.array([0.0 if r.camera is None else r.camera.z for r in run.swarm.robots])
    observer = np.repeat(run.frames["robot"], run.frames["count"])
    height = np.array([markers[int(marker)].marker.z for marker in run.sightings["marker_id"]])
    forward, left, heading = run.sightings["value"].T
    detections = np.zeros(len(run.sightings), DETECTION_DTYPE)
    detections["id"] = run.sightings["marker_id"]
    detections["family"], detections["content"] = FAMILY, CONTENT_POSE
    detections["id_margin"] = np.nan
    detections["corners_px"] = np.nan
    detections["position"] = np.column_stack([-left, camera_height[observer] - height, forward])
    detections["orientation"] = marker_orientation(heading)
    detections["covariance"][:, 0, 0] = -1.0
    detections["alternative_orientation"][:, 3] = 1.0
    detections["alternative_ratio"] = np.nan
    return detections


def marker_orientation(heading: np.typing.NDArray[np.float64]) -> np.typing.NDArray[np.float64]:
    """Quaternions (S, 4) x y z w, in the optical frame, of upright markers.

    Args:
        heading: (S,) direction out of the face [rad], 0 along the optical axis, positive to the left.
    """
    sin, cos, zero = np.sin(heading), np.cos(heading), np.zeros_like(heading)
    right = np.stack([-cos, zero, -sin], axis=-1)
    up = np.stack([zero, zero - 1.0, zero], axis=-1)
    out = np.stack([-sin, zero, cos], axis=-1)
    quaternions: np.typing.NDArray[np.float64] = Rotation.from_matrix(
        np.stack([right, up, out], axis=-1)
    ).as_quat()
    return quaternions
