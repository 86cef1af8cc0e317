"""How a benchmark counts what cameras saw, and which poses it judges."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from bench.epuck.views import Views
from swarm_loc_drivers.sim.epuck.world import Exposure
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    DetectionArrayMessage,
    decode_detections,
    encode_detections,
)
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

seen = pytest.importorskip("bench.epuck.seen", exc_type=ImportError)
rendered = pytest.importorskip("bench.epuck.rendered", exc_type=ImportError)
report = pytest.importorskip("bench.epuck.rendered_report", exc_type=ImportError)

SQUARE = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]])
SECOND = 10**9


def views(count: int = 4) -> Views:
    """Markers 1, 2, ... of 20 px side by side, all clear."""
    corners = SQUARE + np.array([[[100.0 * k, 50.0]] for k in range(count)])
    clear = np.full(count, 30.0), np.zeros(count), np.zeros(count, bool)
    return Views(np.arange(1, count + 1, dtype=np.uint32), corners, *clear)


def test_only_markers_that_can_be_seen_well_count() -> None:
    some = views(5)
    some.margin[1], some.incidence[2], some.hidden[3] = 2.0, math.radians(75.0), True
    some.corners[4] = 0.4 * SQUARE
    assert seen.is_visible(some).tolist() == [True, False, False, False, False]


def test_a_detection_counts_where_its_marker_is() -> None:
    detections = np.zeros(3, DETECTION_DTYPE)
    detections["id"] = [1, 2, 77]
    for row, shift in enumerate((3.0, 200.0, 0.0)):
        detections["corners_px"][row] = (views().corners[min(row, 1)] + shift).reshape(
            detections["corners_px"][row].shape
        )
    assert seen._matched(views(), detections).tolist() == [True, False, False]


class Camera:
    """Stands for a world whose cameras take ten pictures a second and see one marker."""

    PERIOD_NS = SECOND // 10
    rig = None

    def exposure_of(self, robot: int, stamp_ns: int) -> Exposure:
        """See `EpuckWorld`."""
        number = round(stamp_ns / self.PERIOD_NS)
        return Exposure(robot, number, number * self.PERIOD_NS, number * self.PERIOD_NS)


@pytest.mark.parametrize(("last", "lost"), [(600, 0), (598, 0), (596, 1), (12, 585), (0, 597)])
def test_pictures_of_which_nothing_is_heard_are_lost_however_long_it_lasts(
    monkeypatch: pytest.MonkeyPatch, last: int, lost: int
) -> None:
    """The robots drive for a minute, and detections come until the last one."""
    stamps = np.arange(0, 60 * SECOND + 1, SECOND // 20)
    track = Trajectory(stamps + SECOND // 20, np.zeros((len(stamps), 3)))
    live = SimpleNamespace(swarm=Swarm((Robot("r"),)), truth={"r": track})
    messages = [
        DetectionArrayMessage(number * Camera.PERIOD_NS, "r/camera", np.zeros(0, DETECTION_DTYPE))
        for number in range(1, last + 1)
    ]
    run = SimpleNamespace(
        seen={"r": messages}, live=live, begin_ns=SECOND // 20, end_ns=60 * SECOND + SECOND // 20
    )
    monkeypatch.setattr(seen, "views_of", lambda *_: views(1))
    frames, missing, *others = seen._of_robot(run, Camera(), 0, "r").tolist()
    assert (frames, missing, others) == (597, lost, [0, 597 - lost, 0, 0])


def test_detections_without_their_noise_are_else_the_same() -> None:
    detections = np.zeros(2, DETECTION_DTYPE)
    detections["id"], detections["position"] = [3, 4], [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]
    detections["covariance"] = np.eye(6)
    again = decode_detections(rendered._without_noise(encode_detections("a/camera", 7 * SECOND, detections)))
    assert (again.stamp_ns, again.frame_id) == (7 * SECOND, "a/camera")
    np.testing.assert_array_equal(again.detections["position"], detections["position"])
    assert (again.detections["covariance"][:, 0, 0] == -1.0).all()


def test_errors_are_those_of_ten_poses_a_second_in_a_stretch_of_time() -> None:
    stamps = np.arange(0, 4 * SECOND + 1, SECOND // 20)
    pose = np.zeros((len(stamps), 1, 3))
    pose[:, 0, 0] = np.where(stamps < 2 * SECOND, 1.0, 0.25)
    pose[1::2] = 9.0
    truth = Trajectory(stamps, np.zeros((len(stamps), 3)))
    result = ReplayResult(
        "x",
        Swarm((Robot("r"),)),
        stamps,
        pose,
        np.tile(np.eye(3), (len(stamps), 1, 1, 1)),
        np.ones((len(stamps), 1), dtype=np.uint8),
        {"r": truth},
        heading_known=np.ones((len(stamps), 1), dtype=bool),
    )
    summary = report.errors_within(result, 2 * SECOND, 3 * SECOND)
    assert (summary.count, summary.position_mean) == (11, pytest.approx(0.25))
