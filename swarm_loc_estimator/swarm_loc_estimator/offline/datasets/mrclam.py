"""Read a set of the UTIAS multi-robot cooperative localization and mapping dataset, and write it as a bag.

K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu: The UTIAS multi-robot cooperative localization and
mapping dataset, The International Journal of Robotics Research 30(8), 2011. Subjects with odometry are
robots, subjects with a surveyed position are landmarks, whatever the number of the set.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.writer import Stream, write_streams
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, ODOMETRY, POSE_STAMPED
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, encode_detections
from swarm_loc_estimator.common.messages.poses import UNKNOWN_COVARIANCE, encode_odometry, encode_pose_stamped
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.sensors.camera import CONTENT_POSITION
from swarm_loc_estimator.swarm.error_models import OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Pose2, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm

MAX_TRUTH_GAP_NS = 500_000_000
RANGE_OFFSET_SIGMA, RANGE_SCALE_SIGMA = 0.05, 0.02
"""The range curve of these cameras differs by so much between days: an offset [m] and a scale [1]."""

_ODOMETRY = re.compile(r"Robot(\d+)_Odometry\.dat")
_MISFIT = 0.5  # A barcode whose median sighting is further than this from its landmark is wrong [m]
_SIGHTINGS_TO_JUDGE = 10


class MrclamError(UserError):
    """A folder that is not such a dataset."""


@dataclass(frozen=True)
class RobotLog:
    """One robot's files."""

    subject: int  # Its number
    # Poses of its own frame, starting at the origin; the command of a row holds until the next
    odometry: Trajectory
    twist: FloatArray  # (N, 2) commanded forward speed [m/s] and turn rate [rad/s]
    sighting_ns: IntArray  # (M,) stamps, not decreasing
    sighting: FloatArray  # (M, 2) range [m] and bearing [rad, positive to the left]
    barcode: IntArray  # (M,) of each sighting
    truth: Trajectory | None  # Ground truth in map; None when there is none


@dataclass(frozen=True)
class Dataset:
    """One set."""

    robots: tuple[RobotLog, ...]  # In the order of their subjects
    barcode_of: Mapping[int, int]  # Subject -> barcode
    landmarks: Mapping[int, tuple[float, float]]  # Subject -> x [m], y [m]
    remarks: tuple[str, ...]  # Missing files and corrected barcodes, one sentence each


def read_dataset(folder: Path) -> Dataset:
    """Read a folder, and correct barcodes that contradict the ground truth.

    Raises MrclamError if it holds no such dataset, or a damaged file.
    """
    subjects = sorted(
        int(match[1]) for path in folder.glob("Robot*") if (match := _ODOMETRY.fullmatch(path.name))
    )
    if not subjects:
        raise MrclamError(
            f"'{folder}' holds no Robot<number>_Odometry.dat; expected a folder of the MRCLAM dataset."
        )
    barcodes = _table(folder / "Barcodes.dat", 2)
    landmarks = _table(folder / "Landmark_Groundtruth.dat", 3)
    path = folder / "sparse_groundtruth.csv"
    sparse = _table(path, 5, delimiter=",") if path.exists() else np.empty((0, 5))
    remarks: list[str] = []
    robots = tuple(_read_robot(folder, subject, sparse, remarks) for subject in subjects)
    dataset = Dataset(
        robots,
        {int(row[0]): int(row[1]) for row in barcodes},
        {int(row[0]): (float(row[1]), float(row[2])) for row in landmarks},
        tuple(remarks),
    )
    return correct_barcodes(dataset)


def integrate(stamp_ns: IntArray, twist: FloatArray) -> Trajectory:
    """Integrate commands from the origin: exact arcs, each until the stamp of the next row.

    Commands (N, 2) are forward speed [m/s] and turn rate [rad/s].
    """
    step_s = np.diff(stamp_ns) * 1e-9
    turn = twist[:-1, 1] * step_s
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    middle = heading[:-1] + 0.5 * turn
    chord = twist[:-1, 0] * step_s * np.sinc(0.5 * turn / math.pi)
    x = np.concatenate([[0.0], np.cumsum(chord * np.cos(middle))])
    y = np.concatenate([[0.0], np.cumsum(chord * np.sin(middle))])
    return Trajectory(stamp_ns, np.column_stack([x, y, se2.wrap_angle(heading)]))


def correct_barcodes(dataset: Dataset) -> Dataset:
    """Correct barcodes of landmarks that were exchanged in the dataset's files.

    Sightings by robots with ground truth show where a barcode is. One that is far from its own landmark and
    close to that of another wrong one was exchanged with it; each gets a remark.
    """
    places = _seen_places(dataset)
    subjects = [subject for subject in dataset.landmarks if subject in dataset.barcode_of]
    misfit = {
        subject: _misfit(places.get(dataset.barcode_of[subject]), dataset.landmarks[subject])
        for subject in subjects
    }
    wrong = [subject for subject in subjects if misfit[subject] > _MISFIT]
    cost = np.array(
        [[_misfit(places.get(dataset.barcode_of[b]), dataset.landmarks[a]) for b in wrong] for a in wrong]
    ).reshape(len(wrong), len(wrong))
    barcode_of = dict(dataset.barcode_of)
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        subject, donor = wrong[row], wrong[column]
        if cost[row, column] < _MISFIT and donor != subject:
            barcode_of[subject] = dataset.barcode_of[donor]
    remarks = [_barcode_remark(subject, dataset.barcode_of, barcode_of, misfit[subject]) for subject in wrong]
    return replace(dataset, barcode_of=barcode_of, remarks=(*dataset.remarks, *remarks))


def _barcode_remark(subject: int, noted: Mapping[int, int], used: Mapping[int, int], misfit: float) -> str:
    """A sentence on a wrong barcode and its correction."""
    far = f"sightings of barcode {noted[subject]} lie {misfit:.2f} m from landmark {subject}"
    if used[subject] == noted[subject]:
        return f"{far}, and no exchange explains it; it was left as noted."
    donor = next(other for other, barcode in noted.items() if barcode == used[subject])
    return f"{far}; barcode {used[subject]}, noted for landmark {donor}, fits and is used instead."


def _seen_places(dataset: Dataset) -> dict[int, FloatArray]:
    """Barcode -> (K, 2) positions in map, from sightings by robots with a known pose."""
    found: list[FloatArray] = []
    names: list[IntArray] = []
    for robot in dataset.robots:
        if robot.truth is None:
            continue
        pose, known = interpolate(robot.truth, robot.sighting_ns, MAX_TRUTH_GAP_NS)
        distance, bearing = robot.sighting[known].T
        local = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing)])
        found.append(se2.transform_points(pose[known], local))
        names.append(robot.barcode[known])
    if not found:
        return {}
    places, barcodes = np.concatenate(found), np.concatenate(names)
    return {int(barcode): places[barcodes == barcode] for barcode in np.unique(barcodes)}


def _misfit(places: FloatArray | None, landmark: tuple[float, float]) -> float:
    """Median distance of sightings from a landmark [m]; 0 if there are too few."""
    if places is None or len(places) < _SIGHTINGS_TO_JUDGE:
        return 0.0
    return float(np.median(np.hypot(*(places - np.array(landmark)).T)))


def _read_robot(folder: Path, subject: int, sparse: FloatArray, remarks: list[str]) -> RobotLog:
    """Read one robot's files; missing ones become remarks."""
    odometry = _in_order(_table(folder / f"Robot{subject}_Odometry.dat", 3))
    if len(odometry) == 0:
        raise MrclamError(f"'{folder / f'Robot{subject}_Odometry.dat'}' holds no rows.")
    measured = folder / f"Robot{subject}_Measurement.dat"
    sightings = _in_order(_table(measured, 4)) if measured.exists() else np.empty((0, 4))
    if not measured.exists():
        remarks.append(f"robot {subject} has no measurement file: it sees nothing.")
    stamp_ns, twist = _nanoseconds(odometry[:, 0]), odometry[:, 1:3]
    return RobotLog(
        subject,
        integrate(stamp_ns, twist),
        twist,
        _nanoseconds(sightings[:, 0]),
        sightings[:, 2:4],
        sightings[:, 1].astype(np.int64),
        _read_truth(folder, subject, sparse, remarks),
    )


def _read_truth(folder: Path, subject: int, sparse: FloatArray, remarks: list[str]) -> Trajectory | None:
    """Dense ground truth if there is any, else the sparse one, else None."""
    path = folder / f"Robot{subject}_Groundtruth.dat"
    table = _table(path, 4) if path.exists() else sparse[sparse[:, 0] == subject][:, 1:5]
    if len(table) == 0:
        remarks.append(f"robot {subject} has no ground truth: it starts unknown and is not evaluated.")
        return None
    if not path.exists():
        remarks.append(f"robot {subject} has sparse ground truth only: {len(table)} poses.")
    table = _in_order(table)
    pose = table[:, 1:4].copy()
    pose[:, 2] = se2.wrap_angle(pose[:, 2])
    return Trajectory(_nanoseconds(table[:, 0]), pose)


def _table(path: Path, columns: int, delimiter: str | None = None) -> FloatArray:
    """The first columns (N, `columns`) of a text file of numbers."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            table = np.loadtxt(path, comments="#", delimiter=delimiter, usecols=range(columns), ndmin=2)
    except (OSError, ValueError) as error:
        raise MrclamError(f"'{path}' cannot be read: {' '.join(str(error).split())}.") from error
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if bad.size:
        raise MrclamError(f"'{path}' holds a number that is not finite in row {bad[0] + 1} of its data.")
    return table.reshape(-1, columns)


def _in_order(table: FloatArray) -> FloatArray:
    """Rows sorted by time, stable."""
    return table[np.argsort(table[:, 0], kind="stable")]


def _nanoseconds(time_s: FloatArray) -> IntArray:
    """Stamps; the files have milliseconds, a double of today's seconds is good to a quarter microsecond."""
    return np.round(time_s * 1e6).astype(np.int64) * 1000


ROBOT_TYPE = "create"
TIMEOUT_S = 2.0  # The logs pause for over a second about every two minutes, while the robots keep driving
_COMMANDED = OdometryModel(
    wheel_separation=0.258,
    timeout_s=TIMEOUT_S,
    distance_noise=0.005,
    distance_scale_sigma=0.05,
    turn_noise=0.01,
    turn_scale_sigma=0.05,
)
"""Of an iRobot Create's commands, which no encoder checks: scales to 5 %, 7 % over 1 m, 10 % over 1 rad."""

_FAMILY_OTHER = 255
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


def convert(
    dataset: Dataset, folder: Path, delay: Delay, progress: Callable[[float, str], None]
) -> MrclamImport:
    """Write a set as a bag with its `swarm.yaml` inside; robots start where their ground truth begins.

    Raises BagError if the folder is there already, or cannot be created.
    """
    rng = np.random.default_rng(delay.seed)
    streams: list[Stream] = []
    robots = [from_truth_on(robot) for robot in dataset.robots]
    begin_ns = min(int(robot.odometry.stamp_ns[0]) for robot in robots) - _MARGIN_NS
    end_ns = max(int(robot.odometry.stamp_ns[-1]) for robot in robots) + _MARGIN_NS
    for index, robot in enumerate(robots):
        progress(_SERIALIZING * index / len(robots), f"serializing robot{robot.subject}")
        streams += [_odometry(robot), _detections(robot, delay, rng)]
        if robot.truth is not None:
            inside = (robot.truth.stamp_ns >= begin_ns) & (robot.truth.stamp_ns <= end_ns)
            stamp_ns = robot.truth.stamp_ns[inside]
            data = encode_pose_stamped("map", stamp_ns, robot.truth.pose[inside])
            streams.append(Stream(f"robot{robot.subject}/ground_truth", POSE_STAMPED, stamp_ns, data))
    pairs = zip(dataset.robots, robots, strict=True)
    remarks = [*dataset.remarks, *(remark for whole, used in pairs for remark in _start_remarks(whole, used))]
    count = write_streams(
        folder,
        streams,
        lambda share: progress(_SERIALIZING + (1.0 - _SERIALIZING) * share, "writing"),
        lambda part: save_swarm(describe(dataset, robots), part / "swarm.yaml", "\n".join(remarks)),
    )
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
        odometry=_COMMANDED,
        camera=CameraMount(),
        sensor=SensorModel(range_offset_sigma=RANGE_OFFSET_SIGMA, distance_scale_sigma=RANGE_SCALE_SIGMA),
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


def _odometry(robot: RobotLog) -> Stream:
    """Commands as odometry; arrival equals stamp."""
    name, stamp_ns = f"robot{robot.subject}", robot.odometry.stamp_ns
    twist = np.column_stack([robot.twist[:, 0], np.zeros(len(stamp_ns)), robot.twist[:, 1]])
    data = encode_odometry(f"{name}/odom", f"{name}/base_link", stamp_ns, robot.odometry.pose, twist)
    return Stream(f"{name}/odom", ODOMETRY, stamp_ns, data)


def _detections(robot: RobotLog, delay: Delay, rng: np.random.Generator) -> Stream:
    """Sightings of one stamp as one message, late by the delay."""
    name = f"robot{robot.subject}"
    stamp_ns, first = np.unique(robot.sighting_ns, return_index=True)
    # (M,) sightings as detections: a position in the optical frame (x right, z forward), heading unknown
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
    # messages in the order of their arrival
    bounds, frame = [*first.tolist(), len(rows)], f"{name}/camera_optical_frame"
    data = [
        encode_detections(frame, stamp, rows[begin:end])
        for stamp, begin, end in zip(stamp_ns.tolist(), bounds, bounds[1:], strict=False)
    ]
    late_ns = rng.integers(delay.low_ns, delay.high_ns, len(stamp_ns), endpoint=True)
    order = np.argsort(stamp_ns + late_ns, kind="stable")
    return Stream(
        f"{name}/detections", DETECTIONS, (stamp_ns + late_ns)[order], [data[index] for index in order]
    )
