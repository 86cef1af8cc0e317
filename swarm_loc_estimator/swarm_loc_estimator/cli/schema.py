"""Print the JSON Schema of swarm descriptions, with which editors complete and check them.

    schema > swarm.schema.json

A description in the same folder names it in its first line: # yaml-language-server: $schema=swarm.schema.json
"""

from __future__ import annotations

import argparse

from swarm_loc_estimator.common.command_line import command
from swarm_loc_estimator.swarm.schema import schema_text


@command(__doc__)
def main(_options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    print(schema_text(), end="")
    return 0
