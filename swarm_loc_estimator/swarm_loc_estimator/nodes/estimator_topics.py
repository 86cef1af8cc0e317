"""Topics of the estimator: inputs, queued until the next tick, estimates, and commands that set poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseWithCovariance, PoseWithCovarianceStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.common.messages import poses
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.detections import encode_identities
from swarm_loc_estimator.common.messages.poses import PLANE, planar_pose
from swarm_loc_estimator.common.messages.streams import SerializedMessage
from swarm_loc_estimator.common.node import message_class
from swarm_loc_estimator.identification.memory import Identities
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.sensors.inputs import SENSORS, Ingest, InputTopic
from swarm_loc_estimator.sensors.map_topic import MapSensor
from swarm_loc_estimator.sensors.mounts import TF_STATIC, Mounts
from swarm_loc_estimator.sensors.sensor import InputKind
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.sightings import encode_sightings, newest_sightings
from swarm_loc_msgs.msg import RobotIdentities, SwarmPoses, SwarmSightings
from swarm_loc_msgs.srv import SetRobotPose

NO_CLOCK = "use_sim_time is true but no messages received on /clock"

REFUSALS = {
    "absurd": "the pose must lie within 1000 km of the origin.",
    "bad_covariance": "the covariance of x, y and yaw must be positive definite, with variances of 1e-14 to"
    " 1e14, or zero for the default.",
    "not_localized": "the robot has sent no odometry yet.",
}
"""Reason of the estimator not to set a pose -> sentence for the user."""


class SetPoseError(ValueError):
    """A pose that cannot be set."""


class PoseCommands:
    """Sets the pose of a robot in `map_frame`, or deinitializes it, by a service and, if wanted, topics."""

    def __init__(
        self, node: Node, swarm: Swarm, estimator: Estimator, map_frame: str, *, by_topics: bool
    ) -> None:
        self._node = node
        self._swarm = swarm
        self._estimator = estimator
        self._map_frame = map_frame
        for index, robot in enumerate(swarm.robots if by_topics else ()):
            topic, on_pose = f"{robot.name}/initialpose", partial(self._on_initial_pose, index)
            node.create_subscription(PoseWithCovarianceStamped, topic, on_pose, _RELIABLE)

    def on_request(
        self, request: SetRobotPose.Request, response: SetRobotPose.Response
    ) -> SetRobotPose.Response:
        """Execute a request of the service; the response says what was done, or why not."""
        try:
            response.message = self._obey(request)
            response.success = True
            self._node.get_logger().info(f"by service: {response.message}")
        except SetPoseError as error:
            response.success, response.message = False, f"Nothing was changed: {error}"
        return response

    def _obey(self, request: SetRobotPose.Request) -> str:
        robot = self._swarm.index_of.get(request.robot)
        if robot is None:
            raise SetPoseError(f"there is no robot '{request.robot}' in the swarm description.")
        if request.forget:
            self._estimator.forget(robot, self._now_ns())
            return f"Robot '{request.robot}' waits for a fix."
        return self._set_pose(robot, request.pose)

    def _on_initial_pose(self, robot: int, message: PoseWithCovarianceStamped) -> None:
        name, frame = self._swarm.robots[robot].name, message.header.frame_id
        try:
            done = self._set_pose(robot, message.pose, frame)
            self._node.get_logger().info(f"by {name}/initialpose: {done}")
        except SetPoseError as error:
            self._node.get_logger().warning(f"by {name}/initialpose nothing was changed: {error}")

    def _set_pose(self, robot: int, wanted: PoseWithCovariance, frame: str | None = None) -> str:
        """Set a pose in a frame; without one, in `map_frame`, where zeros stand for the start's sigmas."""
        if frame is not None and not np.any(wanted.covariance):
            self._estimator.drop("bad_covariance")
            raise SetPoseError("the covariance is zero.")
        if frame not in (None, self._map_frame):
            raise SetPoseError(f"the pose is in frame '{frame}' but must be in '{self._map_frame}'.")
        described = self._swarm.robots[robot]
        pose, covariance = np.array(planar_pose(wanted.pose)), np.array(wanted.covariance, dtype=float)
        covariance = covariance.reshape(6, 6)[PLANE]
        if not (np.isfinite(pose).all() and np.isfinite(covariance).all()):
            raise SetPoseError("pose and covariance must be finite numbers, and the quaternion not zero.")
        if not covariance.any():
            sigma = described.start_sigma
            covariance = np.diag([sigma.x**2, sigma.y**2, sigma.theta**2])
        fault = self._estimator.set_pose(robot, self._now_ns(), pose, 0.5 * (covariance + covariance.T))
        if fault:
            raise SetPoseError(REFUSALS[fault])
        x, y, theta = pose
        return f"Robot '{described.name}' is at x {x:.3f} m, y {y:.3f} m, theta {theta:.3f} rad."

    def _now_ns(self) -> int:
        """The node's time; raises SetPoseError before the first /clock."""
        now_ns: int = self._node.get_clock().now().nanoseconds
        if not now_ns:
            raise SetPoseError(f"{NO_CLOCK}.")
        return now_ns


_RATE_HZ, _FAST_HZ, _IMAGE_HZ = 100, 500, 30
"""Highest rates of topics of which all messages within the horizon wait: of most; of odometry and turn rates,
which are small unless of many robots; and of images: their queues take most of the memory."""
_LEAST_DEPTH, _MOST_DEPTH, _MAPS = 50, 1000, 5  # and of maps, which are large
_MAX_PER_TAKE = 5000  # Limit of messages per tick over all topics
_MIN_PER_TOPIC = 100
"""Those of the usual horizon; with less, a late estimator would get ever older data and never catch up."""

_MAX_SEQUENCES = 100  # Of a topic with several publishers; of fewer, a rare one would seem to follow a loss
_TF_STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_MAX_FRAME_LENGTH = 64  # Longer names of foreign frames are cut
_RELIABLE = QoSProfile(depth=10)
_SIGHTINGS_PERIOD_NS = 180_000_000  # Publishing period of swarm/sightings, which are only for display
_TF = QoSProfile(depth=100)  # what tf2's own broadcaster offers


def queue_depth(kind: InputKind, horizon_s: float) -> int:
    """Length of the queue of a topic, which is emptied at each tick: what can be used after a long one."""
    if kind.rows == MapSensor.name:
        return _MAPS
    is_small = SENSORS[kind.rows].unit is None and not kind.stands_for
    rate_hz = _FAST_HZ if is_small else _IMAGE_HZ if kind.of_cameras else _RATE_HZ
    return min(max(_LEAST_DEPTH, round(rate_hz * horizon_s)), _MOST_DEPTH)


class EstimatorInputs:
    """Takes all inputs as raw bytes: building message objects would cost more than estimating.

    Messages wait in the middleware, which keeps the newest of each topic, not in the executor, whose queue is
    unbounded; no executor may handle the subscriptions. Lost messages are detected by sequence numbers of
    publishers; those that have waited for longer than the horizon are dropped unread. A topic whose queue was
    full is heard best effort from then on: to send again what came too late adds to the load, and Fast DDS
    2.14 keeps each such message for good. The index of a topic is its handle.
    """

    def __init__(
        self, node: Node, topics: Sequence[InputTopic], drop: Callable[[str, int], None], horizon_s: float
    ) -> None:
        self._node = node
        self._topics = topics
        self._drop = drop
        self._horizon_ns = round(horizon_s * 1e9)
        # Of each topic, the newest sequence numbers of its publishers, and these when a number was left out
        self._newest: list[list[int]] = [[] for _ in topics]
        self._publishers: list[set[tuple[int, ...]]] = [set() for _ in topics]
        self._why_lost = ["overload" for _ in topics]  # Drop reason of messages missing in a sequence
        # Messages by sensor that were lost or dropped here under overload, and that were taken
        self.unread, self.taken = Counter[str](), Counter[str]()
        self.looked_ns = 0  # Newest time that the estimator knows; reading many messages takes a while
        self._quota = max(_MIN_PER_TOPIC, _MAX_PER_TAKE // len(topics))
        self._subscriptions = [self._subscribe(k, ReliabilityPolicy.RELIABLE) for k in range(len(topics))]

    def take(self, time_ns: Callable[[], int]) -> list[SerializedMessage]:
        """Messages as handle, bytes and arrival in order of arrival; those above the limit remain queued.

        `time_ns` returns the node's time. It is called after the messages are taken, since an earlier time
        could be before their stamps. In simulated time, all arrive at that time.
        """
        taken: list[tuple[int, int, bytes]] = []
        clock = self._node.get_clock()
        is_simulated = clock.ros_time_is_active  # where the middleware's times are of another clock
        oldest_ns = 0 if is_simulated else clock.now().nanoseconds - self._horizon_ns
        for handle, subscription in enumerate(self._subscriptions):
            take, message_class = subscription.handle.take_message, subscription.msg_type
            before = len(taken)
            numbers: list[int | None] = []
            while len(taken) < before + self._quota and (message := take(message_class, True)) is not None:
                data, info = message
                numbers.append(info["publication_sequence_number"])
                if info["received_timestamp"] >= oldest_ns:
                    taken.append((info["received_timestamp"], handle, data))
            waited, sensor = len(numbers) - (len(taken) - before), self._topics[handle].kind.rows
            lost = self._count_gaps(handle, numbers)
            self.taken[sensor] += len(numbers) - waited
            for why, count in (("overload", waited), (self._why_lost[handle], lost)):
                self._drop(why, count)
                self.unread[sensor] += count if why == "overload" else 0
            if lost and len(numbers) >= min(self._quota, subscription.qos_profile.depth):
                self._hear_best_effort(handle, "cannot be read fast enough", "overload")
        taken.sort(key=lambda one: one[0])
        now_ns = time_ns()
        # time must not seem to go back to where it was looked at before
        begin_ns = now_ns if is_simulated else self.looked_ns
        self.looked_ns = now_ns
        return [SerializedMessage(k, data, min(max(at_ns, begin_ns), now_ns)) for at_ns, k, data in taken]

    def _count_gaps(self, handle: int, numbers: Sequence[int | None]) -> int:
        """Number of messages missing in the sequences of publishers, which messages do not name.

        A number that continues no sequence is the first of a new publisher, or follows the nearest one.
        """
        newest, gaps = self._newest[handle], []
        for number in filter(None, numbers):
            if number - 1 in newest:
                newest.remove(number - 1)
            else:
                gaps.append(number - 1 - max((one for one in newest if one < number), default=number - 1))
            newest.append(number)
        if not gaps:
            return 0
        known, infos = self._publishers[handle], self._node.get_publishers_info_by_topic
        now = {tuple(one.endpoint_gid) for one in infos(self._topics[handle].name)}
        self._publishers[handle] = now
        del newest[: -1 if len(now | known) == 1 else -_MAX_SEQUENCES]
        return sum(sorted(gaps)[: max(0, len(gaps) - len(now - known))])

    def _subscribe(self, handle: int, reliability: ReliabilityPolicy) -> Subscription:
        topic = self._topics[handle]
        follow = partial(self._hear_best_effort, handle, "is published best effort", "lost")
        is_latched = topic.kind.rows == MapSensor.name and reliability is ReliabilityPolicy.RELIABLE
        return self._node.create_subscription(
            message_class(topic.kind.message_type),
            topic.name,
            lambda _: None,
            QoSProfile(
                depth=queue_depth(topic.kind, 1e-9 * self._horizon_ns),
                reliability=reliability,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE,
            ),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=follow),
        )

    def _hear_best_effort(self, handle: int, trouble: str, why_lost: str, _event: object = None) -> None:
        """Subscribe again as best effort, which matches all publishers but has no retransmissions."""
        before = self._subscriptions[handle]
        if before.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT:
            return
        self._subscriptions[handle] = self._subscribe(handle, ReliabilityPolicy.BEST_EFFORT)
        self._node.destroy_subscription(before)
        self._why_lost[handle] = why_lost
        text = f"{self._topics[handle].name} {trouble}: lost messages are not sent again"
        self._node.get_logger().info(text)


def newest_time_ns(node: Node) -> int:
    """Time of a node [ns]; in simulated time that of the newest /clock received, handled or not.

    Else data newer than the /clock that a busy executor handled last would appear to be of the future.
    """
    now_ns = int(node.get_clock().now().nanoseconds)
    source = node._time_source  # noqa: SLF001 - rclpy has no public access to it
    subscription = source._clock_sub  # noqa: SLF001
    taken = subscription.handle.take_message(Clock, False) if subscription is not None else None
    if taken is None:
        return now_ns
    newest = taken[0].clock
    if nanoseconds(newest) < now_ns:
        node.executor.create_task(source.clock_callback, taken[0])
        return now_ns
    source.clock_callback(taken[0])
    return int(node.get_clock().now().nanoseconds)


def _children_by_topic(swarm: Swarm, parameters: EstimatorParameters) -> dict[str, dict[str, int]]:
    """Topic of transforms -> child frames of the transforms on it, with the index of each robot."""
    # tf2 uses the absolute name, whatever the namespace, unless it is remapped to that of each robot
    topics: dict[str, dict[str, int]] = {}
    for index, robot in enumerate(swarm.robots):
        topic = f"{robot.name}/tf" if parameters.tf_per_robot else "/tf"
        topics.setdefault(topic, {})[parameters.odom_frame_of(robot.name)] = index
    return topics if parameters.publish_tf else {}


class StaticTransforms:
    """Takes mounts that the description does not say from static transforms and the frames of sensors.

    It also notes static transforms into the estimator's own frames, which tf2 would accept.
    """

    def __init__(self, node: Node, swarm: Swarm, ingest: Ingest, parameters: EstimatorParameters) -> None:
        self._mounts, self._ingest = Mounts(swarm), ingest
        self._waiting = [k for k, topic in enumerate(ingest.topics) if topic.name in self._mounts.topics]
        self._is_changed = False
        self._parents: dict[tuple[str, str], str] = {}
        own = {f"{name}_static": {*frames} for name, frames in _children_by_topic(swarm, parameters).items()}
        names = [f"{robot.name}/{TF_STATIC}" for robot in swarm.robots] if parameters.tf_per_robot else []
        for topic in dict.fromkeys([*own, f"/{TF_STATIC}", *names] if self._waiting else own):
            listener = partial(self._on_transforms, topic, own.get(topic, ()))
            node.create_subscription(TFMessage, topic, listener, _TF_STATIC)

    @property
    def foreign(self) -> list[str]:
        """One sentence for each owned frame for which another node publishes a static parent."""
        return [
            f"{topic} has a transform from '{parent}' to '{child}', which only the estimator may publish"
            for (topic, child), parent in self._parents.items()
        ]

    def mounts(self) -> tuple[Swarm, list[str]] | None:
        """The swarm with all mounts and a sentence for each, if there may be new ones since the last call."""
        framed = [handle for handle in self._waiting if self._ingest.frame_id(handle)]
        for handle in framed:
            self._waiting.remove(handle)
            self._mounts.add_frame(self._ingest.topics[handle], self._ingest.frame_id(handle))
        if not (framed or self._is_changed):
            return None
        self._is_changed = False
        return self._mounts.described(), self._mounts.remarks()

    def _on_transforms(self, topic: str, owned: Collection[str], message: TFMessage) -> None:
        if self._mounts.topics:
            self._mounts.add_transforms(topic, message)
            self._is_changed = True
        for transform in message.transforms:
            child = transform.child_frame_id.lstrip("/")
            if child in owned:
                self._parents[topic, child] = transform.header.frame_id.lstrip("/")[:_MAX_FRAME_LENGTH]


class EstimateOutputs:
    """Publishes estimates."""

    def __init__(self, node: Node, swarm: Swarm, parameters: EstimatorParameters) -> None:
        names = [robot.name for robot in swarm.robots]
        self._swarm_poses = node.create_publisher(SwarmPoses, "swarm/poses", _RELIABLE)
        self._names = names
        self._sightings = node.create_publisher(SwarmSightings, "swarm/sightings", _RELIABLE)
        self._sightings_ns = 0
        self._identities = node.create_publisher(RobotIdentities, "aerial/identities", _RELIABLE)
        self._published: Identities | None = None
        self._robot_poses = [
            node.create_publisher(PoseWithCovarianceStamped, f"{name}/pose", _RELIABLE)
            for name in (names if parameters.publish_robot_poses and not parameters.shared_topics else [])
        ]
        self._children = _children_by_topic(swarm, parameters)
        self._tf = [node.create_publisher(TFMessage, topic, _TF) for topic in self._children]
        self._tolerance_ns = round(parameters.transform_tolerance_s * 1e9)
        self.use_frame(parameters.map_frame)

    def use_frame(self, frame: str) -> None:
        """Publish all poses in a frame from now on."""
        self._frame = frame
        self._swarm_poses_encoder = poses.SwarmPosesEncoder(self._names, frame)
        self._transforms = [
            (publisher, poses.TransformsEncoder(frame, [*children]), np.array([*children.values()]))
            for publisher, children in zip(self._tf, self._children.values(), strict=True)
        ]

    def publish(self, estimate: Estimate) -> None:
        """Publish all poses; robots that are not localized are only in `swarm/poses`, with status waiting."""
        e = estimate
        located, states = e.status != Status.WAITING, (e.fix_age_s, e.status, e.heading_known)
        message = self._swarm_poses_encoder.encode(e.stamp_ns, e.poses, e.covariances, *states)
        self._swarm_poses.publish(message)
        stamp_ns = e.stamp_ns + self._tolerance_ns
        for publisher, encoder, robots in self._transforms:
            if located[robots].any():
                publisher.publish(encoder.encode(stamp_ns, located[robots], e.map_to_odom[robots]))
        # publishing one topic per robot is the largest cost of a large swarm, and few have subscribers
        heard = [k for k, one in enumerate(self._robot_poses) if located[k] and one.get_subscription_count()]
        if heard:
            stamps_ns = np.full(len(heard), e.stamp_ns)
            messages = poses.encode_poses(self._frame, stamps_ns, e.poses[heard], e.covariances[heard])
            for robot, message in zip(heard, messages, strict=True):
                self._robot_poses[robot].publish(message)

    def publish_identities(self, identities: Identities | None) -> None:
        """Publish the identities in the newest aerial image whenever they change, also by late data."""
        before, now = self._published, identities
        if now is None or now is before:
            return
        if before is not None and before.stamp_ns == now.stamp_ns:
            same = np.array_equal(before.place, now.place)
            if same and np.array_equal(before.probability, now.probability):
                return
        self._published = now
        message = encode_identities(self._frame, now.stamp_ns, self._names, now.place, now.probability)
        self._identities.publish(message)

    def publish_sightings(self, estimator: Estimator, now_ns: int) -> None:
        """Publish the robots' measurements and their outcomes, a few times per second if subscribed to."""
        if abs(now_ns - self._sightings_ns) < _SIGHTINGS_PERIOD_NS:
            return
        self._sightings_ns = now_ns
        if self._sightings.get_subscription_count():
            sightings = newest_sightings(estimator.recent(), now_ns)
            self._sightings.publish(encode_sightings(self._frame, now_ns, sightings))
