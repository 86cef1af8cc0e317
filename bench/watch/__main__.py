"""The page on which people watch a swarm: how old poses are when they are painted, and what looking costs.

    make bench-watch
    make bench-watch ARGS="--seconds 30 --sizes 5 300"

Latency is from the stamp of a pose, when it is published, through DDS, `watch_node`, the WebSocket and
Chromium (without a window and without a GPU) to the task after the page was painted. The poses come from a
stand-in for the estimator, `bench.watch.publisher`, at 20 Hz. The estimator's load is measured on bags that
are played.
"""

import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from domain_coordinator import domain_id
from playwright.sync_api import Browser

from bench.scenarios.bags import write_bag
from bench.shared.common import (
    DEMO_BAG,
    OUT,
    ProgressLine,
    flat,
    options_of,
    plot_curves,
    table,
    write_figures,
)
from bench.shared.grid import GridSettings, simulate_grid
from bench.watch.browser import WatchedPage, chromium, running_browser
from bench.watch.publisher import homes
from swarm_loc_estimator.common.launch import (
    Child,
    GraphOptions,
    NodeSpec,
    ParameterValue,
    graph_nodes,
    node_command,
    start,
    stop,
)
from swarm_loc_estimator.offline.live_run import ESTIMATOR, PLAYER, START_PATIENCE_S, LiveGraph, cpu_seconds
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_estimator.watch.server import free_port

SIZES = (5, 300, 1000)
BARS_MS = {5: 100.0, 300: 150.0, 1000: 250.0}
LOADED = (5, 300)
_PATIENCE_MS = 60_000
_SETTLED = 20  # So many poses are painted before any counts

Samples = dict[str, list[float]]


def measure(browser: Browser, robots: int, work: Path, seconds: float) -> tuple[dict[str, float], Samples]:
    """Figures of a page with robots without an estimator, and latencies and times of painting [ms]."""
    swarm_file = work / f"swarm{robots}.yaml"
    save_swarm(swarm_of(robots), swarm_file, "Robots of a benchmark.")
    publisher = [sys.executable, "-m", "bench.watch.publisher", str(swarm_file)]
    with ExitStack() as stack:
        stack.enter_context(own_domain())
        port = free_port()
        log = stack.enter_context((OUT / "watch.log").open("wb"))
        parameters: dict[str, ParameterValue] = {"swarm_file": str(swarm_file), "port": port}
        node = NodeSpec("swarm_loc_estimator", "watch_node", "watch", parameters=parameters)
        children = [Child(node, start(command, log)) for command in (node_command(node), publisher)]
        stack.callback(stop, children, lambda _: None)
        page = open_page(browser, port, children[0])
        page.until(f"watch.metrics.latency.length > {_SETTLED}", round(1e3 * START_PATIENCE_S))
        page.until("isFinite(watch.painter.u[0])", round(1e3 * START_PATIENCE_S))  # located
        page.page.mouse.click(*page.place_of(0))
        page.evaluate("{ watch.metrics.latency.length = watch.metrics.frame.length = 0 }")
        pid, begin_s = children[0].process.pid, time.monotonic()
        begin_cpu_s = cpu_seconds(pid)
        page.page.wait_for_timeout(1e3 * seconds)
        core = (cpu_seconds(pid) - begin_cpu_s) / (time.monotonic() - begin_s)
        samples: Samples = page.evaluate("({latency: watch.metrics.latency, frame: watch.metrics.frame})")
        page.close()
    figures = {f"{name}_ms": float(np.percentile(values, 95.0)) for name, values in samples.items()}
    counts = {"page_errors": float(len(page.errors)), "foreign_requests": float(len(page.foreign))}
    shown = {
        "painted_per_s": len(samples["latency"]) / seconds,
        "frame_median_ms": float(np.median(samples["frame"])),
    }
    return {**figures, "server_core": core, **counts, **shown}, samples


def swarm_of(robots: int) -> Swarm:
    """As many robots as wanted, on the grid of the publisher, and landmarks around."""
    reach = float(homes(robots).max()) + 0.5
    marks = [Landmark(5000 + k, reach * (k % 2), reach * (k // 2), yaw=0.0) for k in range(4)]
    return Swarm(tuple(Robot(f"robot{k}") for k in range(robots)), tuple(marks))


def open_page(browser: Browser, port: int, child: Child) -> WatchedPage:
    """The page of a node that is about to listen."""
    deadline_s = time.monotonic() + START_PATIENCE_S
    while not is_listening(child.process.pid, port):
        if child.process.poll() is not None or time.monotonic() > deadline_s:
            raise RuntimeError(f"watch_node has not begun to listen; see {OUT / 'watch.log'}")
        time.sleep(0.1)
    return WatchedPage(browser, f"http://127.0.0.1:{port}/")


def is_listening(pid: int, port: int) -> bool:
    """Whether somebody listens on a port of this machine."""
    lines = Path("/proc", str(pid), "net", "tcp").read_text(encoding="ascii").splitlines()[1:]
    return any(line.split()[1].endswith(f":{port:04X}") and line.split()[3] == "0A" for line in lines)


@contextmanager
def own_domain() -> Iterator[None]:
    """A ROS domain of this process and its children."""
    before = dict(os.environ)
    reservation = domain_id()
    os.environ.update(ROS_DOMAIN_ID=str(reservation.__enter__()), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
        reservation.__exit__(None, None, None)


def estimator_core(bag: Path, browser: Browser | None, seconds: float) -> float:
    """CPU time per second of the estimator while a bag is played, with a page or without."""
    port = free_port()
    swarm_file = str(bag / "swarm.yaml")
    options = GraphOptions(swarm_file, bag=str(bag), watch=browser is not None, watch_port=port)
    nodes = [
        replace(node, parameters={**node.parameters, "loop": True}) if node.name == PLAYER else node
        for node in graph_nodes(options)
    ]
    with LiveGraph(nodes, OUT / "watch_load.log") as graph:
        estimator = graph.process(ESTIMATOR)
        graph.wait_for(lambda: bool(graph.recorder.raw), "publish poses", START_PATIENCE_S)
        page = None
        if browser is not None:
            page = open_page(browser, port, Child(nodes[-1], graph.process("watch")))
            page.until("watch.store.frames.sightings", _PATIENCE_MS)
        begin_s, begin_cpu_s = time.monotonic(), cpu_seconds(estimator.pid)
        graph.wait_for(lambda: time.monotonic() > begin_s + seconds, "go on", START_PATIENCE_S)
        core = (cpu_seconds(estimator.pid) - begin_cpu_s) / (time.monotonic() - begin_s)
        if page is not None:
            page.close()
    return core


def bag_of(robots: int, work: Path) -> Path:
    """A bag with so many robots."""
    if robots == LOADED[0]:
        return DEMO_BAG
    bag = work / f"grid{robots}"
    write_bag(simulate_grid(GridSettings(robots=robots, duration_s=12.0)), bag, f"{robots} robots.")
    return bag


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; its exit status."""
    options = options_of(
        __doc__,
        arguments,
        seconds=(15.0, "how long each page is watched"),
        sizes=(SIZES, "numbers of robots"),
        no_load=(False, "leave the estimator's load out"),
    )
    executable = chromium()
    if executable is None:
        print("There is no Chromium here: apt-get install chromium.", file=sys.stderr)
        return 1
    # measure pages of all sizes, and the load of the estimator
    OUT.mkdir(parents=True, exist_ok=True)
    progress, samples, results = ProgressLine("watch"), {}, {}
    with tempfile.TemporaryDirectory() as work, running_browser(executable) as browser:
        for robots in options.sizes:
            progress(f"page with {robots} robots")
            results[robots], samples[robots] = measure(browser, robots, Path(work), options.seconds)
        for robots in () if options.no_load else LOADED:
            progress(f"estimator of {robots} robots")
            bag, figures = bag_of(robots, Path(work)), results.setdefault(robots, {})
            figures["estimator_core_alone"] = estimator_core(bag, None, options.seconds)
            figures["estimator_core_watched"] = estimator_core(bag, browser, options.seconds)
    # table and figures
    print()
    names = list(dict.fromkeys(name for figures in results.values() for name in figures))
    rows = [[name, *(figures.get(name) for figures in results.values())] for name in names]
    bars = ["bar: latency_ms", *(BARS_MS.get(robots) for robots in results)]
    print(table(["figure", *(f"{robots} robots" for robots in results)], [*rows, bars]))
    for name, label in (("latency", "stamp to painted [ms]"), ("frame", "painting [ms]")):
        curves = {}
        for robots, of_size in samples.items():
            values = np.sort(of_size[name])
            curves[f"{robots} robots"] = (values, np.arange(1, values.size + 1) / values.size)
        plot_curves(f"watch-{name}", (label, "share", (), curves))
    sized = flat({f"robots{n}": figures for n, figures in results.items()})
    print(f"figures: {write_figures('watch', sized | {'machine_load': os.getloadavg()[0]})}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
