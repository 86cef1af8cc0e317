"""Once it is warm, the mapper compiles nothing: meanwhile robots would drive on, and fixes come too late."""

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from compiled_code import compiled_since, printed_by_process, signatures

from bench.shared.bags import copy_part
from swarm_loc_estimator.mapping.mapper_feed import fix_covariance
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.nodes.mapper_precompile import precompile
from swarm_loc_estimator.offline.map_replay import replay_map
from swarm_loc_estimator.swarm.swarm_file import load_swarm

BAG = Path(__file__).parents[3] / "bags" / "pushbots_two"
FREQUENCIES = {"pushbot1": 1000.0, "pushbot2": 1050.0}


def test_nothing_is_compiled_once_robots_report() -> None:
    assert printed_by_process(__file__) == []


def compiled_late() -> list[str]:
    """What is compiled when robots are replayed though all is warm; in a process of its own."""
    precompile()
    before = signatures()
    swarm = load_swarm(BAG / "swarm.yaml")
    with TemporaryDirectory() as folder:
        begin = Path(folder, "begin")
        copy_part(BAG, begin, 80.0)  # the rest of the bag calls the same functions
        mapper, feed, _ = replay_map(begin, swarm, MapperSettings(), FREQUENCIES, lambda _share, _what: None)
    for index in range(len(swarm.robots)):
        number = feed.number(index)
        goal = None if number is None else mapper.goal(number)
        if number is not None and goal is not None:
            fix_covariance(mapper.covariance(number))
        mapper.visits.on(mapper.occupancy())
    return compiled_since(before)


if __name__ == "__main__":
    json.dump(compiled_late(), sys.stdout)
