"""Robots that find themselves among anonymous ones in images from above: success rates, times, detections."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.aerial import calibration, cases, detector, driving, rendered
from bench.aerial.rates import SWARMS, Results
from bench.shared.common import Cell, new_plot, save_plot, table, write_figures

_METHODS = {
    "chained, 4 images": "chained4.n{}.success",
    "... scale unknown": "random.n{}.scale_unknown.success",
}
_TIME = "chained4.n{}.us_per_robot_picture"


def main() -> None:
    """Print the tables, write the figures, draw the plots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="of all worlds")
    parser.add_argument("--share", type=float, default=1.0, help="of the usual number of trials")
    arguments = parser.parse_args()
    results, share, seed = Results(), arguments.share, arguments.seed
    driving.measure(results, max(10, round(200 * share)), seed)
    reliability = calibration.measure(results, max(20, round(300 * share)), seed)
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
    print(_drawn(results), _reliability_drawn(reliability), sep="\n")


def _drawn(results: Results) -> Path:
    """Success rates with their intervals, and times, against the size of the swarm."""
    figure, (rates, times) = new_plot(2, width=5.2)
    for name, key in _METHODS.items():
        all_of = [results.rates[key.format(n)] for n in SWARMS]
        shares = [100.0 * one.share for one in all_of]
        ends = [[100.0 * end for end in one.interval] for one in all_of]
        below = [max(0.0, share - end[0]) for share, end in zip(shares, ends, strict=True)]
        above = [max(0.0, end[1] - share) for share, end in zip(shares, ends, strict=True)]
        rates.errorbar(SWARMS, shares, yerr=[below, above], label=name, capsize=2, marker=".")
    rates.set(xlabel="robots", ylabel="success [%]", xscale="log", ylim=(0.0, 102.0))
    rates.set_xticks(SWARMS, [str(n) for n in SWARMS])
    rates.minorticks_off()
    rates.legend(fontsize=8)
    times.loglog(SWARMS, [results.values[_TIME.format(n)] for n in SWARMS], marker=".")
    times.set(xlabel="robots", ylabel="time per robot and image [us]")
    times.set_xticks(SWARMS, [str(n) for n in SWARMS])
    times.minorticks_off()
    return save_plot(figure, "aerial")


def _reliability_drawn(reliability: calibration.Reliability) -> Path:
    """How often answers are right, against their probability."""
    figure, (axis,) = new_plot(1)
    mean, share, counts = reliability.binned()
    axis.plot([0.0, 1.0], [0.0, 1.0], color="0.7", linewidth=1.0)
    axis.scatter(mean, share, s=4.0 + 60.0 * counts / counts.max(), zorder=3)
    axis.set(xlabel="published probability", ylabel="share of right answers", xlim=(0, 1.02), ylim=(0, 1.02))
    return save_plot(figure, "aerial-reliability")


if __name__ == "__main__":
    main()
