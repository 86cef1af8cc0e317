"""Show a swarm on a page, in any browser of this machine.

    watch swarm.yaml              a swarm whose graph is running
    watch bags/eight_five_robots  a bag, played through the estimator

The page loads nothing from other hosts. --address allows access from other machines, with the --token.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from swarm_loc_estimator.cli.graph import check_graph
from swarm_loc_estimator.common import command_line as cli
from swarm_loc_estimator.common.command_line import argument, command
from swarm_loc_estimator.common.launch import GraphOptions, NodeSpec, ParameterValue, graph_nodes, run_graph
from swarm_loc_estimator.nodes.parameters import WatchParameters
from swarm_loc_estimator.watch.server import Access

_DEFAULT = WatchParameters()


@command(
    __doc__,
    argument("source", metavar="SWARM_FILE|BAG", type=Path, help="swarm description, or a bag"),
    argument("--swarm", type=Path, help="swarm description (default: swarm.yaml beside the bag)"),
    argument("--address", default=_DEFAULT.address, help="what to listen on (default: 127.0.0.1)"),
    argument("--port", type=cli.number_in(0, 65535), default=_DEFAULT.port, help="default: 8420; 0: any"),
    argument("--token", default="", help="token of browsers, as ?token=, 8 characters or more, 5 different"),
    argument("--rate", type=cli.number_in(0.01, 1000.0), default=1.0, help="speed of the bag (default: 1)"),
    argument("--loop", action="store_true", help="play the bag again and again"),
    argument("--teleop", action="store_true", help="let pages drive robots by <robot>/cmd_vel"),
    argument("--use-sim-time", action="store_true", help="take time from /clock without a bag"),
)
def main(options: argparse.Namespace) -> int:
    """Run until Ctrl-C, or until the bag has ended."""
    Access(options.address, options.token)  # a wrong address is refused before anything starts
    return run_graph(watch_nodes(options))


def watch_nodes(options: argparse.Namespace) -> list[NodeSpec]:
    """The nodes that the command line asks for; raises UserError if a file cannot be used."""
    is_bag = not cli.is_description(options.source)
    swarm_file = cli.described(options)
    bag, on_sim_time = str(options.source) if is_bag else None, options.use_sim_time
    graph = GraphOptions(str(swarm_file), bag=bag, rate=options.rate, use_sim_time=on_sim_time)
    check_graph(graph)
    page: dict[str, ParameterValue] = {
        "swarm_file": str(swarm_file),
        "title": options.source.resolve().name if is_bag else "",
        "address": options.address,
        "port": options.port,
        "token": options.token,
        "teleop": options.teleop,
        "use_sim_time": is_bag or options.use_sim_time,
    }
    node = NodeSpec("swarm_loc_estimator", "watch_node", "watch", parameters=page)
    if not is_bag:
        return [node]
    estimator, player = graph_nodes(graph)
    player_parameters = {**player.parameters, "loop": options.loop}
    player = NodeSpec(player.package, player.executable, player.name, parameters=player_parameters)
    return [node, estimator, player]
