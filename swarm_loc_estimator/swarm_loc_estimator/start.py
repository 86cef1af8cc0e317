"""Start executables: signals end them without a traceback while they still import what they need."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from importlib import import_module

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def program(module: str) -> Callable[[], int]:
    """The `main` of a module, which is imported when it is called.

    Args:
        module: Its whole name.

    Returns:
        A function that ends the process by 128 + n at signal n, as shells tell it, until `main` begins.
    """

    def start() -> int:
        handlers = {number: signal.signal(number, lambda n, _: os._exit(128 + n)) for number in _SIGNALS}
        main: Callable[[], int] = import_module(module).main
        for number, handler in handlers.items():
            signal.signal(number, handler)
        return main()

    return start


calibrate = program("swarm_loc_estimator.cli.calibrate")
calibrate_ir = program("swarm_loc_estimator.cli.calibrate_ir")
demo = program("swarm_loc_estimator.cli.demo")
estimator_node = program("swarm_loc_estimator.nodes.estimator_node")
graph = program("swarm_loc_estimator.cli.graph")
import_droplets = program("swarm_loc_estimator.cli.import_droplets")
import_mrclam = program("swarm_loc_estimator.cli.import_mrclam")
mapper_node = program("swarm_loc_estimator.nodes.mapper.mapper_node")
markers_node = program("swarm_loc_estimator.watch.markers_node")
play = program("swarm_loc_estimator.nodes.player.play_node")
replay = program("swarm_loc_estimator.cli.replay")
replay_map = program("swarm_loc_estimator.cli.replay_map")
watch = program("swarm_loc_estimator.cli.watch")
watch_node = program("swarm_loc_estimator.watch.watch_node")
