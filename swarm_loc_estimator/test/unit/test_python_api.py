"""The public Python API: its names, what importing one of them loads, its page, its example."""

import ast
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import swarm_loc_estimator
from swarm_loc_estimator import Batch, Estimator, OdometryRows, Robot, Swarm, replay
from swarm_loc_estimator.sensors.inputs import SENSORS

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "swarm_loc_estimator" / "doc" / "python_api.md"
BAG = ROOT / "bags" / "eight_five_robots"
SWARM = Swarm((Robot("robot1"),))
TWO = np.zeros(2, np.int64)
ROWS = OdometryRows.without_twist(TWO, TWO, np.zeros((2, 3)), TWO)
NAMES = set(swarm_loc_estimator._MODULE_OF)


def run(*arguments: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_type_checkers_see_the_same_names_in_the_same_modules() -> None:
    stub = Path(swarm_loc_estimator.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    tree = ast.parse(stub)
    seen = {
        one.asname: node.module
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for one in node.names
    }
    assert len(seen) == stub.count("import") > 40
    assert seen == swarm_loc_estimator._MODULE_OF


def test_all_names_load_and_no_others() -> None:
    assert all(hasattr(swarm_loc_estimator, name) for name in NAMES)
    assert set(dir(swarm_loc_estimator)) >= NAMES
    assert len(dir(swarm_loc_estimator)) == len(set(dir(swarm_loc_estimator)))
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = swarm_loc_estimator.nothing  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: replay(BAG, tick_s=0.0), r"tick_s = 0.0 must be a number in \[0.001, 3600\] s"),
        (lambda: replay(BAG, tick_s=-0.1), "tick_s = -0.1 must be a number"),
        (lambda: replay(BAG, tick_s=math.nan), "tick_s = nan must be a number"),
        (lambda: replay(BAG, tick_s="0.1"), "tick_s = '0.1' must be a number"),  # type: ignore[arg-type]
        (lambda: replay(BAG, stamp_ns=np.array([2, 1])), "stamp_ns must be increasing whole numbers"),
        (lambda: replay(BAG, stamp_ns=np.array([1, 1])), "stamp_ns must be increasing whole numbers"),
        (lambda: replay(BAG, stamp_ns=np.array([1.0, 2.0])), "stamp_ns must be"),
        (lambda: replay(BAG, stamp_ns=np.ones((2, 2), np.int64)), "stamp_ns must be"),
        (lambda: replay(BAG, "swarm.yaml"), "swarm must be a Swarm, not 'swarm.yaml'"),  # type: ignore[arg-type]
        (lambda: replay(BAG, SWARM, {"x": 1}), "settings must be a Settings, not {'x': 1}"),  # type: ignore[arg-type]
        (lambda: Estimator(SWARM, 2.0), "settings must be a Settings, not 2.0"),  # type: ignore[arg-type]
        (lambda: Batch.of(0, 1, odometri=ROWS), "no sensor 'odometri', only odometry, imu, detections, "),
        (lambda: Batch.of(0, 1, fixes=ROWS), "fixes must be FixRows with columns of equal length"),
        (
            lambda: Batch.of(0, 1, odometry=ROWS._replace(pose=np.zeros((1, 3)))),
            "odometry must be OdometryRows with columns of equal length",
        ),
    ],
)
def test_wrong_arguments_are_named(call: Callable[[], object], sentence: str) -> None:
    with pytest.raises((ValueError, TypeError), match=sentence):
        call()


def test_numba_disable_jit_has_no_effect() -> None:
    code = f"from swarm_loc_estimator import replay; print(len(replay('{BAG}').stamp_ns))"
    assert int(run("-c", code, NUMBA_DISABLE_JIT="1")) > 100


@pytest.mark.parametrize("name", ["Swarm", "Goal", "Settings"])
def test_one_name_loads_neither_the_filter_nor_plots_nor_a_server(name: str) -> None:
    loaded = run("-c", f"import sys; from swarm_loc_estimator import {name}; print(*sys.modules)").split()
    assert swarm_loc_estimator._MODULE_OF[name] in loaded
    assert not {"matplotlib", "aiohttp", "rclpy", "swarm_loc_estimator.filter.state"} & set(loaded)


def test_the_page_names_what_there_is_and_its_code_runs() -> None:
    text = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 4
    printed = [run("-c", block).split("\n") for block in blocks]
    assert float(printed[0][0]) == pytest.approx(0.0027, abs=1e-4)
    assert [line.split()[0] for line in printed[1][:-1]] == [f"epuck{k}" for k in range(1, 6)]
    assert printed[3][0] == "[[0.5 0.  0. ]]"
    assert printed[3][1] == "{}"


def test_the_page_lists_all_names_once() -> None:
    _, _, table = PAGE.read_text(encoding="utf-8").partition("## All names")
    assert sorted(re.findall(r"`(\w+)`", table)) == sorted(NAMES)


def test_the_page_has_the_columns_of_every_sensor() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    for name, sensor in SENSORS.items():
        fields = {*sensor.nothing()._fields} - {"robot", "stamp_ns", "arrival_ns", "rate", "detection"}
        needed, _, optional = rows[name].partition(" | ")
        assert {one for one in fields - {*sensor.optional} if f"`{one}`" not in needed} == set()
        assert {one for one in fields & {*sensor.optional} if f"`{one}`" not in optional} == set()
