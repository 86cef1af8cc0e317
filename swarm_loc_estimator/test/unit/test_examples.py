"""The scripts of `examples/` print what they promise."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from swarm_loc_estimator import load_swarm

ROOT = Path(__file__).parents[3]
EXAMPLES = ROOT / "swarm_loc_estimator" / "examples"
BAG = ROOT / "bags" / "eight_five_robots"
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
    """The numbers of each line."""
    return [[float(one) for one in re.findall(r"-?\d+(?:\.\d+)?", line)] for line in lines]


def test_all_examples_are_tested_and_short() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES.glob("*.py"):
        assert f'@run("{path.name}"' in here
        assert 15 <= len(path.read_text(encoding="utf-8").splitlines()) <= 95, path.name


@run("replay_and_plot.py", str(BAG), "paths.png")
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


@run("survey_landmarks.py", str(BAG))
def test_a_survey_finds_all_landmarks_as_well_as_it_says(printed: list[str]) -> None:
    _, *rows, last = printed
    described = load_swarm(BAG / "swarm.yaml").landmarks
    found = np.array([row.split() for row in rows], dtype=float)
    assert found[:, 0].tolist() == sorted(mark.id for mark in described)
    places = np.array([[mark.x, mark.y] for mark in sorted(described, key=lambda mark: mark.id)])
    away = np.hypot(*(found[:, 1:3] - places).T)
    np.testing.assert_allclose(found[:, 4], away, atol=1e-3)  # coordinates have three digits
    assert (away < 3.0 * found[:, 3]).all()
    assert found[:, 3].max() < 0.015  # [m]
    assert last.startswith("20 of 20 landmarks, RMS 0.00")


@run("sweep_settings.py", str(BAG))
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
