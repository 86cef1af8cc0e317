"""The mapper's pose graph beside gtsam: the same normal equations of finished maps, solved by both.

gtsam gets one key per stop and robot, and a Hessian factor per block of the matrix, built before timing; the
mapper's time includes building the matrix of its blocks.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from bench.pushbot.lidar import LidarDrive
from bench.shared.common import Cell, table
from swarm_loc_drivers.sim.pushbot.exploration import Exploration, PushBotNoise
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.pose_graph import STOP_UNKNOWNS

if TYPE_CHECKING:
    from collections.abc import Callable

    from swarm_loc_estimator.common.arrays import FloatArray
    from swarm_loc_estimator.mapping.pose_graph import NormalEquations, PoseGraph

SLIP, PLAN = 0.02, "corridor"
_REPEATS = 5
_STOP_STRIDE = 10  # Covariances of every tenth stop are compared


def measure_graphs(seeds: int, minutes: float) -> dict[str, float]:
    """Print differences from gtsam and times for maps by laser pointers and by a lidar; return the worst."""
    rows: list[list[Cell]] = []
    figures: dict[str, float] = {}
    for kind in ("pointer", "lidar"):
        found = [compared(mapped(kind, seed, minutes).graph) for seed in range(1, seeds + 1)]
        worst = {name: max(one[name] for one in found) for name in found[0]}
        rows += [[kind, seed, *one.values()] for seed, one in enumerate(found, 1)]
        figures |= {f"graph.{kind}.{name}": value for name, value in worst.items()}
    head = ["map", "seed", "stops", "step differs m", "sigma differs", "solve ms", "gtsam"]
    head += ["covariances ms", "gtsam"]
    print(table(head, rows))
    return figures


def mapped(kind: str, seed: int, minutes: float) -> CooperativeMapper:
    """A finished map of the hallway by two PushBots, or by a robot with a lidar."""
    plan, rng, mapper = floor_plan(PLAN), np.random.default_rng([seed, 332]), CooperativeMapper()
    if kind == "lidar":
        LidarDrive.starting(plan, mapper, SLIP, rng).run(60.0 * minutes)
    else:
        exploration = Exploration(plan, mapper, rng, use_lights=True)
        for _ in range(2):
            exploration.join(PushBotNoise(slip=SLIP))
        exploration.run(60.0 * minutes, lambda _: None)
    mapper.finish()
    return mapper


def compared(graph: PoseGraph) -> dict[str, float]:
    """Differences of steps and standard deviations, and least times, of a solution from gtsam's.

    The graph is disturbed first, since the step of a solved one is zero.
    """
    rng = np.random.default_rng(graph.count)
    graph.states[: graph.count, :3] += rng.normal(0.0, (0.01, 0.01, 0.003), (graph.count, 3))
    graph.states[: graph.count, 2] = wrap_angle(graph.states[: graph.count, 2])
    size = STOP_UNKNOWNS * graph.count + len(graph.slip)
    equations = graph.equations(np.ones(size, dtype=bool))
    peer = gtsam_graph(equations, graph.count)
    step, factor = equations.solve()
    tree = peer.eliminateMultifrontal()
    stops = range(0, graph.count, _STOP_STRIDE)
    theirs = np.concatenate([tree.optimize().at(key) for key in range(graph.count)])
    sigmas = [_sigmas(factor.covariance(STOP_UNKNOWNS * stop + np.arange(3))) for stop in stops]
    peer_sigmas = [_sigmas(tree.marginalCovariance(stop)[:3, :3]) for stop in stops]

    def ours_covariances() -> None:
        for stop in stops:
            factor.covariance(STOP_UNKNOWNS * stop + np.arange(3))

    def peer_covariances() -> None:
        fresh = peer.eliminateMultifrontal()  # it keeps what covariances share
        for stop in stops:
            fresh.marginalCovariance(stop)

    solving_ms = _least_ms(lambda: peer.eliminateMultifrontal().optimize())
    return {
        "stops": float(graph.count),
        "step_difference_m": float(np.abs(step[: theirs.size] - theirs).max()),
        "sigma_ratio_difference": float(np.abs(np.divide(sigmas, peer_sigmas) - 1.0).max()),
        "solve_ms": _least_ms(equations.solve),
        "gtsam_solve_ms": solving_ms,
        "covariances_ms": _least_ms(ours_covariances),
        "gtsam_covariances_ms": _least_ms(peer_covariances) - solving_ms,
    }


def gtsam_graph(equations: NormalEquations, stops: int) -> gtsam.GaussianFactorGraph:
    """Normal equations whose unknowns are all free as factors: keys are stops, and then robots."""
    matrix, right = equations.system()
    by_row = matrix.tocsr()
    begins = np.concatenate(
        [STOP_UNKNOWNS * np.arange(stops), np.arange(STOP_UNKNOWNS * stops, matrix.shape[0] + 1)]
    )
    key_of = np.repeat(np.arange(begins.size - 1), np.diff(begins))
    graph = gtsam.GaussianFactorGraph()
    for key in range(begins.size - 1):
        own = slice(begins[key], begins[key + 1])
        graph.push_back(gtsam.HessianFactor(key, by_row[own, own].toarray(), right[own], 0.0))
        for other in np.unique(key_of[by_row[own].indices]):
            if other > key:
                there = slice(begins[other], begins[other + 1])
                block = by_row[own, there].toarray()
                (here, none), (over, zero) = ((np.zeros((n, n)), np.zeros(n)) for n in block.shape)
                graph.push_back(gtsam.HessianFactor(key, other, here, block, none, over, zero, 0.0))
    return graph


def _sigmas(covariance: FloatArray) -> FloatArray:
    sigmas: FloatArray = np.sqrt(np.diag(covariance))
    return sigmas


def _least_ms(call: Callable[[], object]) -> float:
    """The least time of some calls [ms]."""
    times = []
    for _ in range(_REPEATS):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return 1e3 * min(times)
