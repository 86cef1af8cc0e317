"""Graphs that were good until one thing was changed, and what the doctor is to say of it."""

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_estimator.common.messages.cdr import (
    IMU,
    ODOMETRY,
    POSE_WITH_COVARIANCE,
    TRANSFORMS,
    decode,
    encode,
)
from swarm_loc_estimator.common.messages.poses import encode_fix
from swarm_loc_estimator.doctor.contents import CAMERA_INFO, IMAGE
from swarm_loc_estimator.doctor.doctor import evidence_of_bag
from swarm_loc_estimator.doctor.evidence import Evidence, Heard, Message, Publisher
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.swarm.error_models import ImuModel
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm

BAGS = Path(__file__).parents[3] / "bags"
ROBOT = "epuck2"
ODOM, SEEN = f"{ROBOT}/odom", f"{ROBOT}/detections"
BOTH = (ODOM, SEEN)
POSITIONS = ("pose.pose.position", "alternative.position")  # Of detections
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

Change = Callable[[Evidence], Evidence]


@lru_cache(maxsize=8)
def good(bag: str = "eight_five_robots", seconds: float = 25.0) -> Evidence:
    """The first seconds of a bag of the repository."""
    swarm = load_swarm(BAGS / bag / "swarm.yaml")
    return evidence_of_bag(BAGS / bag, swarm, seconds, unwatched)


def with_topics(evidence: Evidence, **changed: Heard | None) -> Evidence:
    """The evidence with some topics changed or, with None, left out; __ in a name is a slash."""
    topics = dict(evidence.topics)
    for name, heard in changed.items():
        topics.pop(name.replace("__", "/"), None)
        if heard is not None:
            topics[name.replace("__", "/")] = heard
    return Evidence(evidence.swarm, topics, evidence.is_live)


def with_swarm(change: Callable[[Swarm], Swarm]) -> Change:
    return lambda evidence: Evidence(change(evidence.swarm), evidence.topics)


def edited(names: Collection[str], edit: Callable[[Any, int], object]) -> Change:
    """A change of each message on some topics; `edit` gets the message and its arrival [ns]."""

    def change(evidence: Evidence) -> Evidence:
        topics = dict(evidence.topics)
        for name in names:
            heard = topics[name]
            messages = []
            for arrival_ns, data in heard.messages:
                message = decode(data, heard.type)
                edit(message, arrival_ns)
                messages.append(Message(arrival_ns, encode(message, heard.type)))
            topics[name] = Heard(heard.type, messages)
        return Evidence(evidence.swarm, topics)

    return change


def shifted(names: Collection[str], seconds: float) -> Change:

    def edit(message: Any, _arrival_ns: int) -> None:
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec + round(seconds * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)

    return edited(names, edit)


def stamped(sec: int) -> Change:
    def edit(message: Any, _arrival_ns: int) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = sec, 0

    return edited([ODOM], edit)


def mirrored(message: Any, _arrival_ns: int) -> None:
    """As of a driver that takes the left wheel for the right one."""
    message.pose.pose.position.y *= -1.0
    message.pose.pose.orientation.z *= -1.0
    message.twist.twist.angular.z *= -1.0


def reversed_heading(message: Any, _arrival_ns: int) -> None:
    message.pose.pose.orientation.z *= -1.0
    message.twist.twist.angular.z *= -1.0


def frozen_heading(message: Any, _arrival_ns: int) -> None:
    """As of a driver that publishes positions and twists, but leaves the orientation as it began."""
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = 0.0, 1.0


def standing(message: Any, _arrival_ns: int, *, twist: bool = False) -> None:
    message.pose.pose.position.x = message.pose.pose.position.y = message.pose.pose.orientation.z = 0.0
    message.pose.pose.orientation.w = 1.0
    if not twist:
        message.twist.twist.linear.x = message.twist.twist.angular.z = 0.0


def twist_only(message: Any, arrival_ns: int) -> None:
    standing(message, arrival_ns, twist=True)


def farther(factor: float) -> Change:
    def edit(message: Any, _arrival_ns: int) -> None:
        message.detections = message.detections.copy()
        for name in POSITIONS:
            message.detections[name] *= factor

    return edited([SEEN], edit)


def at_zero(message: Any, _arrival_ns: int) -> None:
    message.detections = message.detections.copy()
    message.detections[POSITIONS[0]] = 0.0


def in_body_axes(message: Any, _arrival_ns: int) -> None:
    message.detections = message.detections.copy()
    for name in POSITIONS:
        right, down, ahead = message.detections[name].T.copy()
        message.detections[name] = np.stack([ahead, -right, -down], axis=1)


def not_a_number(message: Any, _arrival_ns: int) -> None:
    message.pose.pose.position.x = np.nan


def framed(frame: str) -> Change:
    def edit(message: Any, _arrival_ns: int) -> None:
        message.header.frame_id = frame

    return edited([ODOM], edit)


def thinned(evidence: Evidence) -> Evidence:
    messages = evidence.topics[ODOM].messages
    return with_topics(evidence, epuck2__odom=Heard(ODOMETRY, messages[:: len(messages) // 25]))


def paused(evidence: Evidence) -> Evidence:
    messages = evidence.topics[ODOM].messages
    begin_ns = messages[0][0]
    kept = [one for one in messages if not 5e9 < one[0] - begin_ns < 10e9]
    return with_topics(evidence, epuck2__odom=Heard(ODOMETRY, kept))


def ending(name: str) -> Change:
    """Nothing on a topic after ten seconds."""

    def change(evidence: Evidence) -> Evidence:
        heard = evidence.topics[name]
        kept = [one for one in heard.messages if one.arrival_ns - heard.messages[0].arrival_ns < 10e9]
        return with_topics(evidence, **{name.replace("/", "__"): replace(heard, messages=kept)})

    return change


def in_millimetres(message: Any, _arrival_ns: int) -> None:
    position = message.pose.pose.position
    position.x, position.y = 1e3 * position.x, 1e3 * position.y
    message.twist.twist.linear.x *= 1e3


def two_robots_one_driver(evidence: Evidence) -> Evidence:
    return with_topics(evidence, epuck2__odom=evidence.topics["epuck1/odom"])


def renamed(evidence: Evidence) -> Evidence:
    return with_topics(evidence, epuck2__odom=None, robot2__odom=evidence.topics[ODOM])


def of_nobody(evidence: Evidence) -> Evidence:
    return with_topics(evidence, epuck9__odom=evidence.topics[ODOM])


def retyped(evidence: Evidence) -> Evidence:
    return with_topics(evidence, epuck2__odom=Heard("geometry_msgs/msg/PoseStamped"))


def malformed(evidence: Evidence) -> Evidence:
    cut = [Message(arrival_ns, data[:40]) for arrival_ns, data in evidence.topics[ODOM].messages]
    return with_topics(evidence, epuck2__odom=Heard(ODOMETRY, cut))


def picture(encoding: str = "mono8") -> Heard:
    fields = {"height": 2, "width": 3, "encoding": encoding, "step": 3, "data": np.zeros(6, np.uint8)}
    return Heard(IMAGE, [Message(1, encode(fields, IMAGE))])


def intrinsics(focal: float = 100.0, width: int = 3) -> Heard:
    k = np.array([focal, 0.0, 1.0, 0.0, focal, 1.0, 0.0, 0.0, 1.0])
    fields = {"height": 2, "width": width, "distortion_model": "plumb_bob", "d": np.zeros(5), "k": k}
    return Heard(CAMERA_INFO, [Message(1, encode({**fields, "r": np.eye(3).ravel()}, CAMERA_INFO))])


def transforms(*parents: str) -> Heard:
    rows = [
        {
            "header": {"frame_id": parent},
            "child_frame_id": f"{ROBOT}/odom",
            "transform": {"rotation": {"w": 1.0}},
        }
        for parent in parents
    ]
    return Heard(TRANSFORMS, [Message(1, encode({"transforms": [row]}, TRANSFORMS)) for row in rows])


def published(name: str, *publishers: Publisher) -> Change:
    def change(evidence: Evidence) -> Evidence:
        heard = evidence.topics.get(name, Heard(TRANSFORMS))
        return with_topics(evidence, **{name.replace("/", "__"): replace(heard, publishers=publishers)})

    return change


def reporting(message: str) -> Change:
    status = {"level": 1, "name": f"{ROBOT}/driver", "message": message}
    heard = Heard(DIAGNOSTICS, [Message(1, encode({"status": [status]}, DIAGNOSTICS))])
    return lambda evidence: with_topics(evidence, diagnostics=heard)


def exchanged_ids(swarm: Swarm) -> Swarm:
    one, other, *rest = swarm.robots
    return replace(swarm, robots=(replace(one, faces=other.faces), replace(other, faces=one.faces), *rest))


def started_elsewhere(swarm: Swarm) -> Swarm:
    one, other, *rest = swarm.robots
    assert other.start is not None
    x, y, theta = other.start
    return replace(swarm, robots=(one, replace(other, start=(x + 1.0, y, theta)), *rest))


def started_turned(swarm: Swarm) -> Swarm:
    one, other, *rest = swarm.robots
    assert other.start is not None
    x, y, theta = other.start
    return replace(swarm, robots=(one, replace(other, start=(x, y, theta - 0.5 * np.pi)), *rest))


def with_gyroscope(factor: float, first_variance: float = 0.0) -> Change:
    """A robot with a gyroscope that measures the turn rates of its odometry, times a factor."""

    def change(evidence: Evidence) -> Evidence:
        messages = []
        for arrival_ns, data in evidence.topics[ODOM].messages:
            odometry = decode(data, ODOMETRY)
            message = {
                "header": odometry.header,
                "orientation": {"w": 1.0},
                "angular_velocity": {"z": factor * odometry.twist.twist.angular.z},
                "angular_velocity_covariance": [first_variance] + 8 * [0.0],
            }
            messages.append(Message(arrival_ns, encode(message, IMU)))
        one, other, *rest = evidence.swarm.robots
        other = replace(other, imu=ImuModel(turn_noise_density=1e-3))
        swarm = replace(evidence.swarm, robots=(one, other, *rest))
        return Evidence(swarm, {**evidence.topics, f"{ROBOT}/imu": Heard(IMU, messages)})

    return change


def landmark_elsewhere(swarm: Swarm) -> Swarm:
    first, *rest = swarm.landmarks
    return replace(swarm, landmarks=(replace(first, x=first.x + 0.5), *rest))


def without_landmark(swarm: Swarm) -> Swarm:
    return replace(swarm, landmarks=swarm.landmarks[1:])


def turned_camera(swarm: Swarm) -> Swarm:
    one, other, *rest = swarm.robots
    assert other.camera is not None
    return replace(swarm, robots=(one, replace(other, camera=replace(other.camera, yaw=0.6)), *rest))


def never_located(evidence: Evidence) -> Evidence:
    """With one more robot, which drives but neither sees nor is seen."""
    moved = edited([ODOM], lambda message, _: setattr(message.pose.pose.position, "y", 0.1))(evidence)
    alone = replace(evidence.swarm.robots[1], name="alone", start=None, camera=None, faces=())
    swarm = replace(evidence.swarm, robots=(*evidence.swarm.robots, alone))
    topics = {**evidence.topics, "alone/odom": framed("alone/odom")(moved).topics[ODOM]}
    return Evidence(swarm, topics)


def with_fixes_in(frame: str) -> Change:
    data = encode_fix(frame, 0, (0.0, 0.0, 0.0), np.eye(3))

    def change(evidence: Evidence) -> Evidence:
        arrival_ns = evidence.topics[ODOM].messages[0].arrival_ns
        return with_topics(evidence, epuck2__fix=Heard(POSE_WITH_COVARIANCE, [Message(arrival_ns, data)]))

    return change


WRONG: dict[str, tuple[Change, str, str]] = {
    "fix in another frame": (with_fixes_in("odom"), f"{ROBOT}/fix", "is in frame 'odom', not in 'map'"),
    "no odometry": (lambda e: with_topics(e, epuck2__odom=None), ODOM, "has no messages"),
    "no detections": (lambda e: with_topics(e, epuck2__detections=None), SEEN, "Start a detector"),
    "other namespace": (renamed, ODOM, "Remap it (--remap epuck2/odom:=robot2/odom)"),
    "other type": (retyped, ODOM, "has the type geometry_msgs/msg/PoseStamped"),
    "malformed": (malformed, ODOM, "none of which is a nav_msgs/msg/Odometry"),
    "robot of no description": (of_nobody, "epuck9/odom", "belongs to no robot"),
    "publisher without messages": (
        lambda e: with_topics(e, epuck2__odom=Heard(ODOMETRY, (), (Publisher("/driver"),))),
        ODOM,
        "though /driver publishes it",
    ),
    "two publishers": (published(ODOM, Publisher("/a"), Publisher("/b")), ODOM, "has 2 publishers: /a, /b"),
    "best effort": (published(ODOM, Publisher("/a", is_reliable=False)), ODOM, "best effort"),
    "volatile static transforms": (published("tf_static", Publisher("/a")), "tf_static", "volatile"),
    "driver in trouble": (reporting("battery low"), f"{ROBOT}/driver", "reports 'battery low'"),
    "slow odometry": (thinned, ODOM, "has a message every 1"),
    "one odometry message": (
        lambda e: with_topics(e, epuck2__odom=Heard(ODOMETRY, e.topics[ODOM].messages[:1])),
        ODOM,
        "has 1 messages in all",
    ),
    "pauses": (paused, ODOM, "pauses for up to 5"),
    "driver that dies": (ending(ODOM), ODOM, "pauses for up to 15"),
    "detector that dies": (ending(SEEN), SEEN, "has no messages in the last 15 s"),
    "odometry in millimetres": (edited([ODOM], in_millimetres), ROBOT, "Publish odometry in metres"),
    "start turned": (with_swarm(started_turned), ROBOT, "and 90 deg from its start"),
    "gyroscope in degrees": (with_gyroscope(57.3), f"{ROBOT}'s gyroscope", "Publish radians per second"),
    "gyroscope upside down": (with_gyroscope(-1.0), f"{ROBOT}'s gyroscope", "positive to the left"),
    "silent gyroscope": (with_gyroscope(0.0), f"{ROBOT}'s gyroscope", "is angular_velocity set"),
    "gyroscope without rates": (
        with_gyroscope(1.0, -1.0),
        ROBOT,
        "by a covariance of -1 that its IMU measures no turn rates",
    ),
    "late stamps of images": (
        shifted([SEEN], -1.5),
        f"{ROBOT}'s detections",
        "Stamp images with their exposure",
    ),
    "clock ahead": (shifted(BOTH, 3.0), f"{ROBOT}'s odometry", "in the future"),
    "clock behind": (shifted(BOTH, -0.7), ROBOT, "behind those of the other robots"),
    "clock a little behind": (shifted(BOTH, -0.3), ROBOT, "or set clock.offset_s to -0.3"),
    "old stamps": (shifted(BOTH, -60.0), f"{ROBOT}'s odometry", "which is beyond horizon_s"),
    "another epoch": (shifted(BOTH, -1e8), f"{ROBOT}'s odometry", "of another time"),
    "no stamps": (stamped(0), f"{ROBOT}'s odometry", "has stamps of zero"),
    "one stamp": (stamped(10), f"{ROBOT}'s odometry", "always the same stamp"),
    "two parents": (
        lambda e: with_topics(e, tf=transforms("map", "world")),
        f"frame '{ROBOT}/odom'",
        "has 2 parents on tf: map, world",
    ),
    "other odometry frame": (framed("odom_combined"), ODOM, "is in frame 'odom_combined'"),
    "no intrinsics": (
        lambda e: with_topics(e, epuck2__image_raw=picture()),
        f"{ROBOT}/image_raw",
        "no message on epuck2/camera_info",
    ),
    "intrinsics of zeros": (
        lambda e: with_topics(e, epuck2__image_raw=picture(), epuck2__camera_info=intrinsics(0.0)),
        f"{ROBOT}/camera_info",
        "intrinsics of zeros",
    ),
    "intrinsics of another size": (
        lambda e: with_topics(e, epuck2__image_raw=picture(), epuck2__camera_info=intrinsics(width=6)),
        f"{ROBOT}/camera_info",
        "6 x 2 pixels but images have 3 x 2",
    ),
    "encoding": (
        lambda e: with_topics(e, epuck2__image_raw=picture("32FC1"), epuck2__camera_info=intrinsics()),
        f"{ROBOT}/image_raw",
        "'32FC1'",
    ),
    "unknown marker": (with_swarm(without_landmark), "marker 100", "is in no description"),
    "not a number": (edited([ODOM], not_a_number), ROBOT, "odometry that is not finite"),
    "one driver for two": (two_robots_one_driver, f"epuck1 and {ROBOT}", "the same odometry"),
    "mirrored odometry": (edited([ODOM], mirrored), f"{ROBOT}'s odometry", "turns the other way"),
    "heading of the wrong sign": (edited([ODOM], reversed_heading), f"{ROBOT}'s odometry", "wrong sign"),
    "heading that never turns": (
        edited([ODOM], frozen_heading),
        f"{ROBOT}'s odometry",
        "turn 0 times as its twists",
    ),
    "odometry stands": (edited([ODOM], standing), ROBOT, "stands while landmarks move"),
    "twist only": (edited([ODOM], twist_only), ROBOT, "constant in the pose of odometry"),
    "small markers": (farther(1.4), ROBOT, "times as far as its odometry says"),
    "not the optical frame": (edited([SEEN], in_body_axes), ROBOT, "Publish them in the optical frame"),
    "positions of zeros": (edited([SEEN], at_zero), ROBOT, "that are not in front of it"),
    "turned camera": (with_swarm(turned_camera), ROBOT, "Set camera.yaw to"),
    "start elsewhere": (with_swarm(started_elsewhere), ROBOT, "which is 1.00 m and 0 deg from its start"),
    "landmark elsewhere": (with_swarm(landmark_elsewhere), "landmark 100", "is other than described"),
    "exchanged ids": (with_swarm(exchanged_ids), "epuck1", "sees markers of its own"),
    "never located": (never_located, "alone", "cannot be located"),
}
"""Change -> how it is made, what is named, and words of the sentence."""
