"""Scans: lines that beams tell, the ratio of turns, beams against lines with their Jacobians."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping_world import MAX_RANGE, SIGMA, inverse_distances

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping.matching import (
    CAUCHY,
    FIT,
    Lattice,
    Scans,
    accumulate,
    agreement,
    beam_residual,
    match_pairs,
    search_offsets,
)
from swarm_loc_estimator.mapping.scans import (
    BINS,
    FREE,
    LINE,
    MAX_BEAMS,
    Beams,
    Scan,
    fit_lines,
    no_beams,
    no_lines,
    set_beams,
    turn_ratio,
)

TURN = np.linspace(0.0, 2.1 * math.pi, 400)
POSES = np.array([[1.5, 1.2, 0.4], [1.9, 1.4, -2.0]])


def scans(noise: np.random.Generator | None = None, ratio: float = 1.0) -> Scans:
    """Two stops in the room."""
    beams, lines = no_beams(2), no_lines(2)
    beams.reach[:] = MAX_RANGE
    for stop, pose in enumerate(POSES):
        beams.sigma[stop] = SIGMA
        set_beams(beams, stop, Scan(TURN, inverse_distances(pose, pose[2] + ratio * TURN, noise)))
        fit_lines(stop, ratio, MAX_RANGE, beams, lines)
    return Scans(np.column_stack([POSES, [ratio, ratio]]), beams, lines)


def test_a_line_is_normal_over_distance() -> None:
    found = scans()
    for degree, normal, distance in ((0, 0.0, 1.9), (180, math.pi, 1.5), (270, 1.5 * math.pi, 1.2)):
        m = round(degree - math.degrees(POSES[0, 2])) % BINS
        assert found.lines.kind[0, m] == LINE
        expected = np.array([math.cos(normal - POSES[0, 2]), math.sin(normal - POSES[0, 2])]) / distance
        assert np.allclose([found.lines.a[0, m], found.lines.b[0, m]], expected, atol=1e-9)


def test_beams_of_more_than_one_stop_are_thinned_and_nothing_is_free() -> None:
    beams, lines = no_beams(1), no_lines(1)
    turn = np.linspace(0.0, 2.0 * math.pi, 3 * MAX_BEAMS)
    set_beams(beams, 0, Scan(turn, np.zeros(len(turn))))
    beams.sigma[0] = SIGMA
    fit_lines(0, 1.0, MAX_RANGE, beams, lines)
    assert beams.counts[0] == MAX_BEAMS
    assert (lines.kind[0] == FREE).all()


@pytest.mark.parametrize("slip", [0.0, 0.02, 0.05])
def test_two_turns_tell_the_ratio(slip: float) -> None:
    rng = np.random.default_rng(5)
    turn = np.linspace(0.0, 4.5 * math.pi, 1600)
    inverse = inverse_distances(POSES[0], (1.0 - slip) * turn, rng)
    assert turn_ratio(turn, inverse, SIGMA) == pytest.approx(1.0 - slip, abs=0.0025)
    assert turn_ratio(-turn, inverse, SIGMA) == pytest.approx(1.0 - slip, abs=0.0025)


def test_one_turn_tells_no_ratio() -> None:
    assert math.isnan(turn_ratio(TURN[:300], np.ones(300), SIGMA))


def test_beams_fit_the_lines_of_another_stop_where_both_are_true() -> None:
    found = scans()
    matched, tried, loss = agreement(found, 0, 1, 0.0, 1)
    assert matched > 0.8 * tried > 150
    assert loss < 0.05 * matched  # lines across a corner are a compromise


def beam_at(found: Scans, change: FloatArray, beam: int) -> tuple[int, float, float, float]:
    """Fate of a beam, its line, its residual and variance, after a change of both stops (8,)."""
    states = found.states + change.reshape(2, 4)
    fate, residual, variance, _, _, _, line = beam_residual(found._replace(states=states), 0, beam, 1, 10.0)
    return fate, line, residual, variance


@settings(max_examples=25, deadline=None)
@given(change=st.lists(st.floats(-0.02, 0.02), min_size=8, max_size=8), beam=st.integers(0, len(TURN) - 1))
def test_jacobians_are_those_of_finite_differences(change: list[float], beam: int) -> None:
    found, here, step = scans(), np.array(change), 1e-6
    fate, line, residual, variance = beam_at(found, here, beam)
    sides = [[beam_at(found, here + s * step * unit, beam) for s in (1.0, -1.0)] for unit in np.eye(8)]
    if fate != FIT or any(side[:2] != (fate, line) for pair in sides for side in pair):
        return  # it meets no line, or another one so near
    numeric = np.array([(below[2] - above[2]) / (2.0 * step) for above, below in sides])
    numeric[7] = numeric[6] * found.lines.turn[1, int(line)]  # a line turns with its beams

    one = found._replace(states=found.states + here.reshape(2, 4), beams=only(found, beam))
    H, g = np.zeros((8, 8)), np.zeros(8)
    assert accumulate(one, 0, 1, 10.0, 1, H, g)[:2] == (1, 1)
    weight = 1.0 / (variance * (1.0 + residual**2 / variance / CAUCHY))
    assert np.allclose(H, weight * np.outer(numeric, numeric), atol=1e-4 * np.abs(H).max())
    assert np.allclose(g, weight * numeric * residual, atol=1e-4 * np.abs(g).max())


def only(found: Scans, beam: int) -> Beams:
    """Beams of which the first stop has one."""
    beams = no_beams(2)
    chosen = slice(beam, beam + 1)
    set_beams(beams, 0, Scan(found.beams.turn[0, chosen], found.beams.inverse[0, chosen]))
    beams.sigma[:], beams.reach[:] = SIGMA, MAX_RANGE
    return beams


def in_corridor(rng: np.random.Generator) -> Scans:
    """Two stops between two endless walls along x, 2.6 m apart."""
    beams, lines = no_beams(2), no_lines(2)
    beams.reach[:] = MAX_RANGE
    for stop, pose in enumerate(POSES):
        sine = np.sin(pose[2] + TURN)
        distance = np.where(sine > 0.0, 2.6 - pose[1], pose[1]) / np.maximum(np.abs(sine), 1e-9)
        seen = distance < MAX_RANGE
        beams.sigma[stop] = SIGMA
        inverse = seen / distance + seen * SIGMA * rng.standard_normal(len(TURN))
        set_beams(beams, stop, Scan(TURN, inverse))
        fit_lines(stop, 1.0, MAX_RANGE, beams, lines)
    return Scans(np.column_stack([POSES, [1.0, 1.0]]), beams, lines)


@pytest.mark.parametrize("seed", range(5))
def test_walls_along_a_corridor_tell_nothing_of_the_way_along_it(seed: int) -> None:
    """Errors of their normals imitate information, as of a wall across."""
    rng = np.random.default_rng(seed)
    pairs, places = np.array([[0, 1], [1, 0]]), np.array([0, 0])
    corridor, room = (
        match_pairs(found, pairs, places, np.ones(2), 0.03, 1)[0].sum(axis=0)
        for found in (in_corridor(rng), scans(rng))
    )
    along, across = np.linalg.eigvalsh(corridor[:2, :2])
    assert along < 1e-6 * across
    assert across > 1e3
    assert np.linalg.eigvalsh(room[:2, :2])[0] > 1e3


def test_search_finds_an_offset_and_no_second_place() -> None:
    found = scans(np.random.default_rng(3))
    moved = found.states.copy()
    moved[0, :3] += [0.12, -0.06, math.radians(3.0)]
    lattice = Lattice(0.3, 0.06, math.radians(6.0), math.radians(1.5))
    best = search_offsets(found._replace(states=moved), np.array([0]), np.array([1]), lattice)
    assert np.allclose(best.offset, [-0.12, 0.06, -math.radians(3.0)], atol=0.031)
    assert best.score > 0.5 > 0.9 * best.other
