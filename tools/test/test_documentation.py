"""What the Markdown files name exists: paths, links, executables, targets of make, bags."""

import re
from collections.abc import Iterator
from configparser import ConfigParser
from pathlib import Path

import pytest

from bench.__main__ import BENCHMARKS
from workspace.layout import PACKAGES, ROOT

FOLDERS = (*PACKAGES, "bags", "bench", "docs", "tools")
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        ROOT / "llms.txt",
        *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md")),
    ]
)
SUFFIXES = "cff|cfg|jpg|md|mcap|msg|png|py|rst|srv|toml|txt|xml|yaml|yml"
MADE_BY_RUNNING = ("out/",)

FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
PATH = re.compile(rf"\.?[\w-]+(?:/\.?[\w.-]+)*(?:/|\.(?:{SUFFIXES}))")
STARTED = re.compile(r"(?:\./run|ros2 run) (swarm_loc_\w+) (\w+)")
LAUNCHED = re.compile(r"ros2 launch (swarm_loc_\w+) ([\w.]+)")
TARGET = re.compile(r"(?:^|`)make ([a-z][\w-]*)", re.MULTILINE)
COUNTS = re.compile(r"^## (?:Diagnostics|Drops)$(.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL)
FIRST_CELL = re.compile(r"^\| (`.*?) \|", re.MULTILINE)
BAG_FILE = re.compile(r"\bbags/[\w/]+\.yaml")


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def named_paths(page: Path) -> Iterator[str]:
    """What stands in backticks and looks like the path of a file or a folder."""
    for code in CODE.findall(FENCE.sub("", text_of(page))):
        if "/" in code and PATH.fullmatch(code) and not code.startswith(MADE_BY_RUNNING):
            yield code


def bases(page: Path) -> Iterator[Path]:
    """Where a path may start: at the root, beside the page, in its package (a page at the root: in any)."""
    yield from (ROOT, page.parent)
    first = page.relative_to(ROOT).parts[0]
    for package in PACKAGES:
        if first in (package, page.name):
            yield from (ROOT / package, ROOT / package / package)


def slug(heading: str) -> str:
    """The anchor that a heading gets."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def executables(package: str) -> set[str]:
    config = ConfigParser()
    config.read(ROOT / package / "setup.cfg", encoding="utf-8")
    lines = config.get("options.entry_points", "console_scripts", fallback="").splitlines()
    return {line.partition("=")[0].strip() for line in lines if line.strip()}


def has_target(name: str) -> bool:
    if name.startswith("bench-"):
        return name.removeprefix("bench-") in BENCHMARKS
    return re.search(rf"^{re.escape(name)}:", text_of(ROOT / "Makefile"), re.MULTILINE) is not None


@pytest.fixture(params=PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def page(request: pytest.FixtureRequest) -> Path:
    path: Path = request.param
    return path


def test_there_are_pages_and_they_name_something() -> None:
    assert {ROOT / "README.md", ROOT / "CONTRIBUTING.md"} <= set(PAGES)
    assert len([name for page in PAGES for name in named_paths(page)]) > 50
    assert "replay" in executables("swarm_loc_estimator")


def test_paths_exist(page: Path) -> None:
    missing = [name for name in named_paths(page) if not any((base / name).exists() for base in bases(page))]
    assert missing == []


def test_links_lead_somewhere(page: Path) -> None:
    for link in LINK.findall(FENCE.sub("", text_of(page))):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), link
        assert not anchor or anchor in map(slug, HEADING.findall(text_of(target))), link


def test_executables_and_launch_files_exist(page: Path) -> None:
    for package, name in STARTED.findall(text_of(page)):
        assert name == "NAME" or name in executables(package), f"{package} {name}"
    for package, name in LAUNCHED.findall(text_of(page)):
        assert (ROOT / package / "launch" / name).is_file(), f"{package} {name}"


def test_targets_of_make_exist(page: Path) -> None:
    targets = set(TARGET.findall(text_of(page))) - {"bench-NAME"}
    assert {name for name in targets if not has_target(name)} == set()


def test_counts_in_diagnostics_exist(page: Path) -> None:
    package = page.relative_to(ROOT).parts[0]
    said = {
        name
        for section in COUNTS.findall(text_of(page))
        for cell in FIRST_CELL.findall(section)
        for name in CODE.findall(cell)
    }
    words = set(
        re.findall(r"\w+", "\n".join(map(text_of, (ROOT / package / package).rglob("*.py")) if said else ""))
    )
    # The code puts these prefixes before names, and forms the reasons of losses from an enumeration.
    kinds = {name: re.sub(r"^(?:(?:ir|odometry|shed)_|lost: )", "", name).replace(" ", "_") for name in said}
    missing = {name for name, kind in kinds.items() if not {name, kind, kind.upper()} & words}
    assert missing == set()


def test_the_tree_of_the_readme_exists() -> None:
    (tree,) = [block for block in FENCE.findall(text_of(ROOT / "README.md")) if "swarm_loc_msgs/ " in block]
    folders = [line.split()[0] for line in tree.splitlines()[1:-1]]
    assert len(folders) == 7
    assert [name for name in folders if not (ROOT / name).is_dir()] == []


def test_descriptions_of_bags_exist(page: Path) -> None:
    assert [name for name in BAG_FILE.findall(text_of(page)) if not (ROOT / name).is_file()] == []
