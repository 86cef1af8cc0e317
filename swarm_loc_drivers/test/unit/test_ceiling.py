"""A rendered arena under a fixed camera, from the picture to the poses of robots with unknown starts."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.vision.ceiling import CeilingRig
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena
from swarm_loc_drivers.sim.run import START_NS, Trajectories
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.swarm.swarm import Face, FixedCamera, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_vision.aerial.ground_control import AerialSettings, FloorMarker, Ground, located
from swarm_loc_vision.aerial.locate_camera import fixed_camera
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector, detection_rows
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.pose import robot_body

FAMILY = family_named("aruco_mip_36h12")
MODEL = CameraModel(width=640, height=480, field_of_view=math.radians(60.0), k1=-0.05, exposure_s=0.004)
ARENA = Arena((1.6, 1.2), FAMILY)
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
    rig = CeilingRig((), (HUNG,), ARENA, MODEL, FLOOR, 1)
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
    rig = CeilingRig(ROBOTS, (HUNG,), ARENA, MODEL, FLOOR, 1)
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
