"""Parameters of `epuck_world_node`, and the world made of them. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from swarm_loc_drivers.epuck.hardware import EPUCK2, EPUCK_MODELS, wheel_geometry
from swarm_loc_drivers.sim.epuck.world import EpuckWorld, EpuckWorldSettings
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena, OverheadSettings
from swarm_loc_drivers.sim.scenarios.eight import ARENA, CAMERA_RATE_HZ, START_NS
from swarm_loc_drivers.sim.scenarios.eight_images import FAMILY
from swarm_loc_drivers.sim.worlds import WORLDS, WorldError
from swarm_loc_estimator.common.parameters import ParameterError, choice, number, text
from swarm_loc_estimator.swarm.swarm import OdometryModel, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.aerial.ground_control import FloorMarker
from swarm_loc_vision.aerial.ground_file import load_ground
from swarm_loc_vision.markers.families import families


@dataclass(frozen=True)
class WorldParameters:
    """Parameters of `epuck_world_node`; the cameras' are those of `CameraModel` and `OverheadSettings`."""

    swarm_file: str = text("", "path of the swarm description; every robot needs a start", required=True)
    world: str = choice("w2", tuple(WORLDS), "which errors robots and cameras have; see sim/worlds.py")
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes the errors")
    rate: float = number(
        1.0, "1", 0.01, 100.0, "simulated seconds per second, as far as the machine keeps up"
    )
    answer_within: float = number(
        0.0,
        "s",
        0.0,
        10.0,
        "simulated time waits for <robot>/detections of images older than this; 0: never",
    )
    link_folder: str = text(
        "", "where each robot's serial port appears under its name; empty: robots on WiFi"
    )
    first_port: int = number(0, "1", 0, 65000, "TCP port of the first robot on WiFi, the others follow")
    model: str = choice("epuck2", tuple(EPUCK_MODELS), "generation of the robots; only epuck2 has WiFi")
    wheel_diameter: float = number(0.041, "m", 0.001, 1.0, "diameter of the wheels")
    wheel_separation: float = number(
        OdometryModel().wheel_separation, "m", 0.001, 10.0, "distance between the two wheels"
    )
    arena_x: float = number(ARENA[0], "m", 0.1, 1000.0, "size of the arena along x, around the origin")
    arena_y: float = number(ARENA[1], "m", 0.1, 1000.0, "size of the arena along y")
    family: str = choice(FAMILY, tuple(families()), "kind of the markers")
    camera_rate: float = number(CAMERA_RATE_HZ, "1/s", 2.0, 60.0, "images of each camera")
    truth_rate: float = number(20.0, "1/s", 0.1, 200.0, "published true poses of each robot")
    control_points_file: str = text(
        "", "path of the floor markers that the overhead camera sees; empty: none are on the floor"
    )
    camera: CameraModel = field(default_factory=CameraModel, metadata={"numbers_of": CameraModel})
    overhead: OverheadSettings = field(
        default_factory=OverheadSettings, metadata={"numbers_of": OverheadSettings}
    )


def _floor_markers(parameters: WorldParameters) -> tuple[FloorMarker, ...]:
    """The markers on the floor."""
    path = parameters.control_points_file
    if not path:
        return ()
    ground = load_ground(Path(path))
    if ground.markers and ground.family.name != parameters.family:
        raise ParameterError(
            f"parameter family = '{parameters.family}' must be that of the floor markers in '{path}':"
            f" {ground.family.name}."
        )
    return ground.markers


def make_world(parameters: WorldParameters) -> tuple[Swarm, EpuckWorld]:
    """The swarm as described, and its world.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    if not parameters.link_folder and EPUCK_MODELS[parameters.model] is not EPUCK2:
        raise ParameterError(
            f"parameter model = '{parameters.model}' needs the parameter link_folder: only epuck2 has WiFi."
        )
    swarm = load_swarm(Path(parameters.swarm_file))
    try:
        arena = Arena((parameters.arena_x, parameters.arena_y), families()[parameters.family])
        settings = EpuckWorldSettings(
            seed=parameters.seed,
            errors=WORLDS[parameters.world],
            arena=arena,
            camera=parameters.camera,
            wheels=wheel_geometry(parameters.wheel_diameter, parameters.wheel_separation),
            camera_rate_hz=parameters.camera_rate,
            start_ns=START_NS,
            overhead=parameters.overhead,
            floor_markers=_floor_markers(parameters),
        )
        return swarm, EpuckWorld(swarm, settings)
    except WorldError as error:
        raise ParameterError(f"parameter swarm_file = '{parameters.swarm_file}': {error}") from error
    except ValueError as error:
        raise ParameterError(f"parameter family = '{parameters.family}': {error}") from error
