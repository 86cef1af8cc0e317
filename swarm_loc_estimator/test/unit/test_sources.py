"""Laws of the record of sources: poses that rest on suspect sources, and radios that deviate once."""

import numpy as np
import pytest

from swarm_loc_estimator.filter.sources import (
    AGREES,
    DEVIATES,
    SUSPECT,
    WELL_CONFIRMED,
    is_contradicted,
    widen_suspect_covariance,
)
from swarm_loc_estimator.filter.state import SourceArrays, SwarmState, new_sources
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.swarm import Robot

NOW_NS, LONG_NS = 10**12, 10**9
ROBOTS, LANDMARKS = 2, 3


def confirmed() -> SourceArrays:
    """Two robots whose poses are confirmed; the first one has just seen the first landmark."""
    state = new_sources(ROBOTS, LANDMARKS)
    state.confirmations[:], state.measured_ns[:] = WELL_CONFIRMED, NOW_NS
    state.source[0, 0], state.seen_ns[0, 0] = ROBOTS, NOW_NS
    return state


def is_widened(state: SourceArrays) -> bool:
    """Whether the covariance of the first robot is widened."""
    covariance = np.zeros((3, 3))
    widen_suspect_covariance(state, 0, covariance)
    return bool(covariance.any())


def test_a_confirmed_pose_is_widened_while_it_measures_a_suspect_source() -> None:
    state = confirmed()
    assert not is_widened(state)
    state.score[ROBOTS] = SUSPECT
    assert is_widened(state)
    state.seen_ns[0, 0] -= LONG_NS
    assert not is_widened(state)


def test_a_suspect_source_that_a_robot_does_not_measure_does_not_concern_it() -> None:
    state = confirmed()
    state.score[ROBOTS + 1] = SUSPECT
    assert not is_widened(state)


def test_a_pose_that_is_little_confirmed_is_widened() -> None:
    state = confirmed()
    state.confirmations[0] = 0.5 * WELL_CONFIRMED
    assert is_widened(state)


@pytest.mark.parametrize(("evidence", "contradicted"), [(2.0, False), (4.0, True)])
def test_radios_deny_a_pose_when_half_of_them_have_deviated_more_than_once(
    evidence: float, contradicted: bool
) -> None:
    state = SwarmState(ParameterTable.of([Robot("a"), Robot("b")]))
    links = state.sources
    for place, finding in enumerate((DEVIATES, AGREES)):
        links.source[0, place], links.seen_ns[0, place] = links.score.size + place, NOW_NS
        links.finding[0, place], links.evidence[0, place] = finding, evidence * (finding == DEVIATES)
    assert is_contradicted(state.arrays(), 0) == contradicted
