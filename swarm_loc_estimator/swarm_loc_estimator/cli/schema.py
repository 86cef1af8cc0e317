"""Print the JSON Schema of swarm descriptions, with which editors complete and check them.

    schema > swarm.schema.json

A description in the same folder names it in its first line: # yaml-language-server: $schema=swarm.schema.json
"""

from __future__ import annotations

from collections.abc import Sequence

from swarm_loc_estimator.common.command_line import command_parser, exit_with_message
from swarm_loc_estimator.swarm.schema import schema_text


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    command_parser(__doc__).parse_args(arguments)
    print(schema_text(), end="")
    return 0
