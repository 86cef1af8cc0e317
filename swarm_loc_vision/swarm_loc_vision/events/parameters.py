"""Parameters of `event_tracker_node`: the lights that are looked for, and how they are tracked."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from swarm_loc_estimator.common.parameters import ParameterError, number, text, texts
from swarm_loc_vision.laser.calibration import LaserCalibration, load_laser

MAX_SOURCES = 32  # Bound on the lights that are looked for at once
_MIN_HZ, _MAX_HZ = 10.0, 5000.0


@dataclass(frozen=True)
class LightSource:
    """A light that blinks."""

    frequency: float  # [Hz]
    # Whether it is in the upper half of the image, as LEDs of other robots, or in the lower half, as the spot
    # of the robot's own laser
    is_above: bool

    @property
    def period_ns(self) -> int:
        """[ns]."""
        return round(1e9 / self.frequency)


@dataclass(frozen=True)
class TrackerSettings:
    """How blinking lights are tracked."""

    window: float = number(0.02, "s", 0.002, 1.0, "length of the windows, each of which makes one report")
    burst_gap: float = number(2.5e-4, "s", 1e-5, 0.01, "pause of a pixel before the first event of a burst")
    period_gate: float = number(
        6e-5, "s", 1e-6, 1e-3, "largest difference of the time between two bursts and the light's period"
    )
    radius: float = number(3.5, "px", 1.0, 20.0, "of the circle whose events determine a light's place")
    min_events: int = number(8, "1", 2, 1000, "events of a light within 3 x 3 pixels, at least")
    sigma_floor: float = number(
        0.02, "px", 0.0, 2.0, "standard deviation of a place that more events do not reduce, per axis"
    )


@dataclass(frozen=True)
class LensSettings:
    """The event camera's lens, for bearings of lights."""

    focal_px: float = number(90.0, "px", 1.0, 10_000.0, "focal length of the event camera")
    centre_column: float = number(63.5, "px", -10_000.0, 10_000.0, "column of its optical axis")
    centre_row: float = number(63.5, "px", -10_000.0, 10_000.0, "row of its optical axis")
    camera_yaw: float = number(0.0, "rad", -3.15, 3.15, "turn of the camera on the robot, to the left")


@dataclass(frozen=True)
class EventTrackerParameters:
    """Parameters of `event_tracker_node`."""

    laser_frequency: float = number(
        450.0, "Hz", 0.0, _MAX_HZ, "of the robot's own laser, in the lower half of the image; 0: none"
    )
    light_frequencies: tuple[str, ...] = texts(
        "of other robots' LEDs, in the upper half of the image, such as 1000 [Hz]; empty: none"
    )
    calibration: str = text("", "path of the laser's calibration; empty: the spot without distances")
    base_frame: str = text("base_link", "frame of distances and bearings: <robot>/base_frame", required=True)
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


def laser_calibration(parameters: EventTrackerParameters) -> LaserCalibration | None:
    """The laser's calibration; None without one.

    Raises:
        LaserFileError: It cannot be used.
    """
    return load_laser(Path(parameters.calibration)) if parameters.calibration else None
