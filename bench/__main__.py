"""Run a benchmark by its name: python -m bench NAME [ARGUMENTS], which `make bench-NAME` calls."""

import runpy
import sys

BENCHMARKS = {
    "aerial": "bench.aerial",
    "commissioning": "bench.commissioning",
    "droplet": "bench.droplet",
    "epuck": "bench.epuck",
    "generate_bag": "bench.scenarios.generate_bag",
    "integrity": "bench.integrity",
    "large_swarms": "bench.graph.large_swarms",
    "lidar": "bench.lidar",
    "mrclam": "bench.mrclam",
    "selfcal": "bench.selfcal",
    "pushbot": "bench.pushbot",
    "pushbot_bag": "bench.pushbot.bag",
    "reading": "bench.peers.reading",
    "robots": "bench.robots",
    "robustness": "bench.robustness",
    "scaling": "bench.peers.scaling",
    "start": "bench.start",
    "vision": "bench.vision",
}
"""Name -> module."""


def main() -> None:
    """Run the benchmark that the first argument names with the other ones."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in BENCHMARKS:
        sys.exit(f"'{name}' is no benchmark; there are {', '.join(BENCHMARKS)}.")
    del sys.argv[1]
    runpy.run_module(BENCHMARKS[name], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
