"""Measure the detector alone: `make bench-vision`."""

from bench.shared.common import options_of, table, write_figures
from bench.vision.boards import PHOTOS, measure_covariances
from bench.vision.report import measure, plot


def main() -> None:
    """Print the tables and figures, and draw the plot."""
    arguments = options_of(
        __doc__,
        seeds=(3, "runs of images"),
        frames=(10, "images of each kind per run"),
        photos=(PHOTOS, "folder of photographs of boards"),
    )
    covariances = measure_covariances(range(2 * arguments.seeds), arguments.photos)
    result = measure(range(arguments.seeds), arguments.frames)
    print(result.tables())
    figures = {**result.figures(), **covariances}
    print(table(("figure", "value"), list(figures.items())))
    print(write_figures("vision", figures), plot(result.scores))


if __name__ == "__main__":
    main()
