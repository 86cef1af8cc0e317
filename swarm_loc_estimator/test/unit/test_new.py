"""`new` writes descriptions that load, for all types and sensors, by options or by answers."""

import io
from itertools import combinations
from pathlib import Path

import pytest

from swarm_loc_estimator.cli.graph import check_graph
from swarm_loc_estimator.cli.new import main
from swarm_loc_estimator.common.launch import GraphOptions
from swarm_loc_estimator.common.yaml_tree import read_tree
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.new_swarm import (
    FAMILY_IDS,
    KNOWN_ROBOTS,
    SENSORS,
    PlanError,
    SwarmPlan,
    planned_swarm,
)
from swarm_loc_estimator.swarm.schema import schema_text
from swarm_loc_estimator.swarm.swarm_file import SCHEMA_FILE, load_swarm


def sensor_sets(name: str) -> list[tuple[str, ...]]:
    known = KNOWN_ROBOTS[name].sensors
    sets = [some for count in (1, 2) for some in combinations(known, count)]
    sets += [known[:k] + known[k + 1 :] for k in range(len(known))]
    return [some for some in dict.fromkeys(sets) if some and len({"mapper", "fix", "mocap"} & set(some)) < 2]


def answer(monkeypatch: pytest.MonkeyPatch, *answers: str) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("".join(f"{one}\n" for one in answers)))


@pytest.mark.parametrize("name", KNOWN_ROBOTS)
def test_every_type_with_all_its_sensors_loads(tmp_path: Path, name: str) -> None:
    for sensors in sensor_sets(name):
        path = tmp_path / f"{'_'.join(sensors)}.yaml"
        options = ["--type", name, "--robots", "2", "--sensors", ",".join(sensors)]
        options += ["--pitch", "2"] if "landmarks" in sensors else []
        assert main([str(path), "--yes", *options]) == 0
        swarm = load_swarm(path)
        odometry = KNOWN_ROBOTS[name].odometry or OdometryModel()
        assert [robot.odometry for robot in swarm.robots] == [odometry] * 2
        assert len(swarm.landmarks) == (4 if "landmarks" in sensors else 0)
        assert len(swarm.anchors) == (4 if "uwb" in sensors else 0)
        assert [one.name for one in swarm.cameras] == ["ceiling1", "ceiling2"] * ("ceiling" in sensors)
        assert (swarm.map is not None) == ("map" in sensors)
        assert (swarm.localizer is not None) == ("mocap" in sensors)
        for robot in swarm.robots:
            assert bool(robot.faces) == bool({"robots", "ceiling"} & set(sensors))
            assert robot.lidar.is_used == bool({"lidar", "map"} & set(sensors))
            assert (robot.uwb is not None) == ("uwb" in sensors)
            assert (robot.camera is not None) == bool({"robots", "landmarks"} & set(sensors))
            assert robot.imu.is_used == ("imu" in sensors)
            assert (robot.fix.position_sigma > 0.0) == ("fix" in sensors)
            assert robot.fix.systematic_share == ("mapper" in sensors)
            assert (robot.ir is not None) == (name == "droplet")
            assert robot.stands == robot.random_walk.moves == (name in ("kilobot", "dotbot", "crazyflie"))
            assert {face.size for face in robot.faces} <= {KNOWN_ROBOTS[name].marker_size}


def test_every_sensor_belongs_to_a_type() -> None:
    assert {sensor for known in KNOWN_ROBOTS.values() for sensor in known.sensors} == set(SENSORS)


def test_the_file_says_what_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "fleet" / "swarm.yaml"
    assert main([str(path), "--yes", "--type", "turtlebot4", "--family", "apriltag_36h11"]) == 0
    text = path.read_text(encoding="utf-8")
    assert text.startswith(f"# yaml-language-server: $schema={SCHEMA_FILE}\n# 5 x TurtleBot 4, located by")
    assert "apriltag_36h11" in text
    assert "Create 3" in text
    assert (path.parent / SCHEMA_FILE).read_text(encoding="utf-8") == schema_text()
    assert [robot.name for robot in load_swarm(path).robots][:2] == ["turtlebot4_1", "turtlebot4_2"]
    said = capsys.readouterr().out
    assert "-r image_raw:=oakd/rgb/preview/image_raw" in said
    assert f"./run swarm_loc_estimator graph {path} --watch" in said


def test_answers_on_standard_input_make_the_description(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answer(
        monkeypatch,
        *("own", "3", "rover", "robots,landmarks,imu", "0.2", "apriltag_36h11"),
        *("0.08", "4x2", "1", "0.12"),
    )
    assert main([str(tmp_path / "swarm.yaml")]) == 0
    swarm = load_swarm(tmp_path / "swarm.yaml")
    assert [robot.name for robot in swarm.robots] == ["rover1", "rover2", "rover3"]
    assert {robot.odometry.wheel_separation for robot in swarm.robots} == {0.2}
    assert {face.size for robot in swarm.robots for face in robot.faces} == {0.08}
    assert {mark.size for mark in swarm.landmarks} == {0.12}
    assert [(mark.x, mark.y) for mark in swarm.landmarks[:5]] == [
        *((-1.5, -1.0), (-0.5, -1.0), (0.5, -1.0), (1.5, -1.0)),
        (2.0, -0.5),
    ]
    assert len(swarm.landmarks) == 12
    assert SENSORS["imu"] in capsys.readouterr().out


def test_wrong_answers_are_asked_again_with_those_that_are_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answer(
        monkeypatch,
        *("epuk", "epuck", "0", "many", "2", "2 robots", "e", "infrared", "landmarks"),
        *("qr", "", "wide", "0.01x2", "", "0", "", "", "never read"),
    )
    assert main([str(tmp_path / "swarm.yaml")]) == 0
    said = capsys.readouterr().out
    for sentence in (
        f"'epuk' must be one of {', '.join(KNOWN_ROBOTS)}.",
        "0 must be a number in [1, 5000].",
        "many must be a number in [1, 5000].",
        "'2 robots' must be at most 60 letters, digits and underscores and start with a letter.",
        "'infrared' must be of robots, landmarks, aerial, fix, ceiling, mocap.",
        f"'qr' must be one of {', '.join(FAMILY_IDS)}.",
        "'wide' must be two lengths in [0.1, 1000] m, such as 2.4x1.6.",
        "'0.01x2' must be two lengths in [0.1, 1000] m, such as 2.4x1.6.",
        "0 must be a number in [0.01, 100] m.",
    ):
        assert sentence in said
    assert [robot.name for robot in load_swarm(tmp_path / "swarm.yaml").robots] == ["e1", "e2"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--robots", "0"], "--robots: 0 must be a number in [1, 5000]."),
        (["--type", "tank"], "--type: 'tank' must be one of epuck,"),
        (["--sensors", "imu"], "--sensors: 'imu' must be of robots, landmarks, aerial, fix, ceiling, mocap."),
        (["--type", "pushbot", "--sensors", "mapper,fix"], "mapper and fix publish on the same topic"),
        (["--robots", "100", "--family", "aruco_mip_36h12"], "The swarm needs 520 markers, but"),
        (["--arena", "1x"], "--arena: '1x' must be two lengths"),
        (
            ["--wheel-separation", "0.2"],
            "--wheel-separation has no meaning for robots of the type epuck located by robots, landmarks.",
        ),
        (["--sensors", "fix", "--size", "0.1"], "--size has no meaning for robots of the type epuck"),
        (["--sensors", "robots", "--arena", "1x2"], "--arena has no meaning"),
        (["--sensors", "robots", "--pitch", "1"], "--pitch has no meaning"),
        (["--sensors", "aerial", "--landmark-size", "1"], "--landmark-size has no meaning"),
    ],
)
def test_wrong_options_end_with_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    assert main([str(tmp_path / "swarm.yaml"), "--yes", *options]) == 1
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "swarm.yaml").write_text("mine")
    assert main([str(tmp_path / "swarm.yaml"), "--yes"]) == 1
    assert capsys.readouterr().err == f"{tmp_path / 'swarm.yaml'} exists and is not overwritten.\n"
    assert (tmp_path / "swarm.yaml").read_text() == "mine"


def test_answers_that_end_too_early_are_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answer(monkeypatch, "epuck", "3")
    assert main([str(tmp_path / "swarm.yaml")]) == 1
    assert "There are no more answers on standard input" in capsys.readouterr().err


@pytest.mark.parametrize("family", FAMILY_IDS)
@pytest.mark.parametrize("robots", [1, 9, 20, 46, 113, 1000, 5000])
def test_ids_are_in_the_family_and_landmarks_above_all_others(family: str, robots: int) -> None:
    plan = SwarmPlan("epuck", robots, "e", ("robots", "landmarks"), family=family)
    if 5 * robots + 20 > FAMILY_IDS[family]:
        with pytest.raises(PlanError):
            planned_swarm(plan)
        return
    swarm = planned_swarm(plan)
    faces = [face.id for robot in swarm.robots for face in robot.faces]
    marks = [mark.id for mark in swarm.landmarks]
    assert len(faces + marks) == len(set(faces + marks)) == 5 * robots + 20
    assert max(faces) < min(marks) < max(marks) < FAMILY_IDS[family]
    if robots <= 9 and FAMILY_IDS[family] >= 250:
        assert faces[0] == 10
        assert min(marks) == 100


def test_turtlebots_get_a_launch_file_and_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two TurtleBot 4s by their lidars, cameras and motion capture."""
    path = tmp_path / "swarm.yaml"
    options = ["--type", "turtlebot4", "--robots", "2", "--sensors", "robots,map,ceiling,mocap"]
    assert main([str(path), "--yes", "--map", str(tmp_path / "floor.yaml"), *options]) == 0
    assert load_swarm(path).map == tmp_path / "floor.yaml"
    parameters = tmp_path / "swarm_params.yaml"
    assert read_tree(parameters) == {"/**/estimator": {"ros__parameters": {"tf_per_robot": True}}}
    include, *nodes = read_tree(tmp_path / "swarm.launch.yaml")["launch"]
    given = {one["name"]: one["value"] for one in include["include"]["arg"]}
    assert given == {"swarm_file": str(path), "watch": "true", "params_file": str(parameters)}
    check_graph(GraphOptions(str(path), parameter_file=str(parameters)))
    arguments = [one["node"]["ros_args"] for one in nodes]
    remaps = [f"-r {name}:=oakd/rgb/preview/{name}" for name in ("image_raw", "camera_info")]
    assert [one.partition(" -p ")[0] for one in arguments if "robot:=turtlebot4_" in one] == [
        " ".join([f"-r __ns:=/turtlebot4_{k}", *remaps]) for k in (1, 2)
    ]
    assert sorted(one["node"]["exec"] for one in nodes) == ["localizer_bridge", *["marker_detector_node"] * 4]
    said = capsys.readouterr().out
    assert f"graph {path} --watch --params-file {parameters}" in said
    assert f"ros2 launch {tmp_path / 'swarm.launch.yaml'}" in said
