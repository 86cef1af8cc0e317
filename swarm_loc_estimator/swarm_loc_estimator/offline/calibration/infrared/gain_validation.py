"""Which robots' gains help where they were not estimated from: cross-validation over blocks of time.

Gains are estimated without one block after the other, and the exchanges of each are judged by those that
were estimated without it. Gains help where exchanges are likelier by them than if elements were all alike,
and than if nobody knew. Errors of the curves are alike in exchanges of one stretch of time, so what blocks
say of all robots together must stand out from how much they differ; of each robot by itself that is too much
to ask, for some read little.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.infrared.gains import Exchanges, GainsError, estimate_gains
from swarm_loc_estimator.offline.calibration.infrared.held_out import (
    ALIKE,
    GAINS,
    HYPOTHESES,
    UNKNOWN,
    held_out_likelihoods,
)
from swarm_loc_estimator.swarm.ir_board import IrPlatform

BLOCKS = 4
_EVIDENCE = math.log(100.0)
"""By so much the log likelihood of all exchanges must be larger."""


def helpful_gains(
    platform: IrPlatform,
    robots: int,
    exchanges: Exchanges,
    progress: Callable[[str], None] = lambda _: None,
) -> BoolArray:
    """Whether the gains (robots,) that `estimate_gains` finds of these exchanges help in others.

    Args:
        platform: Of all robots.
        robots: How many there are.
        exchanges: What they read, in the order of time.
        progress: Called with a word on what is being done.
    """
    count = len(exchanges.receiver)
    logs, blocks = np.full((count, HYPOTHESES, HYPOTHESES), np.nan), np.arange(count) * BLOCKS // count
    for block in range(BLOCKS):
        progress(f"held-out block {block + 1}")
        held = blocks == block
        try:
            fit = estimate_gains(platform, robots, exchanges.chosen(~held))
        except GainsError:
            continue
        logs[held] = held_out_likelihoods(platform, fit.gains, exchanges.chosen(held))
    return _chosen_robots(np.stack([exchanges.receiver, exchanges.transmitter]), logs, blocks, robots)


def _chosen_robots(
    pairs: NDArray[np.int64], logs: FloatArray, blocks: NDArray[np.int64], robots: int
) -> BoolArray:
    """Leave out the robot whose gains help least, until each of the others' help, and all of them for sure.

    Args:
        pairs: (2, k) receivers and transmitters.
        logs: (k, H, H) log likelihoods by the hypotheses on both.
        blocks: (k,) of time.
        robots: How many there are.
    """
    helps = np.ones(robots, dtype=np.bool_)
    while helps.any():
        own = np.full(robots, np.inf)
        for robot in np.flatnonzero(helps).tolist():
            alone = np.arange(robots) == robot
            own[robot] = min(by_block.sum() for by_block in _by_block(pairs, logs, blocks, helps, alone))
        sure = min(_beyond_chance(by_block) for by_block in _by_block(pairs, logs, blocks, helps, helps))
        if own.min() > 0.0 and sure > 0.0:
            break
        helps[own.argmin()] = False
    return helps


def _by_block(
    pairs: NDArray[np.int64],
    logs: FloatArray,
    blocks: NDArray[np.int64],
    helps: BoolArray,
    judged: BoolArray,
) -> list[FloatArray]:
    """By how much (blocks,) gains of robots that are judged are likelier than each other hypothesis."""
    receiver, transmitter = np.where(helps, GAINS, UNKNOWN)[pairs]
    rows, gains = np.arange(len(blocks)), []
    for hypothesis in (ALIKE, UNKNOWN):
        one, other = np.where(judged[pairs], hypothesis, (receiver, transmitter))
        gain = logs[rows, receiver, transmitter] - logs[rows, one, other]
        gains.append(np.bincount(blocks, np.nan_to_num(gain), BLOCKS).astype(np.float64))
    return gains


def _beyond_chance(by_block: FloatArray) -> float:
    """By how much a sum over blocks is larger than it must be."""
    return float(by_block.sum() - max(_EVIDENCE, np.linalg.norm(by_block)))
