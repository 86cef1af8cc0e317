"""A world's parameters: what follows from them, and what is refused in one sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.scenarios.eight_run import EightSettings, describe
from bench.shared.parameter_table import markdown_table
from swarm_loc_drivers.sim.epuck.world import EpuckWorldParameters, make_world
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.scenarios.eight import EightSteering
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_estimator.common.parameters import ParameterError, parameter_specs
from swarm_loc_estimator.swarm.swarm_file import save_swarm

START = np.array([[0.1, 0.2, 0.3], [0.5, -0.2, 1.0]])


@pytest.fixture
def parameters(tmp_path: Path) -> EpuckWorldParameters:
    save_swarm(describe(EightSettings(robots=2), START), tmp_path / "swarm.yaml")
    return EpuckWorldParameters(
        swarm_file=str(tmp_path / "swarm.yaml"), camera=CameraModel(width=64, height=48), world="w0"
    )


def test_the_page_has_all_parameters() -> None:
    page = Path(__file__).parents[2] / "doc" / "epuck_world_node.md"
    assert markdown_table(EpuckWorldParameters) in page.read_text(encoding="utf-8")


def test_robots_begin_where_the_description_says(parameters: EpuckWorldParameters) -> None:
    swarm, world = make_world(parameters)
    assert [robot.name for robot in swarm.robots] == ["epuck1", "epuck2"]
    np.testing.assert_allclose(world.poses, START)


def test_the_worlds_that_there_are_can_be_chosen() -> None:
    (spec,) = (spec for spec in parameter_specs(EpuckWorldParameters) if spec.name == "world")
    assert [spec.checked(name) for name in WORLDS] == list(WORLDS)
    with pytest.raises(ParameterError, match=r"parameter world = 'w9' must be one of w0, w2, w2fast\."):
        spec.checked("w9")


def test_robots_without_wifi_need_serial_ports(parameters: EpuckWorldParameters) -> None:
    with pytest.raises(ParameterError, match="parameter model = 'epuck1' needs the parameter link_folder"):
        make_world(replace(parameters, model="epuck1"))


def test_a_family_without_a_markers_id_is_named(parameters: EpuckWorldParameters) -> None:
    save_swarm(describe(EightSettings(robots=2), START, first_face_id=250), Path(parameters.swarm_file))
    with pytest.raises(ParameterError, match=r"parameter family = 'aruco_mip_36h12': .* has ids 0 to 249"):
        make_world(replace(parameters, family="aruco_mip_36h12"))


def test_a_robot_without_a_start_is_named(parameters: EpuckWorldParameters) -> None:
    save_swarm(describe(EightSettings(robots=2, start_known=False), START), Path(parameters.swarm_file))
    with pytest.raises(ParameterError, match=r"parameter swarm_file = .* robot 'epuck1' has no start pose"):
        make_world(parameters)


def test_the_cameras_parameters_are_among_the_worlds() -> None:
    names = {spec.name for spec in parameter_specs(EpuckWorldParameters)}
    assert {"exposure_s", "width", "k1", "rate", "first_port"} <= names


def test_steering_brings_a_robot_back_onto_the_eight() -> None:
    steering = EightSteering(2, 0.06)
    pose = np.array([0.63, -0.01, 1.3])
    step_ns = 50_000_000
    for step in range(400):
        speed, _, turn_rate = steering.command(0, 10**12 + step * step_ns, pose)
        heading = pose[2] + 0.5 * 0.05 * turn_rate
        pose = pose + 0.05 * np.array([speed * np.cos(heading), speed * np.sin(heading), turn_rate])
    r2 = float(pose[:2] @ pose[:2])
    assert abs(r2**2 - 0.36 * (pose[0] ** 2 - pose[1] ** 2)) < 2e-3
    assert speed == pytest.approx(0.06, rel=0.05)
