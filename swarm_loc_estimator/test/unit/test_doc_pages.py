"""The pages under doc/ have all numbers of a swarm description and all options of the commands."""

import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest

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
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.offline.sweep.sweep import FIGURES, KEYS, MINIMIZED, read_sweep
from swarm_loc_estimator.swarm.new_swarm import KNOWN_ROBOTS, SENSORS
from swarm_loc_estimator.swarm.swarm import Anchor, Face, FixedCamera, Landmark, MapError, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import MODELS, load_swarm

DOC = Path(__file__).parents[2] / "doc"
SWARM_DESCRIPTION = (DOC / "swarm_description.md").read_text(encoding="utf-8")
NEW_SWARM = (DOC / "new_swarm.md").read_text(encoding="utf-8")
COMMANDS = (DOC / "commands.md").read_text(encoding="utf-8")


def table_of(cls: type, *required: str) -> str:
    """The numbers of a dataclass as a table of Markdown."""
    lines = ["| Key | Default | Range | Meaning |", "|---|---|---|---|"]
    given = {f.name: f.default for f in fields(cls) if f.name in number_specs(cls)}
    defaults = {name: "null" if value is None else f"{value:g}" for name, value in given.items()}
    for name, spec in number_specs(cls).items():
        default = "required" if name in required else f"`{defaults[name]}`"
        lines.append(f"| `{name}` | {default} | {spec.range_text} | {spec.doc} |")
    return "\n".join(lines)


@pytest.mark.parametrize("cls", [*MODELS.values(), Face, MapError])
def test_every_number_of_a_robot_has_its_place(cls: type) -> None:
    assert table_of(cls) in SWARM_DESCRIPTION


def test_every_number_of_a_landmark_has_its_place() -> None:
    assert table_of(Landmark, "x", "y") in SWARM_DESCRIPTION


def test_every_number_of_a_fixed_camera_has_its_place() -> None:
    assert table_of(FixedCamera, "x", "y", "z") in SWARM_DESCRIPTION


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


def test_every_number_of_radios_has_its_place() -> None:
    page = (DOC / "uwb.md").read_text(encoding="utf-8")
    assert table_of(UwbDevice) in page
    assert table_of(Anchor, "x", "y") in page


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
