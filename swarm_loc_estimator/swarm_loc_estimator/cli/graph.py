"""Start the whole graph of a swarm, as `ros2 launch swarm_loc_estimator swarm.launch.py` does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from swarm_loc_estimator.common.command_line import exit_with_message
from swarm_loc_estimator.common.launch import (
    GraphOptions,
    check_parameter_file,
    graph_nodes,
    parsed_options,
    run_graph,
)
from swarm_loc_estimator.swarm.swarm_file import load_swarm


def check_graph(options: GraphOptions) -> None:
    """Check that the files of a graph can be used.

    Raises:
        UserError: A file cannot be used; the message says why.
    """
    load_swarm(Path(options.swarm_file))
    if options.bag is not None:
        from swarm_loc_estimator.common.bags.reader import BagReader  # noqa: PLC0415 - live graphs read no bag

        with BagReader(Path(options.bag)):
            pass
    check_parameter_file(options.parameter_file)


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run until a node ends or Ctrl-C."""
    options = parsed_options(GraphOptions, __doc__, arguments)
    check_graph(options)
    return run_graph(graph_nodes(options))
