"""The rules of the layout, see CONTRIBUTING.md: sizes, imports, names, words and documentation."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import house
import message_path
import pytest

from swarm_loc_estimator.common.jit import cached_njit

ROOT = Path(__file__).resolve().parents[2]
LIMITS = {
    "files_over_700": 0,
    "import_circles": 0,
    "duplicate_class_names": 0,
    "tuple_parameters": 0,
    "private_words": 0,
}
PATH_LIMITS = {
    # Kind of message: modules, containers
    "detection": (22, 6),
    "odometry": (18, 8),
    "range": (23, 7),
    "scan": (26, 12),
    "brightness": (27, 21),
}
ORDER = (
    *("common", "swarm", "odometry", "identification", "filter", "initialization", "infrared", "mapping"),
    *("sensors", "timeline", "nodes", "watch", "offline", "doctor", "cli"),
)
"""The folders of the estimator package: each imports only those before it."""
MIN_DOCUMENTED = 0.96

Function = ast.FunctionDef | ast.AsyncFunctionDef


@pytest.mark.parametrize("figure", LIMITS)
def test_a_figure_keeps_its_limit(figure: str) -> None:
    places = house.places()[figure]
    assert len(places) <= LIMITS[figure], "\n".join(places)


def test_the_product_does_not_grow() -> None:
    assert sum(module.line_count for module in house.product_modules()) <= house.PRODUCT_LINES


@pytest.mark.parametrize("kind", message_path.KINDS)
def test_the_path_of_a_message_keeps_its_limits(kind: str) -> None:
    passed, (modules, containers) = message_path.passed(kind), PATH_LIMITS[kind]
    assert len(passed.modules) <= modules, "\n".join(passed.modules)
    assert len(passed.containers) <= containers, "\n".join(passed.containers)


def test_a_detection_passes_reading_converting_fusing_and_encoding() -> None:
    passed = message_path.passed("detection")
    expected = [
        "swarm_loc_estimator.sensors.inputs",
        "swarm_loc_estimator.sensors.camera",
        "swarm_loc_estimator.timeline.estimator",
        "swarm_loc_estimator.filter.prediction",  # compiled
        "swarm_loc_estimator.common.messages.poses",
    ]
    assert [name for name in passed.modules if name in expected] == expected
    assert "swarm_loc_estimator.filter.measurements.Measurements" in passed.containers
    known = {module.name for module in house.product_modules()}
    assert known.issuperset(passed.modules)


@cached_njit
def inner(x: float) -> float:
    """Compiled, called by compiled code."""
    return x


@cached_njit
def outer(x: float) -> float:
    """Compiled, called by Python."""
    return inner(x)


def test_compiled_functions_are_found_through_others() -> None:
    def caller() -> float:
        return outer(1.0)

    found = message_path.compiled_too({caller.__code__: globals()})
    assert [code.co_name for code in found] == ["caller", "outer", "inner"]


def test_the_folders_of_the_estimator_import_in_one_order() -> None:
    place = {f"swarm_loc_estimator.{folder}": k for k, folder in enumerate(ORDER)}
    against = [
        f"{name} imports {other}"
        for name, imported in house.import_graph(house.product_modules()).items()
        for other in imported
        if place.get(house.folder_of(other), -1) > place.get(house.folder_of(name), len(ORDER))
    ]
    assert against == []
    folders = {path.name for path in (ROOT / "swarm_loc_estimator" / "swarm_loc_estimator").iterdir()}
    assert {name for name in folders - {"config", "__pycache__"} if "." not in name} == set(ORDER)


def test_the_architecture_page_shows_the_folders_in_this_order() -> None:
    page = (ROOT / "swarm_loc_estimator" / "doc" / "architecture.md").read_text(encoding="utf-8")
    (diagram,) = [block for block in page.split("```") if "subgraph programs" in block]
    rows = [line.split("~~~") for line in diagram.splitlines() if line.startswith(" " * 12)]
    assert [name.strip() for row in reversed(rows) for name in row] == [*ORDER]
    assert re.findall(r"^\| `(\w+)/` \|", page, re.MULTILINE) == [*ORDER]


def test_the_architecture_page_has_the_modules_that_a_detection_passes() -> None:
    page = (ROOT / "swarm_loc_estimator" / "doc" / "architecture.md").read_text(encoding="utf-8")
    section = page.partition("## The way of a measurement\n")[2].partition("\n## ")[0]
    cells = re.findall(r"^\| \w+ \| (`.*?`) \|", section, re.MULTILINE)
    rows = [[name.replace("/", ".") for name in re.findall(r"`([\w/]+)`", cell)] for cell in cells]
    passed = [name.partition(".")[2] for name in message_path.passed("detection").modules]
    assert sorted(name for row in rows for name in row) == sorted(passed)
    first_of_each = [min(map(passed.index, row)) for row in rows]
    assert first_of_each == sorted(first_of_each)


def product_and_tools() -> list[house.Module]:
    others = [*(ROOT / "bench").rglob("*.py"), *(ROOT / "tools").rglob("*.py")]
    others = [path for path in others if "test" not in path.relative_to(ROOT).parts]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in others]
    return house.product_modules() + [house.Module(*one) for one in zip(names, others, strict=True)]


def public_functions(module: house.Module) -> Iterator[tuple[str, Function]]:
    """Public functions and methods, by name, with the class that a method belongs to."""
    classes = [n for n in module.tree.body if isinstance(n, ast.ClassDef) and not n.name.startswith("_")]
    for prefix, body in (("", module.tree.body), *((f"{one.name}.", one.body) for one in classes)):
        for node in body:
            if isinstance(node, Function) and not node.name.startswith("_"):
                yield f"{module.name}.{prefix}{node.name}", node


def test_what_is_public_is_documented_and_annotated() -> None:
    modules = product_and_tools()
    public = [found for module in modules for found in public_functions(module)]
    assert len(public) > 1000
    bare = [name for name, function in public if function.returns is None]
    assert not bare, f"public functions without annotations: {bare}"
    undocumented = [name for name, function in public if ast.get_docstring(function) is None]
    assert len(undocumented) <= (1.0 - MIN_DOCUMENTED) * len(public), undocumented
    assert [module.name for module in modules if not ast.get_docstring(module.tree)] == []


def test_benchmarks_and_tools_have_short_files_too() -> None:
    assert {m.name: m.line_count for m in product_and_tools() if m.line_count > house.LONG} == {}


def module(tmp_path: Path, name: str, text: str) -> house.Module:
    path = tmp_path / f"{name}.py"
    path.write_text(text, encoding="utf-8")
    return house.Module(name, path)


def test_circles_are_found_among_modules_and_among_folders(tmp_path: Path) -> None:
    one = module(tmp_path, "p.a.x", "from p.b import y")
    other = module(tmp_path, "p.b.y", "import p.c.z")
    last = module(tmp_path, "p.c.z", "from p.b import y")
    assert house.circles(house.import_graph([one, other])) == []
    found = house.circles(house.import_graph([one, other, last]))
    assert [circle.split(":")[0] for circle in found] == ["modules", "folders"]
    late = module(tmp_path, "p.a.w", "from p.c import z")
    folders_only = module(tmp_path, "p.c.v", "from p.a import w")
    found = house.circles(house.import_graph([late, folders_only, module(tmp_path, "p.c.z", "")]))
    assert [circle.split(":")[0] for circle in found] == ["folders"]


def test_classes_of_one_name_are_found_within_a_package(tmp_path: Path) -> None:
    one, other = module(tmp_path, "p.a", "class Stop: ..."), module(tmp_path, "p.b", "class Stop: ...")
    assert house.duplicate_classes([one, module(tmp_path, "q.a", "class Stop: ...")]) == []
    assert house.duplicate_classes([one, other]) == ["Stop: p.a, p.b"]


@pytest.mark.parametrize(
    ("annotation", "counts"),
    [
        ("tuple[float, float]", False),
        ("tuple[int, ...]", False),
        ("tuple[str, ...] | None", False),
        ("list[int]", False),
        ("tuple[float, int]", True),
        ("tuple[FloatArray, FloatArray]", True),
        ("Sequence[tuple[int, bytes]]", True),
        ("tuple[float, tuple[float, float], int] | None", True),
    ],
)
def test_tuples_of_unlike_things_are_found(tmp_path: Path, annotation: str, counts: bool) -> None:
    one = module(tmp_path, "p.a", f"def f(look: {annotation}): ...")
    assert bool(house.tuple_parameters([one])) == counts


def test_private_words_are_found_as_words(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("Of late the robot is Told anew;\nhe retold it.", encoding="utf-8")
    (tmp_path / "CONTRIBUTING.md").touch()
    found = [place.partition(" ")[2] for place in house.private_words(tmp_path)]
    assert found == ["Of late", "Told", "anew"]
