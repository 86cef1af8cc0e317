"""Suspended fixes are used again when they agree."""

import pytest

from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.sources import assess, fixes_of
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.swarm import Landmark, Robot

PERIOD_NS, LIMIT = 100_000_000, 10.0


@pytest.mark.parametrize("sees_landmark", [False, True])
def test_a_robot_alone_with_its_fixes_errs_by_the_same_until_they_are_used(sees_landmark: bool) -> None:
    state = SwarmState(ParameterTable.of([Robot("robot")], [Landmark(1)]))
    belief = state.arrays()
    fixes, scores = fixes_of(belief, 0), list[float]()
    belief.sources.score[fixes] = 2.0 * LIMIT
    for tick in range(100):
        one = Measurements.empty(1)
        one.stamp_ns[:], one.model[:], one.gate[:] = tick * PERIOD_NS, CARTESIAN, 20.0
        if sees_landmark:
            one.observer[:], one.target[:], one.landmark[:] = 0, NOBODY, 0
            assess(one, 0, belief, LIMIT, 0.0, (0.0, 0.0), 1.0, False)
        one.observer[:], one.target[:], one.landmark[:] = NOBODY, 0, NOBODY
        assess(one, 0, belief, LIMIT, 0.89, (0.8, 0.5), 1.0, False)  # an error of less than a sigma
        scores.append(float(belief.sources.score[fixes]))
    # from there on, fixes that are not used locate the robot anew
    assert (min(scores) < 1.5 * LIMIT) != sees_landmark
