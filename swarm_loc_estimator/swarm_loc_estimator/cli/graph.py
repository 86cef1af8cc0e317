"""Start the whole graph of a swarm, as `ros2 launch swarm_loc_estimator swarm.launch.py` does."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from swarm_loc_estimator.graph import GraphOptions, graph_nodes
from swarm_loc_estimator.processes import GraphError, run_graph


def parse(arguments: Sequence[str]) -> GraphOptions:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="graph", description=__doc__)
    parser.add_argument("swarm_file", metavar="SWARM_FILE", help="the swarm description")
    parser.add_argument("--bag", help="play this bag into the graph, which then runs on the bag's clock")
    parser.add_argument("--rate", type=float, default=1.0, help="speed of the bag (default: 1)")
    parser.add_argument("--use-sim-time", action="store_true", help="take time from /clock without a bag")
    parser.add_argument("--params-file", dest="parameter_file", help="ROS parameter file for all nodes")
    return GraphOptions(**vars(parser.parse_args(arguments)))


def say(line: str) -> None:
    """Print a line in one piece, since the nodes print to the same terminal."""
    print(f"[graph] {line}\n", end="", flush=True)


def main() -> int:
    """Run until a node ends or Ctrl-C."""
    try:
        return run_graph(graph_nodes(parse(sys.argv[1:])), say)
    except GraphError as error:
        print(error, file=sys.stderr)
        return 1
