"""Whether published probabilities are right as often as they say, in all kinds of conditions."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.aerial.driving import followed
from bench.aerial.worlds import PERIOD_NS, Conditions, simulate
from swarm_loc_estimator.identification.chain import ChainModel, Scale

if TYPE_CHECKING:
    from bench.aerial.rates import Results
    from swarm_loc_estimator.common.arrays import BoolArray, FloatArray

_SURE = 0.99
_ROBOTS_PER_WORLD = 4
_BINS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0 + 1e-12)


class Reliability(NamedTuple):
    """Answers by their probabilities."""

    probability: FloatArray  # (a,) of each best answer
    right: BoolArray  # (a,) whether it was

    def binned(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean probability, share of right answers and count of each bin that is not empty."""
        which = np.digitize(self.probability, _BINS) - 1
        counts = np.bincount(which, minlength=len(_BINS) - 1)
        some = counts > 0
        mean = np.bincount(which, self.probability, len(_BINS) - 1)[some] / counts[some]
        share = np.bincount(which, self.right, len(_BINS) - 1)[some] / counts[some]
        return mean, share, counts[some].astype(float)


def measure(results: Results, worlds: int, seed: int) -> Reliability:
    """Best answers after each image but the first, by what the estimator assumes by default."""
    rng = np.random.default_rng([seed, 7])
    probability, right = [], []
    for _ in range(worlds):
        conditions = _drawn(rng)
        model = ChainModel(scale=Scale(1.0, 0.02), scale_drift=conditions.drift / np.sqrt(PERIOD_NS * 1e-9))
        world = simulate(conditions, rng)
        for robot in range(min(conditions.robots, _ROBOTS_PER_WORLD)):
            for k, chains in enumerate(followed(world, robot, conditions, model)):
                found = chains.probabilities
                if k and found.size:
                    probability.append(float(found.max()))
                    right.append(int(found.argmax()) == world.place_of(robot, k))
    reliability = Reliability(np.array(probability), np.array(right))
    sure = reliability.probability >= _SURE
    results.count("calibration.right_share_at_99", int(reliability.right[sure].sum()), int(sure.sum()))
    results.values["calibration.answered_share_at_99"] = float(sure.mean())
    return reliability


def _drawn(rng: np.random.Generator) -> Conditions:
    """Any conditions: few robots and many, all in the picture and not, missed, false, drifting."""
    return Conditions(
        robots=int(rng.integers(2, 31)),
        images=int(rng.integers(3, 8)),
        arena=[(30.0, 22.0), (10.0, 10.0), (5.0, 5.0)][rng.integers(3)],
        detected=float(rng.uniform(0.85, 1.0)),
        false_detections=float(rng.choice([0.0, 0.3, 1.5])),
        view=float(rng.choice([1.0, 1.0, 0.75])),
        drift=float(rng.choice([0.0, 0.005])),
    )
