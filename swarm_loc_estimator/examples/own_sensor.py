"""Add a sensor: ultrasonic beacons, whose microphones on the robots measure distances to known places.

Copy it, change what is yours, and import it before the estimator is created. The base class reads bytes,
headers and topics, checks what `measure` returns and counts what is dropped.
"""

import struct
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator import Estimator, Measurements, Messages, Prediction, Robot, Sensor, Swarm, register

BEACONS = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])  # x, y in map [m]
SIGMA_M = 0.03


class BeaconRows(NamedTuple):
    """Readings (k,): the first column is `robot`, the last `arrival_ns`."""

    robot: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    beacon: NDArray[np.int64]
    distance: NDArray[np.float64]  # [m]
    arrival_ns: NDArray[np.int64]


@register
class BeaconSensor(Sensor):
    """Distances to beacons on `<robot>/beacons`."""

    name, topic, message_type = "beacons", "beacons", "my_msgs/msg/BeaconDistance"
    components = ("distance [m]",)  # its own model, see `predict`

    @classmethod
    def decode(cls, data: bytes) -> Any:
        """Read a message; a type whose package is installed needs no decoder."""
        stamp_ns, beacon, distance = struct.unpack("<qqd", data)
        return SimpleNamespace(stamp_ns=stamp_ns, frame_id="", beacon=beacon, distance=distance)

    @classmethod
    def columns(cls, messages: Messages[Any]) -> BeaconRows:
        """Convert decoded messages (n,) to readings."""
        beacon = np.array([one.beacon for one in messages.decoded], dtype=np.int64)
        distance = np.array([one.distance for one in messages.decoded], dtype=float)
        return BeaconRows(messages.robot, messages.stamp_ns, beacon, distance, messages.arrival_ns)

    def measure(self, rows: BeaconRows) -> Measurements:
        """Convert readings (k,) to measurements."""
        out = self.measurements(rows)  # with stamps, observers, model and gate; of no other robot
        out.reading[:] = rows.beacon
        out.marker[:, :2] = BEACONS[rows.beacon]
        out.value[:, 0], out.covariance[:, 0, 0] = rows.distance, SIGMA_M**2
        return out

    @staticmethod
    def predict(one: Measurements, observer: NDArray[np.float64], _target: NDArray[np.float64]) -> Prediction:
        """Predict the distance of a robot at a pose (3,), and its Jacobian by the right-invariant error."""
        x, y = observer[:2]
        away = one.marker[:2] - observer[:2]
        distance = np.hypot(*away)
        ux, uy = away / distance
        return Prediction(np.array([distance]), np.array([[-ux, -uy, ux * y - uy * x]]), np.zeros((1, 3)))


if __name__ == "__main__":
    estimator, rng = Estimator(Swarm((Robot("r1", start=(1.0, 1.0, 0.0)),))), np.random.default_rng(1)
    for now_s in np.arange(1.0, 21.0):
        t = np.arange(now_s - 1.0, now_s, 0.1)
        x = 1.0 + 0.1 * t  # it drives along x at 0.1 m/s; its wheels report 2 % too far
        beacon = rng.integers(0, 3, t.size)
        distance = np.hypot(BEACONS[beacon, 0] - x, BEACONS[beacon, 1] - 1.0)
        distance += rng.normal(0.0, SIGMA_M, t.size)
        estimate, dropped = estimator.step(
            now_s,
            odometry={"robot": "r1", "stamp_s": t, "pose": np.column_stack([0.102 * t, 0.0 * t, 0.0 * t])},
            beacons={"robot": "r1", "stamp_s": t, "beacon": beacon, "distance": distance},
        )
        error = np.hypot(*(estimate.poses[0, :2] - [1.0 + 0.1 * now_s, 1.0]))
        sigma = np.sqrt(estimate.covariances[0, 0, 0] + estimate.covariances[0, 1, 1])
        print(f"{now_s:3.0f} s  error {100.0 * error:5.2f} cm of {100.0 * sigma:5.2f}  dropped {dropped}")
