"""The overhead camera of a simulated world: where robots appear, and that nothing tells them apart."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.scenarios.eight_run import EightSettings, describe
from swarm_loc_drivers.epuck.hardware import wheel_geometry
from swarm_loc_drivers.sim.epuck.world import OVERHEAD, EpuckWorld, EpuckWorldSettings, Exposure
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena, OverheadSettings, overhead_model
from swarm_loc_drivers.sim.render.scene import TOP_HEIGHT, TOP_RADIUS
from swarm_loc_drivers.sim.run import START_NS
from swarm_loc_drivers.sim.scenarios.eight import ARENA, eight_floor
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.detector import AerialDetector
from swarm_loc_vision.aerial.ground_control import AerialSettings, GroundControl

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
