"""Hidden noise: it widens innovations, is written into the description, and has a limit."""

from __future__ import annotations

import numpy as np
import pytest

from swarm_loc_estimator.filter.integrity import (
    MAX_UNITS,
    add_noise_inflation,
    inflate_noise,
    stamp_variance,
    with_noise_inflation,
)
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import POLAR
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot

ROBOTS = (Robot("one", camera=CameraMount()), Robot("two", camera=CameraMount()))


def measurements() -> Measurements:
    """Of the two robots and of nobody, the second a range and a bearing."""
    rows = Measurements.empty(3)
    rows.observer[:], rows.model[1] = [0, 1, NOBODY], POLAR
    return rows


def test_each_unit_adds_noise_up_to_a_limit_and_to_its_observer_only() -> None:
    belief, columns = SwarmState(ParameterTable.of(ROBOTS)).arrays(), measurements()
    variances = []
    while inflate_noise(belief, 1):
        noise = [np.zeros((3, 3)) for _ in range(3)]
        for k in range(3):
            add_noise_inflation(columns, k, belief, noise[k])
        assert (noise[0] == 0.0).all()
        assert (noise[2] == 0.0).all()
        assert stamp_variance(columns, 0, belief) == stamp_variance(columns, 2, belief) == 0.0
        variances.append([*np.diag(noise[1]), stamp_variance(columns, 1, belief)])
    assert len(variances) == MAX_UNITS
    squares = np.arange(1.0, MAX_UNITS + 1.0) ** 2
    np.testing.assert_allclose(variances, np.outer(squares, variances[0]))
    assert variances[0][1] > variances[0][0]  # a bearing: radians


def test_a_description_that_has_proved_wrong_makes_all_noise_doubtful_but_lowers_none() -> None:
    state = SwarmState(ParameterTable.of(ROBOTS))
    state.integrity.noise_inflation[0] = 4.0
    state.augment_all(np.zeros((2, 3)))
    assert state.integrity.noise_inflation[0] == 4.0
    assert 0.0 < state.integrity.noise_inflation[1] < 4.0


def test_the_noise_that_was_found_is_written_into_the_description() -> None:
    sensor = SensorModel(forward_sigma=0.003, residual_position_sigma=0.003, time_sigma_s=0.04)
    found = with_noise_inflation(sensor, 1.0)
    assert found.forward_sigma == found.residual_position_sigma == pytest.approx(0.005)
    assert found.time_sigma_s == pytest.approx(0.05)
    assert with_noise_inflation(sensor, 0.0) == sensor
