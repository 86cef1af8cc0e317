"""Tracks blinking lights in the events of one robot, as a ROS 2 node in the robot's namespace.

    ./run swarm_loc_vision event_tracker_node --ros-args -r __ns:=/pushbot1 -p calibration:=pushbot1.yaml

The node subscribes to `events` and publishes `laser` (spot of the robot's own laser, and the distance),
`lights` (bearings of other robots' LEDs) every 20 ms of the events' time, and `/diagnostics`. Parameters: see
`doc/event_tracker_node.md`.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from functools import partial
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from std_msgs.msg import Header

from swarm_loc_estimator.common.health import PATIENCE_S, Report, drop_values, level_of
from swarm_loc_estimator.common.messages.cdr import EVENT_PACKETS, nanoseconds
from swarm_loc_estimator.common.messages.event_encoding import EventError, decode_events
from swarm_loc_estimator.common.node import ConfiguredNode, message_class, run_node
from swarm_loc_msgs.msg import LaserDistance, LightBearing, LightBearingArray
from swarm_loc_vision.events.tracker import (
    EventTrackerParameters,
    LightTracker,
    Sighting,
    WindowReport,
    direction,
    direction_jacobian,
    laser_calibration,
    light_sources,
)
from swarm_loc_vision.laser.calibration import UNKNOWN

EVENT_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
_OUTPUT_QOS = QoSProfile(depth=50)
_LASER_PATIENCE_S, _SEEN_PATIENCE_S = 15.0, 60.0
"""For the laser, before it was first seen and afterwards: in large halls often nothing is within range."""
_MAX_PIXELS = 1 << 21  # Bound on the pixels of a sensor: the tracker stores the last bursts of each


class EventTrackerNode(ConfiguredNode[EventTrackerParameters]):
    """Decodes packets, tracks lights, publishes."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("event_tracker", EventTrackerParameters, **node_arguments)
        self._sources = light_sources(self.params)
        self._calibration = laser_calibration(self.params)
        self._has_laser = not self._sources[0].is_above
        robot = self.get_namespace().strip("/")
        self._base_frame = f"{robot}/{self.params.base_frame}" if robot else self.params.base_frame
        self._size = (0, 0)
        self._tracker: LightTracker | None = None
        self._counts: Counter[str] = Counter()
        self._next_seq: int | None = None
        self._packet_s = self._laser_s = time.monotonic()
        self._laser = self.create_publisher(LaserDistance, "laser", _OUTPUT_QOS)
        self._lights = self.create_publisher(LightBearingArray, "lights", _OUTPUT_QOS)
        packet_class = message_class(EVENT_PACKETS[0])
        self._packet_type = f"{packet_class.__module__.partition('.')[0]}/msg/{packet_class.__name__}"
        self.create_subscription(packet_class, "events", self._on_events, EVENT_QOS)
        self.start_diagnostics(self._on_diagnostics)

    def _on_events(self, message: Any) -> None:
        self._packet_s = time.monotonic()
        self._counts["packets"] += 1
        if self._next_seq is not None and message.seq > self._next_seq:
            self._counts["packets lost on the way"] += message.seq - self._next_seq
        self._next_seq = message.seq + 1
        size = (message.width, message.height)
        if not 0 < size[0] * size[1] <= _MAX_PIXELS:
            self.health.drop(f"a sensor of {size[0]} x {size[1]} px is not one of 1 to {_MAX_PIXELS}")
            return
        try:
            events = decode_events(
                memoryview(message.events), message.encoding, size, is_bigendian=message.is_bigendian
            )
        except EventError as error:
            self.health.drop(str(error))
            return
        if self._tracker is None or size != self._size:
            self._size, self._tracker = size, LightTracker(self._sources, size, self.params.settings)
        stamp_ns = nanoseconds(message.header.stamp)
        self._counts["events"] += len(events.x)
        for report in self._tracker.track(events._replace(time_ns=stamp_ns + events.time_ns)):
            self._publish(report)

    def _publish(self, report: WindowReport) -> None:
        if report.stamp_ns < 0:
            self.health.drop("its stamp is before zero")
            return
        self._counts["reports"] += 1
        laser = [one for one in report.sightings if not self._sources[one.source].is_above]
        lights = [one for one in report.sightings if self._sources[one.source].is_above]
        if self._has_laser:
            self._laser.publish(self._laser_message(report.stamp_ns, laser[0] if laser else None))
        if len(self._sources) > self._has_laser:
            header = self._header(report.stamp_ns)
            self._lights.publish(
                LightBearingArray(header=header, lights=[self._light_message(one) for one in lights])
            )
            self._counts["lights"] += len(lights)

    def _header(self, stamp_ns: int) -> Header:
        return Header(stamp=Time(nanoseconds=stamp_ns).to_msg(), frame_id=self._base_frame)

    def _laser_message(self, stamp_ns: int, seen: Sighting | None) -> LaserDistance:
        """The spot and its distance; NaN where there is none."""
        message = LaserDistance(header=self._header(seen.stamp_ns if seen else stamp_ns))
        message.distance = message.sigma = message.u_px = message.v_px = math.nan
        message.covariance = np.array([-1.0, 0.0, 0.0, 0.0])
        if seen is None:
            self._counts["windows without the laser"] += 1
            return message
        self._laser_s = time.monotonic()
        found = UNKNOWN
        if self._calibration is not None:
            found = self._calibration.distance(seen.v, float(seen.covariance[1, 1]), seen.locking)
        self._counts["distances"] += not math.isnan(found.distance)
        message.distance, message.sigma = found
        message.u_px, message.v_px, message.events = seen.u, seen.v, seen.events
        message.covariance = seen.covariance.ravel()
        return message

    def _light_message(self, seen: Sighting) -> LightBearing:
        lens = self.params.lens
        u, v = seen.u - lens.centre_column, seen.v - lens.centre_row
        bearing, elevation = direction(u, v, lens.focal_px)
        jacobian = direction_jacobian(u, v, lens.focal_px)
        return LightBearing(
            frequency=self._sources[seen.source].frequency,
            bearing=math.remainder(bearing + lens.camera_yaw, 2.0 * math.pi),
            elevation=elevation,
            covariance=(jacobian @ seen.covariance @ jacobian.T).ravel(),
            u_px=seen.u,
            v_px=seen.v,
            events=seen.events,
        )

    def _on_diagnostics(self) -> None:
        trouble = self._trouble()
        self.health.warn_of("trouble", {trouble: trouble} if trouble else {})
        self.health.warn_of_drops()
        values: dict[str, object] = {
            **dict(sorted(self._counts.items())),
            **drop_values(self.health.drops),
            "time jumps": self._tracker.time_jumps if self._tracker else 0,
        }
        self.publish_reports(Report(self.status_name, trouble or "tracking", level_of(trouble), values))

    def _trouble(self) -> str:
        """What keeps the node from its work; said in the log when it begins."""
        now_s = time.monotonic()
        if now_s > self._packet_s + PATIENCE_S:
            self._laser_s = now_s
            topic = self.resolve_topic_name("events")
            why = self.why_missing(topic, self._packet_type)
            return f"no messages received on {topic}{why} for {PATIENCE_S:g} s and more"
        has_seen = self._counts["reports"] > self._counts["windows without the laser"]
        patience_s = _SEEN_PATIENCE_S if has_seen else _LASER_PATIENCE_S
        if self._has_laser and now_s > self._laser_s + patience_s:
            return (
                f"the laser at {self._sources[0].frequency:g} Hz has not been seen for {patience_s:g} s and"
                " more: is it on, at this frequency, and something within its range?"
            )
        return ""


main = partial(run_node, "event_tracker_node", EventTrackerNode)
