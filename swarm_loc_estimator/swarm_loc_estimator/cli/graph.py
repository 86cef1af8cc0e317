"""Start the whole graph of a swarm, as `ros2 launch swarm_loc_estimator swarm.launch.py` does."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from swarm_loc_estimator.common.command_line import command_parser, exit_with_message, number_in
from swarm_loc_estimator.common.launch import GraphOptions, check_parameter_file, graph_nodes, run_graph
from swarm_loc_estimator.swarm.swarm_file import load_swarm


def parse(arguments: Sequence[str]) -> GraphOptions:
    """Read the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("swarm_file", metavar="SWARM_FILE", help="the swarm description")
    parser.add_argument("--bag", help="play this bag into the graph, which then runs on the bag's clock")
    parser.add_argument(
        "--rate", type=number_in(0.01, 1000.0), default=1.0, help="speed of the bag (default: 1)"
    )
    parser.add_argument("--use-sim-time", action="store_true", help="take time from /clock without a bag")
    parser.add_argument("--watch", action="store_true", help="show the swarm on a page of this machine")
    parser.add_argument(
        "--watch-port", type=number_in(0, 65535), default=8420, help="port of that page (default: 8420)"
    )
    parser.add_argument("--params-file", dest="parameter_file", help="ROS parameter file for all nodes")
    return GraphOptions(**vars(parser.parse_args(arguments)))


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
def main() -> int:
    """Run until a node ends or Ctrl-C."""
    options = parse(sys.argv[1:])
    check_graph(options)
    return run_graph(graph_nodes(options))
