"""The project's own files parse and name what exists: workflow, hooks, citation, papers, container."""

import os
import re
import shlex
import xml.etree.ElementTree as ET
from configparser import ConfigParser
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from swarm_loc_estimator.swarm.swarm_file import load_swarm
from workspace import host, install
from workspace.layout import PACKAGES, REQUIREMENTS, ROOT


def read_yaml(name: str) -> Any:
    return YAML(typ="safe").load((ROOT / name).read_text(encoding="utf-8"))


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


def test_the_workflow_runs_what_continuous_integration_runs() -> None:
    job = read_yaml(".github/workflows/ci.yml")["jobs"]["test"]
    assert job["runs-on"] == "ubuntu-24.04"
    lines = [step["run"] for step in job["steps"] if "run" in step]
    assert lines[-1] == ".ci/run"
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    packages = {"cmake", "g++", "make", "python3-venv", "python3-dev"}
    assert packages <= set(shlex.split(lines[0]))


def test_the_jobs_of_the_workflow_name_what_there_is() -> None:
    jobs = read_yaml(".github/workflows/ci.yml")["jobs"]
    lines = "\n".join(step["run"] for job in jobs.values() for step in job["steps"] if "run" in step)
    called = re.findall(r"^make (.+)$", lines, re.MULTILINE)
    targets = {word for line in called for word in line.split() if "=" not in word}
    assert targets == {"unit", "node", "docs", "test-lowest"}
    assert targets <= make_targets()
    assert [name for name in re.findall(r"requirements/\w+\.txt", lines) if not (ROOT / name).is_file()] == []
    versions = [tuple(map(int, one.split("."))) for one in jobs["python"]["strategy"]["matrix"]["python"]]
    assert versions == [host.LOWEST_PYTHON, host.HIGHEST_WHEEL_PYTHON]


def test_a_release_is_made_of_what_there_is() -> None:
    jobs = read_yaml(".github/workflows/release.yml")["jobs"]
    lines = "\n".join(step["run"] for job in jobs.values() for step in job["steps"] if "run" in step)
    assert {line.split()[0] for line in re.findall(r"^make (.+)$", lines, re.MULTILINE)} <= make_targets()
    needed = {name for job in jobs.values() for name in [job.get("needs", [])] if isinstance(name, str)}
    assert needed | set(jobs["publish"]["needs"]) <= set(jobs)
    versions = [tuple(map(int, one.split("."))) for one in jobs["wheels"]["strategy"]["matrix"]["python"]]
    assert (versions[0], versions[-1]) == (host.LOWEST_PYTHON, host.HIGHEST_WHEEL_PYTHON)


def test_the_example_for_coding_assistants_is_a_description(tmp_path: Path) -> None:
    (example,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "llms.txt").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "swarm.yaml").write_text(example, encoding="utf-8")
    assert [robot.name for robot in load_swarm(tmp_path / "swarm.yaml").robots] == ["tb1", "tb2"]


def test_dependencies_that_are_kept_up_to_date_are_there() -> None:
    updates = read_yaml(".github/dependabot.yml")["updates"]
    places = {one["package-ecosystem"]: ROOT / one["directory"].strip("/") for one in updates}
    assert (places["pip"] / "workspace.lock").is_file()
    assert (places["docker"] / "Dockerfile").is_file()


def test_what_make_adds_to_the_set_up_has_requirements() -> None:
    added = re.findall(r"--extra (\w+)", (ROOT / "Makefile").read_text(encoding="utf-8"))
    assert sorted(added) == sorted(install.EXTRAS)
    assert [name for name in added if not (REQUIREMENTS / f"{name}.txt").is_file()] == []


def test_hooks_are_the_lint_of_the_makefile() -> None:
    (repository,) = read_yaml(".pre-commit-config.yaml")["repos"]
    assert repository["repo"] == "local"
    entries = {hook["id"]: shlex.split(hook["entry"]) for hook in repository["hooks"]}
    assert set(entries) == {"ruff-check", "ruff-format", "mypy"}
    for entry in entries.values():
        known = entry[1] in make_targets() if entry[0] == "make" else os.access(ROOT / entry[0], os.X_OK)
        assert known, entry


def test_the_citation_has_what_the_format_requires() -> None:
    citation = read_yaml("CITATION.cff")
    assert citation["cff-version"] == "1.2.0"
    assert citation["message"]
    for one in (citation, *citation["references"]):
        assert one["title"]
        assert one["authors"]
        assert one["type"]
        assert all("name" in person or "family-names" in person for person in one["authors"])


@pytest.mark.parametrize("package", PACKAGES)
def test_the_citation_has_version_and_license_of_the_packages(package: str) -> None:
    citation = read_yaml("CITATION.cff")
    manifest = (ROOT / package / "package.xml").read_text(encoding="utf-8")
    assert f"<version>{citation['version']}</version>" in manifest
    assert f"<license>{citation['license']}</license>" in manifest


@pytest.mark.parametrize("package", PACKAGES[1:])
def test_pip_and_ros_say_the_same_of_a_package(package: str) -> None:
    config = ConfigParser(interpolation=None)
    config.read(ROOT / package / "setup.cfg", encoding="utf-8")
    manifest = ET.parse(ROOT / package / "package.xml").getroot()  # noqa: S314 - our own file
    said = {name: manifest.findtext(name) for name in ("name", "version", "description", "license")}
    maintainer = manifest.find("maintainer")
    assert maintainer is not None
    said |= {"author": maintainer.text, "author_email": maintainer.get("email")}
    assert {name: config["metadata"][name] for name in said} == said
    assert [{"name": said["author"]}] == read_yaml("CITATION.cff")["authors"]


def test_every_paper_of_the_citation_stands_in_the_readme() -> None:
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split()).lower()
    papers = [paper["title"].partition(":")[0].lower() for paper in read_yaml("CITATION.cff")["references"]]
    assert [title for title in papers if title not in readme] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_the_papers_of_a_package_are_found(package: str) -> None:
    folder = ROOT / package
    assert "<rosdoc2>rosdoc2.yaml</rosdoc2>" in (folder / "package.xml").read_text(encoding="utf-8")
    kind, content = YAML(typ="safe").load_all((folder / "rosdoc2.yaml").read_text(encoding="utf-8"))
    assert kind["type"] == "rosdoc2 config"
    assert [one["sphinx"]["name"] for one in content["builders"]] == [package]
    declaration = (folder / "QUALITY_DECLARATION.md").read_text(encoding="utf-8")
    (level,) = re.findall(r"quality level (\d)", declaration)
    assert f"Quality level: {level} of REP 2004" in (folder / "README.md").read_text(encoding="utf-8")


def test_the_container_starts_what_there_is() -> None:
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    said = {word: line for line in lines for word, _, _ in [line.partition(" ")] if word.isupper()}
    assert said["FROM"] == "FROM ros:jazzy"
    assert said["COPY"].split()[-2:] == [".", "."]
    assert "make setup" in said["RUN"]
    assert "setup" in make_targets()
    assert '"./run"]' in said["ENTRYPOINT"]
    assert os.access(ROOT / "run", os.X_OK)


def test_what_a_host_has_made_stays_out_of_the_container() -> None:
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    made = [line.rstrip("/") for line in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()]
    folders = [line for line in made if line and not line.startswith("#")]
    assert [name for name in folders if name not in ignored and f"**/{name}" not in ignored] == []
