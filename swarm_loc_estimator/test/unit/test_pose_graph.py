"""The pose graph: Jacobians of constraints, sparse normal equations beside dense ones, covariances."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping import pose_graph
from swarm_loc_estimator.mapping.pose_graph import NormalEquations, PoseGraph
from swarm_loc_estimator.mapping.scans import Scan
from swarm_loc_estimator.mapping.settings import MapperSettings

SEEDS = range(5)
STOPS = 4
FIRST, SECOND = np.array([0, 1, 2]), np.array([1, 3, 0])


def kinds(rng: np.random.Generator) -> dict[str, Callable[[FloatArray, FloatArray], pose_graph.Linearised]]:
    """Each kind of constraint with numbers of its own, as a function of states (4, 4) and slips (2,)."""
    motion, turn = rng.normal(0.0, 0.6, (3, 3)), rng.normal(0.0, 2.0, 3)
    sigma, robot = rng.uniform(0.01, 0.2, (3, 3)), np.array([0, 0, 1, 1])
    departures = np.column_stack([turn, motion, sigma])
    ties = np.column_stack([motion, rng.normal(0.0, 20.0, (3, 9))])
    bearings = np.column_stack([turn, motion[:, 2], sigma[:, 0]])
    return {
        "odometry": lambda s, _: pose_graph.odometry(s, FIRST, SECOND, departures),
        "ties": lambda s, _: pose_graph.ties(s, FIRST, SECOND, ties),
        "bearings": lambda s, _: pose_graph.bearings(s, FIRST, SECOND, bearings),
        "priors": lambda s, _: pose_graph.priors(s, FIRST, FIRST, np.column_stack([motion, sigma])),
        "ratios": lambda s, slip: pose_graph.ratios(s, slip, robot, np.full(STOPS, 0.01)),
        "slips": lambda s, slip: pose_graph.slips(len(s), slip, 0.02, 0.03),
    }


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["odometry", "ties", "bearings", "priors", "ratios", "slips"])
def test_jacobians_are_those_of_finite_differences(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    residuals = kinds(rng)[kind]
    unknowns = np.concatenate([rng.normal(0.0, 1.0, 4 * STOPS), rng.normal(0.0, 0.05, 2)])

    def at(values: FloatArray) -> pose_graph.Linearised:
        return residuals(values[: 4 * STOPS].reshape(STOPS, 4), values[4 * STOPS :])

    here, step = at(unknowns), 1e-6
    for m in range(len(here.unknowns)):
        for column, index in enumerate(here.unknowns[m]):
            change = np.zeros(len(unknowns))
            change[index] = step
            numeric = (at(unknowns + change).residual[m] - at(unknowns - change).residual[m]) / (2.0 * step)
            assert np.allclose(here.jacobian[m, :, column], numeric, atol=1e-5 * (1.0 + abs(numeric).max()))


def test_sparse_equations_are_the_dense_ones() -> None:
    rng = np.random.default_rng(1)
    states, slip = rng.normal(0.0, 1.0, (STOPS, 4)), np.zeros(2)
    parts = [make(states, slip) for make in kinds(rng).values()]
    size = 4 * STOPS + 2
    H, g = 1e-6 * np.eye(size), np.zeros(size)
    for part in parts:
        for index, jacobian, residual, weight in zip(*part, strict=True):
            H[np.ix_(index, index)] += jacobian.T @ np.diag(weight) @ jacobian
            g[index] -= jacobian.T @ (weight * residual)
    equations = NormalEquations(np.ones(size, dtype=bool))
    equations.add(parts)
    step, factor, _ = equations.solve()
    assert np.allclose(step, np.linalg.solve(H, g))
    chosen = np.array([4, 5, 6])
    assert np.allclose(factor.covariance(chosen), np.linalg.inv(H)[np.ix_(chosen, chosen)])


def test_what_is_not_free_stays() -> None:
    rng = np.random.default_rng(2)
    free = np.ones(4 * STOPS + 2, dtype=bool)
    free[4:8] = False
    equations = NormalEquations(free)
    equations.add([make(rng.normal(0.0, 1.0, (STOPS, 4)), np.zeros(2)) for make in kinds(rng).values()])
    step, _, _ = equations.solve()
    assert (step[4:8] == 0.0).all()
    assert np.abs(step[free]).min() > 0.0


def test_a_chain_is_as_unsure_as_its_odometry_adds_up() -> None:
    graph = PoseGraph(MapperSettings())
    graph.add_robot()
    sigma = np.array([0.02, 0.01, 1e-4])
    stops = [graph.add_stop(0, np.array([float(k), 0.0, 0.0]), 0.02) for k in range(5)]
    for stop in stops:
        graph.set_scan(stop, Scan(np.zeros(1), np.zeros(1)))
    graph.constraints.priors.add(0, 0, np.zeros(3), np.full(3, 1e-4))
    for begin, end in pairwise(stops):
        graph.constraints.departures.add(begin, end, 0.0, np.array([1.0, 0.0, 0.0]), sigma)
    graph.solve(3)
    assert np.allclose(graph.poses[:, 0], range(5), atol=1e-9)
    deviations = np.sqrt(np.diag(graph.covariance(4)))
    assert deviations[:2] == pytest.approx([0.04, 0.02], rel=0.02)


@pytest.mark.parametrize("seed", range(5))
def test_a_wall_that_only_one_robot_sees_tells_nothing_of_where_the_other_is(seed: int) -> None:
    """The first scans of two robots in a corridor, of whom one sees its end."""
    rng, turn = np.random.default_rng(seed), np.linspace(0.0, 2.1 * math.pi, 400)
    graph = PoseGraph(MapperSettings())
    angle = (1.0 - graph.settings.usual_slip) * turn
    sine, cosine = np.sin(angle), np.cos(angle)
    for robot, (x, sigma) in enumerate([(0.0, 0.001), (2.5, 0.1)]):
        graph.add_robot()
        for part in range(2):
            stop = graph.add_stop(robot, np.array([x, 0.0, 0.0]), 0.005)
            ends = np.divide(-1.5 - x, cosine, out=np.full_like(turn, np.inf), where=cosine < 0.0)
            distance = np.minimum(1.2 / np.maximum(np.abs(sine), 1e-9), ends)
            seen = distance < 3.0
            inverse = seen * (1.0 / distance + 0.005 * rng.standard_normal(len(turn)))
            graph.set_scan(stop, Scan(turn, inverse))
            if part:
                motion, unmoved = np.zeros(3), np.full(3, 1e-3)
                graph.constraints.departures.add(stop - 1, stop, 0.0, motion, unmoved)
            else:
                graph.constraints.priors.add(stop, stop, graph.states[stop, :3].copy(), np.full(3, sigma))
    graph.starts.update(range(4))
    graph.place[:4] = [0, 0, 2, 2]
    graph.targets = {stop: [other for other in range(4) if other != stop] for stop in range(4)}
    graph.solve(4)
    along, across = np.sqrt(np.diag(graph.covariance(2)))[:2]
    assert along > 0.09
    assert across < 0.03
    assert abs(graph.states[2, 0] - 2.5) < 0.02
