"""Cameras above: of images without identities, and of tags that lie."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.scenarios.eight_run import EightSettings, describe
from bench.vision.ceiling import CeilingRig
from swarm_loc_drivers.epuck.hardware import wheel_geometry
from swarm_loc_drivers.sim.epuck.world import OVERHEAD, EpuckWorld, EpuckWorldSettings, Exposure
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena, OverheadSettings, overhead_model
from swarm_loc_drivers.sim.render.scene import TOP_HEIGHT, TOP_RADIUS
from swarm_loc_drivers.sim.run import START_NS, Trajectories
from swarm_loc_drivers.sim.scenarios.eight import ARENA, eight_floor
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.swarm.swarm import Face, FixedCamera, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_vision.aerial.detector import AerialDetector
from swarm_loc_vision.aerial.ground_control import AerialSettings, FloorMarker, Ground, GroundControl, located
from swarm_loc_vision.aerial.locate_camera import fixed_camera
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector, detection_rows
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.pose import robot_body

START = np.array([[0.1, 0.2, 0.3], [0.5, -0.2, 1.9], [-0.4, -0.3, -2.0]])
RATE_HZ = 5.0
CAMERA = OverheadSettings(aerial_rate=RATE_HZ, aerial_width=960, aerial_height=720)
TILTED = replace(
    CAMERA, aerial_tilt=0.4, aerial_y=-1.0, aerial_k1=-0.08, aerial_field_of_view=1.5, aerial_light=0.3
)
CONTROL = AerialSettings(control_sigma_px=0.3, control_sigma=0.001, max_residual=6.0)
SEEN = AerialSettings(
    robot_height=TOP_HEIGHT, robot_diameter=2.0 * TOP_RADIUS, x_min=-1.2, x_max=1.2, y_min=-0.8, y_max=0.8
)


def world(start: FloatArray, overhead: OverheadSettings, seed: int = 1) -> EpuckWorld:
    ground = eight_floor()
    settings = EpuckWorldSettings(
        seed=seed,
        errors=W0,
        arena=Arena(ARENA, ground.family),
        camera=CameraModel(width=64, height=48),
        wheels=wheel_geometry(0.041, 0.053),
        camera_rate_hz=7.5,
        start_ns=START_NS,
        overhead=overhead,
        floor_markers=ground.markers,
    )
    return EpuckWorld(describe(EightSettings(robots=len(start)), start), settings)


def first_exposure(made: EpuckWorld) -> Exposure:
    """Of the overhead camera."""
    for _ in range(100):
        for exposure in made.step():
            if exposure.robot == OVERHEAD:
                return exposure
    raise AssertionError("the overhead camera has taken no image.")


@pytest.mark.parametrize("overhead", [CAMERA, TILTED], ids=["level", "tilted"])
def test_robots_are_found_where_they_are(overhead: OverheadSettings) -> None:
    made = world(START, overhead)
    image = made.image(first_exposure(made))
    control = GroundControl(eight_floor(), overhead_model(overhead).camera, CONTROL)
    ground = control.look(image)
    assert ground is not None, control.trouble
    np.testing.assert_allclose(
        ground.centre, [overhead.aerial_x, overhead.aerial_y, overhead.aerial_z], atol=0.005
    )
    found = AerialDetector(SEEN, ground).detect(image)
    assert len(found) == len(START)
    away = np.linalg.norm(found.place[:, None] - START[None, :, :2], axis=2)
    which = away.argmin(axis=0)
    assert away.min(axis=0).max() < 0.003
    turned = np.asarray(se2.wrap_angle(found.theta[which] - START[:, 2]))
    assert np.abs(turned).max() < math.radians(4.0)


def test_nothing_tells_robots_apart() -> None:
    """Robots that change places leave the image as it was, but for what is on their sides."""
    bare = replace(CAMERA, aerial_tilt=0.0, aerial_y=0.0, aerial_shadow=0.0)
    images = []
    for order in ([0, 1, 2], [2, 0, 1]):
        made = world(START[order], bare)
        images.append(made.image(first_exposure(made)).astype(float))
    control = GroundControl(eight_floor(), overhead_model(bare).camera, CONTROL)
    ground = control.look(images[0].astype(np.uint8))
    assert ground is not None
    tops = np.concatenate([START[:, :2], np.full((3, 1), TOP_HEIGHT)], axis=1)
    for u, v in ground.pixels(tops):
        reach = int(0.7 * TOP_RADIUS * ground.camera.fx / bare.aerial_z)
        window = np.s_[round(v) - reach : round(v) + reach, round(u) - reach : round(u) + reach]
        assert np.abs(images[0][window] - images[1][window]).max() == 0.0


def test_images_are_stamped_with_the_middle_of_their_exposure() -> None:
    made = world(START, CAMERA)
    stamps = [e.stamp_ns for _ in range(250) for e in made.step() if e.robot == OVERHEAD]
    half_ns = round(0.5e9 * CAMERA.aerial_exposure_s)
    expected = [START_NS + half_ns + round(k * 1e9 / RATE_HZ) for k in range(1, len(stamps) + 1)]
    assert stamps == expected
    assert len(stamps) == 6


def test_there_is_no_such_camera_unless_asked_for() -> None:
    made = world(START, OverheadSettings())
    assert all(exposure.robot != OVERHEAD for _ in range(250) for exposure in made.step())


FAMILY = family_named("aruco_mip_36h12")
MODEL = CameraModel(width=640, height=480, field_of_view=math.radians(60.0), k1=-0.05, exposure_s=0.004)
ARENA_CEILING = Arena((1.6, 1.2), FAMILY)
TOP = Face("top", 0, 0.01, 0.0, 0.105, 0.5, size=0.05, lies=True)
ROBOTS = tuple(Robot(f"r{k}", camera=None, faces=(replace(TOP, id=k),), stands=True) for k in range(3))
POSES = np.array([[0.1, 0.2, 0.4], [-0.35, -0.15, 2.8], [0.4, -0.2, -1.5]])
FLOOR = [
    FloorMarker(200 + k, x, y, size=0.1)
    for k, (x, y) in enumerate([(-0.5, 0.35), (0.5, 0.35), (0.5, -0.4), (-0.5, -0.4)])
]
HUNG = FixedCamera("up", 0.03, -0.02, 1.3, yaw=0.5 * math.pi + 0.05, pitch=0.5 * math.pi - 0.06, roll=0.03)


@pytest.fixture(scope="module")
def described() -> FixedCamera:
    """The camera as its markers on the floor locate it."""
    track = still(np.zeros((0, 3)))
    rig = CeilingRig((), (HUNG,), ARENA_CEILING, MODEL, FLOOR, 1)
    settings = AerialSettings(control_sigma_px=0.1, control_sigma=0.0)
    pictures = [rig.take(0, START_NS + 10**9, track, np.random.default_rng(k)) for k in range(5)]
    fit = located(Ground(markers=tuple(FLOOR), family=FAMILY), MODEL.camera, pictures, settings)
    return fixed_camera("up", fit.ground, TOP.z)


def still(poses: np.ndarray) -> Trajectories:
    """Robots (N, 3) that stand for two seconds."""
    stamps_ns = START_NS + np.arange(3, dtype=np.int64) * 10**9
    return Trajectories(stamps_ns, np.tile(poses, (3, 1, 1)))


def test_a_camera_is_located_to_four_millimetres_by_markers_on_the_floor(described: FixedCamera) -> None:
    off = np.array([described.x - HUNG.x, described.y - HUNG.y, described.z - HUNG.z])
    assert np.abs(off).max() < 0.004
    assert described.position_sigma < 0.001


def test_three_pictures_locate_all_robots_and_the_fourth_confirms_them(described: FixedCamera) -> None:
    swarm = Swarm(ROBOTS, (), (described,))
    rig = CeilingRig(ROBOTS, (HUNG,), ARENA_CEILING, MODEL, FLOOR, 1)
    rng, estimator = np.random.default_rng(9), Estimator(swarm)
    detector = MarkerDetector(
        DetectorSettings(),
        {FAMILY: np.arange(250)},
        MODEL.camera,
        lengths=dict.fromkeys(range(3), TOP.size),
        bodies=[robot_body(robot) for robot in ROBOTS],
    )
    status = []
    for stamp_ns in (START_NS + k * 10**8 for k in range(10, 14)):
        rows = detection_rows(detector.detect(rig.take(0, stamp_ns, still(POSES), rng)), 16.0)
        count = len(rows)
        seen = DetectionRows(np.full(count, 3), np.full(count, stamp_ns), rows, np.full(count, stamp_ns))
        estimator.receive(Batch.of(stamp_ns, stamp_ns, detections=seen))
        estimate = estimator.tick(stamp_ns)
        status.append(set(estimate.status.tolist()))
    assert status == [{Status.WAITING}, {Status.WAITING}, {Status.UNCONFIRMED}, {Status.TRACKED}]
    errors = estimate.poses - POSES
    assert np.linalg.norm(errors[:, :2], axis=1).max() < 0.0015
    assert np.abs(se2.wrap_angle(errors[:, 2])).max() < math.radians(0.4)
    assert estimator.drops == {"unknown_id": 4 * len(FLOOR)}
    assert estimator.drops_of(3) == {"unknown_id": 4 * len(FLOOR)}
