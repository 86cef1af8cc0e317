"""Ids from cells: every id in every rotation, and no id from anything else."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm_loc_vision.markers.decoder import (
    FALSE_READINGS,
    Dictionary,
    _clear_cells,
    _flatten,
    correctable_bits,
)
from swarm_loc_vision.markers.families import Family, family_named

INK, PAPER = 40.0, 200.0
BCH = family_named("artoolkit_bch_thin")
SIX = BCH.layout
ALL_BCH = Dictionary(SIX, {BCH: np.arange(4096)})


def cells_of(patterns: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Brightness of cells (N, n + 4, n + 4) of patterns (N, n, n)."""
    grid = patterns.shape[1] + 4
    cells = np.full((len(patterns), grid, grid), PAPER)
    cells[:, 1:-1, 1:-1] = INK
    cells[:, 2:-2, 2:-2] = np.where(patterns, PAPER, INK)
    return cells


def bits_apart(family: Family, ids: NDArray[np.int64], used: NDArray[np.int64]) -> NDArray[np.float64]:
    """Bits by which the nearest other reading, an id in use or the same one turned, differs from each id."""
    turned = np.concatenate([family.layout.rotated(family.words[used], quarters) for quarters in range(4)])
    signs, own = (
        2.0 * family.layout.inner(words).reshape(len(words), -1) - 1.0
        for words in (turned, family.words[ids])
    )
    apart = 0.5 * (family.layout.bits - own @ signs.T)
    return np.asarray(np.sort(apart, axis=1)[:, 1])


def patterns_of(family: Family, ids: NDArray[np.int64]) -> NDArray[np.uint8]:
    border = family.layout.border
    return np.stack([family.pattern(int(i))[border:-border, border:-border] for i in ids])


@pytest.mark.parametrize("quarters", range(4))
def test_all_bch_ids_are_read_in_every_rotation(quarters: int) -> None:
    ids = np.arange(4096)
    readings = ALL_BCH.read(cells_of(np.rot90(patterns_of(BCH, ids), quarters, (1, 2))), 10.0)
    assert (ALL_BCH.ids[readings.word] == ids).all()
    assert (readings.quarters == quarters).all()
    assert (readings.errors == 0.0).all()
    assert 0.5 < readings.margin.min() <= 1.0  # two ids come as close as two bits when turned
    some = ids[::32]
    assert (readings.margin[some] <= 0.5 * bits_apart(BCH, some, ids)).all()


def test_uneven_light_and_noise_do_not_matter() -> None:
    rng = np.random.default_rng(0)
    ids = rng.integers(0, 4096, 300)
    cells = cells_of(patterns_of(BCH, ids))
    row, column = np.mgrid[: SIX.grid, : SIX.grid] / SIX.grid
    lit = cells * 0.4 * (1.0 + row + 0.5 * column) + rng.normal(0.0, 4.0, cells.shape)
    readings = ALL_BCH.read(lit, 10.0)
    assert (ALL_BCH.ids[readings.word] == ids).all()


@given(st.integers(0, 249), st.sets(st.integers(0, SIX.bits - 1), max_size=8))
@example(0, {7})
def test_flipped_bits_are_corrected_as_far_as_is_safe(marker_id: int, flipped: set[int]) -> None:
    family = family_named("aruco_mip_36h12")
    used = np.arange(20)
    dictionary = Dictionary(family.layout, {family: used})
    marker_id %= 20
    pattern = patterns_of(family, np.array([marker_id]))
    pattern.reshape(-1)[sorted(flipped)] ^= 1
    cells = cells_of(pattern)
    readings = dictionary.read(cells, 10.0)
    if len(flipped) <= dictionary.correctable:
        assert dictionary.ids[readings.word[0]] == marker_id
        # least clear is a cell like its neighbours; counted through for all that these ids and bits can be
        assert 0.42 * len(flipped) <= readings.errors[0] <= len(flipped)
        assert readings.margin[0] > 0.25 * (12 - 2 * len(flipped))
        assert readings.margin[0] <= 0.5 * (bits_apart(family, np.array([marker_id]), used) + len(flipped))
    if readings.word[0] >= 0:
        flat, clear = np.empty((SIX.area, SIX.area)), np.empty(SIX.bits)
        light = _flatten(cells[0], dictionary._places, flat, np.empty(3))
        _clear_cells(flat, light, 0.5, dictionary._places, clear)
        read = np.rot90(patterns_of(family, dictionary.ids[readings.word])[0], readings.quarters[0])
        weighed = np.abs(clear)[read.ravel() != pattern.ravel()].sum()
        assert readings.errors[0] == pytest.approx(weighed)
        assert weighed <= dictionary.correctable


def test_of_a_single_id_the_margin_is_to_itself_turned() -> None:
    family, used = family_named("aruco_mip_36h12"), np.array([7])
    readings = Dictionary(family.layout, {family: used}).read(cells_of(patterns_of(family, used)), 10.0)
    assert 0.25 * bits_apart(family, used, used) < readings.margin <= 0.5 * bits_apart(family, used, used)


def test_fewer_ids_in_use_let_more_bits_be_corrected() -> None:
    assert [correctable_bits(n, SIX.bits) for n in (1, 20, 250, 4096)] == sorted(
        (correctable_bits(n, SIX.bits) for n in (1, 20, 250, 4096)), reverse=True
    )
    for words in (1, 20, 250, 4096):
        near = sum(math.comb(SIX.bits, k) for k in range(correctable_bits(words, SIX.bits) + 1))
        assert 4 * words * near / 2**SIX.bits <= FALSE_READINGS


@pytest.mark.parametrize(("name", "count"), [("artoolkit_bch_thin", 4096), ("aruco_mip_36h12", 250)])
def test_random_squares_are_not_read(name: str, count: int) -> None:
    rng = np.random.default_rng(1)
    dictionary = Dictionary(SIX, {family_named(name): np.arange(count)})
    patterns = rng.integers(0, 2, (20_000, 6, 6)).astype(np.uint8)
    readings = dictionary.read(cells_of(patterns), 10.0)
    assert (readings.word >= 0).sum() <= 2  # 0.2 are expected


def test_other_ids_than_those_in_use_are_not_read() -> None:
    dictionary = Dictionary(SIX, {BCH: np.array([5, 9])})
    readings = dictionary.read(cells_of(patterns_of(BCH, np.array([5, 6, 9, 4000]))), 10.0)
    assert [dictionary.ids[w] if w >= 0 else None for w in readings.word] == [5, None, 9, None]


def test_no_contrast_or_a_light_border_is_no_marker() -> None:
    cells = cells_of(patterns_of(BCH, np.array([7, 7])))
    cells[0] = 100.0 + 0.02 * cells[0]
    cells[1, 1, 1:-1] = PAPER
    readings = ALL_BCH.read(cells, 10.0)
    assert (readings.word == -1).all()


@pytest.mark.parametrize(
    ("name", "correctable", "scarce"),
    [
        ("apriltag_16h5", 0, True),
        ("apriltag_25h9", 0, False),
        ("apriltag_standard_41h12", 2, False),
        ("aruco_4x4_50", 0, True),
        ("aruco_5x5_250", 0, True),
        ("aruco_7x7_1000", 4, False),
    ],
)
def test_words_of_few_bits_may_not_differ(name: str, correctable: int, scarce: bool) -> None:
    family = family_named(name)
    dictionary = Dictionary(family.layout, {family: np.arange(len(family.words))})
    assert (dictionary.correctable, dictionary.scarce) == (correctable, scarce)


def test_where_words_are_scarce_all_that_is_known_must_be_clear() -> None:
    family = family_named("apriltag_16h5")
    dictionary = Dictionary(family.layout, {family: np.arange(30)})
    cells = np.repeat(cells_of(patterns_of(family, np.array([7]))), 5, axis=0)
    grey = 0.5 * (INK + PAPER)
    cells[1, 3, 3] += 0.8 * (grey - cells[1, 3, 3])  # a data cell that is neither dark nor light
    cells[2, 1, 2] = PAPER  # the border
    cells[3, 0, 4] = grey  # the margin
    cells[4] = 0.5 * cells[4] + 20.0  # darker as a whole
    readings = dictionary.read(cells, 10.0)
    assert (readings.word >= 0).tolist() == [True, False, False, False, True]
    assert (dictionary.ids[readings.word[[0, 4]]] == 7).all()
