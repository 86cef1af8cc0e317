"""Topics, clocks and frames: missing and other topics, publishers, rates, stamps, trees of transforms."""

from __future__ import annotations

from collections.abc import Iterator
from types import MappingProxyType

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.messages.cdr import TRANSFORMS
from swarm_loc_estimator.doctor.evidence import SETTINGS, Evidence, Finding, Heard, decoded
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.offline.recorded_bag import same_type
from swarm_loc_estimator.sensors.inputs import CLOCKS_APART_S, InputTopic

_HOUR_S = 3600.0
_AHEAD_S = 0.05
_LATE_S = 0.8  # Detections that are later than odometry by more are named [s]; a detector takes .15 to .3 s
_BACK = 0.02  # Share of stamps that are older than the stamp of the message before, from which they are named
_SENSORS = ("odometry", "detections", "imu", "ranges", "brightness")
_SET_CLOCK = "Synchronize it with the others (chrony)"


def check_clocks(evidence: Evidence) -> Iterator[Finding]:
    """Stamps are acquisition times, by clocks that agree."""
    delays: dict[str, float] = {}
    for sensor in _SENSORS:
        rows = evidence.rows(sensor)
        for robot in np.unique(rows.robot).tolist():
            own = rows.robot == robot
            topic = f"{evidence.source_name(robot)}'s {sensor}"
            found = _of_topic(topic, rows.stamp_ns[own], rows.arrival_ns[own])
            yield from found
            name, delay_s = evidence.source_name(robot), _delay_s(rows.stamp_ns[own], rows.arrival_ns[own])
            if not found and sensor == "odometry":
                delays[name] = delay_s
            elif not found and sensor == "detections" and delay_s - delays.get(name, delay_s) > _LATE_S:
                problem = f"arrive {delay_s:.2g} s after their stamps, but its odometry {delays[name]:.2g} s"
                remedy = "Stamp images with their exposure, and synchronize the computer of the camera"
                yield Finding(f"{name}'s detections", problem, remedy)
    if len(delays) == 2:  # which of them is wrong cannot be seen
        apart = max(delays.values()) - min(delays.values())
        if apart > CLOCKS_APART_S:
            yield Finding(
                " and ".join(delays), f"have clocks {apart:.2g} s apart", "Synchronize them (chrony)"
            )
    for robot, clock in evidence.read[2].clocks_apart().items():
        if evidence.source_name(robot) in delays:
            yield Finding(evidence.source_name(robot), clock.problem, clock.remedy)


def _delay_s(stamp_ns: IntArray, arrival_ns: IntArray) -> float:
    """Median time from stamps to arrivals [s]."""
    return 1e-9 * float(np.median(arrival_ns - stamp_ns))


def _of_topic(topic: str, stamp_ns: IntArray, arrival_ns: IntArray) -> list[Finding]:
    """Stamps of one topic."""
    delay_s, horizon_s = _delay_s(stamp_ns, arrival_ns), SETTINGS.horizon_s
    if (stamp_ns == 0).mean() > 0.5:
        return [Finding(topic, "has stamps of zero", "Let its node set header.stamp to the acquisition time")]
    if stamp_ns.size > 10 and np.ptp(stamp_ns) == 0:
        return [Finding(topic, "has always the same stamp", "Let its node set header.stamp at each message")]
    if abs(delay_s) > _HOUR_S:
        remedy = "Set use_sim_time alike in all nodes, and synchronize clocks"
        return [Finding(topic, "has stamps of another time than the clock here", remedy)]
    if delay_s < -_AHEAD_S:
        return [
            Finding(topic, f"has stamps {-delay_s:.2g} s in the future", f"Its clock is ahead. {_SET_CLOCK}")
        ]
    if delay_s > horizon_s:
        problem = f"has stamps {delay_s:.2g} s old, which is beyond horizon_s ({horizon_s:g} s)"
        return [Finding(topic, problem, f"Its clock is behind, or its data are queued. {_SET_CLOCK}")]
    back = np.diff(stamp_ns) < 0
    if topic.endswith("odometry") and back.sum() > max(1, _BACK * stamp_ns.size):
        problem = f"has stamps that go back, {int(back.sum())} times"
        return [Finding(topic, problem, "Stop the second publisher, or the node that sets wrong stamps")]
    return []


def check_frames(evidence: Evidence) -> Iterator[Finding]:
    """Frames are named as the estimator expects them, and form a tree."""
    parents: dict[tuple[str, str], set[str]] = {}
    for name, heard in evidence.topics.items():
        if same_type(heard.type, TRANSFORMS):
            tree = name.removesuffix("tf_static").removesuffix("tf")
            for _, message in decoded(heard)[0]:
                for one in message.transforms:
                    child = one.child_frame_id.lstrip("/")
                    parents.setdefault((tree, child), set()).add(one.header.frame_id.lstrip("/"))
    for (tree, child), names in parents.items():
        if len(names) > 1:
            problem = f"has {len(names)} parents on {tree}tf: {listed(sorted(names))}"
            remedy = "Let only one node publish it; only the estimator may publish map to odom"
            yield Finding(f"frame '{child}'", problem, remedy)
        if child in names:
            yield Finding(
                f"frame '{child}'", "is its own parent", "Correct header.frame_id of that transform"
            )
    yield from _of_fixes(evidence)
    children = {child for _, child in parents}
    _, statistics, ingest = evidence.read
    parameters = EstimatorParameters()
    for number, topic in enumerate(evidence.inputs):
        if topic.kind.rows != "odometry" or not topic.kind.of_each or not statistics[number].received:
            continue
        found = ingest.frame_id(number)
        expected = parameters.odom_frame_of(evidence.swarm.robots[topic.robot].name)
        if found != expected and (not found or found not in children):
            problem = f"is in frame '{found}', but the estimator publishes transforms for '{expected}'"
            remedy = "Set frame_id in the driver, or odom_frame (with tf_per_robot) of the estimator"
            yield Finding(topic.name, problem, remedy)


def _of_fixes(evidence: Evidence) -> Iterator[Finding]:
    """Fixes and aerial images that are not in `map`."""
    _, statistics, ingest = evidence.read
    for number, topic in enumerate(evidence.inputs):
        found = ingest.frame_id(number)
        if topic.kind.in_map and statistics[number].received and found != ingest.map_frame:
            problem = f"is in frame '{found}', not in '{ingest.map_frame}'"
            yield Finding(topic.name, problem, "Publish it in that frame, or set map_frame of the estimator")


_STARTS = MappingProxyType(
    {
        "odometry": "Start the robot's driver, in the robot's namespace",
        "detections": "Start a detector such as marker_detector_node, in the namespace of the camera",
        "imu": "Start the driver of the IMU, or remove imu from the description",
        "brightness": "Start the robot's driver, or remove ir from the description",
        "ranges": "Start the driver of the radio, or remove uwb from the description",
    }
)
"""What to do without the messages of a sensor."""
_SLOW_S = 0.35  # Longest usual time between two odometry messages [s]
_PAUSE_S, _SILENT_S = 2.0, 10.0
"""Shortest pauses that are named: of odometry and gyroscopes, and at the end of detections [s]."""
_PERIODIC = ("odometry", "imu", "detections")
_SOLE = ("swarm/poses",)
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def check_topics(evidence: Evidence) -> Iterator[Finding]:
    """Every expected topic has messages of its type, from one publisher, often enough."""
    statistics = evidence.read[1]
    lone = _lone(evidence)
    # expected topics: their types, messages and rates
    for topic, counted in zip(evidence.inputs, statistics, strict=True):
        heard = evidence.topics.get(topic.name)
        if heard is not None and evidence.usable(topic) is None:
            yield Finding(
                topic.name, f"has the type {heard.type}, not {topic.kind.message_type}", _convert(topic)
            )
        elif topic.expected and not counted.received:
            yield _missing(evidence, topic, heard, lone)
        elif counted.received and counted.malformed == counted.received:
            yield Finding(
                topic.name,
                f"has {counted.malformed} messages, none of which is a {topic.kind.message_type} of ROS 2",
                "Rebuild its publisher with the messages of this workspace",
            )
        elif heard is not None and counted.received and topic.kind.rows in _PERIODIC:
            yield from _rate(topic, heard, evidence.end_ns)
    yield from _pairs(evidence)
    # topics of robots that are not described, unless a wrong name explains a missing topic
    expected = {
        topic.name for topic in evidence.inputs if topic.expected and topic.name not in evidence.topics
    }
    kinds = {topic.kind.message_type for topic in evidence.inputs if topic.name in expected}
    for name, heard in lone.items():
        if not any(same_type(heard.type, kind) for kind in kinds):
            yield Finding(
                name, "belongs to no robot of the description", "Describe that robot, or stop its nodes"
            )
    # publishers, and what other nodes report
    yield from _publishers(evidence)
    for name, heard in evidence.topics.items():
        if same_type(heard.type, DIAGNOSTICS):
            yield from _of_diagnostics(name, heard)


def _pairs(evidence: Evidence) -> Iterator[Finding]:
    """A pattern of the ranges of two radios that fits no topic with messages."""
    inputs = zip(evidence.inputs, evidence.read[1], strict=True)
    pairs = [(topic, counted.received) for topic, counted in inputs if topic.kind.of_pairs]
    if pairs and not any(received for _, received in pairs):
        topic = pairs[0][0]
        of_type = [
            name for name, heard in evidence.topics.items() if same_type(heard.type, topic.kind.message_type)
        ]
        there = f"; {listed(sorted(of_type))} has this type" if of_type else ""
        remedy = "Correct range_topic and the names or addresses of radios, or start their drivers"
        problem = f"fits no topic with messages, such as {topic.name}{there}"
        yield Finding(f"range_topic '{evidence.swarm.range_topic}'", problem, remedy)


def _lone(evidence: Evidence) -> dict[str, Heard]:
    """Topics that look like an input of a robot, but of none that is described."""
    kinds = {topic.kind.topic: topic.kind.message_type for topic in evidence.inputs if topic.kind.of_each}
    known = {topic.name for topic in evidence.inputs}
    return {
        name: heard
        for name, heard in evidence.topics.items()
        if name not in known and same_type(kinds.get(name.rpartition("/")[2], "?"), heard.type)
    }


def _missing(evidence: Evidence, topic: InputTopic, heard: Heard | None, lone: dict[str, Heard]) -> Finding:
    """An expected topic without messages."""
    if heard is not None and heard.publishers:
        nodes = listed(sorted(one.node for one in heard.publishers))
        return Finding(topic.name, f"has no messages, though {nodes} publishes it", "Look at that node's log")
    known = {one.name for one in evidence.inputs}
    of_type = [
        name
        for name, other in evidence.topics.items()
        if name not in known
        and same_type(other.type, topic.kind.message_type)
        and not name.endswith("/ground_truth")
    ]
    # first those with the same last word, then those of the same robot
    last, robot = topic.name.rpartition("/")[2], topic.name.partition("/")[0]
    of_type.sort(key=lambda name: (name not in lone, not name.endswith(last), robot not in name, name))
    if of_type:
        how = "-r" if evidence.is_live else "--remap"
        remedy = f"Remap it ({how} {topic.name}:={of_type[0]}), or correct the name in the description"
        return Finding(topic.name, f"has no messages; {listed(of_type)} has this type", remedy)
    return Finding(topic.name, "has no messages", _STARTS.get(topic.kind.rows, "Start its publisher"))


def _convert(topic: InputTopic) -> str:
    """How to get another type."""
    if topic.kind.rows == "fix":
        return "Use localizer_bridge, which converts poses of other types"
    if topic.kind.rows == "detections":
        return "Use marker_bridge_node, which converts detections of apriltag_ros and aruco_opencv"
    return "Publish the expected type, or give the topic another name"


def _rate(topic: InputTopic, heard: Heard, end_ns: int) -> Iterator[Finding]:
    """Messages that are rare, pause, or ended; what a camera sees may pause, as there may be no markers."""
    last_s = 1e-9 * (end_ns - heard.messages[-1].arrival_ns)
    between_s = 1e-9 * np.diff([arrival_ns for arrival_ns, _ in heard.messages])
    if topic.kind.rows == "detections":
        if last_s > max(_SILENT_S, 3.0 * between_s.max(initial=0.0)):
            problem = f"has no messages in the last {last_s:.0f} s"
            yield Finding(topic.name, problem, "Look whether its node still runs, and what its camera sees")
        return
    if between_s.size < 2:
        problem = f"has {len(heard.messages)} messages in all"
        yield Finding(topic.name, problem, "Publish it 5 times per second or more often")
        return
    usual_s, longest_s = float(np.median(between_s)), max(last_s, float(between_s.max()))
    if usual_s > _SLOW_S:
        problem = f"has a message every {usual_s:.2g} s; poses are predicted with a constant speed meanwhile"
        yield Finding(topic.name, problem, "Publish it 5 times per second or more often")
    elif longest_s > max(_PAUSE_S, 10.0 * usual_s):
        problem = f"pauses for up to {longest_s:.2g} s"
        remedy = "Look whether its node still runs, and check the radio link and the load of the robot"
        yield Finding(topic.name, problem, remedy)


def _publishers(evidence: Evidence) -> Iterator[Finding]:
    """Topics with several publishers, or with a publisher that nobody can hear well."""
    inputs = {topic.name for topic in evidence.inputs}
    for name, heard in evidence.topics.items():
        nodes = sorted(one.node for one in heard.publishers)
        if name in (*inputs, *_SOLE) and len(nodes) > 1:
            remedy = "Stop one of them: two robots in one namespace, or a node that was started twice"
            yield Finding(name, f"has {len(nodes)} publishers: {listed(nodes)}", remedy)
        if name in inputs and any(not one.is_reliable for one in heard.publishers):
            remedy = "Publish it reliable: lost messages are then sent again"
            yield Finding(name, "is published best effort, so lost messages are missing", remedy)
        if name.endswith("tf_static") and any(not one.is_latched for one in heard.publishers):
            remedy = "Use the QoS of tf2's StaticTransformBroadcaster"
            yield Finding(name, "is published volatile, so nodes that start later never hear it", remedy)


def _of_diagnostics(topic: str, heard: Heard) -> Iterator[Finding]:
    """What other nodes report, each by its newest status; the checks here look at the estimator's inputs."""
    newest = {status.name: status for _, message in decoded(heard)[0] for status in message.status}
    for status in newest.values():
        is_estimator = status.name.startswith("estimator") and not status.name.endswith("load")
        if status.level and not is_estimator:
            yield Finding(status.name, f"reports '{status.message}' on {topic}", "See the page of that node")
