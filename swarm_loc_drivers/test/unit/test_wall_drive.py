"""A laser that was calibrated by one simulated drive at a wall reads another drive as well as it says."""

import numpy as np
import pytest

from swarm_loc_drivers.sim.pushbot.optics import assembled
from swarm_loc_drivers.sim.pushbot.wall_drive import WallDriveSettings, drive_at_wall
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.laser.calibration import RowBias, fit_hyperbola

HALF_A_SECOND = 25  # Windows of the tracker


@pytest.mark.parametrize("seed", range(6))
def test_errors_of_rows_do_not_last(seed: int) -> None:
    """What is left of them averages out over half a second; without the bias more lasts."""
    built = assembled(np.random.default_rng(seed))
    first, _ = drive_at_wall(np.random.default_rng([seed, 1]), built, WallDriveSettings(speed=0.25))
    far_away = WallDriveSettings(start=2.4, stop=0.8)
    other, depths = drive_at_wall(np.random.default_rng([seed, 2]), built, far_away)
    found = fit_hyperbola(first)
    far = (depths > 0.8) & (depths < 2.3)
    rows, true_rows = other.rows[far], found.row_at_infinity + found.focal_base / depths[far]
    left = rows - found.row_bias.at_each(rows) - true_rows
    assert found.row_bias != RowBias()
    assert lasting(left) < 0.6 * lasting(rows - true_rows)
    assert lasting(left) < 0.03
    assert 0.5 < np.std(left) / found.row_sigma < 1.5


def lasting(errors: FloatArray) -> float:
    """Standard deviation of errors averaged over half a second; one that all share is the hyperbola's."""
    means = np.convolve(errors, np.full(HALF_A_SECOND, 1.0 / HALF_A_SECOND), mode="valid")
    return float(np.std(means))
