"""Sets of the MRCLAM benchmark: find them, import them as bags, and mask parts of them."""

from __future__ import annotations

import re
import shutil
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.calibration.recording import Recording, read_recording
from swarm_loc_estimator.offline.datasets.mrclam import Delay, convert, read_dataset
from swarm_loc_estimator.sensors.camera import NO_DETECTIONS
from swarm_loc_estimator.swarm.error_models import OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm


class NoSetsError(UserError):
    """No set to run; the message is one sentence."""


def find_sets(folder: Path) -> dict[int, Path]:
    """Number -> folder of every set in a folder; the folder may be a set itself."""
    if not folder.is_dir():
        raise NoSetsError(
            f"There is no folder '{folder}'; name one that holds MRCLAM_Dataset<k> folders: make bench-mrclam"
            ' ARGS="FOLDER".'
        )
    own = [folder] if any(folder.glob("Robot*_Odometry.dat")) else []
    found = own or sorted(path.parent for path in folder.glob("*/Robot1_Odometry.dat"))
    found = found or sorted({path.parent for path in folder.glob("*/Robot*_Odometry.dat")})
    sets: dict[int, Path] = {}
    for path in found:
        number = re.search(r"(\d+)$", path.name)
        sets[int(number[1]) if number else len(sets) + 1] = path
    if not sets:
        raise NoSetsError(f"'{folder}' holds no MRCLAM set: no Robot<number>_Odometry.dat in it or below.")
    return dict(sorted(sets.items()))


def import_set(folder: Path, bag: Path) -> tuple[str, ...]:
    """Write a set as a bag, replacing an existing one; returns the remarks of the import."""
    if bag.exists():
        shutil.rmtree(bag)
    bag.parent.mkdir(parents=True, exist_ok=True)
    return convert(read_dataset(folder), bag, Delay(), lambda _share, _what: None).remarks


@lru_cache(maxsize=2)
def load(bag: Path) -> tuple[Recording, Swarm]:
    """A set in memory."""
    swarm = load_swarm(bag / "swarm.yaml")
    return read_recording(bag, swarm), swarm


def transferred(fitted: Swarm, swarm: Swarm) -> Swarm:
    """The swarm of another set with the fitted models by name; other robots get the mean."""
    by_name = {robot.name: robot for robot in fitted.robots}
    mean = _mean(fitted.robots)
    return replace(swarm, robots=tuple(_with_models(r, by_name.get(r.name, mean)) for r in swarm.robots))


def without_robots(recording: Recording, swarm: Swarm) -> Recording:
    """The recording without detections of robots."""
    return _masked(recording, _shows_landmark(recording, swarm))


def without_sightings(recording: Recording) -> Recording:
    """The recording without detections."""
    return replace(recording, detections=NO_DETECTIONS)


def with_two_seeing(recording: Recording, swarm: Swarm, seeing: tuple[int, int]) -> Recording:
    """The recording with detections of landmarks by two robots only; all see robots."""
    kept = np.isin(recording.detections.robot, seeing) | ~_shows_landmark(recording, swarm)
    return _masked(recording, kept)


def _masked(recording: Recording, kept: BoolArray) -> Recording:
    """The recording with only some of the detections (d,)."""
    return replace(recording, detections=select(recording.detections, kept))


def _shows_landmark(recording: Recording, swarm: Swarm) -> BoolArray:
    """Whether detections (d,) are of landmarks."""
    return np.isin(recording.detections.detection["id"], [landmark.id for landmark in swarm.landmarks])


def unknown_start(swarm: Swarm) -> Swarm:
    """The swarm with unknown starts."""
    return replace(swarm, robots=tuple(replace(robot, start=None) for robot in swarm.robots))


def _with_models(robot: Robot, fitted: Robot) -> Robot:
    return replace(
        robot, odometry=fitted.odometry, response=fitted.response, camera=fitted.camera, sensor=fitted.sensor
    )


def _mean(robots: tuple[Robot, ...]) -> Robot:
    """A robot with the mean of all models."""

    def mean_of(models: list[Any], cls: type) -> Any:
        return cls(**{f.name: float(np.mean([getattr(m, f.name) for m in models])) for f in fields(cls)})

    return replace(
        robots[0],
        odometry=mean_of([robot.odometry for robot in robots], OdometryModel),
        camera=mean_of([robot.camera or CameraMount() for robot in robots], CameraMount),
        sensor=mean_of([robot.sensor for robot in robots], SensorModel),
    )
