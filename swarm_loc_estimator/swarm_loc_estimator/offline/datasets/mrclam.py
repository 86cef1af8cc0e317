"""Read a folder of the UTIAS multi-robot cooperative localization and mapping dataset.

K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu: The UTIAS multi-robot cooperative localization and
mapping dataset, The International Journal of Robotics Research 30(8), 2011. Subjects with odometry are
robots, subjects with a surveyed position are landmarks, whatever the number of the set.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate

MAX_TRUTH_GAP_NS = 500_000_000

_ODOMETRY = re.compile(r"Robot(\d+)_Odometry\.dat")
_MISFIT = 0.5  # A barcode whose median sighting is further than this from its landmark is wrong [m]
_SIGHTINGS_TO_JUDGE = 10


class MrclamError(UserError):
    """A folder that is not such a dataset; the message is one sentence."""


@dataclass(frozen=True)
class RobotLog:
    """One robot's files."""

    subject: int  # Its number
    # Poses of its own frame, starting at the origin; the command of a row holds until the next
    odometry: Trajectory
    twist: FloatArray  # (N, 2) commanded forward speed [m/s] and turn rate [rad/s]
    sighting_ns: IntArray  # (M,) stamps, not decreasing
    sighting: FloatArray  # (M, 2) range [m] and bearing [rad, positive to the left]
    barcode: npt.NDArray[np.int64]  # (M,) of each sighting
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

    Raises:
        MrclamError: It holds no such dataset, or a damaged file.
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
    """Integrate commands from the origin: exact arcs, each command until the stamp of the next row.

    Args:
        stamp_ns: (N,).
        twist: (N, 2) forward speed [m/s], turn rate [rad/s].
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
    names: list[npt.NDArray[np.int64]] = []
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
        _truth(folder, subject, sparse, remarks),
    )


def _truth(folder: Path, subject: int, sparse: FloatArray, remarks: list[str]) -> Trajectory | None:
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
