"""Calibrates the laser of one robot: drives it straight at a wall, fits the hyperbola, writes a YAML file.

    ./run swarm_loc_vision calibrate_laser --ros-args -r __ns:=/pushbot1 -p output:=pushbot1.yaml

With `bag:=FOLDER` the drive comes from a bag. Otherwise the robot's driver and its `event_tracker_node` must
run: put the robot square to a wall, measure the distance from the middle between its wheels to the wall, and
start. The node subscribes to `odom` and `laser` and publishes `cmd_vel`. Parameters: see
`doc/calibrate_laser.md`.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile

from swarm_loc_estimator.common.files import check_folder
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.node import ConfiguredNode, Stop, run_node
from swarm_loc_estimator.common.parameters import ParameterError, number, text
from swarm_loc_msgs.msg import LaserDistance
from swarm_loc_vision.laser.calibration import (
    CalibrationError,
    WallDrive,
    fit_hyperbola,
    recorded_drive,
    save_laser,
)

_QOS = QoSProfile(depth=10)
_COMMAND_S = 0.05
_WAKE_S = 0.1
_PATIENCE_S = 10.0
_SETTLE_S = 0.5  # Time for messages that are under way when the robot stops [s]


@dataclass(frozen=True)
class CalibrateLaserParameters:
    """Parameters of `calibrate_laser`."""

    start_distance: float = number(
        2.5, "m", 0.2, 100.0, "from base_link to the wall at the start, measured by hand"
    )
    start_sigma: float = number(0.005, "m", 1e-5, 1.0, "its standard deviation")
    stop_distance: float = number(0.16, "m", 0.05, 10.0, "from base_link to the wall where the robot stops")
    speed: float = number(0.1, "m/s", 0.01, 1.0, "of the drive")
    camera_x: float = number(0.04, "m", -1.0, 1.0, "position of the camera ahead of base_link")
    output: str = text("", "path of the calibration file to write", required=True)
    bag: str = text("", "path of a bag with the robot's odom and laser; empty: drive now")


class CalibrateLaserNode(ConfiguredNode[CalibrateLaserParameters]):
    """Drives, collects, and fits at the end."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("calibrate_laser", CalibrateLaserParameters, **node_arguments)
        params = self.params
        if params.stop_distance >= 0.5 * params.start_distance:
            raise ParameterError(
                f"parameter stop_distance = {params.stop_distance} must be less than half of"
                f" start_distance = {params.start_distance}."
            )
        output = Path(params.output)
        check_folder(output.parent, output.name)
        self._drive = WallDrive(params.start_distance, params.stop_distance)
        self._heard_s = {"odom": -math.inf, "laser": -math.inf}
        self._command = self.create_publisher(Twist, "cmd_vel", QoSProfile(depth=1))
        self.create_subscription(Odometry, "odom", self._on_odometry, _QOS)
        self.create_subscription(LaserDistance, "laser", self._on_laser, _QOS)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_COMMAND_S, self._send_speed, clock=clock)
        self._speed = 0.0
        self._error: CalibrationError | None = None

    def run(self, stop: Stop) -> int:
        """Drive to the wall or read the bag, then fit and write; returns the exit status."""
        if self.params.bag:
            drive = recorded_drive(Path(self.params.bag), self.get_namespace().strip("/"), self._drive)
            return self._fit(drive)
        executor = EventsExecutor()
        executor.add_node(self)
        begin_s, done_s = time.monotonic(), math.inf
        while not stop.requested and time.monotonic() < done_s + _SETTLE_S:
            executor.spin_once(timeout_sec=_WAKE_S)
            if self._error is not None:
                break
            now_s, heard_s = time.monotonic(), min(self._heard_s.values())
            if self._drive.is_done or now_s > max(begin_s, heard_s) + _PATIENCE_S:
                done_s = min(done_s, now_s)
            hears_all = heard_s > now_s - 1.0
            self._speed = self.params.speed if math.isinf(done_s) and hears_all else 0.0
        self._command.publish(Twist())
        executor.shutdown()
        if self._error is not None:
            raise self._error
        if stop.requested:
            return 130
        if not self._drive.is_done:
            missing = min(self._heard_s, key=lambda name: self._heard_s[name])
            raise CalibrationError(
                f"no messages received on {self.resolve_topic_name(missing)} for {_PATIENCE_S:g} s;"
                f" the robot has driven {self._drive.driven:.2f} m."
            )
        return self._fit(self._drive)

    def _fit(self, drive: WallDrive) -> int:
        params = self.params
        calibration = fit_hyperbola(drive.drive(params.start_sigma, params.camera_x))
        save_laser(Path(params.output), calibration)
        near, far = calibration.min_depth, calibration.max_depth
        _, sigma = calibration.distance(calibration.row(1.0), 0.0)
        print(
            f"{drive.count} rows between {near:.2f} and {far:.2f} m:"
            f" p_inf = {calibration.row_at_infinity:.2f} px, f b = {calibration.focal_base:.3f} px m,"
            f" sigma_px = {calibration.row_sigma:.3f}; a distance of 1 m is known to {100.0 * sigma:.1f} cm."
        )
        print(f"wrote {params.output}")
        return 0

    def _send_speed(self) -> None:
        self._command.publish(Twist(linear=Vector3(x=self._speed)))

    def _on_odometry(self, message: Odometry) -> None:
        self._heard_s["odom"] = time.monotonic()
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        theta = 2.0 * math.atan2(turn.z, turn.w)
        if not all(map(math.isfinite, (place.x, place.y, theta))):
            return
        try:
            self._drive.take_odometry(nanoseconds(message.header.stamp), place.x, place.y, theta)
        except CalibrationError as error:
            self._error = error

    def _on_laser(self, message: LaserDistance) -> None:
        self._heard_s["laser"] = time.monotonic()
        self._drive.take_row(nanoseconds(message.header.stamp), message.v_px)


main = partial(run_node, "calibrate_laser", CalibrateLaserNode)
