"""Fit settings to several bags at once: a sweep whose grid optuna extends by what it has seen so far."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.parameters import Value
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.offline.sweep.grid import Fit, Job, Sweep
from swarm_loc_estimator.offline.sweep.jobs import Backend, Line, loaded, run_sweep
from swarm_loc_estimator.timeline.settings import Settings

_AT_ONCE = 8
"""Trials that are chosen at a time, whatever the number of workers, so that it does not change the table."""


class Best(NamedTuple):
    """The best trial of a fit."""

    values: Mapping[str, Value]  # Setting -> value
    minimized: str  # The column that it minimizes
    mean: float  # Of this column
    # The same with the defaults; None: they are not in the ranges, or have no figure
    mean_before: float | None


class Fitted(NamedTuple):
    """A finished fit."""

    sweep: Sweep  # With the replays of all trials
    finished: Mapping[str, Line]  # Key of a job -> its line
    best: Best | None  # None if each trial had a replay without the figure


def run_fit(sweep: Sweep, fit: Fit, path: Path, backend: Backend, progress: Progress) -> Fitted:
    """Run the trials of a fit; the defaults are the first one, where the ranges contain them.

    Args:
        sweep: The replays of each trial.
        fit: What is tried.
        path: See `run_sweep`; what is finished there is not run again, so a fit can be interrupted, too.
        backend: Runs the workers.
        progress: Called after each job.

    Raises:
        BackendError: optuna is not installed, or the back end is not reached.
        UserError: A worker was killed.
    """
    optuna = loaded("optuna", "optuna")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0, n_startup_trials=_AT_ONCE))
    defaults = {name: getattr(Settings(), name) for name in fit.ranges}
    if all(low <= defaults[name] <= high for name, (low, high) in fit.ranges.items()):
        study.enqueue_trial(defaults)
    kinds = {int: optuna.distributions.IntDistribution, float: optuna.distributions.FloatDistribution}
    searched = {name: kinds[type(defaults[name])](*bounds) for name, bounds in fit.ranges.items()}
    jobs: list[Job] = []
    finished: dict[str, Line] = {}
    for first in range(0, fit.trials, _AT_ONCE):
        trials = [study.ask(searched) for _ in range(min(_AT_ONCE, fit.trials - first))]
        asked = [[job.having(trial.params) for job in sweep.jobs] for trial in trials]
        batch = tuple(itertools.chain(*asked))
        jobs += batch

        def at(share: float, what: str, first: int = first, count: int = len(trials)) -> None:
            progress((first + share * count) / fit.trials, f"trial {first + 1} and next ones: {what}")

        finished |= run_sweep(replace(sweep, jobs=batch), path, backend, at)
        for trial, own in zip(trials, asked, strict=True):
            mean = _mean(own, finished, fit.minimize)
            study.tell(trial, mean, state=None if mean is not None else optuna.trial.TrialState.FAIL)
    every = replace(sweep, jobs=tuple({job.key: job for job in jobs}.values()))
    complete = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    if not complete:
        return Fitted(every, finished, None)
    best = min(complete, key=lambda trial: trial.value)
    before = complete[0].value if complete[0].params == defaults else None
    return Fitted(every, finished, Best(best.params, fit.minimize, best.value, before))


def _mean(jobs: Sequence[Job], finished: Mapping[str, Line], column: str) -> float | None:
    """The mean of a column over jobs; None if one has no figure."""
    values = [finished[job.key].get("figures", {}).get(column) for job in jobs]
    return None if None in values else float(np.mean(values))
