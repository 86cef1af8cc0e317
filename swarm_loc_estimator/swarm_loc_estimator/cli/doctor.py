"""Look at a swarm's topics and say what is wrong, with a remedy for each.

    doctor swarm.yaml                     the live graph, for twenty seconds
    doctor bags/eight_five_robots         a bag

Let the robots drive meanwhile: odometry and cameras are compared with each other. The exit status is 1 if
anything is wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from swarm_loc_estimator.common.command_line import (
    ProgressLine,
    add_remap,
    command_parser,
    exit_with_message,
    number_in,
    swarm_beside,
)
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.doctor.doctor import evidence_of_bag, examine, lines_of
from swarm_loc_estimator.swarm.swarm_file import NAME, load_swarm

_DESCRIPTIONS = (".yaml", ".yml")
_LIVE_S, _BAG_S = 20.0, 120.0


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    is_live = options.source.suffix in _DESCRIPTIONS
    if is_live and options.remap:
        raise UserError("--remap is for bags; remap topics of a live graph in their nodes.")
    if options.use_sim_time and not is_live:
        raise UserError("--use-sim-time is for a live graph; a bag has its own time.")
    if options.namespace and not all(map(NAME.fullmatch, options.namespace.strip("/").split("/"))):
        raise UserError(f"--namespace '{options.namespace}' must be names with slashes between, such as lab.")
    swarm = load_swarm(options.swarm or (options.source if is_live else swarm_beside(options.source)))
    seconds = options.seconds or (_LIVE_S if is_live else _BAG_S)
    with ProgressLine() as progress:
        if is_live:
            listen = import_module("swarm_loc_estimator.doctor.listener").listen
            evidence = listen(swarm, seconds, progress, options.namespace, use_sim_time=options.use_sim_time)
        else:
            evidence = evidence_of_bag(
                options.source, swarm, seconds, progress, options.remap, options.namespace
            )
        progress(1.0, "checking")
        findings = examine(evidence)
    messages = sum(len(heard.messages) for heard in evidence.topics.values())
    print(f"{len(swarm.robots)} robots, {messages} messages on {len(evidence.topics)} topics.")
    for remark in evidence.remarks:
        print(f"Note: {remark}")
    if evidence.is_cut:
        print(f"Note: only the first {seconds:g} s of the bag were looked at; --seconds takes more.")
    print("\n".join(f"- {line}" for line in lines_of(findings)) or "Nothing is wrong.")
    return 1 if findings else 0


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser(__doc__)
    parser.add_argument("source", metavar="SWARM_FILE|BAG", type=Path, help="swarm description, or a bag")
    parser.add_argument("--swarm", type=Path, help="swarm description (default: swarm.yaml beside the bag)")
    parser.add_argument(
        "--seconds",
        type=number_in(1.0, 3600.0, "s"),
        help=f"how long to look (default: {_LIVE_S:g} s live, {_BAG_S:g} s of a bag)",
    )
    parser.add_argument("--namespace", default="", help="namespace of the whole swarm, such as lab")
    parser.add_argument("--use-sim-time", action="store_true", help="take time from /clock")
    add_remap(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
