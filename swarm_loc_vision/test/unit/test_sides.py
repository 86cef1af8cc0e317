"""Sides fitted to pixels: no bias wherever edges lie in the pixels, and as sure as they say."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import ndtr

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.common.camera import LENS_SIZE, Camera
from swarm_loc_vision.markers.decoder import Dictionary
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.lines import Corners, homographies, refine
from swarm_loc_vision.markers.sides import (
    NEW_CAMERA,
    REACH_PX,
    collect,
    empty_pixels,
    lens_shifts,
    refine_read,
)

FAMILY = family_named("artoolkit_bch_thin")
INK, PAPER = 30.0, 200.0
SIZE_PX = 96
STRAIGHT = np.zeros(LENS_SIZE)


def strips(marker_id: int) -> NDArray[np.uint8]:
    return Dictionary(FAMILY.layout, {FAMILY: np.array([marker_id])}).strips


def shares(begin: float, cell: float, blur: float, motion: float, cover: float = 0.0) -> FloatArray:
    """(SIZE_PX, 10) of each pixel's light that comes from each cell of a row and its margin: exact means."""
    edges = begin + cell * np.arange(-1, 10)
    edges[[0, -1]] = -1e3, 1e3  # the margin has no end
    edges[1] += cover * cell
    pixels = np.arange(SIZE_PX)[:, None]

    def integral(x: FloatArray) -> FloatArray:
        z = x / blur
        return np.asarray(blur * (z * ndtr(z) + np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)))

    moved = np.unique(motion * (np.arange(32) - 15.5) / 32.0)
    below = np.mean(
        [integral(pixels + 0.5 - edges - m) - integral(pixels - 0.5 - edges - m) for m in moved], 0
    )
    return np.asarray(below[:, :-1] - below[:, 1:])


def rendered(
    at: tuple[float, float],
    cell: float,
    blur: float = 0.5,
    motion: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
    cover: float = 0.0,
    gamma: float = 1.0,
) -> NDArray[np.uint8]:
    """An upright marker (id `seed`) on endless paper, moving to the right, a share of a cell covered left.

    The camera's output is light to the power of `gamma`.
    """
    cells = np.pad(FAMILY.pattern(seed), 1, constant_values=1) * (PAPER - INK) + INK
    light = shares(at[1], cell, blur, 0.0) @ cells @ shares(at[0], cell, blur, motion, cover).T
    light = 255.0 * (light / 255.0) ** gamma
    light += noise * np.random.default_rng(seed).standard_normal(light.shape)
    return np.asarray(np.clip(np.rint(light), 0, 255), np.uint8)


def corners_of(at: tuple[float, float], cell: float) -> FloatArray:
    side = cell * FAMILY.side
    return np.array(at) + side * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def fitted(
    image: NDArray[np.uint8], near: FloatArray, marker_id: int, displaced: FloatArray | None = None
) -> Corners:
    known = NEW_CAMERA.copy() if displaced is None else displaced
    return refine_read(image, STRAIGHT, near[None], strips(marker_id), FAMILY.layout.border, known)


@settings(max_examples=60)
@given(
    at=st.tuples(st.floats(20.0, 21.0), st.floats(20.0, 21.0)),
    cell=st.floats(4.0, 7.0),
    blur=st.floats(0.4, 0.9),
    marker_id=st.integers(0, 4095),
    shift=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
)
def test_edges_along_rows_and_columns_are_found_wherever_they_lie(
    at: tuple[float, float], cell: float, blur: float, marker_id: int, shift: tuple[float, float]
) -> None:
    true = corners_of(at, cell)
    found = fitted(rendered(at, cell, blur, seed=marker_id), true + np.array(shift), marker_id)
    assert found.corners[0] == pytest.approx(true, abs=0.02)


def nees_of(cell: float, motion: float = 0.0, gamma: float = 1.0) -> FloatArray:
    """(100,) of the corners of markers, each alone in a picture of one camera; 8 is ideal."""
    rng = np.random.default_rng(1)
    nees, displaced = [], NEW_CAMERA.copy()
    for marker_id in range(100):
        at = tuple(rng.uniform(20.0, 21.0, 2).tolist())
        true = corners_of(at, cell)
        near = true + rng.normal(0.0, 0.1, (4, 2))
        image = rendered(at, cell, 0.5, motion, 2.5, marker_id, gamma=gamma)
        found = fitted(image, near, marker_id, displaced)
        error = (found.corners[0] - true).ravel()
        nees.append(error @ np.linalg.solve(found.covariance[0], error))
    return np.array(nees)


@pytest.mark.parametrize(("cell", "motion"), [(2.6, 0.0), (6.0, 0.0), (6.0, 3.0), (6.0, 6.0)])
def test_corners_are_as_sure_as_they_say(cell: float, motion: float) -> None:
    nees = nees_of(cell, motion)
    # 8 were the noise all that there is; what it leaves out is there for worse images than these
    assert 1.0 < np.mean(nees) < 9.0
    assert np.max(nees) < 40.0


@pytest.mark.parametrize("gamma", [0.45, 0.6, 2.2])
def test_corners_that_a_tone_curve_displaces_are_as_sure_as_they_say(gamma: float) -> None:
    nees = nees_of(6.0, gamma=gamma)
    assert 0.5 < np.mean(nees) < 9.0
    assert np.max(nees) < 20.1  # the 99 % bound


def test_a_picture_and_those_before_tell_how_a_camera_displaces_edges() -> None:
    at, cell = (20.3, 20.6), 6.0
    straight, bent = (rendered(at, cell, noise=1.0, seed=100, gamma=gamma) for gamma in (1.0, 0.45))

    def sigma(image: NDArray[np.uint8], count: int, displaced: FloatArray) -> float:
        quads = np.tile(corners_of(at, cell), (count, 1, 1))
        found = refine_read(image, STRAIGHT, quads, np.repeat(strips(100), count, axis=0), 1, displaced)
        return math.sqrt(np.diag(found.covariance[0]).mean())

    new, known = NEW_CAMERA.copy(), NEW_CAMERA.copy()
    assert 0.02 < sigma(straight, 1, new) < 0.05  # alone a marker hardly shows that edges are straight
    assert sigma(bent, 20, known) > 0.1
    assert sigma(straight, 1, known) > 0.1
    later = [sigma(straight, 100, known) for _ in range(10)]
    assert later[-1] < 0.02  # another tone curve: what was long ago is forgotten


def test_motion_makes_the_sides_across_it_less_sure() -> None:
    at = (20.3, 20.6)
    linear = np.array([0.0, 300.0])  # many displacements, all of them zero
    still, moving = (
        np.diag(fitted(rendered(at, 6.0, motion=m, noise=1.0), corners_of(at, 6.0), 0, linear).covariance[0])
        for m in (0.0, 6.0)
    )
    assert (moving[::2] > 3.0 * still[::2]).all()
    # light of the cells, which motion carries along the other sides, displaces these, too
    assert (moving[1::2] < moving[::2]).all()


@pytest.mark.parametrize("cover", [0.1, 0.3, 0.6])
def test_a_covered_side_is_less_sure(cover: float) -> None:
    at, cell, marker_id = (20.3, 20.6), 6.0, 100
    assert strips(marker_id)[0, 3].sum() >= 3
    true = corners_of(at, cell)
    free = fitted(rendered(at, cell, noise=1.0, seed=marker_id), true, marker_id)
    seen = true + cover * cell * np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    covered = fitted(rendered(at, cell, noise=1.0, seed=marker_id, cover=cover), seen, marker_id)
    left = [0, 3]
    error = np.abs(covered.corners[0] - true)[left, 0]
    sigma, usual = (np.sqrt(np.diag(found.covariance[0]))[[0, 6]] for found in (covered, free))
    assert error.min() > 0.5 * cover * cell
    assert (error < 4.0 * sigma).all()
    assert (sigma > 10.0 * usual).all()


def test_what_cannot_be_fitted_keeps_what_the_profiles_say() -> None:
    at, cell, marker_id = (20.3, 20.3), 5.0, 100
    image = rendered(at, cell, seed=marker_id)
    far_off = corners_of(at, cell) + np.array([2.0, 0.0])  # too far for the fit, not for the profiles
    found = fitted(image, far_off, marker_id)
    assert found.contrast[0] > 0.0
    by_profiles = refine(image, STRAIGHT, far_off[None], FAMILY.side)
    assert (found.corners == by_profiles.corners).all()
    assert (found.contrast == by_profiles.contrast).all()
    added = found.covariance[0] - by_profiles.covariance[0]  # what any camera may do
    assert added == pytest.approx(added[0, 0] * np.eye(8))
    assert 0.05 < math.sqrt(added[0, 0]) < 0.2


def test_where_there_is_no_marker_there_are_no_corners() -> None:
    image = np.full((SIZE_PX, SIZE_PX), 120, np.uint8)
    assert fitted(image, corners_of((20.0, 20.0), 5.0), 0).contrast[0] == 0.0


@settings(max_examples=30)
@given(k1=st.floats(-0.3, 0.3), place=st.tuples(st.floats(30.0, 900.0), st.floats(30.0, 600.0)))
def test_the_lens_is_undone_at_every_pixel_next_to_a_side(k1: float, place: tuple[float, float]) -> None:
    camera = Camera(1280, 960, 1000.0, 1000.0, 639.5, 479.5, (k1, 0.05, 1e-3, -1e-3, 0.0))
    quad = camera.to_ideal(
        np.array(place) + 60.0 * np.array([[0.0, 0.1], [1.0, 0.0], [0.9, 1.0], [0.1, 0.8]])
    )
    pixels, image = empty_pixels(8), np.zeros((960, 1280), np.uint8)
    plane, shifts = homographies(quad[None])[0], lens_shifts(camera.lens, quad[None])[0]
    collect(image, quad, plane, shifts, 1, REACH_PX, pixels)
    count = int(pixels.first[4])
    assert count > 500
    frame = np.repeat(pixels.frames, np.diff(pixels.first), axis=0)
    along, outside = pixels.along[:count, None], pixels.outside[:count, None]
    normal = np.column_stack([frame[:, 3], -frame[:, 2]])
    raw = camera.to_raw(frame[:, :2] + along * frame[:, 2:4] + outside * normal)
    error = np.abs(raw - np.rint(raw)).max(axis=1)
    assert error[np.abs(outside[:, 0]) < 3.0].max() < 0.02
