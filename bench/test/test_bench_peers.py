"""What the peers are given must be right before they are compared with."""

from dataclasses import replace

import numpy as np
import pytest

from bench.peers.problem import Moves, Odometry, no_moves, relative_poses, sightings_of, starts_of
from bench.shared.grid import GridSettings, simulate_grid
from bench.shared.simulated_run import without_delay
from swarm_loc_drivers.sim.run import SimulatedRun
from swarm_loc_drivers.sim.scenarios.eight import EightSettings, simulate_eight
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

SHARP = replace(W0, heading_sigma=0.05, described=replace(W0.described, heading_sigma=0.05))
"""A world whose headings are good enough for linear error propagation, unlike the paper's 29 degrees."""


@pytest.fixture(scope="module")
def grid() -> SimulatedRun:
    return simulate_grid(GridSettings(robots=50, duration_s=8.0))


def normalised(error: FloatArray, covariance: FloatArray) -> float:
    """Mean of e' C^-1 e over 3; 1 for a right covariance."""
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return float(np.mean(np.sum(error * solved, axis=-1)) / 3.0)


def true_relative_poses(run: SimulatedRun, stamp_ns: np.ndarray) -> FloatArray:
    """What noise-free sightings say between base links at `stamp_ns`."""
    sightings = sightings_of(run)
    observer = run.truth.at(sightings.observer, stamp_ns)
    target = run.truth.at(np.maximum(sightings.target, 0), stamp_ns)
    return np.where((sightings.target < 0)[:, None], observer, se2.between(observer, target))


def test_odometry_between_two_stamps_errs_as_its_covariance_says(grid: SimulatedRun) -> None:
    odometry = Odometry(grid, grid.odometry)
    begin = grid.start_ns + np.arange(0, 7_000_000_000, 500_000_000)
    robot, from_ns = (values.ravel() for values in np.meshgrid(np.arange(50), begin))
    to_ns = from_ns + 473_000_000  # not at a message
    step, covariance = odometry.step(robot, from_ns, to_ns)
    truth = se2.between(grid.truth.at(robot, from_ns), grid.truth.at(robot, to_ns))
    assert normalised(se2.log(se2.between(step, truth)), covariance) == pytest.approx(1.0, abs=0.12)
    back, back_covariance = odometry.step(robot, to_ns, from_ns)
    np.testing.assert_allclose(back, se2.inverse(step), atol=1e-12)
    assert normalised(se2.log(se2.between(back, se2.inverse(truth))), back_covariance) == pytest.approx(
        1.0, abs=0.12
    )


def test_odometry_at_its_messages_is_what_they_say(grid: SimulatedRun) -> None:
    odometry = Odometry(grid, grid.odometry)
    pose, _ = odometry.at(grid.odometry["robot"].astype(np.int64), grid.odometry["stamp_ns"])
    np.testing.assert_allclose(pose, grid.odometry["pose"], atol=1e-12)


@pytest.mark.parametrize("world", ["grid", "eight"])
def test_relative_poses_err_as_their_covariance_says(world: str, grid: SimulatedRun) -> None:
    run = grid if world == "grid" else simulate_eight(EightSettings(duration_s=20.0, errors=SHARP))
    sightings = sightings_of(run)
    count = len(sightings.stamp_ns)
    relative = relative_poses(sightings, no_moves(count), no_moves(count))
    error = se2.between(relative.pose, true_relative_poses(run, sightings.stamp_ns))
    assert normalised(error, relative.covariance) == pytest.approx(1.0, abs=0.05)


def test_sightings_moved_to_another_stamp_err_as_their_covariance_says(grid: SimulatedRun) -> None:
    sightings = sightings_of(grid)
    odometry = Odometry(grid, grid.odometry)
    wanted = (sightings.stamp_ns - grid.start_ns + 100_000_000) // 200_000_000 * 200_000_000 + grid.start_ns
    moves = [
        Moves(*odometry.step(who, wanted, sightings.stamp_ns))
        for who in (sightings.observer, np.maximum(sightings.target, 0))
    ]
    relative = relative_poses(sightings, moves[0], moves[1])
    error = se2.between(relative.pose, true_relative_poses(grid, wanted))
    assert normalised(error, relative.covariance) == pytest.approx(1.0, abs=0.04)


def test_starts_err_as_their_covariance_says() -> None:
    run = simulate_grid(GridSettings(robots=900, duration_s=0.1))
    start, covariance = starts_of(run)
    assert normalised(se2.between(start, run.truth.poses[0]), covariance) == pytest.approx(1.0, abs=0.15)


def test_filterpys_jacobian_is_the_derivative_of_its_model() -> None:
    filterpy_ekf = pytest.importorskip("bench.peers.filterpy_ekf", exc_type=ImportError)
    run = simulate_eight(EightSettings(duration_s=3.0))
    sightings = sightings_of(run)[:40]
    assert (sightings.target >= 0).any()
    assert (sightings.target < 0).any()
    x = run.truth.poses[100].ravel()
    camera = se2.compose(np.array([0.01, -0.02, 0.3]), sightings.mount)
    analytic = filterpy_ekf.jacobian(x, sightings, camera, sightings.marker)
    for column in range(x.size):
        step = np.zeros_like(x)
        step[column] = 1e-6
        high, low = (
            filterpy_ekf.expected_values(x + s, sightings, camera, sightings.marker) for s in (step, -step)
        )
        numeric = filterpy_ekf.residual(high, low) / 2e-6
        np.testing.assert_allclose(analytic[:, column], numeric, atol=1e-7)


@pytest.mark.parametrize("name", ["filterpy_ekf", "gtsam_lag", "gtsam_batch"])
def test_a_peer_localizes_a_small_swarm(name: str) -> None:
    peer = pytest.importorskip(f"bench.peers.{name}", exc_type=ImportError)
    run = simulate_grid(GridSettings(robots=6, duration_s=4.0))
    output_ns = run.start_ns + np.array([2_500_000_000, 3_050_000_000, 3_900_000_000])
    result = peer.solve(run, output_ns)
    error = result.poses - run.truth.all_at(output_ns)
    assert np.sqrt((error[..., :2] ** 2).sum(axis=-1).mean()) < 0.006
    assert result.cpu_s > 0.0


def test_without_delay_all_is_there_in_the_order_in_which_it_happened(grid: SimulatedRun) -> None:
    run = without_delay(grid)
    for late, prompt in ((grid.odometry, run.odometry), (grid.frames, run.frames)):
        assert len(late) == len(prompt)
        assert np.all(np.diff(prompt["stamp_ns"]) >= 0)
        np.testing.assert_array_equal(prompt["arrival_ns"], prompt["stamp_ns"])
    assert sorted(seen_by(run)) == sorted(seen_by(grid))
    assert seen_by(run) != seen_by(grid)


def seen_by(run: SimulatedRun) -> list[tuple[int, int, tuple[float, ...]]]:
    """Who saw each sighting when, and what."""
    who = (np.repeat(run.frames[name], run.frames["count"]).tolist() for name in ("robot", "stamp_ns"))
    first = np.cumsum(run.frames["count"]) - run.frames["count"]
    np.testing.assert_array_equal(run.frames["first"], first)
    return list(zip(*who, map(tuple, run.sightings["value"].tolist()), strict=True))
