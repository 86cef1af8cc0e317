"""Compile the detector before the first image comes."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.jit import note_precompiled
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.bodies import Placement
from swarm_loc_vision.markers.detector import MarkerDetector
from swarm_loc_vision.markers.detector_settings import DetectorSettings
from swarm_loc_vision.markers.draw import draw_marker
from swarm_loc_vision.markers.families import family_named


def precompile() -> None:
    """Let a detector find two markers of one body, which takes every path through the compiled code."""
    family = family_named("artoolkit_bch_thin")
    image = np.hstack([draw_marker(family, marker_id, margin=4) for marker_id in (1, 2)])
    height, width = image.shape
    camera = Camera(width, height, 500.0, 500.0, 0.5 * width, 0.5 * height)
    apart = 0.05 * (family.side + 8) / family.side
    body = {i: Placement(np.eye(3), np.array([apart * i, 0.0, 0.0]), 0.001) for i in (1, 2)}
    up = np.array([0.0, -1.0, 0.0])
    settings = DetectorSettings(tilt_sigma=0.1)
    MarkerDetector(settings, [(family, np.array([1, 2]))], camera, up=up, bodies=[body]).detect(image)
    note_precompiled(precompile)
