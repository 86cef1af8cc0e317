"""Where markers are said to lie in images, against what the marker detector finds there."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.epuck.views import views_of
from swarm_loc_drivers.epuck.hardware import wheel_geometry
from swarm_loc_drivers.sim.epuck.world import EpuckWorld, EpuckWorldSettings
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena
from swarm_loc_drivers.sim.scenarios.eight import ARENA, FACE_DISTANCE, EightSettings, describe
from swarm_loc_drivers.sim.worlds import W2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import family_named

FAMILY = family_named("artoolkit_bch_thin")
CAMERA = CameraModel(k1=-0.2, k2=0.05)
STILL = replace(W2, exposure_early_s=0.0)
BESIDE = np.array([[-0.6, 0.0, 0.1], [0.0, 0.1, 2.0], [-0.1, -0.25, -1.0]])


def world_at(poses: FloatArray, camera: CameraModel = CAMERA) -> EpuckWorld:
    settings = EpuckWorldSettings(
        3, STILL, Arena(ARENA, FAMILY), camera, wheel_geometry(0.041, 0.053), 7.5, 10**12
    )
    return EpuckWorld(describe(EightSettings(robots=len(poses)), poses), settings)


def test_markers_lie_where_the_detector_finds_them() -> None:
    world = world_at(BESIDE)
    while not (taken := [one for one in world.step() if one.robot == 0]):
        pass
    camera = CAMERA.camera
    found = MarkerDetector(DetectorSettings(), {FAMILY: None}, camera).detect(world.image(taken[0]))
    views = views_of(world.rig, 0, BESIDE)
    clear = (views.margin > 4.0) & ~views.hidden & (views.incidence < 1.2) & (views.side_px > 12.0)
    assert clear.sum() >= 6
    assert set(views.id[clear].tolist()) <= set(found.id.tolist())
    place = {int(one): k for k, one in enumerate(views.id)}
    for marker, corners in zip(found.id.tolist(), found.corners, strict=True):
        assert np.abs(corners - views.corners[place[marker]]).max() < 0.3, marker


@pytest.mark.parametrize("heading", np.linspace(-3.0, 3.0, 7))
def test_a_lens_does_not_bring_into_the_picture_what_is_far_beside_it(heading: float) -> None:
    poses = np.array([[0.1, -0.2, heading], [-1.0, 0.6, 0.0]])
    bent, wide = (
        views_of(world_at(poses, camera).rig, 0, poses)
        for camera in (CameraModel(k1=-0.3), CameraModel(field_of_view=math.radians(100.0)))
    )
    seen = set(bent.id[bent.margin > 0.0].tolist())
    assert seen
    assert seen <= set(wide.id[wide.margin > 0.0].tolist())


def test_a_robot_hides_what_is_behind_it_but_not_its_own_faces() -> None:
    start = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, math.pi]])
    world = world_at(start)
    landmarks = describe(EightSettings(robots=2), start).landmarks
    target = min(landmarks, key=lambda mark: math.hypot(mark.x - 1.2, mark.y - 0.2))
    between = 0.6 * np.array([target.x, target.y])
    before = np.array([start[0], [*between, 0.5]])
    views = views_of(world.rig, 0, before)
    free = views_of(world.rig, 0, start + np.array([[0.0] * 3, [0.0, 0.5, 0.0]]))
    assert views.hidden[views.id == target.id].tolist() == [True]
    assert free.hidden[free.id == target.id].tolist() == [False]
    faces = (views.id >= 20) & (views.id < 25)
    assert 1 <= faces.sum() <= 3
    assert not views.hidden[faces].any()
    assert not np.isin(range(10, 15), views.id).any()  # no camera sees its own robot


def test_size_and_incidence_are_those_of_the_plane_geometry() -> None:
    start = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    swarm = describe(EightSettings(robots=2), start)
    exact = replace(
        STILL, camera_yaw_sigma=0.0, scale_sigma=0.0, map_position_sigma=0.0, face_position_sigma=0.0
    )
    settings = EpuckWorldSettings(
        3, exact, Arena(ARENA, FAMILY), CameraModel(), wheel_geometry(0.041, 0.053), 7.5, 10**12
    )
    views = views_of(EpuckWorld(swarm, settings).rig, 0, start)
    back = views.id == 22
    assert views.incidence[back] == pytest.approx(0.0, abs=1e-6)
    distance = 0.5 - FACE_DISTANCE - 0.03
    size = swarm.robots[1].faces[2].size
    assert views.side_px[back] == pytest.approx(CameraModel().camera.fx * size / distance, rel=1e-6)
    assert views.margin[back] > 0.0
