"""Replay bags with many settings, losses and seeds: one table, with plots.

    sweep sweep.yaml
    sweep sweep.yaml --out out/horizons
    sweep sweep.yaml --backend ray --cluster 192.168.1.10:6379

The file names bags and a grid of settings; every combination is replayed, see doc/sweep.md. table.csv has
one row per replay; sweep.html and the PNG files show what each varied value does. An interrupted sweep goes
on from where it was when it is started again, and its table is the same, byte for byte. Replays that failed
are rows with the reason, and the next run tries them again. A section `fit` searches ranges of settings for
the best values, by optuna.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

from swarm_loc_estimator.common.command_line import ProgressLine, argument, command, folder_to_write
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.offline.sweep.report import SWEEP_FILES, rows_of, write_results
from swarm_loc_estimator.offline.sweep.sweep import NAMES, Backend, Line, read_sweep, run_fit, run_sweep


@command(
    __doc__,
    argument("file", metavar="SWEEP_FILE", type=Path, help="what is replayed"),
    argument("--out", type=folder_to_write(*SWEEP_FILES), default="out/sweep", help="folder for the results"),
    argument("--backend", choices=NAMES, default=NAMES[0], help="what runs the replays"),
    argument("--cluster", metavar="ADDRESS", help="a running cluster of Ray or Dask"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    if options.cluster and options.backend == "loky":
        raise UserError("--cluster is for --backend ray or dask; loky has the processes of this machine.")
    sweep = read_sweep(options.file)
    with ProgressLine() as progress:
        backend = Backend(options.backend, options.cluster)
        path, best = options.out / "jobs.jsonl", None
        if (fit := sweep.fit) is None:
            finished: Mapping[str, Line] = run_sweep(sweep, path, backend, progress)
        else:
            sweep, finished, best = run_fit(sweep, fit, path, backend, progress)
        progress(1.0, "writing the table and plots")
        rows = rows_of(sweep, finished)
        page = write_results(rows, sweep.varied, options.out)
    print(f"{len(rows)} replays\nTable: {options.out / 'table.csv'}\nPage:  {page}")
    if best is not None:
        gained = "".join(f" --set {name}={value:.6g}" for name, value in best.values.items())
        before = "" if best.mean_before is None else f", {best.mean_before:.6g} with the defaults"
        print(f"Best: {gained}\n       mean {best.minimized} {best.mean:.6g}{before}")
    if failed := [row for row in rows if row["failure"]]:
        first = f"the first: {failed[0]['failure']}"
        print(f"{len(failed)} of {len(rows)} replays failed, {first}", file=sys.stderr)
    if fit is not None and best is None:
        print(f"No trial has {fit.minimize} of all its replays.", file=sys.stderr)
    return int(bool(failed) or (fit is not None and best is None))
