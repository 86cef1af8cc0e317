"""Error models of simulated e-pucks: named sets of noise and hidden systematic errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from swarm_loc_estimator.swarm.swarm import SensorModel


@dataclass(frozen=True)
class ErrorModel:
    """Imperfections of one simulated world; all sigmas are one standard deviation.

    Attributes:
        forward_sigma: White noise along the optical axis [m].
        left_sigma: White noise across it [m].
        heading_sigma: White noise of a marker's heading [rad].
        flip_probability: Share of sightings whose heading is the mirror solution of the planar pose problem.
        gross_probability: Share of sightings that are nonsense.
        camera_yaw_sigma: Unknown turn of each camera on its robot [rad].
        scale_sigma: Unknown scale of each camera's distances [1].
        map_position_sigma: Error of every landmark's surveyed position, per axis [m].
        map_heading_sigma: Error of its surveyed direction [rad].
        face_position_sigma: Error of every on-robot marker's position, per axis [m].
        exposure_early_s: Images are taken up to this long before their stamp, uniformly [s].
        turn_slip: Share of every commanded turn that is lost.
        wheel_noise: Variance of a wheel's path per metre rolled [m].
        frame_loss: Share of images that never arrive.
        described: The sensor model that the swarm description gives.
    """

    forward_sigma: float
    left_sigma: float
    heading_sigma: float
    flip_probability: float
    gross_probability: float
    camera_yaw_sigma: float
    scale_sigma: float
    map_position_sigma: float
    map_heading_sigma: float
    face_position_sigma: float
    exposure_early_s: float
    turn_slip: float
    wheel_noise: float
    frame_loss: float
    described: SensorModel


PRINTED_SENSOR = SensorModel(forward_sigma=0.026, left_sigma=0.029, heading_sigma=0.508)
"""The sigmas that the e-puck paper prints below its figure 5."""

W0 = ErrorModel(
    forward_sigma=PRINTED_SENSOR.forward_sigma,
    left_sigma=PRINTED_SENSOR.left_sigma,
    heading_sigma=PRINTED_SENSOR.heading_sigma,
    flip_probability=0.0,
    gross_probability=0.0,
    camera_yaw_sigma=0.0,
    scale_sigma=0.0,
    map_position_sigma=0.0,
    map_heading_sigma=0.0,
    face_position_sigma=0.0,
    exposure_early_s=0.0,
    turn_slip=0.0,
    wheel_noise=2e-5,
    frame_loss=0.05,
    described=PRINTED_SENSOR,
)
"""The printed sigmas as white noise and nothing else."""

W2 = ErrorModel(
    forward_sigma=0.008,
    left_sigma=0.006,
    heading_sigma=0.10,
    flip_probability=0.12,
    gross_probability=0.005,
    camera_yaw_sigma=math.radians(1.8),
    scale_sigma=0.024,
    map_position_sigma=0.016,
    map_heading_sigma=0.03,
    face_position_sigma=0.003,
    exposure_early_s=0.133,
    turn_slip=0.05,
    wheel_noise=2e-5,
    frame_loss=0.05,
    described=PRINTED_SENSOR,
)
"""Small white noise and systematic errors that together look like the paper's experiment."""

W2_FAST = replace(W2, turn_slip=0.20)
"""At 0.08 m/s the wheels slip more in the curves."""

WORLDS = {"w0": W0, "w2": W2, "w2fast": W2_FAST}
