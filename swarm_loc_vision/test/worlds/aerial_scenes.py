"""Cameras over a floor with known poses, for tests of the aerial detector."""

import math

import cv2
import numpy as np

from swarm_loc_vision.aerial.ground_control import ControlPoints, GroundCamera
from swarm_loc_vision.common.camera import Camera

LENSES = {
    "straight": Camera(640, 480, 500.0, 500.0, 319.5, 239.5),
    "barrel": Camera(640, 480, 400.0, 405.0, 310.0, 245.0, (-0.15, 0.02, 0.001, -0.001, 0.0)),
    "rational": Camera(
        640,
        480,
        400.0,
        400.0,
        320.0,
        240.0,
        (-0.1, 0.01, 0.0, 0.0, 0.0, 0.05, 0.0, 0.0),
        "rational_polynomial",
    ),
    "fisheye": Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (0.02, -0.003, 0.0, 0.0), "equidistant"),
}


def over_floor(
    camera: Camera, rng: np.random.Generator, tilt: float = 0.5, height: float = 2.0
) -> GroundCamera:
    """A camera above the origin that looks down, tilted to any side by up to `tilt`."""
    down = np.diag([1.0, -1.0, -1.0])
    spin = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]))[0]
    towards = rng.uniform(-math.pi, math.pi)
    lean = cv2.Rodrigues(rng.uniform(0.0, tilt) * np.array([math.cos(towards), math.sin(towards), 0.0]))[0]
    rotation = lean @ down @ spin
    shift = -rotation @ np.array([*rng.uniform(-0.2, 0.2, 2), height])
    return GroundCamera(camera, np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), shift]), np.zeros((6, 6)))


def floor_points(ground: GroundCamera, rng: np.random.Generator, count: int) -> ControlPoints:
    """Points all over what the camera sees of the floor, with their exact pixels."""
    width, height = ground.camera.width, ground.camera.height
    corners = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
    shares = np.concatenate([corners, rng.uniform(0.05, 0.95, (count - 4, 2))])
    flat = ground.places(shares * [width, height], 0.0)
    places = np.concatenate([flat, np.zeros((count, 1))], axis=1)
    return ControlPoints([f"p{k}" for k in range(count)], places, ground.pixels(places))
