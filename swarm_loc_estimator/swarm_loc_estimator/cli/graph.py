"""Start the whole graph of a swarm, as `ros2 launch swarm_loc_estimator swarm.launch.py` does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from swarm_loc_estimator.common import launch
from swarm_loc_estimator.common.command_line import exit_with_message
from swarm_loc_estimator.common.launch import GraphOptions
from swarm_loc_estimator.swarm.swarm_file import load_swarm


def check_graph(options: GraphOptions) -> None:
    """Raise UserError, which says why, unless the files of a graph can be used."""
    load_swarm(Path(options.swarm_file))
    if options.bag is not None:
        from swarm_loc_estimator.common.bags.reader import BagReader  # noqa: PLC0415 - live graphs read no bag

        with BagReader(Path(options.bag)):
            pass
    launch.check_parameter_file(options.parameter_file)


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run until a node ends or Ctrl-C."""
    options = launch.parsed_options(GraphOptions, __doc__, arguments)
    check_graph(options)
    return launch.run_graph(launch.graph_nodes(options))
