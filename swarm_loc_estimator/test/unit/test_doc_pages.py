"""Pages of the documentation: commands, tables and examples are right."""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.shared.parameter_table import markdown_table
from swarm_loc_estimator import load_swarm as load_swarm_examples
from swarm_loc_estimator.cli import (
    calibrate,
    calibrate_ir,
    import_mrclam,
    new,
    replay,
    replay_map,
    survey,
    sweep,
    watch,
)
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.command_line import parameters_of
from swarm_loc_estimator.common.messages.cdr import IMU, encode
from swarm_loc_estimator.common.messages.poses import decode_pose_stamped
from swarm_loc_estimator.common.parameters import (
    ParameterError,
    ParameterSpec,
    choice,
    from_values,
    number_specs,
    parameter_specs,
)
from swarm_loc_estimator.filter.models import MODELS as MODELS_TUTORIALS
from swarm_loc_estimator.nodes.parameters import (
    EstimatorParameters,
    MapperParameters,
    MarkersParameters,
    PlayerParameters,
    WatchParameters,
)
from swarm_loc_estimator.offline.replay import replay as replay_tutorials
from swarm_loc_estimator.offline.sweep.sweep import FIGURES, KEYS, MINIMIZED, read_sweep
from swarm_loc_estimator.sensors.inputs import SENSORS as SENSORS_TUTORIALS
from swarm_loc_estimator.sensors.localizers import BridgeParameters
from swarm_loc_estimator.swarm.new_swarm import KNOWN_ROBOTS, SENSORS
from swarm_loc_estimator.swarm.swarm import Anchor, Face, FixedCamera, Landmark, MapError, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import MODELS, load_swarm
from swarm_loc_estimator.timeline.settings import Settings

DOC = Path(__file__).parents[2] / "doc"
SWARM_DESCRIPTION = (DOC / "swarm_description.md").read_text(encoding="utf-8")
NEW_SWARM = (DOC / "new_swarm.md").read_text(encoding="utf-8")
COMMANDS = (DOC / "commands.md").read_text(encoding="utf-8")


def table_of(cls: type, *required: str) -> str:
    lines = ["| Key | Default | Range | Meaning |", "|---|---|---|---|"]
    given = {f.name: f.default for f in fields(cls) if f.name in number_specs(cls)}
    defaults = {name: "null" if value is None else f"{value:g}" for name, value in given.items()}
    for name, spec in number_specs(cls).items():
        default = "required" if name in required else f"`{defaults[name]}`"
        lines.append(f"| `{name}` | {default} | {spec.range_text} | {spec.doc} |")
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("page", "cls", "required"),
    [
        *(("swarm_description.md", cls, ()) for cls in (*MODELS.values(), Face, MapError)),
        ("swarm_description.md", Landmark, ("x", "y")),
        ("swarm_description.md", FixedCamera, ("x", "y", "z")),
        ("uwb.md", UwbDevice, ()),
        ("uwb.md", Anchor, ("x", "y")),
    ],
)
def test_every_number_has_its_place(page: str, cls: type, required: tuple[str, ...]) -> None:
    assert table_of(cls, *required) in (DOC / page).read_text(encoding="utf-8")


def test_the_example_with_all_sections_is_a_swarm(tmp_path: Path) -> None:
    example = re.findall(r"```yaml\n(.*?)```", SWARM_DESCRIPTION, re.DOTALL)[-1]
    (tmp_path / "swarm.yaml").write_text(example, encoding="utf-8")
    swarm = load_swarm(tmp_path / "swarm.yaml")
    assert [robot.type for robot in swarm.robots] == ["epuck", "droplet"]
    assert len(swarm.landmarks) == len(swarm.cameras) == len(swarm.anchors) == 1
    assert swarm.range_topic
    assert swarm.map == tmp_path / "floor.yaml"


def test_the_example_of_overhead_cameras_is_a_swarm(tmp_path: Path) -> None:
    page = (DOC / "overhead_cameras.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "swarm.yaml").write_text(example, encoding="utf-8")
    swarm = load_swarm(tmp_path / "swarm.yaml")
    assert [camera.name for camera in swarm.cameras] == ["ceiling1", "ceiling2"]
    assert all(face.lies for robot in swarm.robots for face in robot.faces)


def test_the_page_of_sweeps_has_all_keys_and_columns_and_its_examples_are_sweeps(tmp_path: Path) -> None:
    page = (DOC / "sweep.md").read_text(encoding="utf-8")
    assert [key for key in KEYS if f"| `{key}` |" not in page] == []
    assert [column for column in FIGURES if f"`{column}`" not in page] == []
    assert [key for key in (*MINIMIZED, "trials", "ranges", "minimize") if f"`{key}`" not in page] == []
    (tmp_path / "bags").symlink_to(DOC.parents[1] / "bags")
    read = []
    for example in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL):
        (tmp_path / "sweep.yaml").write_text(example, encoding="utf-8")
        read.append(read_sweep(tmp_path / "sweep.yaml"))
    grid, fit = read
    assert f"makes {len(grid.jobs)} replays" in page
    assert fit.fit is not None


@pytest.mark.parametrize(
    "command", [new, replay, replay_map, calibrate, calibrate_ir, import_mrclam, survey, sweep, watch]
)
def test_every_option_of_a_command_has_its_place(command: object, capsys: pytest.CaptureFixture[str]) -> None:
    main: Callable[[list[str]], int] = command.main  # type: ignore[attr-defined]
    with pytest.raises(SystemExit):
        main(["--help"])
    options = set(re.findall(r"(?<!\S)\[?--([a-z-]+)", capsys.readouterr().out)) - {"help"}
    assert {option for option in options if f"`--{option}" not in COMMANDS} == set()


def test_types_and_sensors_of_new_descriptions_have_their_place() -> None:
    assert [word for word in (*KNOWN_ROBOTS, *SENSORS) if f"`{word}`" not in NEW_SWARM] == []
    for word, said in SENSORS.items():
        row = next(line for line in NEW_SWARM.splitlines() if line.startswith(f"| `{word}` | "))
        assert re.sub(r"\[(.*?)\]\(.*?\)", r"\1", row).replace("`", "") == f"| {word} | {said} |"


ROOT = Path(__file__).parents[3]
PAGE = ROOT / "swarm_loc_estimator" / "doc" / "tutorials.md"
BAG = ROOT / "bags" / "eight_one_robot_fast"


@pytest.fixture
def compass() -> Iterator[dict[str, Any]]:
    """The names of the tutorial's code, whose sensor is known during a test."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)  # noqa: S102
    yield names
    del MODELS_TUTORIALS[SENSORS_TUTORIALS.pop("compass").model]


def with_compass(folder: Path, sigma: float) -> Path:
    """The bag with messages of a compass beside each true pose, and some that are not finite."""
    rng = np.random.default_rng(1)
    with BagReader(BAG) as reader, BagWriter(folder) as writer:
        robot = load_swarm(BAG / "swarm.yaml").robots[0].name
        for topic in reader.topics:
            writer.add_topic(topic.name, topic.type)
        writer.add_topic(f"{robot}/compass", IMU)
        for number, (name, _, log_ns, data) in enumerate(reader.messages()):
            writer.write(name, log_ns, bytes(data))
            if not name.endswith("/ground_truth"):
                continue
            truth = decode_pose_stamped(bytes(data))
            half = 0.5 * (truth.pose[2] + sigma * rng.standard_normal())
            orientation = {"z": np.sin(half), "w": np.cos(half) if number % 50 else np.nan}
            message = {"header": {"stamp": truth.stamp_ns, "frame_id": "map"}, "orientation": orientation}
            writer.write(f"{robot}/compass", log_ns, encode(message, IMU))
    return folder


def test_the_sensor_of_the_tutorial_improves_headings(tmp_path: Path, compass: dict[str, Any]) -> None:
    swarm = load_swarm(BAG / "swarm.yaml")
    bag = with_compass(tmp_path / "bag", compass["SIGMA"])
    before, after = replay_tutorials(BAG, swarm), replay_tutorials(bag, swarm)
    assert after.counters["messages on <robot>/compass"] > 1000
    assert after.counters["compass_non_finite"] > 3
    assert after.counters["measurements used"] > before.counters["measurements used"] + 1000
    assert after.overall.heading_rmse < 0.85 * before.overall.heading_rmse
    assert 1.0 < after.overall.nees < 4.5


@pytest.mark.parametrize(
    ("page", "cls"),
    [
        ("estimator_node.md", EstimatorParameters),
        ("motion_capture.md", BridgeParameters),
        ("play.md", PlayerParameters),
        ("mapper_node.md", MapperParameters),
        ("watch.md", WatchParameters),
        ("watch.md", MarkersParameters),
    ],
)
def test_the_page_says_what_the_table_says(page: str, cls: type) -> None:
    assert markdown_table(cls) in (DOC / page).read_text(encoding="utf-8")


def test_defaults_make_the_default_object() -> None:
    defaults = {spec.name: spec.default for spec in parameter_specs(EstimatorParameters)}
    assert from_values(EstimatorParameters, defaults) == EstimatorParameters()


def test_every_setting_of_the_estimator_is_a_parameter() -> None:
    names = {spec.name for spec in parameter_specs(EstimatorParameters)}
    public = {field.name for field in fields(Settings) if not field.metadata.get("is_internal")}
    assert public <= names


def test_settings_from_texts_are_whole_numbers_where_the_setting_is_one() -> None:
    read = parameters_of(Settings, ["horizon_s=3", "lost_after=5"])
    assert (read.horizon_s, type(read.horizon_s), read.lost_after, type(read.lost_after)) == (
        3.0,
        float,
        5,
        int,
    )
    for pair, said in (
        ("lost_after=2.9", r"parameter lost_after = '2\.9' must be a whole number"),
        ("horizon_s=x", "parameter horizon_s = 'x' must be a number"),
        ("horizon_s=1e9", r"parameter horizon_s = 1000000000\.0 must lie in \[0\.05, 60\] s"),
        ("nothing=1", "--set nothing=1: 'nothing' is no parameter; there are horizon_s, "),
    ):
        with pytest.raises(ParameterError, match=said):
            parameters_of(Settings, [pair])
    with pytest.raises(ParameterError, match="'loop' is no parameter"):
        parameters_of(PlayerParameters, ["loop=true"], {"bag": "x", "loop": True})
    assert parameters_of(PlayerParameters, ["loop=true", "topics=a,b"], {"bag": "x"}) == PlayerParameters(
        bag="x", loop=True, topics=("a", "b")
    )
    with pytest.raises(ParameterError, match=r"lost_after = 2\.9 must be a whole number"):
        spec_of(EstimatorParameters, "lost_after").checked(2.9)


def spec_of(cls: type, name: str) -> ParameterSpec:
    (spec,) = [spec for spec in parameter_specs(cls) if spec.name == name]
    return spec


def test_whole_numbers_will_do_for_real_ones_but_not_the_other_way_round() -> None:
    rate = spec_of(PlayerParameters, "rate").checked(4)
    assert (rate, type(rate)) == (4.0, float)
    with pytest.raises(ParameterError, match=r"wait_for_subscribers = 4\.0 must be a whole number"):
        spec_of(PlayerParameters, "wait_for_subscribers").checked(4.0)
    with pytest.raises(ParameterError, match="rate = True must be a number"):
        spec_of(PlayerParameters, "rate").checked(True)


def test_lists_come_as_lists_or_tuples() -> None:
    topics = spec_of(PlayerParameters, "topics")
    assert topics.checked(["a", "b"]) == topics.checked(("a", "b")) == ("a", "b")
    with pytest.raises(ParameterError, match="topics = 'a' must be a list of texts"):
        topics.checked("a")


@dataclass(frozen=True)
class Choosing:
    """One parameter."""

    colour: str = choice("red", ("red", "blue"), "of the wall")


def test_a_choice_is_one_of_its_texts() -> None:
    colour = spec_of(Choosing, "colour")
    assert colour.checked("blue") == "blue"
    for wrong in ("", "green"):
        with pytest.raises(ParameterError, match=f"parameter colour = '{wrong}' must be one of red, blue"):
            colour.checked(wrong)
    assert '| `colour` | `"red"` | red, blue | of the wall |' in markdown_table(Choosing)


EXAMPLES = ROOT / "swarm_loc_estimator" / "examples"
BAG_EXAMPLES = ROOT / "bags" / "eight_five_robots"
PNG = b"\x89PNG\r\n"


@pytest.fixture
def printed(request: pytest.FixtureRequest, tmp_path: Path) -> list[str]:
    """The lines that the example of a test's parameter prints in an empty folder."""
    name, *arguments = request.param
    found = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (found.returncode, found.stderr) == (0, "")
    return found.stdout.splitlines()


def run(name: str, *arguments: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("printed", [(name, *arguments)], ids=[name], indirect=True)


def columns_of(lines: list[str]) -> list[list[float]]:
    return [[float(one) for one in re.findall(r"-?\d+(?:\.\d+)?", line)] for line in lines]


def test_all_examples_are_tested_and_short() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES.glob("*.py"):
        assert f'@run("{path.name}"' in here
        assert 15 <= len(path.read_text(encoding="utf-8").splitlines()) <= 95, path.name


@run("replay_and_plot.py", str(BAG_EXAMPLES), "paths.png")
def test_a_replay_is_within_its_errors_and_drawn(printed: list[str], tmp_path: Path) -> None:
    head, *rows, picture = printed
    assert re.findall(r"\w+ \[\w+\]", head) == ["position [m]", "heading [deg]"]
    assert [row.split()[0] for row in rows] == [*(f"epuck{k}" for k in range(1, 6)), "all"]
    position, heading, nees = np.array([row.split()[1:] for row in rows], dtype=float).T
    assert 0.001 < position.min() <= position.max() < 0.005  # [m]
    assert heading.max() < 2.0
    assert 1.0 < nees[-1] < 4.0  # ideally 3
    assert picture == "picture: paths.png"
    assert (tmp_path / "paths.png").read_bytes().startswith(PNG)


@run("survey_landmarks.py", str(BAG_EXAMPLES))
def test_a_survey_finds_all_landmarks_as_well_as_it_says(printed: list[str]) -> None:
    _, *rows, last = printed
    described = load_swarm_examples(BAG_EXAMPLES / "swarm.yaml").landmarks
    found = np.array([row.split() for row in rows], dtype=float)
    assert found[:, 0].tolist() == sorted(mark.id for mark in described)
    places = np.array([[mark.x, mark.y] for mark in sorted(described, key=lambda mark: mark.id)])
    away = np.hypot(*(found[:, 1:3] - places).T)
    np.testing.assert_allclose(found[:, 4], away, atol=1e-3)  # coordinates have three digits
    assert (away < 3.0 * found[:, 3]).all()
    assert found[:, 3].max() < 0.015  # [m]
    assert last.startswith("20 of 20 landmarks, RMS 0.00")


@run("sweep_settings.py", str(BAG_EXAMPLES))
def test_a_sweep_shows_what_a_short_horizon_costs(printed: list[str]) -> None:
    horizon, lost, position, _, nees, too_old = np.array(columns_of(printed[1:])).T
    assert [*zip(horizon, lost, strict=True)] == [(0.1, 0.0), (0.1, 50.0), (2.0, 0.0), (2.0, 50.0)]
    assert (too_old > 0).tolist() == [True, True, False, False]  # detections arrive 0.15 to 0.3 s late
    assert position[:2].min() > 10.0 * position[2:].max()
    assert position[2] < position[3] < 6.0  # [mm]
    assert ((nees > 1.0) & (nees < 4.0)).all()


@run("online_from_arrays.py")
def test_an_estimator_steps_with_arrays_of_all_sensors(printed: list[str]) -> None:
    seconds, error, sigma, *_ = np.array([row[:3] for row in columns_of(printed)]).T
    assert seconds.tolist() == [*range(5, 61, 5)]
    assert np.sqrt(np.mean(np.square(error / sigma))) < 2.0
    assert error.max() < 10.0  # [cm], of ranges with 5 cm; wheels alone are wrong by 0.24 m
    gated = [int(one) for one in re.findall(r"'gated': (\d+)", "\n".join(printed))]
    assert sum(gated) < 5  # one of a thousand good ones, of 1200 ranges
    assert set(re.findall(r"'(\w+)'", "\n".join(printed))) <= {"gated"}


@run("own_sensor.py")
def test_a_sensor_of_ones_own_bounds_the_error_of_wheels(printed: list[str]) -> None:
    seconds, error, sigma, *_ = np.array([row[:3] for row in columns_of(printed)]).T
    assert seconds.tolist() == [*range(1, 21)]
    assert np.sqrt(np.mean(np.square(error / sigma))) < 2.0
    assert error.max() < 4.0  # [cm]; wheels alone are wrong by 4 cm in the end, and by the start's 3 cm
