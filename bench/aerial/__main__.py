"""The aerial detector on drawn pictures and on pictures of others: what is found, and how exactly."""

from bench.aerial import cases, detector
from bench.shared.common import options_of, write_figures


def main() -> None:
    """Print the tables, write the figures."""
    arguments = options_of(__doc__, seed=(1, "of all pictures"), share=(1.0, "of the usual number of seeds"))
    figures = detector.measure(arguments.seed, max(2, round(detector.SEEDS * arguments.share)))
    print(write_figures("aerial", figures | cases.measure()))


if __name__ == "__main__":
    main()
