"""Parameters as the table of Markdown that the page of a node has; tests compare the two."""

from swarm_loc_estimator.common.parameters import Value, parameter_specs


def markdown_table(cls: type) -> str:
    """The parameters as a table of Markdown, for the page of the node."""
    lines = ["| Parameter | Default | Range | Meaning |", "|---|---|---|---|"]
    for spec in parameter_specs(cls):
        default = "required" if spec.required and not spec.default else f"`{_shown(spec.default)}`"
        lines.append(f"| `{spec.name}` | {default} | {spec.range_text} | {spec.doc} |")
    return "\n".join(lines)


def _shown(value: Value) -> str:
    """A value as one writes it on the command line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return str(list(value))
    return f'"{value}"' if isinstance(value, str) else str(value)
