"""The documentation site: the Markdown of the repository where it lies, and an API from docstrings."""

from __future__ import annotations

import re
from dataclasses import is_dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import swarm_loc_estimator
from swarm_loc_estimator.common.parameters import number_specs

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
DIAGRAM = re.compile(r"^```mermaid\n(.*?)^```$", re.MULTILINE | re.DOTALL)

project = html_title = "Swarm localization"
author = "Swarm localization maintainers"
root_doc = "README"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
include_patterns = ["*.md", "*/*.md", "*/doc/*.md", "docs/api/*.md", "docs/decisions/*.md", "*/CHANGELOG.rst"]
exclude_patterns = ["docs/navigation.md", "out", "build", "install", "log", ".*"]
myst_heading_anchors = 3
highlight_language = "none"
smartquotes_action = "D"
default_role = "code"

html_theme = "furo"
html_static_path = ["static", "../.workspace/mermaid"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_copyright = False

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {
    name: name for name in ("ArrayLike", "BoolArray", "FloatArray", "IntArray", "NDArray", "npt.NDArray")
}
napoleon_use_ivar = True
python_maximum_signature_line_length = 160


def setup(app: Sphinx) -> None:
    """Connect the hooks."""
    app.connect("source-read", _read_source)
    app.connect("html-page-context", _add_mermaid)
    app.connect("autodoc-process-signature", _shorten_signature)
    app.connect("autodoc-process-docstring", _prepare_docstring, priority=100)  # before napoleon


def _read_source(_app: Sphinx, docname: str, source: list[str]) -> None:
    """Add what GitHub would show as code: the navigation on the start page, messages on that of theirs."""
    if docname == root_doc:
        source[0] += (ROOT / "docs" / "navigation.md").read_text(encoding="utf-8")
    if docname == "swarm_loc_msgs/README":
        for path in sorted([*ROOT.glob("swarm_loc_msgs/msg/*.msg"), *ROOT.glob("swarm_loc_msgs/srv/*.srv")]):
            source[0] += f"\n## {path.stem}\n\n```{{literalinclude}} /{path.relative_to(ROOT)}\n```\n"
    # A link to the file of a message leads there.
    message = r"\]\(([./\w]*)(?:msg|srv)/(\w+)\.(?:msg|srv)\)"
    source[0] = re.sub(message, lambda link: f"]({link[1]}README.md#{link[2].lower()})", source[0])
    source[0] = DIAGRAM.sub(_diagram, source[0])


def _diagram(block: re.Match[str]) -> str:
    """A mermaid block, which GitHub draws, as what mermaid draws in a browser."""
    return f'```{{raw}} html\n<pre class="mermaid">\n{escape(block[1])}</pre>\n```'


def _add_mermaid(app: Sphinx, *event: Any) -> None:
    """Load mermaid on pages with diagrams. It is part of the site: pages load nothing from other servers."""
    _page, _template, context, _doctree = event
    if '<pre class="mermaid">' in context.get("body", ""):
        app.add_js_file("mermaid.min.js")
        app.add_js_file(None, body='mermaid.initialize({theme: "neutral"})')


def _shorten_signature(*event: Any) -> tuple[str | None, str | None]:
    """Show a default without its own arguments, a function or factory by its name, an alias by its own."""
    alias = r"TypeAliasForwardRef\('(\w+)'\)"  # what Sphinx writes for an alias in a union
    signature, returned = (text and re.sub(alias, r"\1", text) for text in event[-2:])
    if signature:
        signature = re.sub(r"= (\w+)\([^()]*\)", r"= \1()", signature)
        signature = re.sub(r"<function [^<>]*<lambda>[^>]*>", "...", signature)
        signature = re.sub(r"= <(?:function )?(\w+)[^>]*>", r"= \1", signature)
    return signature, returned


def _prepare_docstring(_app: Sphinx, what: str, name: str, obj: Any, _options: Any, lines: list[str]) -> None:
    """Describe numbers of a dataclass by their specs, constants by their docstrings; no colon names a type.

    A field of a named tuple without a comment has no description.
    """
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()
    if what == "data":  # autodoc would take the docstring of its type: the API loads it from another module
        from sphinx.pycode import ModuleAnalyzer  # noqa: PLC0415 the tests read this file without Sphinx

        constant = name.rpartition(".")[2]
        of_module = ModuleAnalyzer.for_module(vars(swarm_loc_estimator)["_MODULE_OF"][constant])
        lines[:] = of_module.find_attr_docs().get(("", constant), [])
    if what in {"attribute", "data", "property"}:
        lines.insert(0, r"\ ")  # shown as nothing; a colon behind it names no type
    if isinstance(obj, type) and is_dataclass(obj) and "Attributes:" not in lines:
        specs = number_specs(obj).items()
        numbers = [f"    {name}: {spec.doc}, in {spec.range_text}." for name, spec in specs]
        lines += ["Attributes:", *numbers, ""] if numbers else []
