"""Look at a swarm's topics and say what is wrong, with a remedy for each.

    doctor swarm.yaml                     the live graph, for twenty seconds
    doctor bags/eight_five_robots         a bag

Let the robots drive meanwhile: odometry and cameras are compared with each other. The exit status is 1 if
anything is wrong.
"""

from __future__ import annotations

import argparse
from functools import partial
from importlib import import_module

from swarm_loc_estimator.common.command_line import ProgressLine, add_live_or_bag, command, described, is_live
from swarm_loc_estimator.doctor.doctor import evidence_of_bag, examine, lines_of
from swarm_loc_estimator.swarm.swarm_file import load_swarm

_LIVE_S, _BAG_S = 20.0, 120.0


@command(
    __doc__,
    partial(add_live_or_bag, seconds=f"how long (default: {_LIVE_S:g} s live, {_BAG_S:g} s of a bag)"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    live = is_live(options)
    swarm = load_swarm(described(options))
    seconds = options.seconds or (_LIVE_S if live else _BAG_S)
    with ProgressLine() as progress:
        if live:
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
