"""Fixed cameras and anchors: robots on a line or at one place cannot place them; variances of few stamps."""

import numpy as np
import pytest
from core_messages import detection, joined
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.offline.survey.survey import Placed, place_fixed
from swarm_loc_estimator.sensors.camera import FROM_OPTICAL, DetectionRows
from swarm_loc_estimator.sensors.odometry import NO_ODOMETRY
from swarm_loc_estimator.sensors.ranges import RangeRows
from swarm_loc_estimator.swarm.swarm import Anchor, Face, FixedCamera, Robot, Swarm, UwbDevice

COUNT = 400
CEILING = FixedCamera("ceiling", 0.2, -0.1, 2.5, yaw=0.7, pitch=1.4, roll=0.1)
WALL = FixedCamera("wall", -3.0, 0.0, 1.5, pitch=0.45)
HIGH, LOW = Anchor(2**64 - 1, 2.0, 3.0, 1.5), Anchor(2**63, 1.0, 3.0, 0.08)
RADIO = UwbDevice(1, z=0.08)
PLACES = {
    "line": np.column_stack([np.linspace(-2.0, 2.0, COUNT), np.zeros(COUNT)]),
    "place": np.tile([0.3, 0.2], (COUNT, 1)),
    "floor": np.random.default_rng(9).uniform(-1.5, 1.5, (COUNT, 2)),
    "corridor": np.random.default_rng(9).uniform([-5.0, -0.4], [5.0, 0.4], (COUNT, 2)),
}


def placed(
    where: str, *, camera: FixedCamera = CEILING, anchor: Anchor = HIGH, stamps: int = COUNT, seed: int = 0
) -> Placed:
    """What a robot tells that was at known places, whose path has errors of 5 mm."""
    rng = np.random.default_rng(seed)
    true = PLACES[where]
    stamp_ns = 10**18 + np.sort(np.arange(COUNT) % stamps) * 10**8
    face = Face("top", 7, z=0.08)
    found = np.column_stack([true + 0.005 * rng.standard_normal(true.shape), np.zeros(COUNT)])

    def at(_: IntArray, at_ns: IntArray) -> FloatArray:
        assert np.array_equal(at_ns, stamp_ns)
        return found

    top = np.column_stack([true, np.full(COUNT, 0.08)])
    turn = Rotation.from_euler("ZYX", [camera.yaw, camera.pitch, camera.roll]).as_matrix() @ FROM_OPTICAL
    optical = (top - [camera.x, camera.y, camera.z]) @ turn
    optical[:, :2] += 0.002 * optical[:, 2:] * rng.standard_normal((COUNT, 2))
    seen = joined([detection(face.id, np.eye(4)) for _ in range(COUNT)])
    seen["position"] = optical
    distance = np.linalg.norm(top - [anchor.x, anchor.y, anchor.z], axis=1)
    none = np.zeros(COUNT, dtype=np.uint64)
    recording = Recording(
        "bag",
        NO_ODOMETRY,
        DetectionRows(np.ones(COUNT, dtype=np.int64), stamp_ns, seen, stamp_ns),
        {},
        ranges=RangeRows(
            np.zeros(COUNT, dtype=np.int64),
            stamp_ns,
            none + np.uint64(anchor.address),
            none,
            distance + 0.05 * rng.standard_normal(COUNT),
            np.zeros(COUNT),
            stamp_ns,
        ),
    )
    swarm = Swarm((Robot("a", faces=(face,), uwb=RADIO),), cameras=(camera,))
    return place_fixed(recording, swarm, at, cameras=True)


@pytest.mark.parametrize("where", ["line", "place"])
@pytest.mark.parametrize(("camera", "anchor"), [(CEILING, HIGH), (WALL, LOW)])
def test_robots_on_a_line_or_at_one_place_place_nothing(
    where: str, camera: FixedCamera, anchor: Anchor
) -> None:
    """All that is turned about this line fits as well."""
    found = placed(where, camera=camera, anchor=anchor)
    assert found.cameras == (camera,)
    assert not found.anchors
    assert [one.partition(", since other places fit as well")[0] for one in found.remarks] == [
        f"Camera {camera.name} stays as it is described",
        f"Anchor {anchor.address:#x} is left out",
    ]


@pytest.mark.parametrize("stamps", [1, COUNT])
def test_errors_are_within_the_sigmas_however_few_the_stamps(stamps: int) -> None:
    """An image of many robots has one stamp."""
    squares = []
    for seed in range(4):
        found = placed("floor", stamps=stamps, seed=seed)
        (one,), (seen,) = found.anchors, found.cameras
        assert np.linalg.norm([seen.x - CEILING.x, seen.y - CEILING.y, seen.z - CEILING.z]) < 0.02
        squares.append(np.hypot(one.x - HIGH.x, one.y - HIGH.y) ** 2 / one.position_sigma**2)
    assert 0.5 < np.mean(squares) < 6.0  # 2 is ideal


def test_an_anchor_beside_a_corridor_is_placed() -> None:
    """Its other side is told by less than a tenth of the length."""
    (one,) = placed("corridor").anchors
    assert np.hypot(one.x - HIGH.x, one.y - HIGH.y) < 0.1
