"""The driver of one e-puck or e-puck2 as a ROS 2 node, in the robot's namespace.

    ./run swarm_loc_drivers epuck_driver_node --ros-args -r __ns:=/epuck1 -p address:=/dev/rfcomm0

It takes `cmd_vel` and publishes `odom`, `proximity/ps0` to `ps7`, `image_raw`, `camera_info`, `/tf`,
`/tf_static` and `/diagnostics`. Parameters: see `doc/epuck_driver_node.md`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

from geometry_msgs.msg import Transform, TransformStamped, Vector3
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, Range
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from swarm_loc_drivers.common.robot_driver_node import (
    RobotDriverNode,
    camera_info_message,
    image_message,
    stamp_message,
    yaw_quaternion,
)
from swarm_loc_drivers.epuck.driver import EpuckDriver, EpuckListeners
from swarm_loc_drivers.epuck.hardware import (
    FIELD_OF_VIEW,
    MAX_RANGE_M,
    MIN_RANGE_M,
    PROXIMITY_BEARINGS,
    PROXIMITY_RADIUS_M,
    CameraImage,
    range_of_raw,
)
from swarm_loc_drivers.epuck.parameters import EpuckParameters, camera_calibration
from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.node import run_node

_TF_STATIC_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_RATES = ("readings", "images")
_WRONG = {
    "bad_cmd_vel": "velocities that were not finite or too large",
    "bad_images": "images of another size or kind than requested",
    "counter_restarts": "discontinuous counters, as after a reset",
    "implausible_counters": "readings that the commands cannot explain",
    "missed_replies": "requests without a complete answer in time",
    "reversed_counters": "right wheels counted backwards, as by firmware before December 2018; corrected",
    "time_jumps": "stamps that stepped back",
}


class EpuckDriverNode(RobotDriverNode[EpuckParameters]):
    """Passes velocities to the driver and publishes its data."""

    _driver: EpuckDriver

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("epuck_driver", EpuckParameters, **node_arguments)
        params = self.params
        self._camera_frame = f"{self._prefix}camera_optical_frame"
        self._calibration = camera_calibration(params, params.images) if params.images else None
        odometry = self._odometry_output("odom", self._prefix)
        listeners = EpuckListeners(odometry.publish, self._publish_proximity, self._publish_image)
        self._driver = EpuckDriver(params, listeners, self._now_ns)
        # one topic each: eight messages at once would overflow a sensor-data queue
        names = [f"ps{sensor}" for sensor in range(len(PROXIMITY_BEARINGS))]
        self._proximity = [
            self.create_publisher(Range, f"proximity/{name}", qos_profile_sensor_data) for name in names
        ]
        self._frames = [f"{self._prefix}{name}" for name in names]  # x points out of the sensor
        if self._calibration is not None:
            self._image = self.create_publisher(Image, "image_raw", qos_profile_sensor_data)
            self._camera_info = self.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)
        # an absolute name, because tf2 listens only there
        self._tf_static = self.create_publisher(TFMessage, "/tf_static", _TF_STATIC_QOS)
        header = Header(stamp=stamp_message(self._now_ns()), frame_id=self._base_frame)
        transforms = []
        for frame, bearing in zip(self._frames, PROXIMITY_BEARINGS, strict=True):
            x, y = PROXIMITY_RADIUS_M * math.cos(bearing), PROXIMITY_RADIUS_M * math.sin(bearing)
            transform = Transform(translation=Vector3(x=x, y=y), rotation=yaw_quaternion(bearing))
            transforms.append(TransformStamped(header=header, child_frame_id=frame, transform=transform))
        self._tf_static.publish(TFMessage(transforms=transforms))
        self._start_reports(str(params.link_address), _RATES, _WRONG)
        self._follow("cmd_vel", self._driver.set_velocity)
        self.create_timer(1.0 / params.reading_rate, self._driver.tick)

    def _publish_proximity(self, stamp_ns: int, raw: IntArray) -> None:
        """Publish raw proximity values (8,) as ranges."""
        if not any(publisher.get_subscription_count() for publisher in self._proximity):
            return
        stamp = stamp_message(stamp_ns)
        kind = {"radiation_type": Range.INFRARED, "field_of_view": FIELD_OF_VIEW}
        limits = {"min_range": MIN_RANGE_M, "max_range": MAX_RANGE_M}
        ranges = range_of_raw(raw).tolist()
        for publisher, frame, distance in zip(self._proximity, self._frames, ranges, strict=True):
            header = Header(stamp=stamp, frame_id=frame)
            publisher.publish(Range(header=header, range=distance, **kind, **limits))

    def _publish_image(self, taken: CameraImage) -> None:
        if self._calibration is None:
            return
        image = image_message(taken.pixels, taken.stamp_ns, self._camera_frame)
        self._image.publish(image)
        self._camera_info.publish(camera_info_message(self._calibration, image.header))


main = partial(run_node, "epuck_driver_node", EpuckDriverNode)
