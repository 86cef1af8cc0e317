"""Files for viewers of others: they name the topics, fields and nodes that there are."""

import json
import re
from configparser import ConfigParser
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from ruamel.yaml import YAML

PACKAGE = Path(__file__).parents[2]
VIEWERS = PACKAGE / "viewers"
NODES_WITHOUT_DIAGNOSTICS = {
    "droplet_steering",
    "droplet_world",
    "eight_steering",
    "epuck_world",
    "markers",
    "pushbot_world",
}


def node_names() -> set[str]:
    """Names of all nodes of the packages that report on /diagnostics."""
    named = re.compile(r'super\(\).__init__\(\s*"(\w+)", (\w+Parameters)')
    sources = [
        path
        for package in ("estimator", "vision", "drivers")
        for path in (PACKAGE.parent / f"swarm_loc_{package}" / f"swarm_loc_{package}").rglob("*.py")
    ]
    found = {match[1] for path in sources for match in named.finditer(path.read_text(encoding="utf-8"))}
    return found - NODES_WITHOUT_DIAGNOSTICS - {"calibrate_laser"}  # that is a command


def test_shipped_layouts_show_what_is_published() -> None:
    rviz = YAML(typ="safe").load((VIEWERS / "swarm.rviz").read_text(encoding="utf-8"))[
        "Visualization Manager"
    ]
    topics = {one["Topic"]["Value"] for one in rviz["Displays"] if "Topic" in one}
    assert topics == {"swarm/markers", "map"}
    assert rviz["Global Options"]["Fixed Frame"] == "map"
    layout = json.loads((VIEWERS / "foxglove.json").read_text(encoding="utf-8"))
    assert layout["configById"][layout["layout"]["first"]]["topics"]["/swarm/markers"]["visible"]


def test_plotjuggler_draws_fields_of_swarm_poses() -> None:
    definition = (PACKAGE.parent / "swarm_loc_msgs" / "msg" / "SwarmPose.msg").read_text(encoding="utf-8")
    fields = set(re.findall(r"^[a-z0-9\[\]]+ (\w+)\s", definition, re.MULTILINE))
    curves = list(ET.parse(VIEWERS / "plotjuggler.xml").iter("curve"))  # noqa: S314
    names = [curve.get(key) for curve in curves for key in ("name", "curve_x", "curve_y") if curve.get(key)]
    drawn = [name for name in names if name and name.startswith("/")]
    assert len(drawn) > len(curves) / 2
    for name in drawn:
        matched = re.fullmatch(r"/swarm/poses/robots\[[0-4]\]/(\w+)(\[\d\])?", name)
        assert matched, name
        assert matched[1] in fields, name


@pytest.mark.parametrize("name", sorted(node_names()))
def test_each_node_that_reports_has_one_group_in_diagnostic_aggregator(name: str) -> None:
    settings = YAML(typ="safe").load((VIEWERS / "analyzers.yaml").read_text(encoding="utf-8"))
    groups = settings["analyzers"]["ros__parameters"]
    groups.pop("path")
    matching = [
        group for group, keys in groups.items() if any(part in f"robot1/{name}" for part in keys["contains"])
    ]
    assert len(matching) == 1, (name, matching)


def test_files_for_viewers_are_installed() -> None:
    setup = ConfigParser()
    setup.read(PACKAGE / "setup.cfg")
    installed = setup["options.data_files"]["share/swarm_loc_estimator/viewers"].split()
    assert sorted(installed) == sorted(f"viewers/{path.name}" for path in VIEWERS.iterdir())
