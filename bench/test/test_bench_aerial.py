"""The paper's printed forms fail as they must; the benchmark's worlds, rates and figures are sound."""

from __future__ import annotations

import numpy as np
import pytest

from bench.aerial import calibration, driving, printed, straight, turning
from bench.aerial.paper_methods import ComplexArray, identify_by_turns, identify_by_way
from bench.aerial.rates import Rate, Results
from bench.aerial.worlds import Conditions, simulate
from swarm_loc_estimator.identification.chain import ChainModel

SEED = 77


@pytest.mark.parametrize("robot", [0, 1, 2])
def test_algorithm_1_as_printed_always_answers_the_last_robot(robot: int) -> None:
    first, turned = np.array([0.1, 1.0, -2.0]), np.array([0.2, 0.7, 1.2])
    second = first + turned
    assert printed.algorithm_1(first, second, float(turned[robot])) == 2
    assert identify_by_turns(np.array([first, second]), turned[[robot]]) == robot


def test_absolute_differences_confuse_left_and_right() -> None:
    headings = np.array([[[0.0, 0.0], [-0.5, 0.5]]])
    misfit = printed.turn_misfits(headings, np.array([0.5]))[0]
    assert misfit[0] == pytest.approx(misfit[1])
    assert identify_by_turns(headings[0], np.array([0.5])) == 1


def test_ratios_do_not_know_directions() -> None:
    images = np.array([[0.0, 5.0], [1.0, 6.0], [3.0, 6.0 + 2.0j]])
    misfit = printed.ratio_misfits(images, (1.0, 2.0))
    assert misfit[0, 0, 0] == pytest.approx(misfit[1, 1, 1])


def test_headings_from_x_and_y_agree_where_the_way_is_right_and_have_no_solution_beyond_noise() -> None:
    own, first = 2.0 + 0.0j, np.array([0.0j], dtype=np.complex128)
    exact = printed.angle_misfits(first, _away([0.4, 2.0, -2.5]), own, 1.0)
    assert exact.max() < 1e-7
    noisy = np.array([2.01 + 0.0j])
    assert np.isinf(printed.angle_misfits(first, noisy, own, 1.0)).all()
    assert identify_by_way(first, noisy, own)[:2] == (0, 0)


def _away(angles: list[float]) -> ComplexArray:
    """Two units away, in some directions."""
    there: ComplexArray = np.asarray(2.0 * np.exp(1j * np.array(angles)), dtype=np.complex128)
    return there


def test_a_world_is_what_its_robots_did() -> None:
    world = simulate(Conditions(4, 3, sigma=1e-9, scale_sigma=0.0), np.random.default_rng(SEED))
    for robot in range(4):
        own, true = np.diff(world.own[:, robot]), np.diff(world.position[:, robot])
        np.testing.assert_allclose(np.abs(own), np.abs(true), atol=1e-9)
        places = [world.images[k][world.place_of(robot, k)] for k in range(3)]
        np.testing.assert_allclose(places, world.position[:, robot], atol=1e-6)
    assert np.abs(world.position.real).max() <= 15.0


def test_the_interval_of_a_rate_holds_it_and_narrows() -> None:
    few, many = Rate(9, 10), Rate(900, 1000)
    for rate in (few, many, Rate(0, 5), Rate(5, 5)):
        low, high = rate.interval
        assert 0.0 <= low <= rate.share <= high + 1e-12 <= 1.0 + 1e-9
    assert many.interval[1] - many.interval[0] < few.interval[1] - few.interval[0]
    assert few.interval == pytest.approx((0.596, 0.982), abs=0.001)  # as tables of Wilson's interval have it


def test_all_figures_are_measured() -> None:
    results = Results()
    turning.measure(results, 50, SEED)
    straight.measure(results, 20, SEED)
    figures = results.figures()
    assert figures["angular.n50.rotations4.success"] >= 0.9
    assert figures["linear.n2.success"] >= 0.8
    assert driving.heading_error(SEED) < 1e-9


def test_chains_find_most_robots_and_sure_answers_are_right() -> None:
    results = Results()
    reliability = calibration.measure(results, 15, SEED)
    assert results.rates["calibration.right_share_at_99"].share >= 0.95
    assert reliability.binned()[2].sum() == reliability.right.size
    rng, right = np.random.default_rng(SEED), 0
    for _ in range(4):
        conditions = Conditions(10, 4)
        world = simulate(conditions, rng)
        for robot in range(5):
            *_, chains = driving.followed(world, robot, conditions, ChainModel())
            right += int(np.argmax(chains.probabilities)) == world.place_of(robot, 3)
    assert right >= 17
