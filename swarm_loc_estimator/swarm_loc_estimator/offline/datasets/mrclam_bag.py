"""Write a set of the MRCLAM dataset as a bag with its swarm description."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.definitions import DETECTIONS, ODOMETRY, POSE_STAMPED
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, encode_detections
from swarm_loc_estimator.common.messages.poses import UNKNOWN_COVARIANCE, encode_odometry, encode_pose_stamped
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.offline.datasets.mrclam import MAX_TRUTH_GAP_NS, Dataset, RobotLog, integrate
from swarm_loc_estimator.sensors.sighting_kernels import CONTENT_POSITION
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Pose2, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_writer import save_swarm

ROBOT_TYPE = "create"
WHEEL_SEPARATION = 0.258  # Wheel separation of the iRobot Create [m]
TIMEOUT_S = 2.0
"""The logs pause for just over a second about every two minutes, while the robots keep driving."""

_FAMILY_OTHER = 255
_REPORT_EVERY = 5000
_SERIALIZING = 0.3  # Share of the progress before writing

_MAX_CUT_NS = 120_000_000_000
_MARGIN_NS = 1_000_000_000


@dataclass(frozen=True)
class Delay:
    """Delay of detections, uniform between two limits."""

    low_ns: int = 0  # Least delay
    high_ns: int = 0  # Largest delay
    seed: int = 0  # Of the random numbers


@dataclass(frozen=True)
class MrclamImport:
    """Result of an import."""

    message_count: int  # Number of messages written
    remarks: tuple[str, ...]  # Missing data, corrected barcodes and late starts, one sentence each


@dataclass(frozen=True)
class _Stream:
    """The messages of one topic in order of log time."""

    topic: str
    type: str
    log_ns: IntArray
    data: list[bytes]


def convert(
    dataset: Dataset, folder: Path, delay: Delay, progress: Callable[[float, str], None]
) -> MrclamImport:
    """Write a set as a bag with its `swarm.yaml` inside.

    Args:
        dataset: The set; robots start where their ground truth begins.
        folder: The bag to create.
        delay: Delay of detections.
        progress: Called with the share done, 0 to 1, and what is being done.

    Raises:
        BagError: The folder is there already, or cannot be created.
    """
    rng = np.random.default_rng(delay.seed)
    streams: list[_Stream] = []
    robots = [from_truth_on(robot) for robot in dataset.robots]
    begin_ns = min(int(robot.odometry.stamp_ns[0]) for robot in robots) - _MARGIN_NS
    end_ns = max(int(robot.odometry.stamp_ns[-1]) for robot in robots) + _MARGIN_NS
    for index, robot in enumerate(robots):
        progress(_SERIALIZING * index / len(robots), f"serializing robot{robot.subject}")
        streams += [_odometry(robot), _detections(robot, delay, rng)]
        if robot.truth is not None:
            streams.append(_truth(robot.subject, robot.truth, begin_ns, end_ns))
    count = _write(folder, streams, progress)
    pairs = zip(dataset.robots, robots, strict=True)
    remarks = [*dataset.remarks, *(remark for whole, used in pairs for remark in _start_remarks(whole, used))]
    save_swarm(describe(dataset, robots), folder / "swarm.yaml", "\n".join(remarks))
    progress(1.0, "done")
    return MrclamImport(count, tuple(remarks))


def _start_remarks(whole: RobotLog, used: RobotLog) -> list[str]:
    """A sentence if the ground truth does not cover the robot's first odometry."""
    cut_ns = int(used.odometry.stamp_ns[0] - whole.odometry.stamp_ns[0])
    if cut_ns:
        late_s = f"{cut_ns * 1e-9:.1f} s after its first odometry"
        return [f"robot {used.subject} joins {late_s}, where its ground truth begins."]
    if used.truth is not None and _start(used) is None:
        return [f"robot {used.subject} starts unknown: its ground truth does not cover its start."]
    return []


def from_truth_on(robot: RobotLog) -> RobotLog:
    """The robot's log from its first true pose on, so that its start is known.

    The command of that moment becomes the first row. If more than two minutes would be lost, nothing is cut
    and the start is unknown.
    """
    if robot.truth is None or _start(robot) is not None:
        return robot
    begin_ns, end_ns = int(robot.odometry.stamp_ns[0]), int(robot.odometry.stamp_ns[-1])
    later = robot.truth.stamp_ns[robot.truth.stamp_ns >= begin_ns]
    if len(later) == 0 or later[0] > min(begin_ns + _MAX_CUT_NS, end_ns):
        return robot
    first = int(np.searchsorted(robot.odometry.stamp_ns, later[0], side="right")) - 1
    stamp_ns = robot.odometry.stamp_ns[first:].copy()
    stamp_ns[0] = later[0]
    twist, seen = robot.twist[first:], robot.sighting_ns >= later[0]
    return replace(
        robot,
        odometry=integrate(stamp_ns, twist),
        twist=twist,
        sighting_ns=robot.sighting_ns[seen],
        sighting=robot.sighting[seen],
        barcode=robot.barcode[seen],
    )


def describe(dataset: Dataset, robots: list[RobotLog]) -> Swarm:
    """The swarm description; barcodes are the marker ids."""
    return Swarm(
        tuple(_robot(robot, dataset.barcode_of.get(robot.subject)) for robot in robots),
        tuple(
            Landmark(dataset.barcode_of[subject], x, y)
            for subject, (x, y) in dataset.landmarks.items()
            if subject in dataset.barcode_of
        ),
    )


def _robot(robot: RobotLog, barcode: int | None) -> Robot:
    """A robot with one marker, a cylinder of barcodes around its centre that shows no heading."""
    return Robot(
        f"robot{robot.subject}",
        ROBOT_TYPE,
        odometry=OdometryModel(wheel_separation=WHEEL_SEPARATION, timeout_s=TIMEOUT_S),
        camera=CameraMount(),
        faces=() if barcode is None else (Face("body", barcode),),
        start=_start(robot),
    )


def _start(robot: RobotLog) -> Pose2 | None:
    """The true pose at the first odometry."""
    if robot.truth is None:
        return None
    pose, known = interpolate(robot.truth, robot.odometry.stamp_ns[:1], MAX_TRUTH_GAP_NS)
    if not known[0]:
        return None
    x, y, theta = (round(float(value), 6) for value in pose[0])
    return x, y, theta


def _odometry(robot: RobotLog) -> _Stream:
    """Commands as odometry; arrival equals stamp."""
    name, stamp_ns = f"robot{robot.subject}", robot.odometry.stamp_ns
    twist = np.column_stack([robot.twist[:, 0], np.zeros(len(stamp_ns)), robot.twist[:, 1]])
    data = encode_odometry(
        f"{name}/odom",
        f"{name}/base_link",
        stamp_ns,
        robot.odometry.pose,
        twist,
        UNKNOWN_COVARIANCE,
        UNKNOWN_COVARIANCE,
    )
    return _Stream(f"{name}/odom", ODOMETRY, stamp_ns, data)


def _detections(robot: RobotLog, delay: Delay, rng: np.random.Generator) -> _Stream:
    """Sightings of one stamp as one message, late by the delay."""
    name = f"robot{robot.subject}"
    stamp_ns, first = np.unique(robot.sighting_ns, return_index=True)
    rows = _detection_rows(robot)
    bounds = [*first.tolist(), len(rows)]
    frame = f"{name}/camera_optical_frame"
    data = [
        encode_detections(frame, stamp, rows[begin:end])
        for stamp, begin, end in zip(stamp_ns.tolist(), bounds, bounds[1:], strict=False)
    ]
    late_ns = rng.integers(delay.low_ns, delay.high_ns, len(stamp_ns), endpoint=True)
    order = np.argsort(stamp_ns + late_ns, kind="stable")
    return _Stream(
        f"{name}/detections", DETECTIONS, (stamp_ns + late_ns)[order], [data[index] for index in order]
    )


def _detection_rows(robot: RobotLog) -> npt.NDArray[np.void]:
    """(M,) sightings as detections: a position in the optical frame (x right, z forward), heading unknown."""
    rows = np.zeros(len(robot.barcode), DETECTION_DTYPE)
    distance, bearing = robot.sighting.T
    rows["id"] = robot.barcode
    rows["family"] = _FAMILY_OTHER
    rows["content"] = CONTENT_POSITION
    rows["id_margin"] = rows["alternative_ratio"] = np.nan
    rows["corners_px"] = np.nan
    rows["position"][:, 0] = -distance * np.sin(bearing)
    rows["position"][:, 2] = distance * np.cos(bearing)
    rows["orientation"][:, 3] = rows["alternative_orientation"][:, 3] = 1.0
    rows["covariance"] = UNKNOWN_COVARIANCE
    return rows


def _truth(subject: int, truth: Trajectory, begin_ns: int, end_ns: int) -> _Stream:
    """Ground truth between the first and the last odometry."""
    inside = (truth.stamp_ns >= begin_ns) & (truth.stamp_ns <= end_ns)
    stamp_ns = truth.stamp_ns[inside]
    data = encode_pose_stamped("map", stamp_ns, truth.pose[inside])
    return _Stream(f"robot{subject}/ground_truth", POSE_STAMPED, stamp_ns, data)


def _write(folder: Path, streams: list[_Stream], progress: Callable[[float, str], None]) -> int:
    """Write all messages in order of arrival, equal times in the order of the streams."""
    log_ns = np.concatenate([stream.log_ns for stream in streams])
    source = np.repeat(np.arange(len(streams)), [len(stream.data) for stream in streams])
    order = np.argsort(log_ns, kind="stable")
    readers = [iter(stream.data) for stream in streams]
    names = [stream.topic for stream in streams]
    with BagWriter(folder, compress=True) as bag:
        for stream in streams:
            bag.add_topic(stream.topic, stream.type)
        for done, (at_ns, index) in enumerate(
            zip(log_ns[order].tolist(), source[order].tolist(), strict=True)
        ):
            bag.write(names[index], at_ns, next(readers[index]))
            if done % _REPORT_EVERY == 0:
                progress(_SERIALIZING + (1.0 - _SERIALIZING) * done / len(order), "writing")
    return len(order)
