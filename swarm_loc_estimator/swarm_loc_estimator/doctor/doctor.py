"""The doctor: all checks, on a bag or on what was heard live; here those of topics, clocks and frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.messages.cdr import TRANSFORMS
from swarm_loc_estimator.doctor import contents
from swarm_loc_estimator.doctor.evidence import SETTINGS, Evidence, Finding, Heard, Message, Wanted, decoded
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.offline.recorded_bag import BagLocalizer, Progress, renamed_topics, same_type
from swarm_loc_estimator.sensors.inputs import CLOCKS_APART_S, InputTopic, input_topics, kinds
from swarm_loc_estimator.sensors.mounts import TF_STATIC, Mounts
from swarm_loc_estimator.swarm.swarm import Swarm

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
            name, stamp_ns = evidence.source_name(robot), rows.stamp_ns[own]
            delay_s = 1e-9 * float(np.median(rows.arrival_ns[own] - stamp_ns))
            fault = _of_stamps(sensor, stamp_ns, delay_s)
            if fault is not None:
                yield Finding(f"{name}'s {sensor}", *fault)
            elif sensor == "odometry":
                delays[name] = delay_s
            elif sensor == "detections" and delay_s - delays.get(name, delay_s) > _LATE_S:
                problem = f"arrive {delay_s:.2g} s after their stamps, but its odometry {delays[name]:.2g} s"
                remedy = "Stamp images with their exposure, and synchronize the computer of the camera"
                yield Finding(f"{name}'s detections", problem, remedy)
    if len(delays) == 2:  # which of them is wrong cannot be seen
        apart = max(delays.values()) - min(delays.values())
        if apart > CLOCKS_APART_S:
            problem = f"have clocks {apart:.2g} s apart"
            yield Finding(" and ".join(delays), problem, "Synchronize them (chrony)")
    for robot, clock in evidence.read[2].clocks_apart().items():
        if evidence.source_name(robot) in delays:
            yield Finding(evidence.source_name(robot), clock.problem, clock.remedy)


def _of_stamps(sensor: str, stamp_ns: IntArray, delay_s: float) -> tuple[str, str] | None:
    """Problem and remedy of stamps (n,) that arrive `delay_s` later, by the median; None: they are right."""
    back = int((np.diff(stamp_ns) < 0).sum())
    if (stamp_ns == 0).mean() > 0.5:
        return "has stamps of zero", "Let its node set header.stamp to the acquisition time"
    if stamp_ns.size > 10 and np.ptp(stamp_ns) == 0:
        return "has always the same stamp", "Let its node set header.stamp at each message"
    if abs(delay_s) > _HOUR_S:
        remedy = "Set use_sim_time alike in all nodes, and synchronize clocks"
        return "has stamps of another time than the clock here", remedy
    if delay_s < -_AHEAD_S:
        return f"has stamps {-delay_s:.2g} s in the future", f"Its clock is ahead. {_SET_CLOCK}"
    if delay_s > SETTINGS.horizon_s:
        problem = f"has stamps {delay_s:.2g} s old, which is beyond horizon_s ({SETTINGS.horizon_s:g} s)"
        return problem, f"Its clock is behind, or its data are queued. {_SET_CLOCK}"
    if sensor == "odometry" and back > max(1, _BACK * stamp_ns.size):
        remedy = "Stop the second publisher, or the node that sets wrong stamps"
        return f"has stamps that go back, {back} times", remedy
    return None


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
            remedy = "Correct header.frame_id of that transform"
            yield Finding(f"frame '{child}'", "is its own parent", remedy)
    # fixes and aerial images are in `map`, odometry in the frame of transforms
    children = {child for _, child in parents}
    _, statistics, ingest = evidence.read
    used = [pair for pair in enumerate(evidence.inputs) if statistics[pair[0]].received]
    for number, topic in used:
        found = ingest.frame_id(number)
        if topic.kind.in_map and found != ingest.map_frame:
            problem = f"is in frame '{found}', not in '{ingest.map_frame}'"
            yield Finding(topic.name, problem, "Publish it in that frame, or set map_frame of the estimator")
    for number, topic in used:
        if topic.kind.rows != "odometry" or not topic.kind.of_each:
            continue
        found = ingest.frame_id(number)
        expected = EstimatorParameters().odom_frame_of(evidence.swarm.robots[topic.robot].name)
        if found != expected and (not found or found not in children):
            problem = f"is in frame '{found}', but the estimator publishes transforms for '{expected}'"
            remedy = "Set frame_id in the driver, or odom_frame (with tf_per_robot) of the estimator"
            yield Finding(topic.name, problem, remedy)


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
_CONVERT = MappingProxyType(
    {
        "fix": "Use localizer_bridge, which converts poses of other types",
        "detections": "Use marker_bridge_node, which converts detections of apriltag_ros and aruco_opencv",
    }
)
"""What to do with other types of messages."""
_SLOW_S = 0.35  # Longest usual time between two odometry messages [s]
_PAUSE_S, _SILENT_S = 2.0, 10.0  # Shortest pauses named: of odometry and gyroscopes, and of detections [s]
_PERIODIC = ("odometry", "imu", "detections")
_SOLE = ("swarm/poses",)
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def check_topics(evidence: Evidence) -> Iterator[Finding]:
    """Every expected topic has messages of its type, from one publisher, often enough."""
    inputs = [*zip(evidence.inputs, evidence.read[1], strict=True)]
    # topics that look like an input of a robot, but of none that is described
    of_each = {topic.kind.topic: topic.kind.message_type for topic in evidence.inputs if topic.kind.of_each}
    known = {topic.name for topic in evidence.inputs}
    lone = {
        name: heard
        for name, heard in evidence.topics.items()
        if name not in known and same_type(of_each.get(name.rpartition("/")[2], "?"), heard.type)
    }
    # expected topics: their types, messages and rates
    for topic, counted in inputs:
        heard, kind = evidence.topics.get(topic.name), topic.kind
        if heard is not None and evidence.usable(topic) is None:
            remedy = _CONVERT.get(kind.rows, "Publish the expected type, or give the topic another name")
            yield Finding(topic.name, f"has the type {heard.type}, not {kind.message_type}", remedy)
        elif topic.expected and not counted.received:
            yield _missing(evidence, topic, heard, lone)
        elif counted.received and counted.malformed == counted.received:
            none = f"none of which is a {kind.message_type} of ROS 2"
            remedy = "Rebuild its publisher with the messages of this workspace"
            yield Finding(topic.name, f"has {counted.malformed} messages, {none}", remedy)
        elif heard is not None and counted.received and kind.rows in _PERIODIC:
            yield from _rate(topic, heard, evidence.end_ns)
    # a pattern of the ranges of two radios that fits no topic with messages
    pairs = [(topic, counted.received) for topic, counted in inputs if topic.kind.of_pairs]
    if pairs and not any(received for _, received in pairs):
        topic, kind = pairs[0][0], pairs[0][0].kind
        of_type = [name for name, one in evidence.topics.items() if same_type(one.type, kind.message_type)]
        there = f"; {listed(sorted(of_type))} has this type" if of_type else ""
        remedy = "Correct range_topic and the names or addresses of radios, or start their drivers"
        problem = f"fits no topic with messages, such as {topic.name}{there}"
        yield Finding(f"range_topic '{evidence.swarm.range_topic}'", problem, remedy)
    # topics of robots that are not described, unless a wrong name explains a missing topic
    missing = [topic for topic in evidence.inputs if topic.expected and topic.name not in evidence.topics]
    for name, heard in lone.items():
        if not any(same_type(heard.type, topic.kind.message_type) for topic in missing):
            problem = "belongs to no robot of the description"
            yield Finding(name, problem, "Describe that robot, or stop its nodes")
    # topics with several publishers, or with a publisher that nobody can hear well
    for name, heard in evidence.topics.items():
        nodes = sorted(one.node for one in heard.publishers)
        if name in (*known, *_SOLE) and len(nodes) > 1:
            remedy = "Stop one of them: two robots in one namespace, or a node that was started twice"
            yield Finding(name, f"has {len(nodes)} publishers: {listed(nodes)}", remedy)
        if name in known and any(not one.is_reliable for one in heard.publishers):
            remedy = "Publish it reliable: lost messages are then sent again"
            yield Finding(name, "is published best effort, so lost messages are missing", remedy)
        if name.endswith("tf_static") and any(not one.is_latched for one in heard.publishers):
            remedy = "Use the QoS of tf2's StaticTransformBroadcaster"
            yield Finding(name, "is published volatile, so nodes that start later never hear it", remedy)
    # what other nodes report, by the newest status of each; the checks here look at the estimator's inputs
    for name, heard in evidence.topics.items():
        messages = decoded(heard)[0] if same_type(heard.type, DIAGNOSTICS) else []
        newest = {status.name: status for _, message in messages for status in message.status}
        for status in newest.values():
            is_estimator = status.name.startswith("estimator") and not status.name.endswith("load")
            if status.level and not is_estimator:
                problem = f"reports '{status.message}' on {name}"
                yield Finding(status.name, problem, "See the page of that node")


def _missing(evidence: Evidence, topic: InputTopic, heard: Heard | None, lone: dict[str, Heard]) -> Finding:
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


CHECKS = (
    *(check_topics, check_clocks, check_frames, contents.check_pictures, contents.check_motion),
    *(contents.check_contents, contents.check_sources),
)
_LOOKED_AT = (
    *(kind.message_type for kind in kinds().values()),
    *(TRANSFORMS, DIAGNOSTICS, contents.IMAGE, contents.COMPRESSED_IMAGE, contents.CAMERA_INFO),
)
_MAX_IMAGES = 20  # Of a topic; what is wrong with one is wrong with all


def examine(evidence: Evidence) -> list[Finding]:
    """All that is wrong, the most basic things first; contradictions, which often follow, only if alone."""
    mounts = mounts_of(evidence)
    evidence = replace(evidence, swarm=mounts.described())
    remedy = "Correct the one that is wrong; without it in the description, the transform is taken"
    found = [
        Finding(robot, f"has {key} {described:.3g} in the description but {value:.3g} by tf_static", remedy)
        for robot, key, described, value in mounts.differences()
    ]
    found += [one for check in CHECKS for one in check(evidence)]
    return found or [*contents.check_estimate(evidence)]


def mounts_of(evidence: Evidence) -> Mounts:
    """Mounts of sensors by static transforms."""
    mounts = Mounts(evidence.swarm)
    for name, heard in evidence.topics.items():
        is_static = name.endswith(TF_STATIC) and same_type(heard.type, TRANSFORMS)
        is_usable = name in mounts.topics and evidence.usable(mounts.topics[name]) is not None
        for message in heard.messages if is_static else heard.messages[:1] if is_usable else ():
            mounts.add_message(name, message.data)
    return mounts


def lines_of(findings: Sequence[Finding]) -> list[str]:
    """One line for each problem, with all that have it."""
    abouts: dict[str, list[str]] = {}
    for one in findings:
        abouts.setdefault(f"{one.problem}. {one.remedy}.", []).append(one.about)
    return [f"{listed(names)}{': each' if len(names) > 1 else ''} {said}" for said, names in abouts.items()]


def evidence_of_bag(
    bag: Path,
    swarm: Swarm,
    seconds: float,
    progress: Progress,
    remap: Mapping[str, str] = MappingProxyType({}),
    namespace: str = "",
    is_wanted: Wanted | None = None,
) -> Evidence:
    """The first `seconds` of a bag; `remap` as in `renamed_topics`, `namespace` of the whole swarm or "".

    Kept are messages of types that `is_wanted` selects; without it, those that a check looks at. Raises
    BagError if nothing in the bag can be read, or a topic cannot be mapped.
    """
    known = [topic.name for topic in input_topics(swarm)]
    messages: dict[str, list[Message]] = {}
    with BagReader(bag, renamed_topics(remap, swarm, known)) as reader:
        localizer = BagLocalizer(swarm, reader.topics)
        types = {topic.name: topic.type for topic in (*reader.topics, *localizer.outputs.values())}
        end_ns = reader.time_range_ns[0] + round(seconds * 1e9)
        wanted = [name for name, kind in types.items() if (is_wanted or is_looked_at)(kind)]
        for name, _, log_ns, data in reader.messages([*wanted, *localizer.topics]):
            if log_ns > end_ns:
                break
            of_robots = localizer.read(name, log_ns, data) if name in localizer.topics else ()
            for topic, serialized in of_robots:
                messages.setdefault(topic.name, []).append(Message(log_ns, serialized))
            keep(messages.setdefault(name, []), types[name], Message(log_ns, data))
            progress(min(1.0, reader.progress), "reading")
        heard = {name: Heard(kind, messages.get(name, [])) for name, kind in types.items()}
        topics = {name.removeprefix(f"{namespace.strip('/')}/"): one for name, one in heard.items()}
        return Evidence(swarm, topics, remarks=tuple(reader.losses), is_cut=end_ns < reader.time_range_ns[1])


def is_looked_at(message_type: str) -> bool:
    """Whether a check looks at messages of a type; of all other topics only names and types matter."""
    return any(same_type(message_type, one) for one in _LOOKED_AT)


def keep(kept: list[Message], message_type: str, message: Message) -> None:
    """Keep a message, unless it is one of many images."""
    is_image = any(same_type(message_type, one) for one in (contents.IMAGE, contents.COMPRESSED_IMAGE))
    if not is_image or len(kept) < _MAX_IMAGES:
        kept.append(message)
