"""A first description of a swarm from what was heard of it: robots, clocks, radios, ground truth.

Ground truth, where there is any, gives starts, places of markers and anchors, and which robot carries which
radio. What cannot be found is left out and named.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.messages.cdr import LASER, LASER_SCAN, RANGE, nanoseconds
from swarm_loc_estimator.common.parameters import UserError, number_specs
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.common.yaml_tree import YamlTreeError, read_tree
from swarm_loc_estimator.doctor.doctor import evidence_of_bag, is_looked_at, lines_of, mounts_of
from swarm_loc_estimator.doctor.evidence import Evidence, Finding, Heard, decoded
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.offline.recorded_bag import Progress, same_type
from swarm_loc_estimator.offline.survey.survey import place_fixed
from swarm_loc_estimator.sensors.camera import CONTENT_BEARING, NO_DETECTIONS
from swarm_loc_estimator.sensors.inputs import TRUTH, kinds
from swarm_loc_estimator.sensors.lidar import ScanSensor
from swarm_loc_estimator.sensors.localizers import SOURCES, BodyPose
from swarm_loc_estimator.sensors.odometry import NO_ODOMETRY
from swarm_loc_estimator.swarm.error_models import ClockModel, FixModel, OdometryModel, RandomWalk
from swarm_loc_estimator.swarm.ir_board import PACKAGED, IrPlatform, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.new_swarm import GYROSCOPE, KNOWN_ROBOTS, LIDAR
from swarm_loc_estimator.swarm.swarm import (
    BODY,
    Anchor,
    Face,
    Landmark,
    Localizer,
    Robot,
    StartSigma,
    Swarm,
    SwarmError,
    UwbDevice,
)
from swarm_loc_estimator.swarm.swarm_file import NAME, RANGE_TOPIC, RESERVED_NAMES, ROBOT

_BAG_S = 600.0
_ODOM = "odom"
_NO_TRUTH = ("goal", "initialpose", "goal_pose")  # Topics with poses that are wanted, not measured
_FIXED = ("map", "world")  # Frames of localizers, unless these say another one
_HOUR_NS = 3_600_000_000_000
_LEAST_HZ = 1.0  # Rarer poses are no ground truth
_FAR_M = 1e8  # Places farther off are no measurements
_MIN_ROWS = 20  # Least number of odometry messages, sightings of a marker, or ranges of a pair
_FIRST_M, _MOVED_M = 2.0, 0.3
"""Distance from the start in which odometry is compared with ground truth, and least of it [m]."""
_OFF_M, _OFF_SHARE, _TURNED = 0.2, 0.1, 0.1
"""Residuals [m], share of the distance, and angles [rad] between odometry and ground truth that are named."""
_STEADY = 0.98  # Least mean resultant of differences of headings to ground truth: .2 rad around their mean
_AHEAD = 0.8  # Least share of the motion that lies along the headings of a robot with wheels
_ANCHOR_M = 0.1  # Least standard deviation of an anchor, whose bias is not known [m]
_MOUNT_M = 0.03  # Error of the places of markers by cameras whose poses were not measured [m]
_SPREAD_M = 0.15  # Greatest spread of the places of a marker by ground truth [m]
_MAX_PLANS = 50_000  # Assignments of radios to robots that are compared
_NO_NOISE = 1.0  # Noise of a pair with few ranges [m]
_CLEARER = 1.3  # Ratio of the noise of the second best one to that of the best, below which it is not sure
_PAIR = re.compile(r"((?:.*\D)?)([1-9]\d{0,18})(\D+)([1-9]\d{0,18})(\D*)")  # Topics of two addresses
_WALK = RandomWalk(position=0.01, heading=0.1)  # Of robots without odometry: 10 cm/s, 18 deg/s


class Proposal(NamedTuple):
    """A description, what it says, and what it cannot say."""

    swarm: Swarm
    facts: list[str]  # What was found, one sentence each
    asked: list[str]  # What must be written by hand, a line each


@dataclass
class _Draft:
    """A description in the making."""

    topics: Mapping[str, Heard]  # Those with messages
    used: dict[str, dict[str, str]]  # Robot -> expected topic -> topic
    robots: dict[str, dict[str, Any]] = field(default_factory=dict)  # Robot -> fields of `Robot`
    tracks: dict[str, Trajectory] = field(default_factory=dict)  # Robot -> ground truth
    swarm: dict[str, Any] = field(default_factory=dict)  # Fields of `Swarm`
    facts: list[str] = field(default_factory=list)
    asked: list[Finding] = field(default_factory=list)  # What must be written by hand

    def ask(self, about: str, problem: str, remedy: str) -> None:
        """Note something that must be written by hand."""
        self.asked.append(Finding(about, problem, remedy))

    def described(self, **changes: Any) -> Swarm:
        """The swarm as far as it is known."""
        robots = tuple(Robot(name, **fields) for name, fields in self.robots.items())
        try:
            return Swarm(robots, **{**self.swarm, **changes})
        except SwarmError as error:  # such as two boards with one id
            raise UserError(f"What was found contradicts itself: {error}") from error

    def poses(self, robots: IntArray, stamps_ns: IntArray) -> FloatArray:
        """Poses (k, 3) by ground truth of robots (k,) at stamps (k,); NaN: not known."""
        poses = np.full((robots.size, 3), np.nan)
        for index, name in enumerate(self.robots):
            if name in self.tracks and (own := robots == index).any():
                poses[own], _ = interpolate(self.tracks[name], stamps_ns[own], DEFAULT_GAP_NS)
        return poses

    def read(self, **changes: Any) -> Evidence:
        """The topics as this swarm reads them."""
        return Evidence(self.described(**changes), self.topics)


def proposed(
    topics: Mapping[str, Heard], choose_type: Callable[[str], str], folder: Path | None = None
) -> Proposal:
    """A description of what was heard.

    Args:
        topics: By name, with messages.
        choose_type: Called with the likely type of `KNOWN_ROBOTS`; returns the right one.
        folder: Where a map may lie beside the recording; None: nowhere.

    Raises:
        UserError: No robot was found, or two that cannot be described together.
    """
    heard = {name: one for name, one in topics.items() if one.messages}
    draft = _Draft(heard, robot_topics(heard))
    if not draft.used:
        said = f"none of the topics {listed(sorted(heard))} is odometry" if heard else "there is no message"
        raise UserError(f"No robot was found: {said}.")
    draft.swarm["topics"] = _renamed(draft.used)
    known_type = choose_type(likely_type(heard, draft.used))
    # robots with the sensors that they publish, their clocks, and the mounts by transforms
    for name, used in draft.used.items():
        draft.robots[name] = _sensors(draft, name, used, known_type)
    _map(draft, folder)
    draft.facts += _facts(draft)
    _clocks(draft)
    for robot in mounts_of(draft.read()).described().robots:
        draft.robots[robot.name] |= {one: getattr(robot, one) for one in ("lidar", "camera", "imu")}
    # ground truth, and what it tells
    _ground_truth(draft)
    _starts(draft)
    _markers(draft)
    _radios(draft)
    return Proposal(draft.described(), draft.facts, lines_of(draft.asked))


def heard_in(bag: Path, progress: Progress) -> Evidence:
    """The first ten minutes of a bag; raises BagError if nothing in it can be read."""
    return evidence_of_bag(bag, Swarm(), _BAG_S, progress, is_wanted=is_proposed_from)


def is_proposed_from(message_type: str) -> bool:
    """Whether messages of a type tell anything."""
    others = (LASER, *(source.message_type for source in SOURCES.values()))
    return is_looked_at(message_type) or any(same_type(message_type, one) for one in others)


def robot_topics(topics: Mapping[str, Heard]) -> dict[str, dict[str, str]]:
    """Robot -> expected topic, such as odom -> the topic that was found.

    Robots are those with odometry. The name of one is the word of the topic in which topics differ.
    """
    of_each = [kind for kind in kinds().values() if kind.of_each and not kind.of_pairs and not kind.is_shared]
    found: dict[str, dict[str, str]] = {}
    # odometry: words before it
    before: dict[str, list[str]] = {}
    for name, heard in topics.items():
        if same_type(heard.type, kinds()["odometry"].message_type) and TRUTH not in name:
            words = name.split("/")
            end = next((k for k, word in enumerate(words) if _ODOM in word), len(words) - 1)
            before[name] = words[:end]
    for name, words in sorted(before.items(), key=lambda one: (len(one[0]), one[0])):
        alike = [other for other in before.values() if len(other) == len(words)]
        differ = [k for k, column in enumerate(zip(*alike, strict=True)) if len(set(column)) > 1]
        found.setdefault(_named(words[differ[-1] if differ else -1] if words else "robot"), {}).setdefault(
            _ODOM, name
        )
    # other sensors of these robots; cameras without odometry are fixed where others have some
    driven = bool(found)
    for kind in of_each:
        for name, heard in sorted(topics.items(), key=lambda one: (len(one[0]), one[0])):
            words = name.split("/")
            if kind.topic == _ODOM or not same_type(heard.type, kind.message_type):
                continue
            if kind.name == "fixes" and words[-1] != kind.topic:
                continue
            robot = next((one for one in found if one in map(_named, words)), None)
            if robot is None and len(found) == 1 and _ODOM in found.get("robot", {}):
                robot = "robot"
            if robot is None and words[1:] == [kind.topic] and not (driven and kind.of_cameras):
                robot = _named(words[0])
            if robot is not None:
                own, used = kind.topic, found.setdefault(robot, {})
                if kind.name == ScanSensor.name and own in used:  # of another lidar, if in another frame
                    frames = map(_frame, _scans(topics, used).values())
                    own = own if _frame(heard) in frames else name.rpartition(f"{robot}/")[2]
                used.setdefault(own, name)
    for robot, used in found.items():
        truth = [name for name in topics if TRUTH in name and robot in map(_named, name.split("/"))]
        used.update({TRUTH: truth[0]} if truth else {})
    # text and numbers of a name by turns
    parts = {name: [int(n) if n.isdigit() else n for n in re.split(r"(\d+)", name)] for name in found}
    return {name: found[name] for name in sorted(found, key=parts.__getitem__)}


def _scans(topics: Mapping[str, Heard], used: Mapping[str, str]) -> dict[str, Heard]:
    """The scans of a robot, by its own topics."""
    return {own: topics[name] for own, name in used.items() if same_type(topics[name].type, LASER_SCAN)}


def _frame(heard: Heard) -> str:
    """The frame of messages."""
    return next((str(message.header.frame_id) for _, message in decoded(heard, 1)[0]), "")


def _named(word: str) -> str:
    """A word as the name of a robot."""
    name = re.sub(r"\W", "_", word)
    return name if NAME.fullmatch(name) and name not in RESERVED_NAMES else f"robot_{name}"


def _renamed(used: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """`Swarm.topics`: one rule for all robots where it fits them all."""
    rules: dict[str, str] = {}
    for own in sorted({own for topics in used.values() for own in topics}):
        names = {robot: topics[own] for robot, topics in used.items() if own in topics}
        patterns = {name.replace(robot, ROBOT) for robot, name in names.items()}
        if patterns == {f"{ROBOT}/{own}"}:
            continue
        if len(patterns) == 1 and ROBOT in next(iter(patterns)) and len(names) > 1:
            rules[f"{ROBOT}/{own}"] = patterns.pop()
        else:
            rules |= {f"{robot}/{own}": name for robot, name in names.items() if name != f"{robot}/{own}"}
    return rules


def likely_type(topics: Mapping[str, Heard], used: Mapping[str, Mapping[str, str]]) -> str:
    """The type of `KNOWN_ROBOTS` whose name or lidar frame the robots have; "own" if there is none."""
    frames = {_frame(heard) for heard in topics.values() if same_type(heard.type, LASER_SCAN)}
    for name, known in KNOWN_ROBOTS.items():
        if known.lidar_frame and any(frame.endswith(known.lidar_frame) for frame in frames):
            return name
    stems = {re.split(r"[\d_]", robot)[0].lower() for robot in used}
    alike = [
        one for one in KNOWN_ROBOTS if any(stem in one or one in stem for stem in stems if len(stem) > 3)
    ]
    return next((one for one in alike if one in stems), alike[-1] if alike else "own")


def _sensors(draft: _Draft, name: str, used: Mapping[str, str], known_type: str) -> dict[str, Any]:
    """Fields of a robot by the topics that it publishes."""
    known, drives = KNOWN_ROBOTS[known_type], _ODOM in used
    sees = "detections" in used or any("image" in t and name in t.split("/") for t in draft.topics)
    fields: dict[str, Any] = {
        "type": known_type,
        "odometry": known.odometry or OdometryModel(),
        "stands": not drives,
        "random_walk": RandomWalk() if drives else _WALK,
        "camera": known.camera if sees else None,
    }
    if "imu" in used:
        fields["imu"] = known.imu if known.imu.is_used else GYROSCOPE
    if "scan" in used:
        others: dict[str, dict[str, float]] = {own: {} for own in _scans(draft.topics, used) if own != "scan"}
        fields["lidar"] = replace(known.lidar if known.lidar.is_used else LIDAR, others=others)
        if others:
            problem = f"has scans on {listed(['scan', *others])}"
            draft.ask(name, problem, "Remove what repeats the scans of another topic from lidar.others")
    if any(same_type(one.type, LASER) and name in topic.split("/") for topic, one in draft.topics.items()):
        fields["fix"] = FixModel(systematic_share=1.0)  # of mapper_node
    if "brightness" in used:
        for _, message in decoded(draft.topics[used["brightness"]], 1)[0]:
            boards = _boards(message.n)
            if fitting := [*boards]:
                fields["ir"] = RobotIr(int(message.receiver), boards[fitting[0]], fitting[0])
                draft.ask(name, f"has one of the infrared boards {listed(fitting)}", "Write ir.platform")
    if "ranges" in used:
        taken = {one["uwb"].address for one in draft.robots.values() if "uwb" in one}
        fields["uwb"] = UwbDevice(next(k for k in itertools.count(1) if k not in taken))
        draft.ask(name, "has a radio whose address no message says", "Write uwb.address")
    if not drives:
        draft.ask(name, "has no odometry", "Write a random_walk in place of this guess")
    elif sees and "detections" not in used:
        draft.ask(name, "has images but no detections", "Run marker_detector_node, and record again")
    return fields


@cache
def _boards(sensors: int) -> dict[str, IrPlatform]:
    """Packaged infrared boards with so many sensors, by name."""
    boards = {one: load_ir_platform(one) for one in PACKAGED}
    return {one: board for one, board in boards.items() if len(board.angles) == sensors}


def _facts(draft: _Draft) -> Iterator[str]:
    """One sentence for each kind of topic: how many, their type, rate, delay and frame."""
    groups: dict[str, dict[str, str]] = {}
    for robot, used in draft.used.items():
        for own, name in used.items():
            groups.setdefault(own, {})[name] = robot
    for own, names in groups.items():
        heard = [draft.topics[name] for name in names]
        patterns = {name.replace(robot, ROBOT) for name, robot in names.items()}
        rates = [(len(one.messages) - 1) / max(1e-9 * _spell_ns(one), 1e-3) for one in heard]
        stamped = [
            (arrival_ns, message.header, robot)
            for one, robot in zip(heard, names.values(), strict=True)
            for arrival_ns, message in decoded(one, _MIN_ROWS)[0]
            if hasattr(message, "header")  # which ground truth in transforms has not
        ]
        if not stamped:
            continue
        late_s = 1e-9 * float(np.median([at_ns - nanoseconds(one.stamp) for at_ns, one, _ in stamped]))
        frames = sorted({one.frame_id.replace(robot, ROBOT) for _, one, robot in stamped})
        yield (
            f"{own} of {len(names)} robots: {listed(sorted(patterns))}, {heard[0].type},"
            f" {np.median(rates):.3g} Hz, {late_s:.3g} s after their stamps, in {' or '.join(frames)}."
        )


def _spell_ns(heard: Heard) -> int:
    """Time between the first and the last message."""
    return heard.messages[-1].arrival_ns - heard.messages[0].arrival_ns


def _clocks(draft: _Draft) -> None:
    """Offsets of clocks of another epoch, as in a recording that was played and recorded again."""
    rows = draft.read().rows("odometry")
    late_ns: dict[str, float] = {}
    for index, name in enumerate(draft.robots):
        own = rows.robot == index
        if own.sum() > 1 and np.ptp(rows.stamp_ns[own]) == 0:
            draft.ask(
                name, "has always the same stamp in odometry, so nothing of it is used", "Correct its driver"
            )
        elif own.any():
            late_ns[name] = float(np.median((rows.arrival_ns - rows.stamp_ns)[own]))
    allows = number_specs(ClockModel)["offset_s"].allows
    for name in [name for name, value in late_ns.items() if not allows(1e-9 * value)]:
        draft.ask(name, f"has stamps {1e-9 * late_ns.pop(name):.4g} s before they arrived", "Set its clock")
    far = {name: value for name, value in late_ns.items() if abs(value) > _HOUR_NS}
    for name in far:
        offset_s = -round(1e-9 * min(far.values()), 3)
        draft.robots[name]["clock"] = ClockModel(offset_s)
    if far:
        draft.facts.append(f"Stamps of {listed([*far])} are of another time; clock.offset_s corrects them.")


class _Body(NamedTuple):
    """A tracked body."""

    frame: str  # Frame of its poses
    by_arrival: bool  # Whether its stamps are of another epoch, so that arrivals are taken
    track: Trajectory


def _bodies(draft: _Draft, source: str, names: Sequence[str], pattern: str) -> dict[str, _Body]:
    """Bodies on topics, by the word in place of <body> in a pattern, or by the names in messages."""
    poses: dict[str, list[tuple[int, BodyPose]]] = {}
    for name in names:
        before, _, after = pattern.partition(BODY)
        own = name.removeprefix(before).removesuffix(after)
        for arrival_ns, message in decoded(draft.topics[name])[0]:
            for one in SOURCES[source].bodies(message):
                is_fixed = one.frame_id in _FIXED or (source != "tf" and _ODOM not in one.frame_id)
                if is_fixed and _ODOM not in one.name:  # robots publish other transforms and poses, too
                    poses.setdefault(one.name or own, []).append((arrival_ns, one))
    found = {}
    for body, some in poses.items():
        stamps_ns = np.array([(one.stamp_ns, arrival_ns) for arrival_ns, one in some])
        by_arrival = bool(abs(np.median(stamps_ns[:, 1] - stamps_ns[:, 0])) > _HOUR_NS)
        stamp_ns, pose = stamps_ns[:, int(by_arrival)], np.array([one.pose for _, one in some])
        order = np.argsort(stamp_ns, kind="stable")
        order = order[(np.abs(pose[order]) < _FAR_M).all(axis=1)]
        if order.size > _MIN_ROWS:
            track = Trajectory(stamp_ns[order], pose[order])
            found[body] = _Body(some[0][1].frame_id, by_arrival, track)
    return found


def _ground_truth(draft: _Draft) -> None:
    """Ground truth on topics of robots, and the first localizer some of whose bodies are robots."""
    for robot, used in draft.used.items():
        for source, kind in SOURCES.items():
            if TRUTH in used and same_type(draft.topics[used[TRUTH]].type, kind.message_type):
                for body in _bodies(draft, source, [used[TRUTH]], BODY).values():
                    draft.tracks[robot] = body.track
    taken = {name for used in draft.used.values() for name in used.values()}
    for source, kind in SOURCES.items():
        names = [
            name
            for name, heard in draft.topics.items()
            if same_type(heard.type, kind.message_type) and name not in taken and not name.endswith(_NO_TRUTH)
            if (len(heard.messages) - 1) * 1e9 > _LEAST_HZ * _spell_ns(heard)
            if BODY not in kind.topic or "/" in name
        ]
        if not names:
            continue
        has_own = BODY in kind.topic
        pattern = _pattern(names) if has_own else names[0]
        fits = re.compile(re.escape(pattern).replace(re.escape(BODY), r"([^/]+)"))
        names = [name for name in names if fits.fullmatch(name)]
        bodies = _bodies(draft, source, names, pattern)
        of_robots = {_robot_of(body, draft.robots): body for body in bodies}
        robots = {of_robots[robot]: robot for robot in draft.robots if robot in of_robots}
        if not robots or draft.tracks:
            continue
        first = bodies[next(iter(robots))]
        draft.tracks = {robot: bodies[body].track for body, robot in robots.items()}
        draft.swarm["localizer"] = Localizer(
            source,
            f"/{pattern}",
            "ground_truth",
            tuple(f"{body}={robot}" for body, robot in robots.items()),
            source_frame="" if first.frame in _FIXED else first.frame,
            stamp_on_arrival=first.by_arrival,
        )
        others = sorted({*bodies} - {*robots})
        said = f" Bodies that are no robots: {listed(others)}." if others else ""
        draft.facts.append(
            f"Ground truth by {pattern}; with localizer.output fix the estimator uses it.{said}"
        )


def _pattern(names: Sequence[str]) -> str:
    """The pattern, with a word replaced by <body>, that most topics fit; of equal ones, of the last words."""
    counts: Counter[str] = Counter()
    for name in names:
        words = name.split("/")
        for k in range(len(words) - 1):
            counts["/".join([*words[:k], BODY, *words[k + 1 :]])] += 1
    return max(counts, key=lambda one: (counts[one], one.index(BODY)))


def _robot_of(body: str, robots: Mapping[str, Any]) -> str:
    """The robot with the name of a body, or with its number and the beginning of its name; "": none."""
    stems = {one: re.sub(r"[\d\W_]", "", one).lower() for one in (body, *robots)}
    numbers = {one: [int(n) for n in re.findall(r"\d+", one)[-1:]] for one in stems}
    alike = [
        one
        for one in robots
        if stems[one] and numbers[one] and numbers[one] == numbers[body]
        if stems[body].startswith(stems[one]) or stems[one].startswith(stems[body])
    ]
    return body if body in robots else alike[0] if len(alike) == 1 else ""


def _starts(draft: _Draft) -> None:
    """Start poses, and axes of bodies, by ground truth and the odometry of the first metres."""
    rows, offsets = draft.read().rows("odometry"), []
    for index, (name, fields) in enumerate(draft.robots.items()):
        if name not in draft.tracks:
            draft.ask(name, "has an unknown start", "Write start, or leave it to the estimator")
            continue
        own = select(rows, (rows.robot == index) & (np.abs(rows.pose) < _FAR_M).all(axis=1))
        own = select(own, np.argsort(own.stamp_ns, kind="stable"))
        true = draft.poses(own.robot, own.stamp_ns)
        odometry, true = own.pose[np.isfinite(true[:, 0])], true[np.isfinite(true[:, 0])]
        if len(true) < _MIN_ROWS:
            fields["start"] = tuple(draft.tracks[name].pose[0].round(4).tolist())
            continue
        # the frame of odometry in map, by the first metres
        driven = np.cumsum(np.hypot(*np.diff(odometry[:, :2], axis=0, prepend=odometry[:1, :2]).T))
        some = driven < _FIRST_M
        frame = se2.rigid_fit(odometry[some, :2], true[some, :2])
        away = se2.compose(frame, odometry[some]) - true[some]
        off = round(float(np.sqrt(np.mean(np.sum(away[:, :2] ** 2, axis=1)))), 3)
        turns = np.exp(-1j * away[:, 2]).mean()
        start, turned = true[0], 0.0
        if off > max(_OFF_M, _OFF_SHARE * float(driven[-1])):
            problem = f"has ground truth {off:.2g} m from its odometry"
            draft.ask(name, problem, "Write which body it is under localizer.bodies")
            del draft.tracks[name]
            continue
        if np.linalg.norm(np.ptp(odometry[some, :2], axis=0)) < _MOVED_M:
            pass  # too little to tell
        elif abs(turns) < _STEADY and _drives_ahead(odometry[some]):  # headings of ground truth are wrong
            start = se2.compose(frame, odometry[0])
            fields["start_sigma"] = StartSigma(max(off, 0.01), max(off, 0.01), max(off, _TURNED))
        elif abs(turns) < _STEADY:
            problem = "has headings in odometry that do not turn as in ground truth"
            draft.ask(name, problem, "Look at its driver, or at the bodies of ground truth")
        elif abs(np.angle(turns)) > _TURNED and "localizer" in draft.swarm:
            turned = round(float(np.angle(turns)), 4)
            offsets.append(f"{name}=0,0,{turned}")
            track = draft.tracks[name]
            draft.tracks[name] = replace(track, pose=se2.compose(track.pose, [0.0, 0.0, -turned]))
        fields["start"] = tuple(np.round(se2.compose(start, [0.0, 0.0, -turned]), 4).tolist())
    if offsets:
        draft.swarm["localizer"] = replace(draft.swarm["localizer"], offsets=tuple(offsets))
        draft.facts.append(f"Axes of bodies in ground truth are turned by the offsets {listed(offsets)}.")
    if draft.tracks:
        draft.facts.append(f"Starts of {listed([*draft.tracks])} are by ground truth.")


def _drives_ahead(pose: FloatArray) -> bool:
    """Whether headings of poses (k, 3) lie along their motion, forwards or backwards."""
    step = np.diff(pose[:, :2], axis=0)
    turns = 2.0 * (np.arctan2(step[:, 1], step[:, 0]) - pose[1:, 2])
    size = np.hypot(*step.T)
    return bool(abs(np.sum(size * np.exp(1j * turns))) > _AHEAD * size.sum())


def _markers(draft: _Draft) -> None:
    """Markers that were seen: landmarks, or faces of robots, where ground truth shows to what they belong."""
    rows, robots = draft.read().rows("detections"), draft.described().robots
    usable = (rows.robot < len(robots)) & (rows.detection["content"] != CONTENT_BEARING)
    rows = select(rows, usable & np.isfinite(rows.detection["position"]).all(axis=1))
    mounts = np.array(
        [(one.x, one.y, one.yaw) if (one := robot.camera) else [np.nan] * 3 for robot in robots]
    )
    view = np.stack([rows.detection["position"][:, 2], -rows.detection["position"][:, 0]], axis=1)
    camera = se2.compose(draft.poses(rows.robot, rows.stamp_ns), mounts[rows.robot])
    places = se2.transform_points(camera, view)
    landmarks, unknown, faces = [], [], []
    ids, counts = np.unique(rows.detection["id"], return_counts=True)
    for marker in ids[counts >= _MIN_ROWS].tolist():
        # where it stays: in map, or on one of the robots
        own = rows.detection["id"] == marker
        fits = {"": _place(places[own])}
        for index, name in enumerate(draft.robots):
            pose = draft.poses(np.full(own.sum(), index), rows.stamp_ns[own])
            fits[name] = _place(se2.transform_points(se2.inverse(pose), places[own]))
        holder = min(fits, key=lambda one: fits[one][1])
        (x, y), spread = fits[holder][0].tolist(), fits[holder][1]
        sigma = round(math.hypot(min(spread, _SPREAD_M), _MOUNT_M), 4)
        if spread >= _SPREAD_M:
            unknown.append(str(marker))
        elif holder:
            face = Face(f"marker_{marker}", marker, x, y, position_sigma=sigma)
            draft.robots[holder]["faces"] = (*draft.robots[holder].get("faces", ()), face)
            faces.append(str(marker))
        else:
            landmarks.append(Landmark(marker, x, y, position_sigma=sigma))
    draft.swarm["landmarks"] = tuple(landmarks)
    if landmarks or faces:
        standing = listed([str(mark.id) for mark in landmarks]) or "none"
        draft.facts.append(
            f"By ground truth, markers {listed(faces) or 'none'} are on robots and {standing} stand; survey"
            " places them better."
        )
        draft.ask("all markers", "have no yaw, size and z here", "Measure them, and the cameras' poses")
    if unknown:
        remedy = "Write those on robots under faces and ids; survey places the others"
        draft.ask(f"marker {listed(unknown)}", "was seen, but nothing shows where", remedy)


def _place(places: FloatArray) -> tuple[FloatArray, float]:
    """Median (2,) of places (k, 2), some NaN, and their robust spread; infinite if they are few."""
    known = places[np.isfinite(places).all(axis=1)]
    if len(known) < _MIN_ROWS:
        return np.zeros(2), math.inf
    middle = np.median(known, axis=0)
    return middle.round(4), round(1.4826 * float(np.median(np.abs(known - middle))), 4)


Plan = tuple[tuple[str, int], ...]  # Robots and the radios on them
Ranges = tuple[IntArray, FloatArray]  # Times [ns] and ranges [m] of a pair of radios


def _radios(draft: _Draft) -> None:
    """Radios on topics of pairs, which robots carry them, and the places of the others."""
    pairs = _range_pairs(draft)
    nodes = sorted({node for pair in pairs for node in pair})
    if nodes:
        _carriers(draft, nodes, pairs)
    # the others, by the paths of those that carry radios
    others = sorted({*nodes} - {one["uwb"].address for one in draft.robots.values() if "uwb" in one})
    rows = draft.read(anchors=tuple(map(Anchor, others))).rows("ranges")
    if rows.robot.size and draft.tracks:
        recording = Recording("", NO_ODOMETRY, NO_DETECTIONS, {}, ranges=rows)
        found = place_fixed(recording, draft.described(), draft.poses, cameras=False)
        draft.swarm["anchors"] = tuple(
            replace(one, position_sigma=round(max(one.position_sigma, _ANCHOR_M), 3)) for one in found.anchors
        )
        draft.facts += [*found.remarks, f"{len(found.anchors)} anchors are placed by ground truth."]
    elif rows.robot.size or others:
        which = listed([*map(str, others)]) or "of fixed places"
        draft.ask(f"radio {which}", "has an unknown place", "Write it under anchors, or use survey")


def _range_pairs(draft: _Draft) -> dict[tuple[int, int], Ranges]:
    """The ranges of topics of pairs by both addresses, in whose names the last two numbers are these."""
    groups: dict[str, dict[tuple[int, int], Heard]] = {}
    for name, heard in draft.topics.items():
        if same_type(heard.type, RANGE):
            found = _PAIR.fullmatch(name)
            pattern = "{0}{{from}}{2}{{to}}{4}".format(*found.groups()) if found else ""
            if found is None or not RANGE_TOPIC.fullmatch(pattern):
                problem = "has not two decimal numbers from 1 on for two radios"
                draft.ask(name, problem, "Write range_topic and the radios' names, on a topic for each pair")
                continue
            groups.setdefault(pattern, {})[int(found[2]), int(found[4])] = heard
    if not groups:
        return {}
    draft.swarm["range_topic"], topics = max(groups.items(), key=lambda one: len(one[1]))
    return {
        pair: (np.array([_time_ns(*one) for one in some]), np.array([one.range for _, one in some]))
        for pair, heard in topics.items()
        for some in [[one for one in decoded(heard)[0] if np.isfinite(one[1].range)]]
    }


def _time_ns(arrival_ns: int, message: Any) -> int:
    """The stamp of a message or, if that is of another epoch, its arrival."""
    stamp_ns = nanoseconds(message.header.stamp)
    return arrival_ns if abs(arrival_ns - stamp_ns) > _HOUR_NS else stamp_ns


def _carriers(draft: _Draft, nodes: Sequence[int], pairs: Mapping[tuple[int, int], Ranges]) -> None:
    """Radios on robots: those whose ranges differ from distances by ground truth with the least noise."""
    robots = [*draft.tracks]
    count, most = min(len(nodes), len(robots)), max(len(nodes), len(robots))
    can_tell = count > 1 and math.perm(most, count) <= _MAX_PLANS
    errors = {
        (*pair, *two): _error(ranges, *(draft.tracks[robot] for robot in two))
        for pair, ranges in (pairs if can_tell else {}).items()
        for two in itertools.permutations(robots, 2)
    }
    if not any(noise < _NO_NOISE for noise, _ in errors.values()):
        problem = "measures ranges, but nothing shows which robot carries it"
        draft.ask(f"radio {listed([*map(str, nodes)])}", problem, "Write uwb.address of the robots")
        return

    def of_plan(plan: Plan) -> list[tuple[str, str, float, float]]:
        links = itertools.permutations(plan, 2)
        return [(r, q, *errors[a, b, r, q]) for (r, a), (q, b) in links if (a, b, r, q) in errors]

    # every assignment, from the least noise on
    plans: list[Plan] = (
        [tuple(zip(robots, some, strict=True)) for some in itertools.permutations(nodes, count)]
        if len(nodes) >= len(robots)
        else [tuple(zip(some, nodes, strict=True)) for some in itertools.permutations(robots, count)]
    )
    noise = [sum(one[2] for one in of_plan(plan)) for plan in plans]
    first, second = np.argsort(noise, kind="stable")[:2].tolist()
    if count > 2 and noise[second] < _CLEARER * noise[first]:  # two may always be exchanged
        about = listed([robot for robot, _ in plans[first]])
        draft.ask(about, "may carry another radio, which fits nearly as well", "Look at the addresses")
    # their noise and biases, two of which each range has
    links = [one for one in of_plan(plans[first]) if one[2] < _NO_NOISE]
    sides = np.array([[robot in link[:2] for robot, _ in plans[first]] for link in links], dtype=float)
    biases = np.linalg.lstsq(sides.reshape(-1, count), np.array([link[3] for link in links]), rcond=None)[0]
    sigma = float(np.median([link[2] for link in links])) if links else UwbDevice(1).range_sigma
    for (robot, node), bias in zip(plans[first], biases.tolist(), strict=True):
        radio = UwbDevice(node, range_sigma=max(round(sigma, 3), 0.001), range_bias=round(bias, 3))
        draft.robots[robot]["uwb"] = radio
    carried = listed([f"{robot} {node}" for robot, node in plans[first]])
    draft.facts.append(f"By ground truth, robots carry the radios {carried}, with these biases and noise.")


def _error(ranges: Ranges, one: Trajectory, other: Trajectory) -> tuple[float, float]:
    """Robust standard deviation and median of the error of ranges between two robots [m]."""
    (place, known), (target, also) = (interpolate(track, ranges[0], DEFAULT_GAP_NS) for track in (one, other))
    error = (ranges[1] - np.hypot(*(target - place)[:, :2].T))[known & also]
    if error.size < _MIN_ROWS:
        return _NO_NOISE, 0.0
    middle = float(np.median(error))
    return 1.4826 * float(np.median(np.abs(error - middle))) + max(0.0, abs(middle) - 1.0), middle


def _map(draft: _Draft, folder: Path | None) -> None:
    """A map of map_server beside the recording, for lidars."""
    if not any("lidar" in fields and fields["lidar"].is_used for fields in draft.robots.values()):
        return
    found = []
    for path in sorted(folder.glob("*.yaml")) if folder else ():
        with suppress(YamlTreeError):
            tree = read_tree(path)
            if isinstance(tree, dict) and {"image", "resolution"} <= {*tree}:
                found.append(path)
    if len(found) == 1:
        draft.swarm["map"] = found[0].resolve()
        draft.facts.append(f"Map: {found[0]}.")
    else:
        said = f"one of {listed([*map(str, found)])}" if found else "a file of map_server (map_saver_cli)"
        draft.ask("the map", "is not known", f"Write {said} as map, if lidars are to locate robots in it")
