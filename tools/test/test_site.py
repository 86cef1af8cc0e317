"""The documentation site has all pages of the repository, all names of the API, and all messages."""

import re
import runpy

import swarm_loc_estimator
from workspace.layout import PACKAGES, ROOT

DOCS = ROOT / "docs"
PLACES = ("*.md", "docs/**/*.md", *(f"{place}/**/*.md" for place in (*PACKAGES, "bags", "bench", "tools")))
START_PAGE, NAVIGATION = ROOT / "README.md", DOCS / "navigation.md"
ENTRY = re.compile(r"^(?!```|:)(\S+)$", re.MULTILINE)
SHOWN = re.compile(r"^(?:\.\. auto\w+::|:pyobject:) (?:[\w.]+\.)?(\w+)$", re.MULTILINE)


def test_the_navigation_has_every_page_once() -> None:
    pages = {page for place in PLACES for page in ROOT.glob(place)} - {START_PAGE, NAVIGATION}
    pages |= set(ROOT.glob("*/CHANGELOG.rst"))
    assert len(pages) > 50
    entries = ENTRY.findall(NAVIGATION.read_text(encoding="utf-8"))
    assert sorted(entries) == sorted(str(page.relative_to(ROOT).with_suffix("")) for page in pages)


def test_the_reference_has_every_name_of_the_api() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in (DOCS / "api").glob("*.md"))
    assert set(swarm_loc_estimator._MODULE_OF) - set(SHOWN.findall(pages)) == set()


def test_diagrams_are_drawn_by_mermaid() -> None:
    read_source = runpy.run_path(str(DOCS / "conf.py"))["_read_source"]
    page = ["Text\n\n```mermaid\nflowchart LR\n    a --> b[x<br>y]\n```\n\n```\ncode\n```\n"]
    read_source(None, "swarm_loc_estimator/doc/architecture", page)
    diagram = "flowchart LR\n    a --&gt; b[x&lt;br&gt;y]\n"
    raw = f'```{{raw}} html\n<pre class="mermaid">\n{diagram}</pre>\n```'
    assert page == [f"Text\n\n{raw}\n\n```\ncode\n```\n"]


def test_messages_stand_on_one_page_and_links_lead_there() -> None:
    read_source = runpy.run_path(str(DOCS / "conf.py"))["_read_source"]
    page = [(ROOT / "swarm_loc_msgs" / "README.md").read_text(encoding="utf-8")]
    read_source(None, "swarm_loc_msgs/README", page)
    files = [path for kind in ("msg", "srv") for path in ROOT.glob(f"swarm_loc_msgs/{kind}/*.{kind}")]
    assert len(files) > 15
    for path in files:
        assert f"## {path.stem}\n\n```{{literalinclude}} /{path.relative_to(ROOT)}\n" in page[0]
        assert f"[`{path.stem}`](README.md#{path.stem.lower()})" in page[0]

    link = ["see [`swarm_loc_msgs/SwarmFixes`](../../swarm_loc_msgs/msg/SwarmFixes.msg) and [x](msg/x.txt)"]
    read_source(None, "swarm_loc_estimator/doc/large_swarms", link)
    target = "../../swarm_loc_msgs/README.md#swarmfixes"
    assert link == [f"see [`swarm_loc_msgs/SwarmFixes`]({target}) and [x](msg/x.txt)"]
