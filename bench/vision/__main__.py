"""Measure the detector alone: `make bench-vision`."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.vision.boards import PHOTOS, measure_covariances
from bench.vision.report import measure, plot


def main() -> None:
    """Print the tables and figures, and draw the plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="runs of images")
    parser.add_argument("--frames", type=int, default=10, help="images of each kind per run")
    parser.add_argument("--photos", type=Path, default=PHOTOS, help="folder of photographs of boards")
    arguments = parser.parse_args()
    covariances = measure_covariances(range(2 * arguments.seeds), arguments.photos)
    result = measure(range(arguments.seeds), arguments.frames)
    print(result.tables())
    for name, value in {**result.figures(), **covariances}.items():
        print(f"{name} = {value:.4g}")
    print(plot(result.scores))


if __name__ == "__main__":
    main()
