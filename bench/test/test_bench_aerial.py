"""The benchmark's worlds, rates and figures are sound."""

import numpy as np
import pytest

from bench.aerial import chains as statistics
from bench.aerial.chains import Conditions, Rate, Results, simulate
from swarm_loc_estimator.identification.chain import ChainModel

SEED = 77


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


def test_chains_find_most_robots_and_sure_answers_are_right() -> None:
    results = Results()
    reliability = statistics.measure_calibration(results, 15, SEED)
    assert results.rates["calibration.right_share_at_99"].share >= 0.95
    assert reliability.binned()[2].sum() == reliability.right.size
    rng, right = np.random.default_rng(SEED), 0
    for _ in range(4):
        conditions = Conditions(10, 4)
        world = simulate(conditions, rng)
        for robot in range(5):
            *_, chains = statistics.followed(world, robot, conditions, ChainModel())
            right += int(np.argmax(chains.probabilities)) == world.place_of(robot, 3)
    assert right >= 17
