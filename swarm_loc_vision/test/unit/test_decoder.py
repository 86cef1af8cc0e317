"""Families of markers, and the decoder."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm_loc_estimator.swarm.new_swarm import FAMILY_IDS
from swarm_loc_vision.markers.decoder import (
    FALSE_READINGS,
    Dictionary,
    _clear_cells,
    _flatten,
    correctable_bits,
)
from swarm_loc_vision.markers.families import Family, draw_marker, families, family_named

BCH = family_named("artoolkit_bch_thin")


def distances(word: np.uint64, words: np.ndarray[tuple[int], np.dtype[np.uint64]]) -> list[int]:
    return [int(other).bit_count() for other in words ^ word]


def test_bch_words_are_nine_bits_apart_in_one_orientation() -> None:
    # the code is linear but for a mask, so the distances to one word are those to any
    for marker_id in (0, 100, 4095):
        apart = distances(BCH.words[marker_id], BCH.words)
        assert sorted(apart)[:2] == [0, 9]


def test_bch_words_hold_their_id_above_the_mask() -> None:
    ids = ((BCH.words ^ np.uint64(0x8F80B8750)) >> np.uint64(24)).astype(int)
    assert (ids == np.arange(4096)).all()


def dictionary_of_opencv(name: str) -> cv2.aruco.Dictionary:
    """A dictionary of the installed OpenCV; skips the test where that is too old for it."""
    aruco = getattr(cv2, "aruco", None)
    if not hasattr(aruco, name) or not hasattr(aruco, "ArucoDetector"):
        pytest.skip(f"OpenCV {cv2.__version__} does not have {name}")
    return cv2.aruco.getPredefinedDictionary(getattr(aruco, name))


OPENCV = pytest.mark.parametrize(
    ("name", "of_opencv", "quarters"),
    [
        ("aruco_mip_36h12", "DICT_ARUCO_MIP_36h12", 0),
        ("apriltag_36h11", "DICT_APRILTAG_36h11", 2),  # OpenCV turns these by half a turn
        ("apriltag_16h5", "DICT_APRILTAG_16h5", 2),
        ("apriltag_25h9", "DICT_APRILTAG_25h9", 2),
        *(
            (f"aruco_{n}x{n}_{count}", f"DICT_{n}X{n}_{count}", 0)
            for n in (4, 5, 6, 7)
            for count in (50, 100, 250, 1000)
        ),
    ],
)


@OPENCV
def test_words_are_those_of_opencv(name: str, of_opencv: str, quarters: int) -> None:
    dictionary, family = dictionary_of_opencv(of_opencv), family_named(name)
    assert len(family.words) == len(dictionary.bytesList)
    for marker_id in range(len(family.words)):
        drawn = np.rot90(dictionary.generateImageMarker(marker_id, family.side), quarters)
        assert (drawn == 255 * family.pattern(marker_id)).all()


@OPENCV
def test_opencv_reads_what_is_drawn(name: str, of_opencv: str, quarters: int) -> None:
    dictionary = dictionary_of_opencv(of_opencv)
    detector = cv2.aruco.ArucoDetector(dictionary)
    for marker_id in (0, 7, len(dictionary.bytesList) - 1):
        corners, ids, _ = detector.detectMarkers(draw_marker(family_named(name), marker_id, 8, 2))
        assert np.ravel(ids).tolist() == [marker_id]
        assert np.ravel(corners[0])[2 * quarters : 2 * quarters + 2] == pytest.approx([16, 16], abs=1)


@pytest.mark.parametrize(
    ("name", "count", "apart"),
    [
        ("aruco_mip_36h12", 250, 12),
        ("apriltag_36h11", 587, 11),
        ("apriltag_16h5", 30, 5),
        ("apriltag_25h9", 35, 9),
        ("apriltag_standard_41h12", 2115, 12),
    ],
)
def test_published_words_are_apart_in_all_orientations(name: str, count: int, apart: int) -> None:
    family = family_named(name)
    assert len(family.words) == count
    turned = np.concatenate([family.layout.rotated(family.words, quarters) for quarters in range(4)])
    some = family.words[:: max(1, count // 600)]
    assert min(sorted(distances(word, turned))[1] for word in some) == apart


TAGS = [
    (name, name.replace("apriltag_standard_", "tagStandard").replace("apriltag_", "tag"))
    for name in ("apriltag_16h5", "apriltag_25h9", "apriltag_36h11", "apriltag_standard_41h12")
]


@pytest.mark.parametrize(("name", "of_apriltag"), TAGS)
def test_the_library_of_apriltag_reads_what_is_drawn(name: str, of_apriltag: str) -> None:
    library = pytest.importorskip("pupil_apriltags")
    library.Detector.__del__ = lambda _: None  # it frees its families twice: the process would end in a crash
    detector, family = (
        library.Detector(families=of_apriltag, nthreads=1, quad_decimate=1.0),
        family_named(name),
    )
    for marker_id in (0, 7, len(family.words) - 1):
        (found,) = detector.detect(draw_marker(family, marker_id, 10, 2))
        assert found.tag_id == marker_id
        first, size = 10 * (2 + family.layout.outside), 10 * family.side
        upper_left = found.corners[3] - first
        assert upper_left == pytest.approx([0.0, 0.0], abs=1.0)
        assert found.corners[1] - first == pytest.approx([size, size], abs=1.0)


def test_a_surrounded_marker_is_a_white_border_in_a_black_ring_between_data() -> None:
    pattern = family_named("apriltag_standard_41h12").pattern(3)
    assert pattern.shape == (9, 9)
    assert not pattern[1:-1, [1, -2]].any()
    assert not pattern[[1, -2], 1:-1].any()
    assert pattern[2:-2, [2, -3]].all()
    assert pattern[[2, -3], 2:-2].all()
    outer = np.concatenate([pattern[0], pattern[-1], pattern[1:-1, 0], pattern[1:-1, -1]])
    assert 0 < outer.sum() < outer.size


def test_sizes_of_images_and_borders() -> None:
    thin, thick = family_named("artoolkit_bch_thin"), family_named("artoolkit_bch_thick")
    assert draw_marker(thin, 0, 5, 1).shape == (50, 50)
    assert draw_marker(thick, 0, 5, 0).shape == (60, 60)
    image = draw_marker(thick, 3, 1, 1)
    assert (image[0] == 255).all()
    assert (image[1:4, 1:-1] == 0).all()
    assert thin.side - 6 == 0.125 * 2 * thin.side
    assert thick.side - 6 == 0.25 * 2 * thick.side


def test_unknown_names_and_ids_are_one_sentence() -> None:
    with pytest.raises(ValueError, match="there is no marker family 'qr', only artoolkit_bch_thin"):
        family_named("qr")
    with pytest.raises(ValueError, match="aruco_mip_36h12 has ids 0 to 249, not 250"):
        families()["aruco_mip_36h12"].pattern(250)


def test_new_descriptions_know_the_families_and_their_ids() -> None:
    assert {name: len(family.words) for name, family in families().items()} == FAMILY_IDS


INK, PAPER = 40.0, 200.0
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
