"""Parameters of `event_tracker_node`, and the tracker that they describe. No ROS here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from swarm_loc_estimator.common.number_spec import number
from swarm_loc_estimator.common.parameters import ParameterError, choice, text, texts
from swarm_loc_vision.events.centroid_tracker import CentroidTracker
from swarm_loc_vision.events.paper_tracker import PaperSettings, PaperTracker
from swarm_loc_vision.events.settings import MAX_SOURCES, LightSource, TrackerSettings
from swarm_loc_vision.events.windows import WindowedTracker
from swarm_loc_vision.laser.calibration import LaserCalibration
from swarm_loc_vision.laser.laser_file import load_laser

_MIN_HZ, _MAX_HZ = 10.0, 5000.0


@dataclass(frozen=True)
class LensSettings:
    """The event camera's lens, for bearings of lights."""

    focal_px: float = number(90.0, "px", 1.0, 10_000.0, "focal length of the event camera")
    centre_column: float = number(63.5, "px", -10_000.0, 10_000.0, "column of its optical axis")
    centre_row: float = number(63.5, "px", -10_000.0, 10_000.0, "row of its optical axis")
    camera_yaw: float = number(0.0, "rad", -3.15, 3.15, "turn of the camera on the robot, to the left")


@dataclass(frozen=True)
class EventTrackerParameters:
    """Parameters of `event_tracker_node`; those of the tracker itself are its settings."""

    method: str = choice(
        "centroid",
        ("centroid", "paper"),
        "centre of all events in time, or equation (1) of the PushBot paper",
    )
    laser_frequency: float = number(
        450.0, "Hz", 0.0, _MAX_HZ, "of the own laser, looked for in the lower half; 0: none"
    )
    light_frequencies: tuple[str, ...] = texts(
        "of other robots' LEDs, looked for in the upper half, such as 1000 [Hz]; empty: none"
    )
    calibration: str = text("", "path of the laser's calibration; empty: no distances, only the spot")
    base_frame: str = text("base_link", "distances and bearings are in <robot>/base_frame", required=True)
    lens: LensSettings = field(default_factory=LensSettings, metadata={"numbers_of": LensSettings})
    settings: TrackerSettings = field(
        default_factory=TrackerSettings, metadata={"numbers_of": TrackerSettings}
    )


def light_sources(parameters: EventTrackerParameters) -> list[LightSource]:
    """The lights that are looked for: the laser first where there is one, then LEDs by frequency.

    Raises:
        ParameterError: A frequency cannot be used.
    """
    laser = parameters.laser_frequency
    sources = [LightSource(_in_range("laser_frequency", laser), is_above=False)] if laser else []
    lights = sorted({_in_range("light_frequencies", one) for one in parameters.light_frequencies})
    sources += [LightSource(frequency, is_above=True) for frequency in lights]
    if not sources:
        raise ParameterError(
            "parameters laser_frequency = 0 and light_frequencies = [] leave nothing to track."
        )
    if len(sources) > MAX_SOURCES:
        raise ParameterError(
            f"parameter light_frequencies has {len(lights)} entries, the most are {MAX_SOURCES - 1}."
        )
    return sources


def _in_range(name: str, value: float | str) -> float:
    try:
        frequency = float(value)
    except ValueError:
        frequency = -1.0
    if not _MIN_HZ <= frequency <= _MAX_HZ:
        raise ParameterError(f"parameter {name} = {value!r} must lie in [{_MIN_HZ:g}, {_MAX_HZ:g}] Hz.")
    return frequency


def make_tracker(
    parameters: EventTrackerParameters, sources: Sequence[LightSource], size: tuple[int, int]
) -> WindowedTracker:
    """The tracker for a sensor of a size [px]."""
    if parameters.method == "paper":
        return PaperTracker(sources, size, parameters.settings, PaperSettings())
    return CentroidTracker(sources, size, parameters.settings)


def laser_calibration(parameters: EventTrackerParameters) -> LaserCalibration | None:
    """The laser's calibration; None without one.

    Raises:
        LaserFileError: It cannot be used.
    """
    return load_laser(Path(parameters.calibration)) if parameters.calibration else None
