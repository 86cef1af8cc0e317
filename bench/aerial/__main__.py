"""Robots that find themselves among anonymous ones in images from above: success rates, times, detections."""

from bench.aerial import cases, chains, detector, rendered
from bench.aerial.chains import SWARMS, Results
from bench.shared.common import Cell, options_of, plot_curves, table, write_figures

_METHODS = {
    "chained, 4 images": "chained4.n{}.success",
    "... scale unknown": "random.n{}.scale_unknown.success",
}
_TIME = "chained4.n{}.us_per_robot_picture"


def main() -> None:
    """Print the tables, write the figures, draw the plots."""
    arguments = options_of(__doc__, seed=(1, "of all worlds"), share=(1.0, "of the usual number of trials"))
    results, share, seed = Results(), arguments.share, arguments.seed
    chains.measure(results, max(10, round(200 * share)), seed)
    reliability = chains.measure_calibration(results, max(20, round(300 * share)), seed)
    rows: list[list[Cell]] = [
        [f"{name} [%]", *(f"{100.0 * results.rates[key.format(n)].share:.1f}" for n in SWARMS)]
        for name, key in _METHODS.items()
    ]
    rows.append(["time per robot and image [us]", *(results.values[_TIME.format(n)] for n in SWARMS)])
    print(table(["success of", *(f"n = {n}" for n in SWARMS)], rows))
    seen = detector.measure(seed, max(2, round(detector.SEEDS * share)))
    seen |= cases.measure()
    seen |= rendered.measure(seed, max(1, round(rendered.WORLDS_RUN * share)))
    print(write_figures("aerial", {**results.figures(), **seen}))
    success = {
        name: [100.0 * results.rates[key.format(n)].share for n in SWARMS] for name, key in _METHODS.items()
    }
    times = {"": [results.values[_TIME.format(n)] for n in SWARMS]}
    mean, found, _ = reliability.binned()
    plot_curves(
        "aerial",
        ("robots", "success [%]", SWARMS, success),
        ("robots", "time per robot and image [us]", SWARMS, times),
        ("published probability", "share of right answers", mean, {"": found, "ideal": mean}),
        style=".-",
    )


if __name__ == "__main__":
    main()
